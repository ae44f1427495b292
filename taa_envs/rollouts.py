"""Many replays of one scene at once: the same hand along different paths, on all cores.

Each is what :func:`taa_envs.replay.simulate` would make of its path (a test compares them); the object's joint is as
passive here as there.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from taa_envs.controls import HOLD
from taa_envs.hands.rig import JointedController
from taa_envs.rows import BatchRows, hand_rows
from taa_envs.scene import Scene, decode_touch, touch_columns
from taa_envs.simulation import HandPath

LOOK = 20  # steps between two looks at the clock


class OutOfTime(Exception):
    """The replays were not done when their time was up."""


@dataclass(frozen=True)
class Rollout:
    """One replay, sampled at the reference's frames up to the demonstration's end and once more after the hold.

    Attributes:
        q: (F + 1,) rad or m.  contact: (F,) bool, the hand pushed between a frame and the next.
        penetration: m, the deepest overlap.  diverged: the simulation became unstable; q is then worthless.
    """

    q: np.ndarray
    contact: np.ndarray
    penetration: float
    diverged: bool


class _Row:
    """One of many simulations, as much of ``MjData`` as a controller writes and reads."""

    def __init__(self, rows: BatchRows, row: int) -> None:
        bind = rows.batch.bind
        self.qpos, self.qvel, self.ctrl = rows.qpos[row], rows.qvel[row], rows.ctrl[row]
        self.mocap_pos, self.mocap_quat = bind("mocap_pos")[row], bind("mocap_quat")[row]
        self.time = 0.0


class _JointedRows:
    """A hand with joints in many simulations: each is retargeted by itself, all are stepped together."""

    def __init__(self, controller: JointedController, rows: BatchRows) -> None:
        self._controller, self._rows = controller, rows
        self._data: list[Any] = [_Row(rows, k) for k in range(rows.n)]

    def targets(self, joints: np.ndarray) -> np.ndarray:
        return joints

    def place(self, ids: np.ndarray, joints: np.ndarray) -> None:
        for k in ids:
            self._controller.place(self._data[k], joints[k])

    def control(self, target: np.ndarray) -> None:
        for data, joints, now in zip(self._data, target, self._rows.time, strict=True):
            data.time = float(now)
            self._controller.control(data, joints)


class Rollouts:
    """A scene, and room for ``n`` simulations of it.

    Args:
        scene: with a hand.
        n: how many run side by side; more paths than that are run in turns.
        threads: 0 for one a core.
    """

    def __init__(self, scene: Scene, n: int = 24, threads: int = 0) -> None:
        self.scene, self.n = scene, n
        self._rows = BatchRows(scene, n, threads)
        jointed = isinstance(scene.hand, JointedController)
        self._hand = _JointedRows(scene.hand, self._rows) if jointed else hand_rows(scene, self._rows)

    def run(self, paths: Sequence[HandPath], deadline: float = np.inf) -> list[Rollout]:
        """Replay every path from the reference's first frame to the demonstration's end plus :data:`HOLD`.

        Raises:
            OutOfTime: ``time.monotonic()`` passed the deadline, s, before all were done.
        """
        out: list[Rollout] = []
        for first in range(0, len(paths), self.n):
            some = list(paths[first:first + self.n])
            out += self._together([*some, *[some[-1]] * (self.n - len(some))], deadline)[:len(some)]
        return out

    def _together(self, paths: list[HandPath], deadline: float) -> list[Rollout]:
        scene, rows, hand, n = self.scene, self._rows, self._hand, self.n
        asset, model = scene.asset, scene.model
        reference, end = asset.reference, asset.demo["demo_end_frame"]
        dt, lead = model.opt.timestep, scene.hand.lead
        start, stop = float(reference.time[0]), asset.end_time + HOLD
        everyone = np.arange(n)
        rows.clear(everyone)
        scene.put(rows.qpos, asset.demo["q_start"])
        scene.put_further(rows.qpos, start)
        hand.place(everyone, np.stack([path.at(start) for path in paths]))
        rows.forward(everyone)
        edges = np.append(reference.time[:end + 1], stop)
        columns = touch_columns(scene)
        q, contact = np.empty((n, end + 2)), np.zeros((n, end + 1), bool)
        depth, bad = np.zeros(n), np.zeros(n, bool)
        q[:, 0], frame, clock = rows.qpos[:, scene.qpos], 0, rows.time
        for i in range(int(np.ceil((stop - start) / dt))):
            if i % LOOK == 0 and time.monotonic() > deadline:
                raise OutOfTime
            t = start + i * dt
            while t >= edges[frame + 1] and frame < end:
                frame += 1
                q[:, frame] = rows.qpos[:, scene.qpos]
            hand.control(hand.targets(np.stack([path.at(t + lead) for path in paths])))
            rows.step(None)
            force, _, _, overlap = decode_touch(columns, rows.sensordata)
            contact[:, frame] |= (force * force).sum(-1) > 0
            np.maximum(depth, overlap, out=depth)
            now = rows.time
            bad |= now < clock + 0.5 * dt  # MuJoCo begins anew, its clock at zero, where a state is not finite
            clock = now
        q[:, end + 1] = rows.qpos[:, scene.qpos]
        return [Rollout(q[k].copy(), contact[k].copy(), float(depth[k]), bool(bad[k])) for k in range(n)]

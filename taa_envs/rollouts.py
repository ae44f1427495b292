"""Many replays of one scene at once: the same hand along different paths, on all cores.

Each is what :func:`taa_envs.replay.simulate` would make of its path (a test compares them); the object's joint is as
passive here as there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taa_envs.replay import HOLD
from taa_envs.rows import BatchRows, hand_rows
from taa_envs.scene import Scene, decode_touch, touch_columns
from taa_envs.simulation import HandPath


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
        self._hand = hand_rows(scene, self._rows)

    def run(self, paths: Sequence[HandPath]) -> list[Rollout]:
        """Replay every path from the reference's first frame to the demonstration's end plus :data:`HOLD`."""
        out: list[Rollout] = []
        for first in range(0, len(paths), self.n):
            some = list(paths[first:first + self.n])
            out += self._together([*some, *[some[-1]] * (self.n - len(some))])[:len(some)]
        return out

    def _together(self, paths: list[HandPath]) -> list[Rollout]:
        scene, rows, hand, n = self.scene, self._rows, self._hand, self.n
        asset, model = scene.asset, scene.model
        reference, end = asset.reference, asset.demo["demo_end_frame"]
        dt, lead = model.opt.timestep, scene.hand.lead
        start, stop = float(reference.time[0]), asset.end_time + HOLD
        everyone = np.arange(n)
        rows.clear(everyone)
        rows.qpos[:, scene.qpos] = asset.demo["q_start"]
        hand.place(everyone, np.stack([path.at(start) for path in paths]))
        rows.forward(everyone)
        edges = np.append(reference.time[:end + 1], stop)
        columns = touch_columns(scene)
        q, contact = np.empty((n, end + 2)), np.zeros((n, end + 1), bool)
        depth, bad = np.zeros(n), np.zeros(n, bool)
        q[:, 0], frame, clock = rows.qpos[:, scene.qpos], 0, rows.time
        for i in range(int(np.ceil((stop - start) / dt))):
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

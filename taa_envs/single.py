"""The task for one simulation, with as little Python around MuJoCo's steps as it takes.

The same numbers as :class:`taa_envs.task.Task` on one row (a test compares them to the last bit of every control): what
is one number is one of Python's here, and what is an array goes through few calls into arrays that are there already.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from typing import Any

import numpy as np

from taa_envs.motion import CORRECTIONS, PACE, SLEW, TIPS
from taa_envs.registry import CONTROL_PERIOD
from taa_envs.reward import DRIVEN_SHARE, SUCCESS_PROGRESS, goal_reward, scalar_terms
from taa_envs.rows import BAD, SingleRows
from taa_envs.scene import SUBSTEPS, TIMESTEP, Scene
from taa_envs.task import Task

_ONES = np.ones(SUBSTEPS)


class SingleTask(Task):
    """See the module. What an episode changes stays in the arrays of :class:`Task`, so that snapshots are the same."""

    def __init__(self, scene: Scene, rows: SingleRows, *, action: str = "residual",
                 reward: str | Mapping[str, float] = "dense") -> None:
        super().__init__(scene, rows, action=action, reward=reward)
        data, layout = rows.data, self._layout
        self._data, self._out, self._flat = data, np.empty(layout.size), self._raw[0]
        self._frames, self._driving = self._times.tolist(), self.asset.reference.contact.tolist()
        demo = self.asset.demo
        self._start_q, self._end_q = demo["q_start"], demo["q_demo_end"]
        self._range_q = demo["q_max"] - demo["q_min"]
        self._matrix = np.empty((4, 3))
        self._touches = rows.touches[0]
        self._forces, self._places = self._touches[:, 1:4].T, self._touches[:, 7:10]
        self._tips_here = np.empty((len(TIPS), 3))
        self._tip_rows = np.array(TIPS)
        hand, grip = layout.at["hand"].start, layout.at["grip"]
        self._hand_out, self._speed_out = self._flat[hand:hand + 63].reshape(21, 3), self._flat[hand + 63:hand + 66]
        self._error_out, self._tips_out = self._flat[layout.error].reshape(21, 3), self._flat[grip].reshape(5, 3)
        self._action_out = self._flat[layout.at["action"]]
        contact = layout.at["contact"].start
        self._contact_out = self._flat[contact:contact + 5]
        self._played = [0, 0]  # of the frames in which the demonstrated hand drives: played, and with contact

    def step_one(self, action: np.ndarray) -> tuple[float, dict[str, float], dict[str, Any]]:
        """One environment step of an action (A,); reward, scaled reward terms, and the info of :meth:`Task.info`."""
        scene, data = self.scene, self._data
        values = [min(max(a, -1.0), 1.0) for a in np.asarray(action, np.float32).tolist()]
        if len(values) != self.action_size:
            raise ValueError(f"an action has {self.action_size} numbers, this one has {len(values)}")
        before = self._time.item()
        q0 = data.qpos[scene.qpos].item()
        if self.residual:
            correction = [c + min(max(a - c, -SLEW), SLEW)
                          for a, c in zip(values[:CORRECTIONS], self._correction[0].tolist(), strict=True)]
            self._correction[0] = correction
            time = max(before + CONTROL_PERIOD * (1 + PACE * values[CORRECTIONS]), self._frames[0])
            self._time[0] = time
            aim = self._motion.one(time + self._lead, correction, self.translation, self._offset[0].tolist(),
                                   self._matrix)
        else:
            aim = self._targets(np.array(values)[None])[0]
            time = self._time.item()
        self._hand.advance_one(self._aim[0], aim)
        self._aim[0] = aim
        q = data.qpos[scene.qpos].item()
        moved = (q - q0) / self._stroke
        self._find_tips()
        contact, torque = self._touch_one()
        driven = moved if moved > 0 and torque * self._stroke > 0 else 0.0
        self._mark_one(before, time, contact)
        numbers = data.warning.number
        raised = int(numbers.sum())
        warned = max(raised - self._raised, 0)
        self._raised, self._warned[0] = raised, warned
        clock = data.time
        late = clock < self._clock.item() + (SUBSTEPS - 0.5) * TIMESTEP
        diverged = late or self._diverged.item() or bool(warned and numbers[BAD].any())
        self._diverged[0], self._clock[0] = diverged, clock
        fraction = (q - self._start_q) / self._stroke
        first, total = self._first.item(), self._driven.item() + driven
        self._driven[0] = total
        made = min(max(fraction, 0.0), 1.0) - first
        share = min(total / made, 1.0) if made > 1e-9 else 0.0
        success = fraction >= SUCCESS_PROGRESS and share >= DRIVEN_SHARE and not diverged
        succeeded = success or self._succeeded.item()
        self._succeeded[0] = succeeded
        distance = 0.0
        if not contact and "reach" in self.scales:
            distance = self._surface_distance(self._tips_out[None]).item()
        depth = max(-data.sensordata[self._depth].item(), 0.0)
        terms = scalar_terms(driven, moved, contact, distance, depth, values, self._action[0].tolist(), success,
                             self.scales)
        self._action[0] = values
        info = {"joint_progress": min(max(fraction, 0.0), 1.0),
                "final_q_error": abs(q - self._end_q) / self._range_q, "is_success": succeeded, "success_now": success,
                "contact": contact, "contact_fraction": self._played[1] / max(self._played[0], 1), "diverged": diverged,
                "warnings": warned}
        if self.goal:
            return goal_reward(self.achieved(), np.array([[1.0, DRIVEN_SHARE]]))[0].item(), terms, info
        return float(sum(terms.values())), terms, info

    def _touch_one(self) -> tuple[bool, float]:
        total = (_ONES @ self._touches).tolist()
        k = -1 / SUBSTEPS
        fx, fy, fz = k * total[1], k * total[2], k * total[3]
        contact = fx * fx + fy * fy + fz * fz > 0
        if not contact:
            self._push[0] = 0.0
            return False, 0.0
        x, y, z = self._axis[0].tolist()
        if self._hinge:
            (_, gxy, gxz), (gyx, _, gyz), (gzx, gzy, _) = (self._forces @ self._places).tolist()
            px, py, pz = self._point[0].tolist()
            torque = (x * (k * (total[4] + gzy - gyz) - py * fz + pz * fy)
                      + y * (k * (total[5] + gxz - gzx) - pz * fx + px * fz)
                      + z * (k * (total[6] + gyx - gxy) - px * fy + py * fx))
            if self._pitch:
                torque += self._pitch * (fx * x + fy * y + fz * z)
        else:
            torque = fx * x + fy * y + fz * z
        self._push[0] = 1.0, fx, fy, fz, torque
        return True, torque

    def _mark_one(self, before: float, time: float, contact: bool) -> None:
        if time < before:
            before, time = time, before
        first = bisect_right(self._frames, before + 1e-9) - 1
        last = max(bisect_right(self._frames, time - 1e-9) - 1, first)
        seen, hit = self._seen[0], self._hit[0]
        for frame in range(first, last + 1):
            if self._driving[frame]:
                self._played[0] += not seen[frame]
                self._played[1] += contact and not hit[frame]
            seen[frame] = True
            if contact:
                hit[frame] = True

    def _recount(self) -> None:
        wanted = self.asset.reference.contact & self._seen[0]
        self._played = [int(wanted.sum()), int((wanted & self._hit[0]).sum())]

    def _place(self, *args: Any) -> None:
        super()._place(*args)
        self._recount()
        self._find_tips()

    def restore(self, row: int, state: Mapping[str, Any]) -> None:
        super().restore(row, state)
        self._recount()

    def observe_one(self) -> np.ndarray:
        """(size,) float32: :meth:`Task.observation` of the only simulation."""
        flat, data, here = self._flat, self._data, self._hand.landmarks()[0]
        fraction = (data.qpos[self.scene.qpos].item() - self._start_q) / self._stroke
        flat[:3] = fraction, data.qvel[self.scene.dof].item(), fraction
        self._hand_out[:] = here
        self._speed_out[:] = self._hand.velocity()[0]
        self._contact_out[:] = self._push[0]
        np.subtract(here, self._offset[0], self._error_out)
        if self.residual:
            self._action_out[:CORRECTIONS] = self._correction[0]
            self._action_out[CORRECTIONS] = self._action[0, CORRECTIONS]
        else:
            self._action_out[:] = self._action[0]
        out = self._out
        np.multiply(flat, self._scale, out)
        np.add(out, self._motion.shown.one(self._time.item()), out)
        np.maximum(out, -10.0, out=out)
        np.minimum(out, 10.0, out=out)
        return out.astype(np.float32)

    def _find_tips(self) -> None:
        """:meth:`Task._tips`, into the observation."""
        np.subtract(self._hand.landmarks()[0].take(self._tip_rows, 0), self.rows.link_pos[0], self._tips_here)
        np.matmul(self._tips_here, self.rows.link_mat[0], self._tips_out)


__all__ = ["SingleTask"]

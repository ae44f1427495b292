"""A demonstrated hand on another hand's joints: differential inverse kinematics with mink.

Tasks, in order of weight: the finger tips are where the demonstration has them (that is where it touches), the palm
looks and lies as the demonstrated palm does, the joints stay near their middle. One step is one quadratic program under
joint and velocity limits; as a linear step can still leave a limit, both are enforced again after integration.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from taa_envs.hands.landmarks import TIPS, palm_frame

if TYPE_CHECKING:
    import mujoco

TIP_COST, PALM_POSITION_COST, PALM_TURN_COST, POSTURE_COST = 1.0, 0.06, 0.03, 0.003
JOINT_SPEED = 8.0  # rad/s of every finger joint
DAMPING = 1e-6
SOLVER = "daqp"


class Retargeting:
    """Inverse kinematics of a hand on a free base.

    Args:
        model: the hand alone; its first joint is free, all others are hinges with limits; sites ``palm`` (axes as
            :func:`taa_envs.hands.landmarks.palm_frame` says) and ``tip_<finger>``.
        side: "right" or "left".
        fingers: those that the hand has.

    Attributes:
        unsolved: how many steps had no solution; the joints then stayed where they were.
        low, high: (n,) rad, limits of the hinges.
    """

    def __init__(self, model: mujoco.MjModel, side: str, fingers: tuple[str, ...]) -> None:
        import mink

        self.model, self.side, self.fingers = model, side, fingers
        self.unsolved = 0
        self._configuration = mink.Configuration(model)
        self.low, self.high = model.jnt_range[1:, 0].copy(), model.jnt_range[1:, 1].copy()
        self.rest = np.clip(0.0, self.low, self.high) + 0.25 * (self.high - np.clip(0.0, self.low, self.high))
        self._tips = {f: mink.FrameTask(f"tip_{f}", "site", position_cost=TIP_COST, orientation_cost=0.0)
                      for f in fingers}
        self._palm = mink.FrameTask("palm", "site", position_cost=PALM_POSITION_COST, orientation_cost=PALM_TURN_COST)
        cost = np.zeros(model.nv)
        cost[6:] = POSTURE_COST
        self._posture = mink.PostureTask(model, cost=cost)
        self._posture.set_target(np.concatenate([[0, 0, 0, 1, 0, 0, 0], self.rest]))
        names = [model.joint(j).name for j in range(1, model.njnt)]
        self._joint_limit = mink.ConfigurationLimit(model, gain=0.95)
        self._speed_limit = mink.VelocityLimit(model, {name: JOINT_SPEED for name in names})

    def start(self, joints: np.ndarray, rounds: int = 60) -> np.ndarray:
        """(7 + n,) configuration for landmarks (21, 3) m: palm in place, joints near their middle, then solved."""
        import mink
        import mujoco

        q = np.concatenate([[0, 0, 0, 1, 0, 0, 0], self.rest]).astype(float)
        self._configuration.update(q)
        here = self._configuration.get_transform_frame_to_world("palm", "site")
        wanted = mink.SE3.from_matrix(palm_frame(joints, self.side))
        base = wanted.multiply(here.inverse())
        q[:3], q[3:7] = base.translation(), base.rotation().wxyz
        mujoco.mju_normalize4(q[3:7])
        for _ in range(rounds):
            q = self.step(q, joints, 0.05)
        return q

    def step(self, q: np.ndarray, joints: np.ndarray, dt: float) -> np.ndarray:
        """One step of dt s from configuration q (7 + n,) towards landmarks (21, 3) m; a new array."""
        import mink

        configuration = self._configuration
        configuration.update(q)
        for finger, task in self._tips.items():
            task.set_target(mink.SE3.from_translation(joints[TIPS[finger]]))
        self._palm.set_target(mink.SE3.from_matrix(palm_frame(joints, self.side)))
        try:
            velocity = mink.solve_ik(configuration, [*self._tips.values(), self._palm, self._posture], dt, SOLVER,
                                     damping=DAMPING, limits=[self._joint_limit, self._speed_limit])
        except mink.MinkError:
            velocity = None
        if velocity is None or not np.isfinite(velocity).all():
            self.unsolved += 1
            return q.copy()
        moved = configuration.integrate(velocity, dt)
        reach = JOINT_SPEED * dt
        moved[7:] = np.clip(np.clip(moved[7:], q[7:] - reach, q[7:] + reach), self.low, self.high)
        return moved

    def tips(self, q: np.ndarray) -> Mapping[str, np.ndarray]:
        """Finger -> (3,) m, where its tip is at configuration q."""
        self._configuration.update(q)
        return {f: self._configuration.get_transform_frame_to_world(f"tip_{f}", "site").translation()
                for f in self.fingers}

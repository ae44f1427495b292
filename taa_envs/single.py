"""The task for one simulation, with as little Python around MuJoCo's steps as it takes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from taa_envs import kernels
from taa_envs.reward import DRIVEN_SHARE, TERMS, goal_reward
from taa_envs.rows import SingleRows
from taa_envs.scene import Scene
from taa_envs.task import Task


class SingleTask(Task):
    """:class:`Task` of one row; the same compiled code, and Python's numbers in place of arrays of one."""

    def __init__(self, scene: Scene, rows: SingleRows, *, action: str = "residual",
                 reward: str | Mapping[str, float] = "dense") -> None:
        super().__init__(scene, rows, action=action, reward=reward)
        self._shape, self._result = (self.action_size,), self._results[0]
        self._scaled = [(name, kernels.TERMS + TERMS.index(name), scale) for name, scale in self.scales.items()]

    def step_one(self, action: np.ndarray) -> tuple[float, dict[str, float], dict[str, Any]]:
        """One environment step of an action (A,); reward, scaled reward terms, and the info of :meth:`Task.info`."""
        action = np.asarray(action, np.float32)
        if action.shape != self._shape:
            raise ValueError(f"an action has {self.action_size} numbers, this one has the shape {action.shape}")
        self._given[0] = action
        self._advance(None)
        out = self._result.tolist()
        progress, error, succeeded, success, contact, fraction, diverged, warned = out[:8]
        terms = {name: scale * out[k] for name, k, scale in self._scaled}
        info = {"joint_progress": progress, "final_q_error": error, "is_success": succeeded > 0,
                "success_now": success > 0, "contact": contact > 0, "contact_fraction": fraction,
                "diverged": diverged > 0, "warnings": int(warned)}
        if self.goal:
            return goal_reward(self.achieved(), np.array([[1.0, DRIVEN_SHARE]]))[0].item(), terms, info
        return float(sum(terms.values())), terms, info

    def observe_one(self) -> np.ndarray:
        """(size,) float32: :meth:`Task.observation` of the only simulation."""
        return self.observation()[0]


__all__ = ["SingleTask"]

"""The same task as a dm_control environment.

    environment = taa_envs.dm.load("ID")
    timestep = environment.reset()
    timestep = environment.step(action)

Actions, rewards, episodes and randomisation are those of :class:`taa_envs.env.ArticulationEnv`, whose task runs here on
the data of a dm_control ``Physics``; observations are its parts ("joint", "hand", "contact", "reference", "action").
"""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import dm_env
import numpy as np
from dm_control.mujoco import Physics
from dm_control.mujoco.wrapper import MjModel
from dm_env import specs
from gymnasium.utils import seeding

from taa_envs.asset import Asset
from taa_envs.registry import CONTROL_PERIOD, get_asset, max_episode_steps
from taa_envs.rows import SingleRows
from taa_envs.scene import build_scene
from taa_envs.single import SingleTask


class ArticulationEnvironment(dm_env.Environment):
    """See the module; made by :func:`load`.

    Attributes:
        task: the task, for info and snapshots.
    """

    def __init__(self, asset: Asset, *, hand: str, reward: str | Mapping[str, float], action: str, randomize: Any,
                 seed: int | None, time_limit: float | None, touch_static: bool) -> None:
        scene = build_scene(asset, hand, touch_static=touch_static)
        self._physics = Physics.from_model(MjModel(scene.model))
        self.task = SingleTask(scene, SingleRows(scene, self._physics.data.ptr), action=action, reward=reward)
        if self.task.goal:
            raise ValueError("dm_control environments are not goal-conditioned; use reward='dense' or 'sparse'")
        self._randomize, self._generator = randomize, seeding.np_random(seed)[0]
        self._limit = max_episode_steps(asset.demo["duration"]) if time_limit is None \
            else max(1, round(time_limit / CONTROL_PERIOD))
        self._steps, self._over = 0, True

    @property
    def physics(self) -> Physics:
        """The dm_control physics that the task runs on; ``physics.render`` draws it."""
        return self._physics

    def control_timestep(self) -> float:
        """s of one step."""
        return CONTROL_PERIOD

    def reset(self, options: Mapping[str, Any] | None = None) -> dm_env.TimeStep:
        """Start an episode; options as the Gymnasium environment's.

        Raises:
            ValueError: an option is unknown or out of range.
        """
        self.task.begin(0, self._generator, options, self._randomize)
        self._steps, self._over = 0, False
        return dm_env.restart(self._observation())

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """One step; starts an episode where none runs. An episode that the time limit ends has discount 1."""
        if self._over:
            return self.reset()
        reward, _, info = self.task.step_one(action)
        self._steps += 1
        seen = self._observation()
        if info["success_now"] or info["diverged"]:
            self._over = True
            return dm_env.termination(reward, seen)
        if self._steps >= self._limit:
            self._over = True
            return dm_env.truncation(reward, seen)
        return dm_env.transition(reward, seen)

    def _observation(self) -> OrderedDict[str, np.ndarray]:
        parts = self.task.parts_of(self.task.observe_one()[None])
        return OrderedDict((name, value[0]) for name, value in parts.items())

    def observation_spec(self) -> OrderedDict[str, specs.BoundedArray]:
        return OrderedDict((name, specs.BoundedArray((size,), np.float32, -10.0, 10.0, name))
                           for name, size in self.task.observation_parts.items())

    def action_spec(self) -> specs.BoundedArray:
        return specs.BoundedArray((self.task.action_size,), np.float32, -1.0, 1.0, "action")

    def close(self) -> None:
        self._physics.free()


def load(asset: str | os.PathLike | Asset, *, hand: str = "points", reward: str | Mapping[str, float] = "dense",
         action: str = "residual", randomize: Any = False, seed: int | None = None, time_limit: float | None = None,
         touch_static: bool = False) -> ArticulationEnvironment:
    """A dm_control environment of an asset.

    Args:
        asset: id, folder or asset.
        seed: of everything that draws; the first episode is then the Gymnasium environment's under that seed.
        time_limit: s, default the registered one.
        hand, reward, action, randomize, touch_static: as the Gymnasium environment's.

    Raises:
        UnknownAsset, AssetError: there is none, or it is not valid.
        ValueError: an argument is unknown.
    """
    return ArticulationEnvironment(get_asset(asset), hand=hand, reward=reward, action=action, randomize=randomize,
                                   seed=seed, time_limit=time_limit, touch_static=touch_static)

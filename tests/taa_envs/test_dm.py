"""The dm_control environment gives what the Gymnasium one gives."""

from __future__ import annotations

import unittest

import dm_env
import numpy as np
import pytest
from dm_env import test_utils

import taa_envs.dm
from taa_envs.asset import Asset
from taa_envs.env import ArticulationEnv


@pytest.mark.parametrize("action", ["residual", "absolute"])
def test_equals_the_gymnasium_environment(action: str, door: Asset) -> None:
    env = ArticulationEnv(door, action=action, observation="dict", randomize=True)
    same = taa_envs.dm.load(door, action=action, randomize=True, seed=7)
    rng = np.random.default_rng(0)
    observation, _ = env.reset(seed=7)
    timestep = same.reset()
    assert timestep.first() and timestep.reward is None
    for _ in range(70):
        for name, value in observation.items():
            np.testing.assert_array_equal(value, timestep.observation[name])
        act = np.clip(env.reference_action() + 0.1 * rng.normal(size=env.action_space.shape), -1, 1).astype(np.float32)
        observation, reward, terminated, _, _ = env.step(act)
        timestep = same.step(act)
        assert timestep.reward == reward and (timestep.discount == 0.0) == terminated


def test_episode_ends(door: Asset) -> None:
    env = taa_envs.dm.load(door, reward="sparse")
    timestep = env.reset()
    zero = np.zeros(8, np.float32)
    while not timestep.last():
        timestep = env.step(zero)
    assert timestep.reward == 1.0 and timestep.discount == 0.0
    assert env.step(zero).first()  # as dm_env has it
    env = taa_envs.dm.load(door, action="absolute", time_limit=0.1)
    env.reset()
    steps = [env.step(np.zeros(63, np.float32)) for _ in range(5)]
    assert [t.step_type for t in steps] == [dm_env.StepType.MID] * 4 + [dm_env.StepType.LAST]
    assert steps[-1].discount == 1.0


def test_physics_is_the_tasks(door: Asset) -> None:
    env = taa_envs.dm.load(door)
    env.reset(options={"q0": 0.3})
    assert env.physics.named.data.qpos["joint"] == 0.3
    picture = env.physics.render(height=48, width=64, camera_id="overview")
    assert picture.shape == (48, 64, 3) and picture.std() > 0
    with pytest.raises(ValueError, match="goal"):
        taa_envs.dm.load(door, reward="sparse_goal")


class TestContract(test_utils.EnvironmentTestMixin, unittest.TestCase):
    """dm_env's own checks."""

    @pytest.fixture(autouse=True)
    def _take(self, door: Asset) -> None:
        self._door = door

    def make_object_under_test(self) -> dm_env.Environment:
        return taa_envs.dm.load(self._door, seed=0)

    def make_action_sequence(self):
        rng = np.random.default_rng(0)
        for _ in range(20):
            yield rng.uniform(-1, 1, 8).astype(np.float32)

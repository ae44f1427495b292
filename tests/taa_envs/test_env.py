"""The Gymnasium environment."""

from __future__ import annotations

import os
import pickle
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import taa_envs
from taa_envs.asset import Asset
from taa_envs.env import ArticulationEnv, apply_residual
from taa_envs.replay import replay

ZERO = np.zeros(7, np.float32)


@pytest.fixture(scope="module", autouse=True)
def registered(asset_root, door: Asset, drawer: Asset):
    before = os.environ.get("TAA_ASSETS")
    os.environ["TAA_ASSETS"] = str(asset_root)
    taa_envs.register_assets()
    yield
    if before is None:
        del os.environ["TAA_ASSETS"]
    else:
        os.environ["TAA_ASSETS"] = before
    taa_envs.register_assets()


@pytest.mark.parametrize("name", ["TAA/door", "TAA/drawer"])
def test_gymnasium_check(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*different from the unwrapped version.*")
        check_env(gymnasium.make(name).unwrapped)


def test_stable_baselines_check() -> None:
    from stable_baselines3.common.env_checker import check_env as check

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(gymnasium.make("TAA/door", render_mode="rgb_array", height=64).unwrapped)


@pytest.mark.parametrize("name", ["door", "drawer"])
def test_zero_action_is_the_open_loop_replay(name: str, request: pytest.FixtureRequest) -> None:
    asset = request.getfixturevalue(name)
    env = ArticulationEnv(asset)
    env.reset(seed=0)
    run = replay(asset, controls=False).trajectory
    for i in range(1, 90):
        env.step(ZERO)
        if i % 5 == 0:  # every 0.1 s is a step's end and a frame of the 30 Hz reference
            assert env.simulation.q == pytest.approx(run.q[3 * i // 5], abs=2e-3 * abs(asset.demo["q_demo_end"]))


def test_demonstration_succeeds_and_says_so() -> None:
    env = gymnasium.make("TAA/door", reward="sparse")
    env.reset(seed=0)
    for _ in range(env.spec.max_episode_steps):
        _, reward, terminated, truncated, info = env.step(ZERO)
        if terminated or truncated:
            break
    assert terminated and info["is_success"] and reward == 1.0
    assert info["joint_progress"] >= 0.95 and info["final_q_error"] <= 0.06 and info["contact_fraction"] > 0.9


def test_hand_taken_away_fails_and_is_truncated() -> None:
    env = gymnasium.make("TAA/door", max_episode_steps=150)
    env.reset(seed=0)
    away = np.array([1, 1, 0, 0, 0, 0, -1], np.float32)
    for _ in range(150):
        _, _, terminated, truncated, info = env.step(away)
        assert not terminated
    assert truncated and not info["is_success"] and info["joint_progress"] < 0.1


def test_starting_at_the_end_is_no_success() -> None:
    env = gymnasium.make("TAA/door").unwrapped
    _, info = env.reset(seed=0, options={"phase": 1.0})
    assert info["joint_progress"] == pytest.approx(1.0) and not info["is_success"]
    _, _, terminated, _, info = env.step(ZERO)
    assert not terminated and not info["is_success"]


def test_reward_is_the_sum_of_its_terms() -> None:
    env = gymnasium.make("TAA/door")
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(40):
        _, reward, _, _, info = env.step(env.action_space.sample())
        assert reward == pytest.approx(sum(info["reward_terms"].values()))
        assert set(info["reward_terms"]) == {"progress", "reach", "action_rate", "penetration", "success"}


def test_same_seed_same_episode() -> None:
    def episode(seed: int) -> np.ndarray:
        env = gymnasium.make("TAA/door")
        observations = [env.reset(seed=seed, options={"randomize": True})[0]]
        env.action_space.seed(1)
        for _ in range(40):
            observations.append(env.step(env.action_space.sample())[0])
        return np.array(observations)

    np.testing.assert_array_equal(episode(3), episode(3))
    assert not np.array_equal(episode(3), episode(4))


def test_randomization_ends_with_its_episode(door: Asset) -> None:
    env = ArticulationEnv(door)
    damping = env.simulation.model.dof_damping.copy()
    env.reset(seed=0, options={"randomize": {"damping": 0.5}})
    assert not np.array_equal(env.simulation.model.dof_damping, damping)
    env.reset()
    np.testing.assert_array_equal(env.simulation.model.dof_damping, damping)


def test_reset_options(door: Asset) -> None:
    env = ArticulationEnv(door)
    env.reset(options={"q0": 0.7})
    assert env.simulation.q == 0.7
    env.reset(options={"phase": 0.5})
    middle = np.interp(0.5 * door.demo["duration"], door.reference.time, door.reference.q)
    assert env.simulation.q == pytest.approx(middle)
    for bad, message in (({"q0": 9.0}, "range"), ({"phase": 2}, "phase"), ({"speed": 1}, "known: q0"),
                         ({"randomize": {"colour": 1}}, "known: hand")):
        with pytest.raises(ValueError, match=message):
            env.reset(options=bad)


def test_what_is_returned_is_never_written_to_again(door: Asset) -> None:
    env = ArticulationEnv(door)
    observation, info = env.reset(seed=0)
    kept = observation.copy()
    action = ZERO.copy()
    second, _, _, _, info2 = env.step(action)
    action[:] = 9
    third = env.step(ZERO)[0]
    np.testing.assert_array_equal(observation, kept)
    assert info is not info2 and info["reward_terms"] is not info2["reward_terms"]
    assert not np.shares_memory(second, third) and (third[-7:] == 0).all()


def test_pickles_as_made() -> None:
    env = gymnasium.make("TAA/door", reward="sparse").unwrapped
    again = pickle.loads(pickle.dumps(env))
    assert again.asset.id == "door" and again.scales == {"success": 1.0}
    np.testing.assert_array_equal(env.reset(seed=1)[0], again.reset(seed=1)[0])


def test_renders_in_each_mode() -> None:
    assert ArticulationEnv.metadata["render_fps"] == 50
    for mode, shape, kind in (("rgb_array", (96, 128, 3), np.uint8), ("depth_array", (96, 128), np.float32)):
        env = gymnasium.make("TAA/door", render_mode=mode, height=96)
        env.reset(seed=0)
        picture = env.render()
        assert picture.shape == shape and picture.dtype == kind and picture.std() > 0
        env.close()
    with pytest.raises(ValueError, match="rgb_array"):
        ArticulationEnv("door", render_mode="ascii")
    with pytest.raises(ValueError, match="known: overview"):
        ArticulationEnv("drawer", camera="video")


def test_make_through_the_module() -> None:
    assert gymnasium.make("taa_envs:TAA/door").unwrapped.asset.id == "door"


def test_residual_moves_turns_and_closes(door: Asset) -> None:
    joints = door.reference.hand_joints[0]
    np.testing.assert_array_equal(apply_residual(joints, ZERO), joints)
    moved = apply_residual(joints, np.array([1, 0, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(moved - joints, np.tile([0.03, 0, 0], (21, 1)), atol=1e-12)
    turned = apply_residual(joints, np.array([0, 0, 0, 0, 0, 1, 0]))
    palm = [0, 5, 9, 13, 17]
    np.testing.assert_allclose(turned[palm].mean(0), joints[palm].mean(0), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(turned[8] - turned[0]), np.linalg.norm(joints[8] - joints[0]))
    closed = apply_residual(joints, np.array([0, 0, 0, 0, 0, 0, 1]))
    assert np.linalg.norm(closed[4] - closed[8]) == pytest.approx(0.5 * np.linalg.norm(joints[4] - joints[8]))
    np.testing.assert_array_equal(closed[palm], joints[palm])

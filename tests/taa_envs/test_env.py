"""The Gymnasium environment."""

from __future__ import annotations

import inspect
import json
import os
import pickle
import re
import warnings
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import taa_envs
from taa_envs.asset import Asset
from taa_envs.env import ArticulationEnv, apply_residual
from taa_envs.hands.points import PointsHand
from taa_envs.registry import max_episode_steps
from taa_envs.replay import replay

ZERO = np.zeros(8, np.float32)


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


@pytest.mark.parametrize("arguments", [{"render_mode": "rgb_array", "height": 64}, {"action": "absolute"},
                                       {"observation": "dict"}, {"reward": "sparse_goal"}, {"randomize": True}])
def test_checkers_on_every_kind(arguments: dict) -> None:
    from stable_baselines3.common.env_checker import check_env as check

    env = gymnasium.make("TAA/door", **arguments).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*different from the unwrapped version.*")
        check(env)
        if "render_mode" not in arguments:
            check_env(env, skip_render_check=True)


@pytest.mark.parametrize("name", ["door", "drawer"])
def test_golden_rollout(name: str, request: pytest.FixtureRequest) -> None:
    """The joint after each half second of the replay, as this version of MuJoCo gave it when it was written down."""
    golden = json.loads((Path(__file__).parent / "golden.json").read_text())
    if mujoco.__version__ not in golden:
        pytest.skip(f"no golden rollout for MuJoCo {mujoco.__version__}; write one into golden.json")
    env = ArticulationEnv(request.getfixturevalue(name))
    env.reset(seed=0)
    q = []
    for step in range(1, 101):
        env.step(ZERO)
        if step % 25 == 0:
            q.append(env.q)
    np.testing.assert_allclose(q, golden[mujoco.__version__][name], rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", ["door", "drawer"])
def test_zero_action_is_the_open_loop_replay(name: str, request: pytest.FixtureRequest) -> None:
    asset = request.getfixturevalue(name)
    env = ArticulationEnv(asset)
    env.reset(seed=0)
    run = replay(asset, controls=False).trajectory
    for i in range(1, 90):
        env.step(ZERO)
        if i % 5 == 0:  # every 0.1 s is a step's end and a frame of the 30 Hz reference
            assert env.q == pytest.approx(run.q[3 * i // 5], abs=2e-3 * abs(asset.demo["q_demo_end"]))


@pytest.mark.parametrize("limit", [1e9, 20.0])
def test_a_blocked_link_is_pushed_with_no_more_than_the_hand_has(door, limit: float) -> None:
    env = ArticulationEnv(door, hand=PointsHand(total_force=limit))
    env.reset(seed=0)
    env.task.rows.fields(0, ("dof_frictionloss",))["dof_frictionloss"][env.task.scene.dof] = 100.0
    total = []
    for _ in range(100):
        env.step(ZERO)
        total.append(np.linalg.norm(env.data.actuator_force[env.task.scene.hand.act], axis=1).sum())
    # What is foreseen is not exact where contact begins: for a step or two it may be half as much again.
    assert np.percentile(total, 75) > 10.0 and np.percentile(total, 85) < 1.15 * limit and max(total) < 2 * limit
    assert limit < 1e9 or max(total) > 50.0


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
    away = np.array([1, 1, 0, 0, 0, 0, -1, 0], np.float32)
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


def test_dict_observation_is_the_flat_one_in_parts(door: Asset) -> None:
    flat, parts = (ArticulationEnv(door, observation=kind) for kind in ("flat", "dict"))
    a, b = flat.reset(seed=0)[0], parts.reset(seed=0)[0]
    for _ in range(45):
        np.testing.assert_array_equal(a, np.concatenate(list(b.values())))
        assert parts.observation_space.contains(b) and flat.observation_space.contains(a)
        a, b = flat.step(ZERO)[0], parts.step(ZERO)[0]
    assert b["contact"][0] == 1 and b["contact"][2] > 0  # the door is pulled towards +y
    assert b["contact"][4] > 0  # and the pull turns it the demonstrated way


def test_the_documentation_says_what_is_there(door: Asset) -> None:
    text = ArticulationEnv.__doc__
    for kind, size in (("residual", 8), ("absolute", 63)):
        env = ArticulationEnv(door, action=kind)
        assert env.action_space.shape == (size,) and f"Box(-1, 1, ({size},), float32)" in text
        assert str(env.observation_space.shape[0]) in text
    env = ArticulationEnv(door)
    start = 0
    for name, count in env.task.observation_parts.items():
        first = re.search(rf"\| {name} \| (\d+)", text)
        assert first and int(first[1]) == start
        start += count
    _, info = env.reset(seed=0, options={"randomize": True})
    assert all(f"``{name}``" in text for name in info)
    for name in inspect.signature(ArticulationEnv).parameters:
        assert f"{name}:" in text or f"{name}, " in text or f"{name}=" in text


def test_absolute_zero_and_random_actions_fail_and_the_reference_succeeds(door: Asset, drawer: Asset) -> None:
    for asset in (door, drawer):
        env = ArticulationEnv(asset, action="absolute", reward="sparse")
        rng = np.random.default_rng(0)
        limit = max_episode_steps(asset.demo["duration"])
        for actions in (np.zeros((limit, 63)), rng.uniform(-1, 1, (limit, 63))):
            env.reset(seed=0)
            assert sum(env.step(action)[1] for action in actions) == 0
        env.reset(seed=0)
        assert any(env.step(env.reference_action())[2] for _ in range(limit))


def test_success_is_latched_and_instantaneous(door: Asset) -> None:
    env = ArticulationEnv(door)
    env.reset(seed=0)
    while not env.step(ZERO)[4]["success_now"]:
        pass
    env.data.qvel[env.task.scene.dof] = -3.0  # somebody slams it
    for _ in range(30):
        info = env.step(np.array([1, 1, 0, 0, 0, 0, -1, 0], np.float32))[4]
    assert info["joint_progress"] < 0.9 and info["is_success"] and not info["success_now"]


def test_flung_door_earns_nothing_and_never_succeeds(door: Asset) -> None:
    env = ArticulationEnv(door, action="absolute")
    env.reset(seed=0)
    env.data.qvel[env.task.scene.dof] = 20.0
    total, info = 0.0, {}
    for _ in range(60):
        _, _, terminated, _, info = env.step(np.zeros(63, np.float32))
        total += info["reward_terms"]["progress"]
        assert not terminated
    assert info["joint_progress"] > 0.5 and total <= 1e-9 and not info["is_success"]


def test_goal_conditioned(door: Asset) -> None:
    env = gymnasium.make("TAA/door", reward="sparse_goal")
    seen, _ = env.reset(seed=0)
    rewards = []
    for _ in range(env.spec.max_episode_steps):
        seen, reward, terminated, truncated, info = env.step(ZERO)
        assert reward == env.unwrapped.compute_reward(seen["achieved_goal"], seen["desired_goal"], info)
        assert (reward == 0.0) == info["success_now"]
        rewards.append(reward)
        if terminated:
            break
    assert rewards[-1] == 0.0 and set(rewards[:-1]) == {-1.0}
    np.testing.assert_allclose(seen["achieved_goal"][0], info["joint_progress"], atol=1e-6)
    with pytest.raises(ValueError, match="sparse_goal"):
        ArticulationEnv(door, reward="sparse_goal", observation="dict")


def test_a_snapshot_goes_on_as_the_episode_did(door: Asset) -> None:
    env, other = ArticulationEnv(door, randomize=True), ArticulationEnv(door)
    env.reset(seed=3)
    for _ in range(50):
        env.step(ZERO)
    state = pickle.loads(pickle.dumps(env.get_state()))
    first = [env.step(ZERO) for _ in range(20)]
    first_reset = env.reset()[0]
    for again in (env, other):
        again.set_state(state)
        for a in first:
            b = again.step(ZERO)
            np.testing.assert_array_equal(a[0], b[0])
            assert a[1] == b[1] and a[4] == b[4]
    np.testing.assert_array_equal(first_reset, env.reset()[0])


def test_unknown_names_are_refused_with_the_known_ones(door: Asset) -> None:
    for bad, message in (({"action": "torque"}, "residual"), ({"observation": "pixels"}, "flat"),
                         ({"reward": "rich"}, "dense")):
        with pytest.raises(ValueError, match=f"known: {message}"):
            ArticulationEnv(door, **bad)


def test_randomization_ends_with_its_episode(door: Asset) -> None:
    env = ArticulationEnv(door)
    damping = env.model.dof_damping.copy()
    env.reset(seed=0, options={"randomize": {"damping": 0.5}})
    assert not np.array_equal(env.model.dof_damping, damping)
    env.reset()
    np.testing.assert_array_equal(env.model.dof_damping, damping)


def test_reset_options(door: Asset) -> None:
    env = ArticulationEnv(door)
    env.reset(options={"q0": 0.7})
    assert env.q == 0.7
    env.reset(options={"phase": 0.5})
    middle = np.interp(0.5 * door.demo["duration"], door.reference.time, door.reference.q)
    assert env.q == pytest.approx(middle)
    for bad, message in (({"q0": 9.0}, "range"), ({"phase": 2}, "phase"), ({"speed": 1}, "known: q0"),
                         ({"randomize": {"colour": 1}}, "known: axis")):
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
    assert not np.shares_memory(second, third) and (third[-8:] == 0).all()


def test_pickles_as_made() -> None:
    env = gymnasium.make("TAA/door", reward="sparse").unwrapped
    again = pickle.loads(pickle.dumps(env))
    assert again.asset.id == "door" and again.task.scales == {"success": 1.0}
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


def test_the_pace_holds_and_turns_back_the_demonstration(door: Asset) -> None:
    env = ArticulationEnv(door)
    env.reset(seed=0)
    wait, back, ahead = (np.eye(8, dtype=np.float32)[7] * a for a in (-2 / 3, -1, 1))
    clock = [env.task.time[0]]
    for action in (ZERO, wait, ahead, back):
        env.step(action)
        clock.append(env.task.time[0])
    np.testing.assert_allclose(np.diff(clock), [0.02, 0, 0.05, -0.01], atol=1e-8)
    for _ in range(50):
        env.step(back)
    assert env.task.time[0] == door.reference.time[0]  # not before its beginning


def test_corrections_reach_as_far_as_the_asset_is_uncertain(door: Asset, tmp_path: Path) -> None:
    import dataclasses

    from taa_envs.motion import residual_translation

    unsure = dataclasses.replace(door, provenance={**door.provenance, "hand.offset": {"value": 0, "std": 0.03}})
    assert residual_translation(door, 0.1) == 0.03
    assert 0.09 <= residual_translation(unsure, 0.1) <= 0.1
    env = ArticulationEnv(unsure)
    env.reset(seed=0)
    still = env.task._aim[0, :21].mean(0)
    for _ in range(5):
        env.step(np.array([1, 0, 0, 0, 0, 0, 0, -2 / 3], np.float32))
    np.testing.assert_allclose(env.task._aim[0, :21].mean(0) - still, [env.task.translation, 0, 0], atol=1e-3)


def test_actions_of_another_size_are_refused(door: Asset) -> None:
    with pytest.raises(ValueError, match="8 numbers"):
        ArticulationEnv(door).step(np.zeros(7, np.float32))


def test_residual_moves_turns_and_closes(door: Asset) -> None:
    joints = door.reference.hand_joints[0]
    np.testing.assert_allclose(apply_residual(joints, ZERO), joints, atol=1e-15)
    moved = apply_residual(joints, np.array([1, 0, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(moved - joints, np.tile([0.03, 0, 0], (21, 1)), atol=1e-12)
    turned = apply_residual(joints, np.array([0, 0, 0, 0, 0, 1, 0]))
    palm = [0, 5, 9, 13, 17]
    np.testing.assert_allclose(turned[palm].mean(0), joints[palm].mean(0), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(turned[8] - turned[0]), np.linalg.norm(joints[8] - joints[0]))
    closed = apply_residual(joints, np.array([0, 0, 0, 0, 0, 0, 1]))
    assert np.linalg.norm(closed[4] - closed[8]) == pytest.approx(0.5 * np.linalg.norm(joints[4] - joints[8]))
    np.testing.assert_allclose(closed[palm], joints[palm], atol=1e-15)

"""The batched environment: the single one, many times."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import taa_envs
from taa_envs.asset import Asset
from taa_envs.env import ArticulationEnv
from taa_envs.vector import BatchedArticulationEnv


def random_actions(count: int, n: int, size: int, scale: float = 0.4) -> np.ndarray:
    return (scale * np.random.default_rng(0).uniform(-1, 1, (count, n, size))).astype(np.float32)


@pytest.mark.parametrize(("name", "action", "size", "count"),
                         [("door", "residual", 8, 130), ("drawer", "residual", 8, 130), ("door", "absolute", 63, 40)])
def test_equals_single_environments_step_by_step(name: str, action: str, size: int, count: int,
                                                 request: pytest.FixtureRequest) -> None:
    """Under gymnasium's own loop, with randomised models, over the ends of episodes."""
    asset = request.getfixturevalue(name)
    arguments = {"asset": asset, "action": action, "randomize": True}
    singles = gymnasium.vector.SyncVectorEnv(
        [lambda: gymnasium.wrappers.TimeLimit(ArticulationEnv(**arguments), 70)] * 3)
    batch = BatchedArticulationEnv(num_envs=3, max_episode_steps=70, threads=1, **arguments)
    a, info_a = singles.reset(seed=11)
    b, info_b = batch.reset(seed=11)
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-10)
    for key, value in info_a["randomized"].items():
        if not key.startswith("_"):
            np.testing.assert_array_equal(value, info_b["randomized"][key])
    for actions in random_actions(count, 3, size):
        ra, rb = singles.step(actions), batch.step(actions)
        for x, y in zip(ra[:4], rb[:4], strict=True):
            np.testing.assert_allclose(x, y, rtol=0, atol=1e-10)
        for key in ("joint_progress", "contact_fraction", "is_success", "final_q_error"):
            np.testing.assert_array_equal(ra[4][key], rb[4][key])


def test_dict_and_goal_observations(door: Asset) -> None:
    for arguments in ({"observation": "dict"}, {"reward": "sparse_goal"}):
        single, batch = ArticulationEnv(door, **arguments), BatchedArticulationEnv(door, 2, threads=1, **arguments)
        assert batch.single_observation_space == single.observation_space
        a, b = single.reset(seed=0)[0], batch.reset(seed=0)[0]
        assert batch.observation_space.contains(b)
        for _ in range(45):
            ra, rb = single.step(np.zeros(8)), batch.step(np.zeros((2, 8)))
        assert ra[1] == rb[1][0]
        for key in a:
            np.testing.assert_array_equal(ra[0][key], rb[0][key][0])


def test_made_by_name(asset_root, door: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TAA_ASSETS", str(asset_root))
    taa_envs.register_assets()
    try:
        env = gymnasium.make_vec("TAA/door", 2, vectorization_mode="vector_entry_point", reward="sparse")
        assert env.unwrapped.max_episode_steps == gymnasium.spec("TAA/door").max_episode_steps
        assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
        observation, _ = env.reset(seed=[4, 4])
        assert env.observation_space.contains(observation)
        np.testing.assert_array_equal(observation[0], observation[1])
        env.close()
    finally:
        monkeypatch.undo()
        taa_envs.register_assets()


def test_every_registered_id_passes_the_checkers(asset_root, door: Asset, drawer: Asset,
                                                 monkeypatch: pytest.MonkeyPatch) -> None:
    """Gymnasium's and Stable-Baselines3's, one simulation and many: the shipped assets and the tests' own."""
    from gymnasium.utils.env_checker import check_env
    from stable_baselines3.common.env_checker import check_env as check_sb3
    from stable_baselines3.common.vec_env import VecCheckNan

    from train.vec import BatchedVecEnv

    monkeypatch.setenv("TAA_ASSETS", str(asset_root))
    ids = taa_envs.register_assets()
    try:
        assert {"TAA/door", "TAA/drawer"} <= set(ids)
        for env_id in ids:
            env = gymnasium.make(env_id).unwrapped
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                warnings.filterwarnings("ignore", message=".*different from the unwrapped version.*")
                check_env(env, skip_render_check=True)
                check_sb3(env)
            many = gymnasium.make_vec(env_id, 2, vectorization_mode="vector_entry_point", autoreset_mode="same_step",
                                      max_episode_steps=4)
            many.action_space.seed(0)
            seen, info = many.reset(seed=0)
            kept = seen.copy()
            for _ in range(9):  # over the ends of two episodes
                assert many.observation_space.contains(seen) and seen.dtype == np.float32
                step = many.step(many.action_space.sample())
                seen = step[0]
                assert [np.shape(x) for x in step[1:4]] == [(2,)] * 3
                assert step[2].dtype == step[3].dtype == bool
                assert all(np.shape(v) == (2,) for k, v in step[4].items() if k[:1] != "_" and isinstance(v, np.ndarray)
                           and k != "final_obs")
            assert not np.array_equal(kept, seen)
            np.testing.assert_array_equal(many.reset(seed=0)[0], kept)  # and nothing handed out was written to
            face = VecCheckNan(BatchedVecEnv(many.unwrapped), raise_exception=True)
            face.reset()
            for _ in range(5):
                face.step(np.zeros((2, 8), np.float32))
            many.close()
    finally:
        monkeypatch.undo()
        taa_envs.register_assets()


def test_autoreset_modes(door: Asset) -> None:
    def run(mode: str, steps: int = 13) -> list[tuple]:
        env = BatchedArticulationEnv(door, 2, max_episode_steps=6, autoreset_mode=mode, threads=1)
        env.reset(seed=0)
        return [env.step(a) for a in random_actions(steps, 2, 8)]

    later, at_once = run("next_step"), run("same_step")
    assert [bool(r[3][0]) for r in later] == [i in (5, 12) for i in range(13)]
    assert [bool(r[3][0]) for r in at_once] == [i in (5, 11) for i in range(13)]
    # The first observation of the next episode comes a step later, or beside the last one of the old.
    np.testing.assert_array_equal(later[5][0], at_once[5][4]["final_obs"])
    np.testing.assert_array_equal(later[6][0], at_once[5][0])
    assert (later[6][1] == 0).all() and at_once[5][4]["_final_obs"].all()
    np.testing.assert_array_equal(at_once[5][4]["final_info"]["joint_progress"], later[5][4]["joint_progress"])

    env = BatchedArticulationEnv(door, 2, max_episode_steps=3, autoreset_mode="disabled", threads=1)
    env.reset(seed=0)
    for actions in random_actions(3, 2, 8):
        env.step(actions)
    with pytest.raises(ValueError, match="reset_mask"):
        env.step(actions)
    before = env.task.q
    env.reset(options={"reset_mask": np.array([True, False]), "q0": 0.5})
    assert env.task.q[0] == 0.5 and env.task.q[1] == before[1]
    with pytest.raises(ValueError, match="known: next_step"):
        BatchedArticulationEnv(door, 2, autoreset_mode="never")


def test_a_snapshot_goes_on_as_the_episodes_did(door: Asset) -> None:
    env, other = (BatchedArticulationEnv(door, 3, max_episode_steps=30, randomize=True, threads=1) for _ in range(2))
    env.reset(seed=1)
    actions = random_actions(60, 3, 8)
    for a in actions[:25]:
        env.step(a)
    state = env.get_state()
    first = [env.step(a) for a in actions[25:]]
    other.set_state(state)
    for a, expected in zip(actions[25:], first, strict=True):
        got = other.step(a)
        for x, y in zip(expected[:4], got[:4], strict=True):
            np.testing.assert_array_equal(x, y)


def test_held_actions_are_the_same_steps(door: Asset) -> None:
    """Rewards sum, an episode's end ends the hold, and the next begins after it."""
    held = BatchedArticulationEnv(door, 2, max_episode_steps=8, autoreset_mode="same_step", hold=3, randomize=True,
                                  threads=1)
    plain = BatchedArticulationEnv(door, 2, max_episode_steps=8, autoreset_mode="disabled", randomize=True, threads=1)
    np.testing.assert_array_equal(held.reset(seed=2)[0], plain.reset(seed=2)[0])
    for k, action in enumerate(random_actions(3, 2, 8)):
        steps = [plain.step(action) for _ in range(3 if k < 2 else 2)]
        seen, rewards, terminated, truncated, info = held.step(action)
        np.testing.assert_allclose(rewards, sum(s[1] for s in steps), atol=1e-12)
        np.testing.assert_array_equal(info["final_obs"] if k == 2 else seen, steps[-1][0])
        np.testing.assert_allclose(sum(info.get("final_info", info)["reward_terms"].values()), rewards, atol=1e-12)
        assert truncated.all() == (k == 2) and not terminated.any()
    np.testing.assert_array_equal(seen, plain.reset(options={"reset_mask": np.ones(2, bool)})[0])
    with pytest.raises(ValueError, match="hold"):
        BatchedArticulationEnv(door, 2, hold=0)


def test_bad_arguments(door: Asset) -> None:
    env = BatchedArticulationEnv(door, 2, threads=1)
    with pytest.raises(ValueError, match="2 seeds"):
        env.reset(seed=[1])
    with pytest.raises(ValueError, match=r"shape \(2, 8\)"):
        env.step(np.zeros((3, 8)))
    with pytest.raises(ValueError, match="known: q0"):
        env.reset(options={"speed": 1})


def test_hands_with_joints_are_refused_in_one_line(door: Asset) -> None:
    with pytest.raises(ValueError, match="one simulation at a time; use hand='points' or vectorization_mode='sync'"):
        BatchedArticulationEnv(door, 2, hand="human")

"""The guide that knows the draws, and what a policy learns from it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from taa_envs.asset import Asset
from taa_envs.errors import TaaEnvsError
from taa_envs.vector import BatchedArticulationEnv
from train import guide
from train.config import Config, load_config
from train.guide import Guide, Way, carried, play, teach
from train.policy import Policy, policy_arguments
from train.run import train
from train.vec import BatchedVecEnv, Normal

SMALL = Config(algo="ppo", envs=2, steps=100_000, checkpoint_every=10**6, hold=5, guide_episodes=8,
               algorithm={"n_steps": 64, "batch_size": 64}, policy={"net_arch": [64, 64], "activation_fn": "relu"})


def fresh(door: Asset, config: Config):
    """An untrained PPO as training begins with it, and its observations' normal."""
    from stable_baselines3 import PPO

    batch = BatchedArticulationEnv(door, config.envs, autoreset_mode="same_step", randomize=True, hold=config.hold)
    size = batch.single_observation_space.shape
    normal = Normal(np.zeros(size), np.ones(size))
    model = PPO("MlpPolicy", BatchedVecEnv(batch, normal), policy_kwargs=policy_arguments(config.policy), seed=0,
                device="cpu", **config.algorithm)
    return model, normal


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-2, 2), min_size=7, max_size=7), st.floats(-1.5, 1.5))
def test_points_are_carried_there_and_back(door: Asset, numbers: list[float], q: float) -> None:
    axis = np.array([*numbers[:2], 2.5])
    joint = (axis / np.linalg.norm(axis))[None], np.array([numbers[2:5]])
    x, at = np.array([[numbers[5], numbers[6], 0.3]]), np.array([q])
    there = carried(door, joint, at, x)
    assert np.allclose(carried(door, joint, -at, there), x)
    assert np.isclose(np.linalg.norm(there - joint[1]), np.linalg.norm(x - joint[1]))  # a hinge keeps distances


def test_without_draws_the_guide_is_the_replay(door: Asset) -> None:
    env = BatchedArticulationEnv(door, 2)
    env.reset(seed=0)
    guide = Guide(env, {}, [Way(0.0, 0.0)] * 2)
    for _ in range(60):
        assert np.abs(guide.act()).max() < 1e-6
        env.step(env.reference_action())
    pressing = Guide(env, {}, [Way(0.0, 0.0), Way(0.02, 0.02)]).act()
    assert np.abs(pressing[0]).max() < 1e-6
    assert np.linalg.norm(pressing[1, :3]) * env.task.translation == pytest.approx(0.02, 1e-3)


def test_the_guide_takes_back_what_was_drawn(door: Asset) -> None:
    """A shifted hand is led back exactly, as far as an action reaches; a shifted pivot moves the hand along its arc."""
    env = BatchedArticulationEnv(door, 2)
    env.reset(seed=0)
    for _ in range(60):
        env.step(env.reference_action())
    offset = np.array([[0.01, -0.02, 0.005]] * 2)
    said = Guide(env, {"hand": offset}, [Way(0.0, 0.0)] * 2).act()
    assert np.allclose(said[:, :3] * env.task.translation, -offset, atol=1e-6)
    point = np.tile(np.array(door.joint["point"], float) + [0.0, 0.02, 0.0], (2, 1))
    moved = Guide(env, {"point": point}, [Way(0.0, 0.0)] * 2).act()[:, :3] * env.task.translation
    q = np.interp(env.task.time[0], door.reference.time, door.reference.q)
    assert np.linalg.norm(moved[0]) == pytest.approx(2 * np.sin(abs(q) / 2) * 0.02, abs=2e-4)


def test_the_guide_reaches_in_and_waits_as_it_is_told(door: Asset) -> None:
    env = BatchedArticulationEnv(door, 2)
    env.reset(seed=0)
    aside = env.reference_action()
    aside[:, 1] = 1.0  # the hand passes the door, which lags
    for _ in range(60):
        env.step(aside)
    q = np.interp(env.task.time, door.reference.time, door.reference.q)
    assert (door.stroke_fraction(q) > door.stroke_fraction(env.task.q) + 0.01).all()
    axis, point = np.array(door.joint["axis"], float), np.array(door.joint["point"], float)
    said = Guide(env, {}, [Way(0.0, 0.0, pace=0.1), Way(0.0, 0.0, pace=0.1, wait=1e-4, inward=0.02)]).act()
    assert np.allclose(said[:, 7], [0.1, guide.STAND])
    still, inward = env.task.path(env.task.time).mean(1) + said[:, :3] * env.task.translation
    assert np.linalg.norm(np.cross(still - point, axis)) - np.linalg.norm(np.cross(inward - point, axis)) == (
        pytest.approx(0.02, abs=1e-4))
    assert abs((inward - still) @ axis) < 1e-6  # not along it


def test_a_clumsy_driver_errs_as_much_as_stated_and_alike_under_a_seed(door: Asset,
                                                                       monkeypatch: pytest.MonkeyPatch) -> None:
    env, acted = BatchedArticulationEnv(door, 32), []
    step = env.step
    monkeypatch.setattr(env, "step", lambda action: acted.append(action.copy()) or step(action))
    ways = [Way(0.0, 0.0)] * 32

    def errors(slip: np.ndarray | float) -> np.ndarray:
        acted.clear()
        advised = play(env, 5, ways, slip=slip).advised
        return np.array(acted)[:10] - advised[:10]

    assert not errors(0.0).any()
    first, again = errors(np.linspace(0, 0.05, 32)), errors(np.linspace(0, 0.05, 32))
    assert (first == again).all()
    used = np.isin(np.arange(first.shape[-1]), guide.USED)
    assert not first[..., ~used].any() and not first[:, 0].any()
    habit = first[:, 16:].mean(0)[:, used]  # of the clumsier half; what comes anew evens out
    assert 0.02 < habit.std() < 0.06


def test_a_policy_learns_what_the_guide_says(door: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guide, "TRIALS", 4)
    monkeypatch.setattr(guide, "WAYS", guide.WAYS[:2])
    monkeypatch.setattr(guide, "EPOCHS", 100)
    weights = []
    for _ in range(2):
        model, normal = fresh(door, SMALL)
        used = teach(model, door, SMALL, normal)
        longest = model.env.env.max_episode_steps
        assert 0 < used <= guide.most_steps(SMALL, longest)
        weights.append({name: value.clone() for name, value in model.policy.state_dict().items()})
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])  # nothing else is drawn from
    env = BatchedArticulationEnv(door, 8, randomize=True, hold=SMALL.hold)
    run = play(env, 77, [guide.WAYS[0]] * 8)  # draws that no lesson had
    advised, observed = run.advised[run.live], run.observed[run.live]
    acted = Policy(model.policy, normal, SMALL.hold).act(observed)
    assert np.mean((acted - advised) ** 2) < 0.2 * np.mean(advised**2)


def test_a_guide_needs_room_and_ppo(door: Asset, tmp_path) -> None:
    short = Config(**{**SMALL.as_dict(), "steps": 256})
    assert train(door, short, tmp_path / "run")["guided"] is False
    file = tmp_path / "a.toml"
    file.write_text("envs = 2\nsteps = 9\ncheckpoint_every = 9\nguide_episodes = 4\n", encoding="utf-8")
    with pytest.raises(TaaEnvsError, match="guide_episodes = 0"):
        load_config("sac", file)
    file.write_text("envs = 2\nsteps = 9\ncheckpoint_every = 9\n[policy]\nactivation_fn = 'os.system'\n",
                    encoding="utf-8")
    with pytest.raises(TaaEnvsError, match="known are relu and tanh"):
        train(door, load_config("ppo", file), tmp_path / "other")

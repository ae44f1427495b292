"""Training, resuming, policies on disk, evaluation."""

from __future__ import annotations

import csv
import json
import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from taa_envs.asset import Asset
from taa_envs.errors import TaaEnvsError
from taa_envs.vector import BatchedArticulationEnv
from train.config import Config, load_config
from train.evaluate import episodes, evaluate
from train.film import record
from train.guide import Way
from train.policy import load_policy
from train.run import train
from train.vec import BatchedVecEnv

PPO = Config(algo="ppo", envs=2, steps=1024, checkpoint_every=256, hold=2, algorithm={"n_steps": 64, "batch_size": 64,
             "n_epochs": 2}, policy={"net_arch": [16]})
SAC = Config(algo="sac", envs=2, steps=600, checkpoint_every=200, hold=2, algorithm={"buffer_size": 500,
             "learning_starts": 50, "batch_size": 16, "gradient_steps": 1}, policy={"net_arch": [16]})
GUIDED = Config(**{**PPO.as_dict(), "steps": 4000, "guide_episodes": 2, "evaluate_every": 500, "evaluate_episodes": 2,
                   "enough": 2.0, "policy": {"net_arch": [16], "activation_fn": "relu"}})


class Killed(Exception):
    pass


def curve(folder: Path) -> list[list[str]]:
    """Without the columns of seconds."""
    with (folder / "curve.csv").open(newline="", encoding="utf-8") as f:
        return [row[:-2] for row in csv.reader(f)]


@pytest.mark.parametrize("config", [Config(**{**PPO.as_dict(), "evaluate_every": 500, "evaluate_episodes": 2,
                                              "enough": 2.0, "anneal_to": -1.0, "anneal_steps": 800}),
                                    GUIDED, SAC], ids=["ppo", "guided", "sac"])
def test_a_killed_run_goes_on_to_the_same_curve(config: Config, door: Asset, tmp_path: Path,
                                                monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("train.run.CHUNK", 200)
    for name, value in (("TRIALS", 1), ("WAYS", (Way(0.0, 0.02),)), ("ROUNDS", 1), ("EPOCHS", 3)):
        monkeypatch.setattr(f"train.guide.{name}", value)
    whole = train(door, config, tmp_path / "whole")
    assert whole["resumed_at"] == 0 and whole["steps"] >= config.steps

    def kill(share: float, row: dict) -> None:
        if row["steps"] >= config.steps // 2 + 50:  # between two checkpoints
            raise Killed

    with pytest.raises(Killed):
        train(door, config, tmp_path / "killed", progress=kill)
    np.random.default_rng(0).random(3), torch.rand(5)  # other generators' states do not matter
    again = train(door, config, tmp_path / "killed")
    assert 0 < again["resumed_at"] < config.steps
    assert again["guided"] is whole["guided"] is (config is GUIDED)
    assert curve(tmp_path / "killed") == curve(tmp_path / "whole") and len(curve(tmp_path / "whole")) > 3
    a, b = (load_policy(tmp_path / name)[0].network.state_dict() for name in ("whole", "killed"))
    assert all(torch.equal(a[key], b[key]) for key in a)


def test_a_kill_between_checkpoint_and_results(door: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The run is done by its checkpoint, but policy and curve are those of the checkpoint before, or absent."""
    from train import run

    small = Config(**{**PPO.as_dict(), "steps": 512})
    train(door, small, tmp_path / "whole")
    write, calls = run._write_results, []

    def killed(*arguments: object) -> None:
        calls.append(1)
        if len(calls) == 2:
            raise Killed
        write(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(run, "_write_results", killed)
        with pytest.raises(Killed):
            train(door, small, tmp_path / "killed")
    assert len(curve(tmp_path / "killed")) < len(curve(tmp_path / "whole"))
    assert train(door, small, tmp_path / "killed")["resumed_at"] == 512
    assert curve(tmp_path / "killed") == curve(tmp_path / "whole")
    (tmp_path / "early").mkdir()
    (tmp_path / "early" / ".config.json.elsewhere-1-x.json").touch()  # what a kill in the very first write leaves
    assert train(door, small, tmp_path / "early")["steps"] == 512


def test_a_run_stops_by_the_clock_and_goes_on(door: Asset, tmp_path: Path) -> None:
    stopped = train(door, PPO, tmp_path / "run", minutes=1e-6)
    assert stopped["steps"] == 256 and (tmp_path / "run" / "policy.pt").is_file()  # one iteration
    done = train(door, PPO, tmp_path / "run")
    assert done["resumed_at"] == 256 and done["steps"] == PPO.steps and done["seconds"] > stopped["seconds"]


def test_a_folder_holds_one_run(door: Asset, tmp_path: Path) -> None:
    small = Config(**{**PPO.as_dict(), "steps": 256})
    train(door, small, tmp_path / "run")
    done = train(door, small, tmp_path / "run")
    assert done["resumed_at"] == done["steps"] == 256  # nothing left to do
    with pytest.raises(TaaEnvsError, match="other settings"):
        train(door, Config(**{**small.as_dict(), "seed": 1}), tmp_path / "run")
    # What is drawn belongs to what was trained on: the same model, known less well, is another asset.
    vague = replace(door, provenance={**door.provenance, "hand.offset": {"value": 0.0, "origin": "fitted", "std": 0.5}})
    with pytest.raises(TaaEnvsError, match="of another asset"):
        train(vague, small, tmp_path / "run")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("x")
    with pytest.raises(TaaEnvsError, match="not a training run"):
        train(door, small, tmp_path / "mine")
    assert [p.name for p in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_the_policy_loads_in_a_fresh_process(door: Asset, tmp_path: Path) -> None:
    train(door, Config(**{**PPO.as_dict(), "steps": 256}), tmp_path / "run")
    here = evaluate(door, tmp_path / "run", 3)
    code = ("import sys, json; from taa_envs import load_asset; from train.evaluate import evaluate\n"
            "print(json.dumps(evaluate(load_asset(sys.argv[1]), sys.argv[2], 3)))")
    out = subprocess.run([sys.executable, "-c", code, str(door.path), str(tmp_path / "run" / "policy.pt")], check=True,
                         capture_output=True, text=True, timeout=120,
                         env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])})
    assert json.loads(out.stdout.splitlines()[-1]) == here
    assert here["episodes"] == 3 and here["replay"]["success_ci95"][0] <= here["replay"]["success"]


def test_replay_in_the_evaluation_is_the_replay(door: Asset) -> None:
    run = episodes(door, None, 2, randomize=False)
    assert run["success"].all() and (run["progress"] >= 0.95).all() and run["steps"][0] == run["steps"][1]
    same = episodes(door, None, 3, seed=5)
    np.testing.assert_array_equal(same["progress"][1:], episodes(door, None, 2, seed=6)["progress"])


def test_bad_policies_are_refused(door: Asset, tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple:
            return os.mkdir, (str(tmp_path / "ran"),)

    (tmp_path / "evil.pt").write_bytes(pickle.dumps(Evil()))
    torch.save({"format": "taa-policy/2", "x": Evil()}, tmp_path / "evil2.pt")
    torch.save({"format": "other"}, tmp_path / "other.pt")
    torch.save({"format": "taa-policy/2"}, tmp_path / "empty.pt")
    for name in ("evil.pt", "evil2.pt", "other.pt", "empty.pt", "none.pt"):
        with pytest.raises(TaaEnvsError):
            evaluate(door, tmp_path / name, 1)
    assert not (tmp_path / "ran").exists()


def test_settings_come_from_files(tmp_path: Path) -> None:
    for algo in ("ppo", "sac"):
        assert load_config(algo).algo == algo and load_config(algo, steps=7, seed=3).steps == 7
    with pytest.raises(TaaEnvsError, match="known: ppo, sac"):
        load_config("dqn")
    for text in ("steps = ", "envs = 0\nsteps = 1\ncheckpoint_every = 1", "speed = 3"):
        (tmp_path / "c.toml").write_text(text)
        with pytest.raises(TaaEnvsError):
            load_config("ppo", tmp_path / "c.toml")


def test_vec_env_as_stable_baselines_wants_it(door: Asset) -> None:
    with pytest.raises(ValueError, match="same_step"):
        BatchedVecEnv(BatchedArticulationEnv(door, 2))
    env = BatchedVecEnv(BatchedArticulationEnv(door, 2, autoreset_mode="same_step", max_episode_steps=5, threads=1))
    env.seed(3)
    first = env.reset()
    total = 0.0
    for step in range(5):
        seen, reward, done, infos = env.step(np.zeros((2, 8), np.float32))
        total += reward[0]
        assert done.all() == (step == 4)
    assert infos[0]["TimeLimit.truncated"] and infos[0]["episode"]["r"] == pytest.approx(total, abs=1e-6)
    assert infos[0]["episode"]["l"] == 5
    np.testing.assert_array_equal(seen, first)  # the unperturbed start
    assert not np.array_equal(infos[0]["terminal_observation"], first[0])


@pytest.mark.slow
def test_video(door: Asset, tmp_path: Path) -> None:
    train(door, Config(**{**PPO.as_dict(), "steps": 256}), tmp_path / "run")
    record(door, tmp_path / "run", tmp_path / "a.mp4", count=1, height=96)
    assert (tmp_path / "a.mp4").stat().st_size > 5000


def test_the_curve_does_not_begin_with_successes_alone(door: Asset) -> None:
    """An average over what has ended is of early successes only; over what began long enough ago it is not."""
    from train.run import _Episodes

    episodes = _Episodes(longest=10)

    def pass_by(*ended: tuple[bool, int]) -> None:
        """One decision, in which episodes end: success, length."""
        episodes.locals = {"infos": [{"episode": {"r": 0.0, "l": length}, "is_success": won, "joint_progress": 1.0}
                                     for won, length in ended] or [{}]}
        episodes._on_step()

    for step in range(1, 10):
        pass_by(*([(True, 5)] if step == 5 else []))
        assert np.isnan(episodes.means()[0])  # a failure that began with that success may still be running
    pass_by((False, 10), (True, 5))
    assert episodes.means()[0] == 0.5 and episodes.count == 2  # the second success began later


def test_the_best_policy_is_kept_and_a_perfect_one_ends_training(door: Asset, tmp_path: Path,
                                                                 monkeypatch: pytest.MonkeyPatch) -> None:
    from train import run

    config = Config(**{**PPO.as_dict(), "evaluate_every": 256, "steps": 100_000})
    answers, weights = [0.5, 0.7, 0.6, 1.0], []

    def success(self: object, model: object) -> float:
        weights.append({name: value.clone() for name, value in model.policy.state_dict().items()})
        return answers[len(weights) - 1]

    monkeypatch.setattr(run._Judge, "success", success)

    def kept(of: int) -> bool:
        held = load_policy(tmp_path / "run")[0].network.state_dict()
        return all(torch.equal(held[name], value) for name, value in weights[of].items())

    def look(share: float, row: dict) -> None:
        if row["steps"] == 768:  # written at the end of the iteration before
            assert kept(1) and not kept(0)

    done = train(door, config, tmp_path / "run", progress=look)
    assert done["evaluated"] == 1.0 and done["steps"] == 768 and kept(3)
    assert train(door, config, tmp_path / "run")["resumed_at"] == 768  # it stays ended
    with (tmp_path / "run" / "curve.csv").open(encoding="utf-8") as f:
        assert [(row["steps"], float(row["evaluated"])) for row in csv.DictReader(f)] == [
            ("0", 0.5), ("256", 0.7), ("512", 0.6), ("768", 1.0)]


def test_a_replay_that_needs_no_training_is_left_as_it_is(door: Asset, tmp_path: Path) -> None:
    config = Config(**{**PPO.as_dict(), "randomize": False, "evaluate_every": 1, "evaluate_episodes": 2})
    done = train(door, config, tmp_path / "run")
    assert done["evaluated"] == 1.0 and done["steps"] == 0
    policy = load_policy(tmp_path / "run")[0]
    assert not policy.act(np.random.default_rng(0).normal(size=(4, *policy.sizes[0]))).any()  # the replay


def test_a_replay_that_never_failed_in_the_evaluation_is_taught_all_the_same(door: Asset, tmp_path: Path,
                                                                             monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("TRIALS", 1), ("WAYS", (Way(0.0, 0.02),)), ("ROUNDS", 1), ("EPOCHS", 3)):
        monkeypatch.setattr(f"train.guide.{name}", value)
    config = Config(**{**GUIDED.as_dict(), "enough": 0.0, "evaluate_episodes": 2})
    done = train(door, config, tmp_path / "run")
    assert done["guided"] is True and 0 < done["steps"] < config.steps
    assert train(door, config, tmp_path / "run")["resumed_at"] == done["steps"]  # it stays ended



def test_exploration_falls_along_its_line(door: Asset, tmp_path: Path) -> None:
    config = Config(**{**PPO.as_dict(), "steps": 512, "anneal_to": -2.0, "anneal_steps": 256})
    train(door, config, tmp_path / "run")
    assert (load_policy(tmp_path / "run")[0].network.log_std < -1.9).all()


def test_a_wall_shows_every_asset_to_its_end(door: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from train import film

    train(door, Config(**{**PPO.as_dict(), "steps": 256}), tmp_path / "run")
    lengths = iter([8, 3])

    def pairs(*_: object, **__: object) -> Iterator[list[np.ndarray]]:
        for k in range(next(lengths)):
            yield [np.full((20, 30, 3), 20 * k, np.uint8)] * 2

    monkeypatch.setattr(film, "_pairs", pairs)
    film.wall([(door, tmp_path / "run")] * 2, tmp_path / "a.webp", columns=1, height=20)
    image = Image.open(tmp_path / "a.webp")
    assert image.size == (60, 40) and image.format == "WEBP"
    image.seek(7)
    last = np.array(image.convert("RGB"))[::20, -1, 0].astype(int)
    assert np.abs(last - [140, 40]).max() < 12  # the shorter one waits at its end

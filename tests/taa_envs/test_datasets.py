"""Minari datasets: recorded, loaded back, played again with the same score."""

from __future__ import annotations

import json
from pathlib import Path

import minari
import numpy as np
import pytest

import taa_envs
from taa_envs.asset import Asset
from taa_envs.cli import main
from taa_envs.datasets import default_name, is_dataset_name, load, record, replayed, score_episode
from taa_envs.errors import TaaEnvsError


@pytest.fixture(autouse=True)
def here(tmp_path: Path, door: Asset, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("TAA_ASSETS", str(door.path.parent))
    taa_envs.register_assets()
    yield
    monkeypatch.undo()
    taa_envs.register_assets()


def test_a_recorded_episode_plays_again_to_the_same_score(door: Asset) -> None:
    name = record(door, episodes=3, seed=5)
    assert name == default_name(door) == "TAA/door/replay-v0" and name in minari.list_local_datasets()
    data = minari.load_dataset(name)  # as somebody without this package would
    assert data.total_episodes == 3 and data.total_steps == sum(len(e) for e in data)
    for row in replayed(door, name):
        assert row["same"] and row["again"] == row["recorded"]
        scores = score_episode(door, name, row["episode"])
        assert scores["joint_progress"] == row["recorded"]
        assert scores["is_success"] == data[row["episode"]].infos["is_success"][-1]
    first, second = data[0], data[1]
    assert first.observations.shape == (len(first) + 1, 170) and first.actions.shape == (len(first), 8)
    assert not np.array_equal(first.observations[0], second.observations[0])  # each drawn afresh
    env = data.recover_environment()
    np.testing.assert_array_equal(env.reset(seed=5)[0], first.observations[0])
    env.close()


def test_a_policys_actions_are_held(door: Asset) -> None:
    asked = []

    def act(observation: np.ndarray) -> np.ndarray:
        asked.append(observation)
        return np.full(8, 0.1 * (-1) ** len(asked), np.float32)

    name = record(door, "TAA/door/shaky-v2", 1, randomize=False, act=act, hold=5, algorithm="shaking")
    actions = load(name)[0].actions
    assert len(asked) == -(-len(actions) // 5)
    np.testing.assert_array_equal(actions[:5], np.tile(actions[0], (5, 1)))
    assert (actions[5] == -actions[0]).all() and next(iter(replayed(door, name)))["same"]


def test_what_is_refused(door: Asset, drawer: Asset, tmp_path: Path) -> None:
    record(door, episodes=1, randomize=False)
    with pytest.raises(TaaEnvsError, match="overwrite"):
        record(door, episodes=1)
    record(door, episodes=2, randomize=False, overwrite=True)
    assert load("TAA/door/replay-v0").total_episodes == 2
    for bad in ("../../etc/x-v0", "/abs/x-v0", "TAA//x-v0", "x", "TAA/door/replay-v0/.."):
        assert not is_dataset_name(bad)
        with pytest.raises(TaaEnvsError, match="no dataset's name"):
            record(door, bad, 1)
    with pytest.raises(TaaEnvsError, match="cannot be read"):
        load("TAA/none-v0")
    with pytest.raises(TaaEnvsError, match="episodes 0 to 1"):
        score_episode(door, "TAA/door/replay-v0", 2)
    with pytest.raises(TaaEnvsError, match="TAA/door"):
        score_episode(drawer, "TAA/door/replay-v0")
    assert not [p for p in (tmp_path / "minari" / "TAA" / "door").iterdir() if p.name.startswith(".")]


def test_commands(door: Asset, capfd: pytest.CaptureFixture) -> None:
    assert main(["replay", "door", "--record", "replay", "--episodes", "1", "--json"]) == 0
    made = json.loads(capfd.readouterr().out)
    assert made["dataset"] == "TAA/door/replay-v0" and made["episodes"][0]["same"]
    assert main(["score", "door", made["dataset"], "--json"]) == 0
    scores = json.loads(capfd.readouterr().out)
    assert scores["joint_progress"] == made["episodes"][0]["recorded"]
    assert main(["replay", "door", "--record", "replay", "--episodes", "1"]) == 1
    assert "--overwrite" in capfd.readouterr().err
    assert main(["score", "door", "nothing"]) == 1
    assert "no such file" in capfd.readouterr().err

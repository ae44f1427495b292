"""``taa train`` and ``taa evaluate``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from taa_envs.asset import Asset
from taa_envs.cli import main


def test_train_then_evaluate(door: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                             capfd: pytest.CaptureFixture) -> None:
    monkeypatch.setenv("TAA_ASSETS", str(door.path.parent))
    monkeypatch.chdir(tmp_path)
    settings = tmp_path / "small.toml"
    settings.write_text("envs = 2\nsteps = 64\ncheckpoint_every = 64\nhold = 1\n"
                        "[algorithm]\nn_steps = 32\nbatch_size = 32\n")
    assert main(["train", "door", "--config", str(settings), "--json"]) == 0
    made = json.loads(capfd.readouterr().out)
    assert made["steps"] == 64 and made["run"] == str(Path("runs") / "door-ppo-0")
    assert main(["evaluate", "door", made["policy"], "--episodes", "2", "--json"]) == 0
    scores = json.loads(capfd.readouterr().out)
    assert scores["episodes"] == 2 and 0 <= scores["policy"]["success"] <= 1
    assert scores["gain"] == scores["policy"]["success"] - scores["replay"]["success"]


def test_refusals_are_one_line(door: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                               capfd: pytest.CaptureFixture) -> None:
    monkeypatch.setenv("TAA_ASSETS", str(door.path.parent))
    for arguments in (["evaluate", "door", str(tmp_path / "none.pt")], ["train", "nothing"],
                      ["train", "door", "--config", str(tmp_path / "none.toml")]):
        assert main(arguments) == 1
        lines = capfd.readouterr().err.strip().splitlines()
        assert lines[-1].startswith("error: ") and sum(line.startswith("error") for line in lines) == 1

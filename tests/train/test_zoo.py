"""The table of policies: one command, resumable, honest about counts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from taa_envs.asset import Asset
from train import zoo


def run_of(policy: float, replay: float, episodes: int = 100) -> dict:
    return {"episodes": episodes, "policy": {"success": policy}, "replay": {"success": replay},
            "trained": {"steps": 1000, "seconds": 60.0, "processor": 90.0}}


def test_seeds_are_pooled_and_shown(door: Asset) -> None:
    entry = zoo.Entry(door, [run_of(0.9, 0.5), run_of(0.98, 0.5)], [])
    success, low, high = entry.pooled("policy")
    assert success == pytest.approx(0.94) and 0.89 < low < 0.94 < high < 0.97
    row = zoo.table([entry]).splitlines()[-1]
    assert "**94%**" in row and "90%, 98%" in row and "+44" in row and "50% (40% to 60%)" in row


def test_the_summary_counts_every_asset_and_names_those_that_fall_short(door: Asset) -> None:
    other = replace(door, id="lid")
    said = zoo.summary([zoo.Entry(door, [run_of(0.94, 0.5)], []), zoo.Entry(other, [run_of(0.95, 0.8)], [])])
    assert said.startswith(f"1 of 2 assets reach 95%; {door.id} 94.0%.")
    assert "(1 of them) the policy is 44 to 44" in said


@pytest.mark.slow
def test_what_is_done_is_not_done_again(door: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TAA_ASSETS", str(door.path.parent))
    page = tmp_path / "docs" / "zoo.md"
    page.parent.mkdir()
    command = ["door", "--seeds", "0", "--steps", "64", "--minutes", "0.001", "--episodes", "2", "--out",
               str(tmp_path / "zoo"), "--page", str(page)]
    zoo.main(command)
    text = page.read_text()
    assert (page.parent / "images" / "zoo.webp").stat().st_size > 2000
    assert "| door | revolute |" in text and (page.parent / "images" / "zoo.png").stat().st_size > 5000

    def never(*_: object, **__: object) -> dict:
        raise AssertionError("trained again")

    monkeypatch.setattr(zoo, "train", never)
    zoo.main(command)
    assert page.read_text() == text

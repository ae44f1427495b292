"""Finding and registering assets."""

from __future__ import annotations

import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import pytest

import taa_envs
from taa_envs import registry
from taa_envs.asset import Asset


@pytest.fixture
def only_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A search path of one folder."""
    monkeypatch.setenv("TAA_ASSETS", str(tmp_path / "here"))
    monkeypatch.setattr(registry, "shipped_folder", lambda: tmp_path / "shipped")
    monkeypatch.setattr(registry, "user_folder", lambda: tmp_path / "user")
    monkeypatch.setattr(registry, "_warned", set())
    (tmp_path / "here").mkdir()
    yield tmp_path
    monkeypatch.undo()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        registry.register_assets()


def test_registers_and_forgets(only_here: Path, door: Asset) -> None:
    shutil.copytree(door.path, only_here / "here" / "door")
    assert taa_envs.register_assets() == ["TAA/door"]
    spec = gymnasium.spec("TAA/door")
    assert spec.max_episode_steps == registry.max_episode_steps(door.demo["duration"]) > door.demo["duration"] * 50
    shutil.rmtree(only_here / "here" / "door")
    assert taa_envs.register_assets() == []
    assert "TAA/door" not in gymnasium.registry


def test_first_folder_of_the_search_path_wins(only_here: Path, door: Asset) -> None:
    for place in ("shipped", "user"):
        shutil.copytree(door.path, only_here / place / "door")
    with pytest.warns(UserWarning, match="comes first"):
        assert registry.find_asset("TAA/door") == only_here / "shipped" / "door"


def test_unknown_id_lists_what_there_is(only_here: Path, door: Asset) -> None:
    with pytest.raises(taa_envs.UnknownAsset, match="none yet"):
        registry.find_asset("window")
    shutil.copytree(door.path, only_here / "here" / "door")
    with pytest.raises(taa_envs.UnknownAsset, match="'window'; known: door"):
        taa_envs.get_asset("window")


def test_broken_folders_are_named_once_and_left_out(only_here: Path, door: Asset) -> None:
    here = only_here / "here"
    shutil.copytree(door.path, here / "door")
    (here / "broken").mkdir()
    (here / "broken" / "asset.json").write_text("{")
    (here / ".door.tmp").mkdir()
    (here / "readme.txt").write_text("not a folder")
    (here / "Photos 2024").mkdir()
    (here / "Photos 2024" / "asset.jpg").write_text("somebody else's folder")
    with pytest.warns(UserWarning, match="broken was left out") as caught:
        assert taa_envs.register_assets() == ["TAA/door"]
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        taa_envs.register_assets()
    for name in "abcde":
        (here / f"broken-{name}").mkdir()
        (here / f"broken-{name}" / "asset.json").write_text("[]")
    with pytest.warns(UserWarning, match="broken-a was left out.*; and 2 more$") as caught:
        assert taa_envs.register_assets() == ["TAA/door"]
    assert len(caught) == 1, "one line, however many are broken"


def test_import_is_light_and_survives_a_broken_asset(tmp_path: Path) -> None:
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "asset.json").write_text("{")
    code = ("import sys, time; import numpy, gymnasium; t = time.perf_counter(); import taa_envs; "
            "print(time.perf_counter() - t, [m for m in ('torch', 'cv2', 'reconstruct', 'train', 'diagnose', 'mujoco') "
            "if m in sys.modules])")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True,
                          cwd=Path(taa_envs.__file__).parents[1],
                          env={"PATH": "/usr/bin:/bin", "TAA_ASSETS": str(tmp_path), "HOME": str(tmp_path)})
    seconds, modules = done.stdout.split(" ", 1)
    assert float(seconds) < 0.5 and modules.strip() == "[]"
    assert "broken" in done.stderr

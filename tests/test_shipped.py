"""What ships: small, sound, registered, and made from clips of our own."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from taa_envs import gate
from taa_envs.asset import load_asset
from taa_envs.env import ArticulationEnv
from taa_envs.registry import shipped_folder
from taa_envs.replay import replay

FOLDERS = sorted(f.parent for f in shipped_folder().glob("*/asset.json"))
README = Path(__file__).resolve().parents[1] / "assets" / "README.md"


def test_all_together_are_small_and_listed_with_their_licence():
    size = sum(f.stat().st_size for folder in FOLDERS for f in folder.rglob("*") if f.is_file())
    assert 0 < size < 20_000_000
    text = README.read_text(encoding="utf-8")
    assert "Apache-2.0" in text
    listed = set(re.findall(r"`(synth-[a-z0-9_-]+)`", text))
    assert listed == {folder.name for folder in FOLDERS}


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda f: f.name)
def test_each_passes_the_gate_again_and_is_what_it_says(folder):
    asset = load_asset(folder)
    assert json.loads((folder / "asset.json").read_text())["gate"]["passed"]
    contacts, depth = gate.sweep_contacts(asset)
    assert contacts == 0 and depth == 0
    assert asset.joint["verdict"] in ("ok", "ambiguous") and len(asset.metadata["source"]["sha256"]) == 64
    low, high = asset.provenance["joint.range"]["value"]
    q = asset.reference.q
    assert low <= q.min() + 1e-6 and q.max() <= high + 1e-6 and np.ptp(q) > 0
    assert asset.provenance["moving.mass"]["origin"] == "assumed" and (folder / "preview.png").is_file()


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda f: f.name)
def test_a_zero_action_is_its_replay_and_succeeds(folder):
    asset = load_asset(folder)
    run = replay(asset, controls=False).trajectory
    env = ArticulationEnv(asset)
    env.reset(seed=0)
    progress, info = [], {}
    while len(progress) < 1.5 * asset.end_time / 0.02 and not info.get("is_success"):
        info = env.step(np.zeros(env.action_space.shape, np.float32))[-1]
        progress.append(info["joint_progress"])
    assert info["is_success"]
    t = 0.02 * np.arange(1, len(progress) + 1)
    shown = np.clip(np.interp(t, run.time, asset.stroke_fraction(run.q)), 0, 1)
    assert np.abs(shown - progress).max() < 0.05

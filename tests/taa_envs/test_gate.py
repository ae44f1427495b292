"""The gate: what behaves passes, what does not is named and never written."""

from __future__ import annotations

import json

import numpy as np
import pytest

from taa_envs import gate
from taa_envs.asset import AssetError, load_asset, save_asset
from tests.taa_envs.made import WALL, box, door_arguments, drawer_arguments, link


def test_findings_of_a_sound_asset_are_in_its_folder(door):
    found = json.loads((door.path / "asset.json").read_text())["gate"]
    assert found["passed"] and found["failures"] == []
    assert found["contacts"] == 0 and found["penetration_m"] == 0
    assert found["sweep_states"] >= 41 and found["swept"] > 0.999
    assert len(found["settle_seconds"]) == 8 and all(t is not None and t < 5 for t in found["settle_seconds"])
    assert any(t > 0 for t in found["settle_seconds"])  # some were moving
    assert found["exports"] == ["mjcf", "urdf"]


def test_a_link_that_hits_the_other_is_not_written(tmp_path):
    arguments = door_arguments()
    post = box((0.15, 0.10, 0.0), (0.20, 0.15, 0.6), WALL)  # in the door's way
    arguments["static"] = link(post)
    with pytest.raises(AssetError, match="overlap by up to .* mm"):
        save_asset(tmp_path, "door", **arguments)
    assert not list(tmp_path.iterdir())


def test_the_gate_can_be_left_out_and_says_so(tmp_path):
    arguments = door_arguments()
    arguments["static"] = link(box((0.15, 0.10, 0.0), (0.20, 0.15, 0.6), WALL))
    asset = save_asset(tmp_path, "door", gate=False, **arguments)
    assert asset.metadata["gate"] is None
    found = gate.examine(asset)
    assert not found.passed and found.contacts > 0 and found.penetration_m > 0.01
    assert found.swept < 0.6  # the post stops it about half way


def test_a_joint_without_any_loss_never_rests(tmp_path):
    with pytest.raises(AssetError, match="do not come to rest"):
        save_asset(tmp_path, "drawer", damping=0.0, frictionloss=0.0, **drawer_arguments())
    assert not list(tmp_path.iterdir())


def test_a_link_that_gravity_pulls_gains_speed_but_no_energy(tmp_path):
    arguments = door_arguments()
    arguments["joint"] = {**arguments["joint"], "axis": [1.0, 0.0, 0.0], "point": [0.0, -0.01, 0.0]}
    arguments["static"] = link(box((-0.06, -0.40, -0.5), (-0.02, -0.30, -0.4), WALL))
    asset = save_asset(tmp_path, "flap", gate=False, **arguments)
    text = asset.model_path.read_text()
    assert 'gravcomp="1"' in text
    asset.model_path.write_text(text.replace('gravcomp="1"', 'gravcomp="0"'))
    times, _, growth = gate.settle(load_asset(asset.path))
    assert growth < gate.ENERGY_SLACK
    assert sum(t is not None and t > 0.1 for t in times) > 4  # most fall and come to rest at the stop


def test_energy_from_nowhere_is_seen(tmp_path):
    """A wound-up spring gives what no state at rest had."""
    asset = save_asset(tmp_path, "door", **door_arguments())
    text = asset.model_path.read_text()
    assert gate.settle(asset)[2] < gate.ENERGY_SLACK
    asset.model_path.write_text(text.replace('<joint name="joint"', '<joint name="joint" springref="3" stiffness="5"'))
    assert gate.settle(load_asset(asset.path))[2] > gate.ENERGY_SLACK


def test_same_seed_same_findings(door):
    first, second = gate.examine(door, seed=3), gate.examine(door, seed=3)
    assert first == second
    assert gate.examine(door, seed=4).settle_seconds != first.settle_seconds
    assert np.isfinite(first.energy_growth)

"""What is hidden is named, what is not there is not. The hidden mechanisms are the injector's, not the library's."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import mujoco
import pytest

from diagnose import diagnose

_spec = importlib.util.spec_from_file_location("injector", Path(__file__).with_name("injector.py"))
injector = sys.modules.setdefault("injector", importlib.util.module_from_spec(_spec))
_spec.loader.exec_module(injector)

MEASURED = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "measured"


def hidden(folder, plant, names, noise="white", seed=1, count=3, **how):
    case = injector.draw(seed, plant, names, noise, how.pop("reversal", True))
    model, files = injector.write(case, seed, folder, count=count, **how)
    return case, diagnose(model, files, "j")


def test_hidden_friction_is_named_and_the_model_extended(tmp_path):
    case, result = hidden(tmp_path, "door", ("coulomb_friction",))
    assert result.verdict == "explained" and result.causes == ("coulomb_friction",)
    p = result.data["causes"][0]["parameters"]["friction"]
    assert p["value"] == pytest.approx(case.truth["friction"], rel=0.02)
    assert p["ci95"][0] < p["value"] < p["ci95"][1]
    assert result.data["extended"]["heldout_rmse"] < 0.05 * result.data["nominal"]["heldout_rmse"]
    out = result.write(tmp_path / "out")
    data = json.loads((out / "diagnosis.json").read_text())
    model = mujoco.MjModel.from_xml_path(data["extended_model"])
    assert model.nu == 0 and model.dof_frictionloss[0] == pytest.approx(p["value"], rel=1e-4)
    page = (out / "report.html").read_text()
    assert "coulomb_friction" in page and "http" not in page.replace("http-equiv", "")


def test_correlated_noise_alone_is_no_cause(tmp_path):
    _, result = hidden(tmp_path, "door", (), noise="ar")
    assert result.verdict == "consistent" and not result.data["causes"]
    assert result.data["gain"]["heldout_rmse_ratio"] == 1.0


def test_without_reversal_or_rest_friction_is_not_told_from_a_torque(tmp_path):
    """Fast coasts in one direction that end before the door stops."""
    _, result = hidden(tmp_path, "door", ("coulomb_friction",), reversal=False, seconds=0.6)
    assert result.verdict == "ambiguous"
    named = {result.causes, *(tuple(a) for a in result.data["alternatives"])}
    assert {("coulomb_friction",), ("constant_torque",)} <= named
    assert "from the other side" in result.data["next_experiment"]


@pytest.mark.slow
def test_a_force_in_one_quadrant_is_not_explained(tmp_path):
    _, result = hidden(tmp_path, "flap", ("quadrant_force",), count=6)
    assert result.verdict == "unexplained" and result.causes == ("unknown",)
    assert "position" in result.data["causes"][0]["evidence"]["where"]


@pytest.mark.slow
@pytest.mark.skipif(not MEASURED.is_dir(), reason="the measured data are not beside the repository")
def test_free_swing_is_cut_and_its_rod_is_not_what_swings():
    folder = MEASURED / "freeswing"
    result = diagnose(folder / "model.xml", [folder / f"run{i}.csv" for i in (1, 2, 3)], "hinge")
    d = result.data
    assert result.verdict != "consistent"
    assert d["extended"]["heldout_rmse"] < 0.3 * d["nominal"]["heldout_rmse"]
    assert any("ratios to the inertia" in a for a in d["assumptions"])
    assert sum("left out" in a for a in d["assumptions"]) == 3

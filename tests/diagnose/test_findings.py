"""What is hidden is named, what is not there is not. The hidden mechanisms are the injector's, not the library's."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from diagnose import diagnose

_spec = importlib.util.spec_from_file_location("injector", Path(__file__).with_name("injector.py"))
injector = sys.modules.setdefault("injector", importlib.util.module_from_spec(_spec))
_spec.loader.exec_module(injector)

MEASURED = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "measured"


def hidden(folder, plant, names, noise="white", seed=1, count=6, protocol="both_ways", **how):
    case = injector.draw(seed, plant, names, noise, protocol)
    model, files = injector.write(case, seed, folder, count=count, **how)
    return case, diagnose(model, files, "j")


def test_hidden_friction_is_named_and_the_model_extended(tmp_path):
    case, result = hidden(tmp_path, "door", ("coulomb_friction",))
    assert result.verdict == "explained" and result.causes == ("coulomb_friction",)
    p = result.data["causes"][0]["parameters"]["friction"]
    assert p["value"] == pytest.approx(case.truth["coulomb_friction.friction"], rel=0.02)
    assert p["ci95"][0] < p["value"] < p["ci95"][1]
    assert result.data["extended"]["heldout_rmse"] < 0.05 * result.data["nominal"]["heldout_rmse"]
    out = result.write(tmp_path / "out")
    data = json.loads((out / "diagnosis.json").read_text())
    model = mujoco.MjModel.from_xml_path(data["extended_model"])
    assert model.nu == 0 and model.dof_frictionloss[0] == pytest.approx(p["value"], rel=1e-4)
    page = (out / "report.html").read_text()
    assert "coulomb_friction" in page and "http" not in page.replace("http-equiv", "")


@pytest.mark.slow
@pytest.mark.parametrize("plant, names", [
    ("flap", ("viscous_damping",)), ("drawer", ("quadratic_drag",)), ("door", ("end_stop",)), ("drawer", ("detent",)),
    ("flap", ("backlash",)), ("door", ("spring", "coulomb_friction")), ("flap", ("inertia",)),
])  # fmt: skip
def test_what_is_hidden_is_named(tmp_path, plant, names):
    case, result = hidden(tmp_path, plant, names, seed=1)
    assert result.verdict == "explained" and set(result.causes) == set(names)
    for cause in result.data["causes"]:
        for key, p in cause["parameters"].items():
            assert p["value"] == pytest.approx(case.truth[f"{cause['name']}.{key}"], rel=0.1, abs=1e-3)


@pytest.mark.parametrize("noise", [
    "ar", pytest.param("white", marks=pytest.mark.slow), pytest.param("quantised", marks=pytest.mark.slow),
    pytest.param("uneven", marks=pytest.mark.slow), pytest.param("dropped", marks=pytest.mark.slow),
    pytest.param("repeated", marks=pytest.mark.slow),
])  # fmt: skip
def test_noise_alone_is_no_cause(tmp_path, noise):
    """The twin of every finding: the same protocol with nothing hidden."""
    _, result = hidden(tmp_path, "door", (), noise=noise)
    assert result.verdict == "consistent" and not result.data["causes"]
    assert result.data["gain"]["heldout_rmse_ratio"] == 1.0


@pytest.mark.slow
def test_a_bent_sensor_is_no_torque(tmp_path):
    _, result = hidden(tmp_path, "flap", (), noise="distorted")
    assert result.verdict == "unexplained" and result.causes == ("unknown",)
    assert "reading itself is bent" in result.data["causes"][0]["evidence"]["why"]


@pytest.mark.parametrize("hidden_name", ["coulomb_friction", pytest.param("constant_torque", marks=pytest.mark.slow)])
def test_without_reversal_or_rest_friction_is_not_told_from_a_torque(tmp_path, hidden_name):
    """Fast coasts in one direction that end before the door stops; both ways they are told apart (first test)."""
    _, result = hidden(tmp_path, "door", (hidden_name,), protocol="one_way")
    assert result.verdict == "ambiguous"
    named = {result.causes, *(tuple(a) for a in result.data["alternatives"])}
    assert {("coulomb_friction",), ("constant_torque",)} <= named
    assert "from the other side" in result.data["next_experiment"]


@pytest.mark.slow
def test_fresh_cases(tmp_path):
    """A slice of the benchmark, another one by TAA_FRESH_SEED; one miss in ten is allowed."""
    seed = int(os.environ.get("TAA_FRESH_SEED", "1"))
    rng = np.random.default_rng(seed)
    right, told = 0, []
    for k in range(5):
        name = str(rng.choice(injector.SINGLE))
        plant = str(rng.choice(injector.fits((name,))))
        _, result = hidden(tmp_path / f"{k}", plant, (name,), seed=int(rng.integers(2**31)))
        right += result.causes == (name,)
        _, empty = hidden(tmp_path / f"{k}n", plant, (), noise=str(rng.choice(injector.NOISES)),
                          seed=int(rng.integers(2**31)))  # fmt: skip
        right += empty.verdict != "explained"
        told += [(plant, name, result.verdict, result.causes), empty.verdict]
    assert right >= 9, f"TAA_FRESH_SEED={seed}: {told}"


@pytest.mark.slow
@pytest.mark.parametrize("plant, name", [("flap", "quadrant_force"), ("door", "growing_friction"),
                                         ("drawer", "hysteresis")])  # fmt: skip
def test_what_the_library_does_not_hold_is_not_explained(tmp_path, plant, name):
    _, result = hidden(tmp_path, plant, (name,))
    assert result.verdict == "unexplained" and result.causes == ("unknown",)
    assert "position" in result.data["causes"][0]["evidence"]["where"]


@pytest.mark.slow
def test_a_sure_cause_is_named_beside_what_is_left(tmp_path):
    """A spring and a small force that comes and goes: the first is named, the second is reported with its size."""
    case = injector.draw(7, "door", ("spring", "slow_wave"))
    case.truth["slow_wave.force"] *= 0.1
    model, files = injector.write(case, 7, tmp_path)
    result = diagnose(model, files, "j")
    assert result.causes == ("spring",) and result.verdict == "explained"
    value = result.data["causes"][0]["parameters"]["stiffness"]["value"]
    assert value == pytest.approx(case.truth["spring.stiffness"], rel=0.02)
    left = result.data["remainder"]
    assert left["times_noise"] > 1 and left["rmse"] < 0.1 * left["explained_rmse"] and "slow errors" in left["why"]


@pytest.mark.slow
@pytest.mark.skipif(not MEASURED.is_dir(), reason="the measured data are not beside the repository")
def test_free_swing_is_cut_and_its_rod_is_not_what_swings():
    folder = MEASURED / "freeswing"
    result = diagnose(folder / "model.xml", [folder / f"run{i}.csv" for i in (1, 2, 3)], "hinge")
    d = result.data
    # More weight or less inertia: one thing as long as no torque is logged. What is left is said beside it.
    assert result.verdict == "ambiguous" and result.causes == ("gravity_torque",)
    assert any("inertia" in a for a in d["alternatives"]) and "known torque" in d["next_experiment"]
    assert d["remainder"]["rmse"] < 0.1 * d["remainder"]["explained_rmse"]
    assert d["extended"]["heldout_rmse"] < 0.1 * d["nominal"]["heldout_rmse"]
    assert any("ratios to the inertia" in a for a in d["assumptions"])
    assert sum("left out" in a for a in d["assumptions"]) == 3


@pytest.mark.skipif(not MEASURED.is_dir(), reason="the measured data are not beside the repository")
def test_cabinet_has_its_catch_where_the_pull_has_its_hump():
    folder = MEASURED / "ikea_cabinet"
    result = diagnose(folder / "model.xml", [folder / "run1.csv"], "hinge")
    d = result.data
    assert "detent" in result.causes and result.verdict in ("explained", "ambiguous")
    terms = result.found.best.fit.terms()
    assert 0.1 < terms["detent_place"] + terms["detent_width"] < 0.25  # the pull peaks at 0.2 rad, over the rest
    assert d["extended"]["heldout_rmse"] < 0.1 * d["nominal"]["heldout_rmse"]
    assert any("imposed" in a for a in d["assumptions"]) and any("one way only" in a for a in d["assumptions"])
    assert "way back" in d["next_experiment"]

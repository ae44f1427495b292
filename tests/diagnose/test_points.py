"""What 3D points say about the joint's place; every finding with its twin in which nothing is hidden."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from diagnose import LogError, diagnose, load_log

_spec = importlib.util.spec_from_file_location("injector_points", Path(__file__).with_name("injector_points.py"))
injector = sys.modules.setdefault("injector_points", importlib.util.module_from_spec(_spec))
_spec.loader.exec_module(injector)

SEED = 3


def hidden(folder, effect, kind="hinge", **how):
    case, model, files = injector.write_points(SEED, effect, folder, kind, **how)
    return case, diagnose(model, files, "j")


@pytest.mark.parametrize("effect, kind, number", [
    ("axis_misalignment", "hinge", "tilt"),
    pytest.param("axis_misalignment", "slide", "tilt", marks=pytest.mark.slow),
    pytest.param("pivot_offset", "hinge", "distance", marks=pytest.mark.slow),
])  # fmt: skip
def test_a_joint_elsewhere_is_named_and_put_right(tmp_path, effect, kind, number):
    """Its weight and inertia follow: they are not named beside it."""
    case, result = hidden(tmp_path, effect, kind)
    assert result.verdict == "explained" and result.causes == (effect,)
    p = result.data["causes"][0]["parameters"][number]
    assert p["value"] == pytest.approx(case.truth[number], rel=0.02)
    d = result.data
    assert d["unit"] == "m" and d["extended"]["heldout_rmse"] < 1.1 * d["noise_floor"] < d["nominal"]["heldout_rmse"]
    out = result.write(tmp_path / "out")
    model = mujoco.MjModel.from_xml_path(json.loads((out / "diagnosis.json").read_text())["extended_model"])
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    best = result.placed.found.best
    assert data.xaxis[0] == pytest.approx(best.axis, abs=1e-6)
    away = data.xanchor[0] - best.anchor
    assert np.linalg.norm(away - (away @ best.axis) * best.axis) < 1e-6


@pytest.mark.parametrize("memory", [0.0, pytest.param(0.8, marks=pytest.mark.slow)])
def test_points_alone_are_no_cause(tmp_path, memory):
    _, result = hidden(tmp_path, "nothing", memory=memory)
    assert result.verdict == "consistent" and not result.causes
    assert result.data["gain"]["heldout_rmse_ratio"] == pytest.approx(1.0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["hinge", "slide"])
def test_a_second_joint_is_found_and_held(tmp_path, kind):
    case, result = hidden(tmp_path, "second_joint", kind)
    assert result.verdict == "explained" and result.causes == ("second_joint",)
    direction = result.placed.found.best.twist[:3]
    assert abs(direction @ case.direction) > np.cos(np.radians(2))
    assert result.data["extended"]["heldout_rmse"] < 1.1 * result.data["noise_floor"]  # a spring holds it: predicted
    out = result.write(tmp_path / "out")
    model = mujoco.MjModel.from_xml_path(json.loads((out / "diagnosis.json").read_text())["extended_model"])
    assert model.njnt == 2 and model.nu == 0 and model.joint("j_second").stiffness[0] > 0


@pytest.mark.slow
def test_points_that_come_loose_are_no_joint(tmp_path):
    _, result = hidden(tmp_path, "loose_point")
    assert result.verdict == "unexplained" and result.causes == ("unknown",)
    assert "one more joint does not explain it" in result.data["causes"][0]["evidence"]["why"]


def test_point_columns_come_in_threes_and_may_have_gaps(tmp_path):
    rows = [f"{i * 0.01:.2f},{0.01 * i:.3f},{0.1 * i},0,1" for i in range(40)]
    rows[7] = "0.07,0.070,,,"
    file = tmp_path / "log.csv"
    file.write_text("\n".join(["time,q,marker1_x,marker1_y,marker1_z", *rows]))
    log = load_log(file)
    assert log.markers.shape == (40, 1, 3) and np.isnan(log.markers[7]).all() and np.isfinite(log.markers[8]).all()
    file.write_text("\n".join(["time,q,marker1_x,marker1_y,other", *rows]))
    with pytest.raises(LogError, match="no column marker1_z"):
        load_log(file)

"""Exports come back through their own loaders as the same object, and a changed one is caught."""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from taa_envs.asset import save_asset
from taa_envs.cli import main
from taa_envs.errors import TaaEnvsError
from taa_envs.exports import FORMATS, export_asset
from taa_envs.exports.check import check_export, load_mujoco
from taa_envs.exports.usd import prim_name, read_obj
from tests.taa_envs.made import door_arguments


@pytest.fixture
def needs_usd():
    pytest.importorskip("pxr", reason="the extra usd is not installed")


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("which", ["door", "drawer"])
def test_an_export_comes_back_as_the_same_object(kind, which, request, tmp_path):
    if kind == "usd":
        pytest.importorskip("pxr", reason="the extra usd is not installed")
    asset = request.getfixturevalue(which)
    file = export_asset(asset, kind, tmp_path / kind)
    assert check_export(asset, kind, file) == []
    # Self-contained: it loads from another place.
    moved = (tmp_path / kind).rename(tmp_path / "elsewhere") / file.name
    assert check_export(asset, kind, moved) == []


@pytest.mark.parametrize(
    ("tag", "attribute", "word"),
    [("limit", "upper", "limits"), ("axis", "xyz", "axis"), ("mass", "value", "mass"), ("inertia", "izz", "inertia"),
     ("dynamics", "damping", "damping"), ("dynamics", "friction", "friction")],
)  # fmt: skip
def test_a_changed_urdf_is_caught(door, tmp_path, tag, attribute, word):
    from xml.etree import ElementTree

    file = export_asset(door, "urdf", tmp_path / "urdf")
    tree = ElementTree.parse(file)
    element = next(e for e in tree.iter(tag) if e.get(attribute))
    old = element.get(attribute)
    element.set(attribute, "0.6 0 0.8" if tag == "axis" else str(1.02 * float(old)))
    tree.write(file)
    assert word in [line.split()[0] for line in check_export(door, "urdf", file)]


def test_a_changed_usd_is_caught(door, tmp_path, needs_usd):
    from pxr import Usd, UsdPhysics

    file = export_asset(door, "usd", tmp_path / "usd")
    stage = Usd.Stage.Open(str(file))
    joint = UsdPhysics.RevoluteJoint(stage.GetPrimAtPath("/door/joint"))
    upper = door.provenance["joint.range"]["value"][1]
    assert np.isclose(joint.GetUpperLimitAttr().Get(), np.degrees(upper), rtol=1e-5)
    joint.GetUpperLimitAttr().Set(12.0)
    stage.GetRootLayer().Save()
    assert check_export(door, "usd", file)[0].startswith("limits")


def test_usd_carries_mesh_picture_and_units(door, tmp_path, needs_usd):
    from pxr import Usd, UsdGeom, UsdPhysics, UsdShade

    file = export_asset(door, "usd", tmp_path / "usd")
    stage = Usd.Stage.Open(str(file))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/door/moving/moving_visual"))
    vertices, faces, uv = read_obj(door.path / "meshes" / "moving.obj")
    assert len(mesh.GetPointsAttr().Get()) == len(vertices) and uv.shape == (len(faces), 3, 2)
    material, _ = UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()
    assert material
    picture = UsdShade.Shader(stage.GetPrimAtPath("/door/moving/moving_visual_material/picture"))
    name = picture.GetInput("file").Get()
    assert (file.parent / name.path).read_bytes() == (door.path / "meshes" / "moving.png").read_bytes()
    assert not stage.GetPrimAtPath("/door/static").HasAPI(UsdPhysics.MassAPI)  # nobody weighed it


def test_urdf_visuals_keep_their_picture(door, tmp_path):
    file = export_asset(door, "urdf", tmp_path / "urdf")
    folder = file.parent / "meshes"
    assert (folder / "moving.mtl").read_text().split()[-1] == "moving.png"
    assert (folder / "moving.png").is_file()
    assert (folder / "moving.obj").read_text().startswith("mtllib moving.mtl\n")


@pytest.mark.parametrize("kind", ["urdf", "usd"])
def test_a_screw_is_refused_with_its_reason(door, tmp_path, kind):
    screw = dataclasses.replace(door, joint={**door.joint, "type": "screw"})
    with pytest.raises(TaaEnvsError, match="no screw joint.*mjcf"):
        export_asset(screw, kind, tmp_path / kind)


def test_usd_without_its_package_is_one_line(door, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(TaaEnvsError, match=r"usd-core; install it with: pip install 'taa-envs\[usd\]'"):
        export_asset(door, "usd", tmp_path / "usd")


def test_unknown_format_lists_the_known(door, tmp_path):
    with pytest.raises(TaaEnvsError, match="mjcf, urdf, usd"):
        export_asset(door, "step", tmp_path / "x")
    assert not (tmp_path / "x").exists()


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(axis=arrays(float, 3, elements=st.floats(-1, 1)), point=arrays(float, 3, elements=st.floats(-0.5, 0.5)),
       end=st.floats(0.2, 2.5))  # fmt: skip
def test_any_hinge_survives_urdf(tmp_path_factory, axis, point, end):
    if np.linalg.norm(axis) < 0.1:
        axis = np.array([0.0, 0.0, 1.0])
    arguments = door_arguments(q_end=end)
    arguments["joint"] = {**arguments["joint"], "axis": (axis / np.linalg.norm(axis)).tolist(), "point": point.tolist()}
    root = tmp_path_factory.mktemp("any")
    asset = save_asset(root, "door", gate=False, **arguments)
    file = export_asset(asset, "urdf", root / "urdf")
    assert check_export(asset, "urdf", file) == []
    assert load_mujoco(file).joint.kind == "revolute"


def test_the_command_writes_and_says_where(door, tmp_path, monkeypatch, capsys):
    import json

    monkeypatch.setenv("TAA_ASSETS", str(door.path.parent))
    assert main(["export", "door", "--format", "urdf", "--out", str(tmp_path / "out"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["file"] == str(tmp_path / "out" / "door.urdf")
    assert load_mujoco(tmp_path / "out" / "door.urdf").joint.kind == "revolute"
    assert main(["export", "door", "--format", "urdf", "--out", str(tmp_path / "out")]) == 1
    assert "exists" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "clean"), [("door", "door"), ("usb-plug_3", "usb_plug_3"), ("3dbox", "_3dbox")])
def test_prim_names_are_accepted_by_usd(name, clean):
    assert prim_name(name) == clean

"""The asset folder: round trip, atomic writing, and folders that strangers made."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taa_envs.asset import (
    ID_PATTERN,
    Asset,
    AssetError,
    AssetExists,
    Reference,
    check_id,
    demonstration,
    load_asset,
    save_asset,
)
from tests.taa_envs.made import door_arguments, drawer_arguments


@pytest.fixture
def copy(door: Asset, tmp_path: Path) -> Path:
    """A door that a test may spoil."""
    return Path(shutil.copytree(door.path, tmp_path / "door"))


def edit_json(folder: Path, **changes: object) -> None:
    data = json.loads((folder / "asset.json").read_text())
    data.update(changes)
    (folder / "asset.json").write_text(json.dumps(data))


def test_round_trip_keeps_joint_reference_and_camera(door: Asset) -> None:
    given_ = door_arguments()
    again = load_asset(door.path)
    np.testing.assert_allclose(again.joint["axis"], given_["joint"]["axis"])
    np.testing.assert_allclose(again.joint["point"], given_["joint"]["point"])
    for name in ("time", "q", "hand_joints", "hand_valid", "contact"):
        np.testing.assert_array_equal(getattr(again.reference, name), given_["reference"][name])
    np.testing.assert_allclose(again.camera["T_camera_world"], given_["camera"]["T_camera_world"])
    assert again.metadata["source"]["sha256"] == "0" * 64
    assert again.metadata["mujoco_version"] == mujoco.__version__


def test_every_number_names_its_origin(door: Asset) -> None:
    origins = {name: entry["origin"] for name, entry in door.provenance.items()}
    assert origins["joint.axis"] == "fitted" and origins["joint.range"] == "observed"
    assert {origins[f"joint.{n}"] for n in ("damping", "frictionloss", "armature")} == {"assumed"}
    assert door.provenance["joint.axis"]["std"] == pytest.approx(np.deg2rad(1.0))


@pytest.mark.parametrize("name", ["door", "drawer"])
def test_model_is_passive_and_agrees_with_joint(name: str, request: pytest.FixtureRequest) -> None:
    asset = request.getfixturevalue(name)
    model = mujoco.MjModel.from_xml_path(str(asset.model_path))
    assert (model.nu, model.neq, model.nv, model.nq) == (0, 0, 1, 1)
    data = mujoco.MjData(model)
    q = 0.6 * asset.demo["q_demo_end"]
    data.qpos[0] = q
    mujoco.mj_kinematics(model, data)
    body = model.body("moving").id
    corner = np.array([0.1, 0.2, 0.3])
    moved = data.xpos[body] + data.xmat[body].reshape(3, 3) @ corner
    axis = np.array(asset.joint["axis"])
    if asset.joint_type == "prismatic":
        expected = corner + q * axis
    else:
        from scipy.spatial.transform import Rotation

        point = np.array(asset.joint["point"])
        expected = point + Rotation.from_rotvec(q * axis).apply(corner - point)
    np.testing.assert_allclose(moved, expected, atol=1e-9)


@pytest.mark.parametrize("name", ["door", "drawer"])
def test_released_link_stays_where_it_is(name: str, request: pytest.FixtureRequest) -> None:
    asset = request.getfixturevalue(name)
    model = mujoco.MjModel.from_xml_path(str(asset.model_path))
    data = mujoco.MjData(model)
    data.qpos[0] = q = 0.5 * asset.demo["q_demo_end"]
    mujoco.mj_step(model, data, 1000)
    assert abs(data.qpos[0] - q) < 1e-3 * abs(q)


def test_range_is_what_was_observed(door: Asset) -> None:
    model = mujoco.MjModel.from_xml_path(str(door.model_path))
    np.testing.assert_allclose(model.jnt_range[0], [door.reference.q.min(), door.reference.q.max()], rtol=1e-5)


def test_exists_unless_overwritten(tmp_path: Path) -> None:
    save_asset(tmp_path, "door", **door_arguments())
    with pytest.raises(AssetExists, match="overwrite"):
        save_asset(tmp_path, "door", **door_arguments())
    assert save_asset(tmp_path, "door", mass=3.0, overwrite=True, **door_arguments()).provenance["moving.mass"] == {
        "value": 3.0, "unit": "kg", "origin": "given", "note": "mass given"}
    assert [p.name for p in tmp_path.iterdir()] == ["door"]


def test_failure_leaves_nothing_and_keeps_the_old(tmp_path: Path) -> None:
    old = save_asset(tmp_path, "door", **door_arguments())
    before = old.model_path.read_bytes()
    flat = door_arguments()
    flat["moving"].parts = ((np.eye(3), np.array([[0, 1, 2]])),)
    with pytest.raises(AssetError, match="no solid collision part"):
        save_asset(tmp_path, "door", overwrite=True, **flat)
    assert [p.name for p in tmp_path.iterdir()] == ["door"] and old.model_path.read_bytes() == before


def test_further_files_are_stored(tmp_path: Path) -> None:
    asset = save_asset(tmp_path, "door", files={"preview.png": b"picture"}, **door_arguments())
    assert (asset.path / "preview.png").read_bytes() == b"picture"
    with pytest.raises(AssetError, match="further file"):
        save_asset(tmp_path, "other", files={"../x": b""}, **door_arguments())


@pytest.mark.parametrize("change, message", [
    ({"type": "screw"}, "screw"), ({"axis": [0, 0, 0]}, "axis"), ({"point": None}, "point"),
    ({"axis": [np.nan, 0, 1]}, "finite")])
def test_joints_that_cannot_be_simulated_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    arguments = door_arguments()
    arguments["joint"] |= change
    with pytest.raises(AssetError, match=message):
        save_asset(tmp_path, "door", **arguments)
    assert not list(tmp_path.iterdir())


def test_reference_that_does_not_move_is_refused(tmp_path: Path) -> None:
    arguments = drawer_arguments()
    arguments["reference"]["q"] = np.zeros_like(arguments["reference"]["q"])
    with pytest.raises(AssetError, match="does not move"):
        save_asset(tmp_path, "drawer", **arguments)


@given(st.text(max_size=70))
def test_ids(text: str) -> None:
    if ID_PATTERN.fullmatch(text):
        assert check_id(text) == text and "/" not in text and "." not in text
    else:
        with pytest.raises(AssetError):
            check_id(text)


@pytest.mark.parametrize("bad", ["", "-a", "A", "a/b", "..", "a.b", "a" * 65, "a\n", None, 3])
def test_bad_ids(bad: object) -> None:
    with pytest.raises(AssetError):
        check_id(bad)


@given(st.lists(st.floats(-2, 2), min_size=2, max_size=60))
def test_demonstration_starts_at_zero_and_ends_at_one(values: list[float]) -> None:
    q = np.array(values)
    if np.abs(q - q[0]).max() <= 1e-6:
        return
    demo = demonstration(q)
    assert demo["q_demo_end"] == q[demo["demo_end_frame"]] != demo["q_start"] == q[0]
    assert demo["q_min"] <= min(demo["q_start"], demo["q_demo_end"])
    assert abs(demo["q_demo_end"] - q[0]) >= 0.49 * np.abs(q - q[0]).max()


def test_demonstration_that_comes_back_ends_at_its_far_point() -> None:
    q = np.concatenate([np.linspace(0, 1, 50), np.linspace(1, 0, 50)])
    assert demonstration(q)["demo_end_frame"] == 49
    assert demonstration(q[:70])["demo_end_frame"] == 69  # still more than half open: one stroke


# --- folders from strangers ---------------------------------------------------------------------------------------

@pytest.mark.parametrize("change, message", [
    ({"schema": "taa-asset/99"}, "schema"), ({"id": "../door"}, "id"), ({"id": "window"}, "folder's name"),
    ({"joint": {"type": "ball"}}, "ball"),
    ({"joint": {"type": "revolute", "axis": [0, 0, 9], "point": [0, 0, 0]}}, "length"),
    ({"joint": {"type": "revolute", "axis": "z", "point": [0, 0, 0]}}, "numbers"), ({"joint": []}, "joint"),
    ({"provenance": {"x": {"value": 1, "origin": "guessed"}}}, "provenance"), ({"demo": {}}, "demo"),
    ({"camera": {"K": [[1]]}}, "camera"), ({"notes": [float("nan")]}, "finite")])
def test_hostile_metadata(copy: Path, change: dict, message: str) -> None:
    edit_json(copy, **change)
    with pytest.raises(AssetError, match=message):
        load_asset(copy)


@pytest.mark.parametrize("text", ["", "[]", "{", "[" * 100_000, "nonsense"])
def test_metadata_that_is_no_object(copy: Path, text: str) -> None:
    (copy / "asset.json").write_text(text)
    with pytest.raises(AssetError):
        load_asset(copy)


def test_metadata_of_unbounded_size(copy: Path) -> None:
    with (copy / "asset.json").open("ab") as f:
        f.truncate(100 << 20)
    with pytest.raises(AssetError, match="larger"):
        load_asset(copy)


@pytest.mark.parametrize("victim", ["asset.json", "reference.npz", "meshes/moving.obj"])
def test_links_are_not_followed(copy: Path, tmp_path: Path, victim: str) -> None:
    target = tmp_path / "elsewhere"
    shutil.move(copy / victim, target)
    (copy / victim).symlink_to(target)
    with pytest.raises(AssetError, match="link"):
        load_asset(copy)


@pytest.mark.parametrize("old, new, message", [
    ('file="moving.obj"', 'file="../../moving.obj"', "leaves the folder"),
    ('file="moving.obj"', 'file="/etc/passwd"', "leaves the folder"),
    ('file="moving.obj"', 'file="absent.obj"', "not in the folder"),
    ('meshdir="meshes"', 'meshdir="../.."', "leaves the folder"),
    ("<worldbody>", '<include file="model.xml"/><worldbody>', "include"),
    ("<worldbody>", '<extension><plugin plugin="x"/></extension><worldbody>', "extension"),
    ("<mujoco", '<!DOCTYPE x [<!ENTITY a "b">]><mujoco', "entity"),
    ('body name="static"', 'body name="frame"', "static"),
    ('joint name="joint"', 'joint name="hinge"', "joint"),
    ('joint name="joint"', 'joint name="joint" type="slide"', "type"),
    ("</worldbody>", '</worldbody><actuator><motor joint="joint"/></actuator>', "actuator"),
    ("</worldbody>", '</worldbody><equality><joint joint1="joint"/></equality>', "equality"),
    ("</mujoco>", "", "XML")])
def test_hostile_models(copy: Path, old: str, new: str, message: str) -> None:
    text = (copy / "model.xml").read_text()
    assert old in text
    (copy / "model.xml").write_text(text.replace(old, new, 1))
    with pytest.raises(AssetError, match=message):
        load_asset(copy)


def write_reference(folder: Path, **changes: object) -> None:
    with np.load(folder / "reference.npz") as arrays:
        data = {name: arrays[name] for name in arrays.files}
    data.update(changes)
    np.savez(folder / "reference.npz", **{k: v for k, v in data.items() if v is not None})


@pytest.mark.parametrize("change, message", [
    ({"q": np.array([{"a": 1}], dtype=object)}, "plain arrays"),
    ({"q": np.zeros(3)}, "shape"), ({"q": None}, "no array"),
    ({"hand_joints": np.zeros((5, 20, 3))}, "shape"), ({"time": np.zeros(87)}, "increase"),
    ({"hand_joints": np.full((87, 21, 3), np.nan)}, "finite"), ({"time": np.zeros((87, 1))}, "frames")])
def test_hostile_references(copy: Path, change: dict, message: str) -> None:
    write_reference(copy, **change)
    with pytest.raises(AssetError, match=message):
        load_asset(copy)


def test_reference_that_is_a_pickle_or_a_bomb(copy: Path) -> None:
    (copy / "reference.npz").write_bytes(b"\x80\x04N.")
    with pytest.raises(AssetError, match="plain arrays"):
        load_asset(copy)
    import zipfile

    zeros = io.BytesIO()
    np.save(zeros, np.zeros(40 << 20))
    with zipfile.ZipFile(copy / "reference.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("time.npy", zeros.getvalue())
    with pytest.raises(AssetError, match="unpacks"):
        load_asset(copy)


def test_reference_is_a_copy(door: Asset) -> None:
    arrays = door_arguments()["reference"]
    reference = Reference.from_arrays(arrays)
    arrays["q"][:] = 7
    assert not (reference.q == 7).any()

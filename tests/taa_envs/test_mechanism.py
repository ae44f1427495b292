"""Objects with several joints and with a screw: written, checked, simulated, exported."""

from __future__ import annotations

import json
from contextlib import closing

import mujoco
import numpy as np
import pytest

from taa_envs.asset import AssetError, load_asset, save_asset
from taa_envs.env import ArticulationEnv
from taa_envs.errors import TaaEnvsError
from taa_envs.exports import export_asset
from taa_envs.exports.check import check_export
from taa_envs.replay import replay
from taa_envs.scene import build_scene
from taa_envs.simulation import Simulation
from tests.taa_envs.made import chest_arguments, valve_arguments


@pytest.fixture(scope="module")
def chest(asset_root):
    return save_asset(asset_root, "chest", **chest_arguments())


@pytest.fixture(scope="module")
def valve(asset_root):
    return save_asset(asset_root, "valve", **valve_arguments())


def test_a_second_joint_stands_beside_the_first(chest, asset_root):
    document = json.loads((chest.path / "asset.json").read_text())
    assert document["joint"]["type"] == document["joint_2"]["type"] == "prismatic"
    assert document["gate"]["passed"] and "urdf" in document["gate"]["exports"]
    assert document["provenance"]["joint_2.range"]["value"][1] == pytest.approx(0.1)
    model = mujoco.MjModel.from_xml_path(str(chest.model_path))
    assert [model.joint(k).name for k in range(model.njnt)] == ["joint", "joint_2"] and model.nu == model.neq == 0
    assert {model.body(k).name for k in range(1, model.nbody)} == {"static", "moving", "moving_2"}
    with np.load(chest.path / "reference.npz") as arrays:
        assert arrays["q_2"].max() == pytest.approx(0.1)
    again = load_asset(chest.path)
    assert len(again.further) == 1 and again.links == ("moving", "moving_2")


def test_one_joint_looks_as_it_always_did(drawer):
    document = json.loads((drawer.path / "asset.json").read_text())
    assert "joint_2" not in document and document["collision"]["excluded_pairs"] == [["static", "moving"]]
    with np.load(drawer.path / "reference.npz") as arrays:
        assert set(arrays) == {"time", "q", "hand_joints", "hand_valid", "contact"}
    model = mujoco.MjModel.from_xml_path(str(drawer.model_path))
    assert (model.njnt, model.neq, model.nbody) == (1, 0, 3)


def test_the_further_joint_is_passive_and_starts_where_the_demonstration_has_it(chest):
    with closing(ArticulationEnv(chest)) as env:
        env.reset(seed=0, options={"phase": 0.5})
        base = env.unwrapped
        late = float(base.data.qpos[1])
        env.reset(seed=0)
        assert late == pytest.approx(0.1) and base.data.qpos[1] == 0.0
        for _ in range(20):
            env.step(np.zeros(env.action_space.shape, np.float32))
        # Nothing touches it: it stays, to the solver's rounding.
        assert abs(base.data.qpos[1]) < 1e-6


def test_a_hand_moves_the_further_link_too(chest):
    scene = build_scene(chest)
    simulation = Simulation(scene)
    grip = np.array(chest.reference.hand_joints[len(chest.reference.time) // 2])
    from_behind = grip - grip.mean(0) + [0.0, 0.08, 0.46]  # inside the upper drawer, behind its front
    simulation.reset(0.0, from_behind)
    for k in range(400):
        simulation.step(from_behind - [0.0, 0.0004 * k, 0.0])
    assert simulation.data.qpos[scene.further[0][0]] > 0.05
    assert abs(simulation.q) < 1e-3


def test_replay_of_the_first_joint_does_not_need_the_second(chest, drawer):
    alone, beside = replay(drawer), replay(chest)
    assert alone.joint_progress > 0.9 and beside.joint_progress == pytest.approx(alone.joint_progress, abs=0.05)


def test_urdf_holds_both_joints_and_usd_says_why_not(chest, tmp_path):
    assert check_export(chest, "urdf", export_asset(chest, "urdf", tmp_path / "urdf")) == []
    with pytest.raises(TaaEnvsError, match="one joint"):
        export_asset(chest, "usd", tmp_path / "usd")


def test_a_further_joint_without_its_states_is_refused(chest, tmp_path):
    import shutil

    copy = shutil.copytree(chest.path, tmp_path / chest.id)
    with np.load(copy / "reference.npz") as arrays:
        rest = {name: arrays[name] for name in arrays if name != "q_2"}
    np.savez_compressed(copy / "reference.npz", **rest)
    with pytest.raises(AssetError, match="q_2"):
        load_asset(copy)


def test_links_that_meet_do_not_pass_the_gate(asset_root):
    made = chest_arguments()
    (other,) = made["further"]
    low = other.link
    low.vertices[:, 2] -= 0.2  # into the first drawer's place
    low.parts = tuple((vertices - [0, 0, 0.2], faces) for vertices, faces in low.parts)
    with pytest.raises(AssetError, match="overlap"):
        save_asset(asset_root, "crowded", **made)


def test_a_screw_is_a_hinge_with_an_advance(valve):
    document = json.loads((valve.path / "asset.json").read_text())
    assert document["gate"]["passed"] and document["gate"]["exports"] == ["mjcf"]
    assert document["provenance"]["joint.pitch"] == {"value": 0.01, "unit": "m/rad", "origin": "fitted", "std": 0.001,
                                                     "note": "advance (lengths from: given)"}  # fmt: skip
    model = mujoco.MjModel.from_xml_path(str(valve.model_path))
    data = mujoco.MjData(model)
    assert [model.joint(k).name for k in range(2)] == ["joint", "advance"] and model.neq == 1 and model.nu == 0
    data.qfrc_applied[0] = 2.0 * model.dof_frictionloss[0] + 0.5
    worst = 0.0
    for _ in range(1500):
        mujoco.mj_step(model, data)
        worst = max(worst, abs(data.qpos[1] - 0.01 * data.qpos[0]))
    # It arrives at its stop, and the tie holds to a hundredth of the advance on the way.
    assert data.qpos[0] == pytest.approx(2.0, abs=0.02) and worst < 2e-4
    assert data.body("moving").xpos[2] - 0.0 == pytest.approx(0.02, abs=5e-4)


def test_a_screw_is_driven_by_pushing_along_its_axis(valve):
    """Work is work: lifting the handle turns it (a thread without friction), and counts for the joint."""
    model = mujoco.MjModel.from_xml_path(str(valve.model_path))
    model.dof_frictionloss[:] = 0.0
    data = mujoco.MjData(model)
    data.qfrc_applied[1] = 20.0
    for _ in range(300):
        mujoco.mj_step(model, data)
    assert data.qpos[0] > 0.05 and data.qpos[1] == pytest.approx(0.01 * data.qpos[0], abs=2e-4)


def test_a_screw_is_replayed_and_stepped(valve):
    assert replay(valve).joint_progress > 0.9
    with closing(ArticulationEnv(valve)) as env:
        env.reset(seed=1, options={"q0": 1.0, "randomize": ["axis", "point"]})
        base = env.unwrapped
        assert base.data.qpos[1] == pytest.approx(0.01) and base.data.qpos[0] == 1.0
        assert np.array_equal(base.model.jnt_axis[0], base.model.jnt_axis[1])
        observation, *_ = env.step(env.action_space.sample())
        assert np.isfinite(observation).all()


def test_formats_without_screws_say_so(valve, tmp_path):
    for kind in ("urdf", "usd"):
        with pytest.raises(TaaEnvsError, match="no screw joint"):
            export_asset(valve, kind, tmp_path / kind)
    assert check_export(valve, "mjcf", export_asset(valve, "mjcf", tmp_path / "mjcf")) == []


@pytest.mark.parametrize(("change", "words"), [
    ({"pitch": 0.0}, "pitch"), ({"pitch": None}, "pitch"), ({"point": None}, "point"),
    ({"type": "ball"}, "ball")])  # fmt: skip
def test_a_screw_that_is_none_is_refused(asset_root, change, words):
    made = valve_arguments()
    with pytest.raises(AssetError, match=words):
        save_asset(asset_root, "broken-valve", **{**made, "joint": {**made["joint"], **change}})


def test_a_model_that_contradicts_its_pitch_is_refused(valve, tmp_path):
    import shutil

    copy = shutil.copytree(valve.path, tmp_path / valve.id)
    document = json.loads((copy / "asset.json").read_text())
    document["joint"]["pitch"] = 0.02
    (copy / "asset.json").write_text(json.dumps(document))
    with pytest.raises(AssetError, match="pitch"):
        load_asset(copy)



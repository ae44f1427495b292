"""A chest with two drawers, from cues with depth to an asset with two joints."""

import json

import mujoco
import numpy as np
import pytest

from reconstruct.pipeline import fit_scene, reconstruct
from taa_envs.asset import load_asset
from tests.reconstruct import two_drawers as chest


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("chest")
    (folder / "cues").mkdir()
    uv, visible, xyz = chest.tracks()
    np.savez(folder / "cues" / "tracks.npz", uv=uv, visible=visible, xyz_world=xyz)
    np.savez(folder / "cues" / "camera.npz", K=chest.K, T_world_camera=np.tile(np.eye(4), (chest.T, 1, 1)), metric=True)
    return folder


def strokes(joints):
    return sorted(round(float(np.ptp(j["q"])), 2) for j in joints)


def test_the_scene_folder_holds_two_joints(scene):
    joint = fit_scene(scene)
    assert (joint["verdict"], joint["type"]) == ("ok", "prismatic") and "2 parts" in joint["reason"]
    assert strokes([joint, joint["joint_2"]]) == [0.2, 0.24]
    for one in (joint, joint["joint_2"]):
        assert abs(np.dot(one["axis"], chest.OUT)) > np.cos(np.radians(1.0)) and one["metric"]
    assert "joint_3" not in joint


@pytest.mark.slow
def test_two_drawers_become_one_asset_with_two_joints(scene, tmp_path):
    video = chest.write_video(tmp_path / "chest.avi")
    made = reconstruct(video, "chest", scene=scene, out=tmp_path / "assets", focal=chest.FOCAL)
    assert made.error is None and set(made.as_dict()) >= {"joint", "joint_2"}
    asset = load_asset(made.asset.path)
    assert asset.links == ("moving", "moving_2")
    assert strokes([asset.joint, *asset.further]) == [0.2, 0.24]
    document = json.loads((asset.path / "asset.json").read_text())
    assert document["gate"]["passed"] and any(note.startswith("joint_2: prismatic") for note in document["notes"])
    assert np.allclose(asset.reference.further[0], asset.further[0]["q"])
    model = mujoco.MjModel.from_xml_path(str(asset.model_path))
    size = [np.ptp(model.mesh_vert[model.mesh_vertadr[m] : model.mesh_vertadr[m] + model.mesh_vertnum[m]], axis=0)
            for m in (model.mesh("moving").id, model.mesh("moving_2").id)]  # fmt: skip
    # Both fronts are 48 x 16 cm.
    for extent in size:
        assert np.sort(extent)[-1] == pytest.approx(0.48, rel=0.25)

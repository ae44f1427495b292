"""SAM 3D Objects and SegviGen, played by stand-ins: their meshes come to lie on the simulator's object."""

from __future__ import annotations

import json
import os
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reconstruct import cues_io
from reconstruct.cues import Hands, LinkMasks
from reconstruct.errors import TaaError
from reconstruct.joint.models import JointFit
from reconstruct.providers.make import provide
from reconstruct.providers.released import camera_to_glb_pose
from reconstruct.providers.sam3d import key_frames, near_part
from reconstruct.synth import load_truth, render_clip
from reconstruct.synth.render import LINK_CODE
from reconstruct.video import load_video
from tests.reconstruct import standins
from tests.reconstruct.provider_scenes import MAKER, small_request
from tests.reconstruct.released_scenes import link_meshes

FRAMES = 16


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    return load_truth(render_clip("oven", tmp_path_factory.mktemp("clips"), frames=FRAMES, size=(480, 270)))


@pytest.fixture(scope="module")
def seen(truth, tmp_path_factory):
    """The clip, its joint and its masks, as the stages before leave them."""
    video = load_video(truth.video, tmp_path_factory.mktemp("frames"))
    xyz = truth.tracks["xyz_world"][truth.tracks["link"] == LINK_CODE["moving"]][:, 0].astype(float)
    fit = JointFit("ok", "", truth.type, {}, truth.axis, truth.point, None, truth.q, np.arange(FRAMES), truth.K,
                   truth.T_camera_world[0], xyz, np.arange(len(xyz)), True, "given")  # fmt: skip
    masks = LinkMasks(truth.moving, truth.static | truth.room, truth.hand, np.ones(FRAMES))
    return video, fit, masks, Hands((), truth.hand, MAKER)


@pytest.fixture
def request_for(truth, seen, tmp_path):
    video, fit, masks, hands = seen
    links = link_meshes(truth)
    facts = {"T_camera_world": truth.T_camera_world, "T_world_moving": truth.T_world_moving}
    for name in ("static", "moving"):
        mesh = links[name].subdivide().subdivide()
        facts |= {f"{name}_v": np.asarray(mesh.vertices), f"{name}_f": np.asarray(mesh.faces)}
    sam = standins.environment(tmp_path, "sam3d", "scripts/03_sam3d_reconstruct.py", standins.SAM3D, facts)
    sam["checkpoint"] = "hf"
    segvigen = standins.environment(tmp_path, "segvigen", "scripts/05_segvigen_segment.py", standins.SEGVIGEN, facts)
    (Path(segvigen["repository"]) / "inference_full.py").touch()
    G = np.eye(4)
    G[:3, :3], G[:3, 3] = 1.3 * Rotation.from_euler("xyz", [0.2, -0.7, 1.1]).as_matrix(), [0.05, 0.1, 1.0]
    (Path(sam["repository"]) / "pose.json").write_text(json.dumps(camera_to_glb_pose(G)))
    (Path(sam["repository"]) / "matrix.json").write_text(json.dumps(G.tolist()))

    def make(labels: str = "votes"):
        chosen = {"mesh": "sam3d", "labels": labels}
        request = small_request(tmp_path / "scene", {"sam3d": sam, "segvigen": segvigen}, chosen, video, fit=fit,
                                masks=masks, hands=hands)  # fmt: skip
        return request, Path(sam["repository"]), Path(segvigen["repository"])

    return make


def distance(vertices: np.ndarray, mesh) -> float:
    """Median distance of points from a surface of boxes, m."""
    import trimesh

    surface = trimesh.sample.sample_surface(mesh, 20000, seed=0)[0]
    from scipy.spatial import cKDTree

    return float(np.median(cKDTree(surface).query(vertices)[0]))


@pytest.mark.slow
@pytest.mark.parametrize("labels", ["votes", "segvigen"])
def test_meshes_come_to_lie_on_the_object_at_rest(request_for, truth, labels):
    request, _, _ = request_for(labels)
    provide("mesh", cues_io.MESHES[1], request)
    links = link_meshes(truth)
    for name in cues_io.MESHES:
        vertices, faces, _ = cues_io.read_mesh(request.folder.path(name))
        link = Path(name).stem
        assert len(faces) > 100
        assert distance(vertices, links[link]) < 0.012 * truth.diagonal, (labels, link)
        if labels == "segvigen":  # voted labels bleed at the border of the links
            size, true = np.ptp(vertices, axis=0), np.ptp(np.asarray(links[link].vertices), axis=0)
            assert np.abs(size - true).max() < 0.08 * truth.diagonal
    maker = request.folder.maker(cues_io.MESHES[1])
    assert maker.name == "sam3d" and maker.licence == "SAM License"
    assert ("SegviGen" in maker.version) == (labels == "segvigen")


@pytest.mark.parametrize(
    ("mood", "where", "labels", "words"),
    [
        ("fail", 1, "votes", "sam3d failed with exit code 3"),
        ("nothing", 1, "votes", "sam3d ended without an error but wrote no combined"),
        ("shapes", 1, "votes", "pose.json holds no rotation"),
        ("fail", 2, "segvigen", "segvigen failed with exit code 3"),
        ("nothing", 2, "segvigen", "no mesh of SAM 3D Objects lies where the part is"),
    ],
)
def test_what_goes_wrong_is_one_clear_line(request_for, mood, where, labels, words):
    request, *repositories = request_for(labels)
    (repositories[where - 1] / "mood").write_text(mood)
    with pytest.raises(TaaError, match=words) as error:
        provide("mesh", cues_io.MESHES[1], request)
    assert "\n" not in str(error.value) and not request.folder.path(cues_io.MESHES[1]).exists()


def test_key_frames_spread_over_the_range(seen):
    _, fit, masks, _ = seen
    frames = key_frames(fit, masks)
    q = np.asarray(fit.q)[frames]
    assert 3 <= len(frames) <= 5 and np.ptp(q) > 0.6 * np.ptp(fit.q)
    with pytest.raises(TaaError, match="no frame shows both links"):
        key_frames(fit, LinkMasks(masks.moving & False, masks.static, masks.hand, masks.confidence))


def test_the_room_is_not_the_static_link():
    moving = np.zeros((2, 40, 60), bool)
    moving[:, 15:25, 20:40] = True
    static = ~moving
    near = near_part(static, moving)
    assert near[:, 18, 14:19].all() and not near[:, 0].any() and not near[:, :, :10].any() and not near[moving].any()

"""Rendered clips: what the pixels show and what the truth says are the same thing."""

import hashlib
import json

import cv2
import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from reconstruct.synth import list_clips, load_truth, render_clip, render_clips, write_cues
from reconstruct.synth.animation import animate
from reconstruct.synth.clips import build_clip
from reconstruct.synth.hand_model import FLAT, HandPose, _Skin, build_hand, landmarks
from reconstruct.synth.staging import skin_radii
from reconstruct.synth.truth import write_mjcf

SIZE = (240, 136)
JOINTED = ["demo", "drawer", "laptop", "oven", "monitor", "stapler", "puncher", "cabinet", "box", "locker", "crate"]


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    """Small renderings of a push on a hinge and of a pull on a slide."""
    out = tmp_path_factory.mktemp("clips")
    return {name: load_truth(path) for name, path in render_clips(out, ["demo", "drawer"], 0, 12, SIZE).items()}


def box_pixels(model, data, truth, frame, link):
    """(H, W) bool: silhouette of one link's boxes in the MJCF, rasterised from their corners."""
    mask = np.zeros(truth.size[::-1], np.uint8)
    for g in range(model.ngeom):
        if model.body(model.geom_bodyid[g]).name != link:
            continue
        signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
        corners = data.geom_xpos[g] + (signs * model.geom_size[g]) @ data.geom_xmat[g].reshape(3, 3).T
        uv = truth.project(corners, frame)
        hull = uv[ConvexHull(uv).vertices]
        cv2.fillConvexPoly(mask, np.round(hull * 16).astype(np.int32), 1, shift=4)
    return mask.astype(bool)


@pytest.mark.parametrize("name", ["demo", "drawer"])
def test_mjcf_at_q_covers_the_rendered_moving_pixels(clips, name):
    truth = clips[name]
    model = mujoco.MjModel.from_xml_path(str(truth.mjcf))
    data = mujoco.MjData(model)
    for t in (0, 6, 11):
        data.qpos[0] = truth.q[t]
        mujoco.mj_forward(model, data)
        drawn = box_pixels(model, data, truth, t, "moving")
        seen = truth.moving[t]
        assert seen.sum() > 500
        grown = cv2.dilate(drawn.astype(np.uint8), np.ones((3, 3))).astype(bool)
        assert (seen & ~grown).sum() <= 0.002 * seen.sum()
        # The other way round: what is drawn and not hidden by hand, static link or room is seen.
        shrunk = cv2.erode(drawn.astype(np.uint8), np.ones((3, 3))).astype(bool)
        assert (shrunk & truth.room[t]).sum() <= 0.03 * seen.sum()


@pytest.mark.parametrize("name", ["demo", "drawer"])
def test_tracks_follow_the_joint_and_the_depth(clips, name):
    truth = clips[name]
    moving = truth.tracks["link"] == 3
    xyz = truth.tracks["xyz_world"]
    T = truth.link_pose(truth.q)
    predicted = np.einsum("tij,nj->nti", T[:, :3, :3], xyz[moving, 0]) + T[:, :3, 3]
    assert np.abs(predicted - xyz[moving]).max() < 1e-5
    assert np.allclose(xyz[~moving], xyz[~moving, :1])
    assert truth.tracks["visible"][moving].mean() > 0.3
    for t in (0, 11):
        uv, seen = truth.tracks["uv"][:, t], truth.tracks["visible"][:, t]
        assert np.abs(truth.project(xyz[:, t], t) - uv).max() < 0.05
        on_grid = seen & (np.abs((np.round(uv) - 1) % 3).max(axis=1) == 0)
        i, j = ((np.round(uv[on_grid, m]) - 1).astype(int) // 3 for m in (1, 0))
        z = (xyz[on_grid, t] @ truth.T_camera_world[t, :3, :3].T + truth.T_camera_world[t, :3, 3])[:, 2]
        assert on_grid.sum() > 10
        assert np.abs(truth.depth[t, i, j] - z).max() < 0.009


def test_hand_joints_lie_on_hand_pixels(clips):
    truth = clips["demo"]
    w, h = truth.size
    for t in (4, 8):
        uv = np.round(truth.project(truth.hand_joints[t], t)).astype(int)
        inside = ((uv >= 0) & (uv < (w, h))).all(axis=1)
        assert inside.sum() >= 18
        assert truth.hand[t, uv[inside, 1], uv[inside, 0]].mean() > 0.9


def test_video_holds_every_frame(clips):
    truth = clips["demo"]
    capture = cv2.VideoCapture(str(truth.video))
    frames = []
    while True:
        ok, frame = capture.read()
        if not ok:
            break
        frames.append(frame)
    assert len(frames) == 12
    assert frames[0].shape[:2] == truth.size[::-1]
    assert min(f.std() for f in frames) > 10


def test_same_seed_same_bytes_other_seed_other_pixels(tmp_path):
    digests = []
    for folder, seed in (("a", 3), ("b", 3), ("c", 4)):
        path = render_clip("still", tmp_path / folder, seed, frames=8, size=(160, 90))
        digests.append(
            [hashlib.sha256((path / f).read_bytes()).hexdigest() for f in ("video.mp4", "truth.json", "object.xml")]
        )
    assert digests[0] == digests[1]
    assert digests[0][0] != digests[2][0]


def test_masks_are_a_partition(clips):
    truth = clips["drawer"]
    total = truth.moving.astype(int) + truth.static + truth.hand + truth.room
    assert total.max() == 1
    assert (total == 1).mean() > 0.99


def test_truth_is_stated_as_contracts_say(clips):
    for truth in clips.values():
        assert truth.q[0] == 0 and np.all(np.diff(truth.q) >= 0)
        assert truth.q_range[0] <= truth.q.min() and truth.q.max() <= truth.q_range[1]
        assert np.isclose(np.linalg.norm(truth.axis), 1)
        assert truth.hand_joints.shape == (12, 21, 3)
        assert truth.image_line.shape == (2, 2)
        assert truth.contact.any() and not truth.contact[0] and not truth.contact[-1]
    assert clips["drawer"].point is None


def test_cues_have_the_contract_arrays(clips, tmp_path):
    truth = clips["demo"]
    cues = write_cues(truth.video.parent, tmp_path)
    n, (w, h) = 12, truth.size
    read = {f.stem: dict(np.load(f)) for f in cues.glob("*.npz")}
    assert read["frames"]["time"].shape == (n,)
    assert read["camera"]["T_world_camera"].shape == (n, 4, 4) and read["camera"]["metric"]
    assert np.allclose(read["camera"]["T_world_camera"] @ truth.T_camera_world, np.eye(4), atol=1e-9)
    assert read["depth"]["depth"].dtype == np.float32 and len(read["depth"]["depth"]) == n
    assert all(read["masks"][k].shape == (n, h, w) for k in ("static", "moving", "hand"))
    tracks = read["tracks"]
    assert tracks["uv"].shape == (*tracks["visible"].shape, 2) and tracks["xyz_world"].shape == (
        len(tracks["uv"]),
        n,
        3,
    )
    assert read["hand"]["joints_world"].shape == (n, 21, 3) and str(read["hand"]["side"]) == "right"


@pytest.mark.parametrize("name", JOINTED)
def test_contact_is_rigid_and_on_the_surface(name):
    clip = build_clip(name)
    motion = animate(clip, 60, 15.0, 0)
    joints = landmarks(clip.pose, clip.side)
    held = np.linalg.inv(motion.T_world_moving) @ motion.T_world_hand
    in_link = np.einsum("tij,kj->tki", held[:, :3, :3], joints) + held[:, None, :3, 3]
    driving = in_link[motion.contact]
    assert np.abs(driving - driving.mean(axis=0)).max() < 0.003
    # Distance of each landmark's skin to the nearest moving box: some touch, none is deep inside.
    gap = []
    for box in (b for b in clip.model.boxes if b.link == "moving"):
        d = np.abs((driving - box.centre) @ box.rotation) - box.size / 2
        outside = np.linalg.norm(np.maximum(d, 0), axis=-1) + np.minimum(d.max(axis=-1), 0)
        gap.append(outside - skin_radii())
    nearest = np.min(gap, axis=(0, 2))
    assert nearest.max() < 0.002 and nearest.min() > -0.004


@pytest.mark.parametrize("name", JOINTED)
def test_true_hand_drives_the_joint_by_contact_alone(name, tmp_path):
    clip = build_clip(name)
    motion = animate(clip, 120, 30.0, 0)
    write_mjcf(clip.model, tmp_path / "object.xml")
    joints = np.einsum("tij,kj->tki", motion.T_world_hand[:, :3, :3], landmarks(clip.pose, clip.side))
    joints += motion.T_world_hand[:, None, :3, 3]
    assert replay(tmp_path / "object.xml", joints) / motion.q[-1] > 0.95
    assert replay(tmp_path / "object.xml", joints + [0, -5.0, 0]) == 0


def replay(path, joints):
    """Largest joint value while spheres of 7 mm move along (T, 21, 3)."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.option.timestep, spec.option.gravity = 0.002, [0, 0, 0]
    for k in range(21):
        body = spec.worldbody.add_body(name=f"hand{k}", mocap=True, pos=joints[0, k])
        # Stiff: MuJoCo takes a mocap body for standing, so that the part it drives sinks in by speed x time constant.
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.007, 0, 0], solref=[0.004, 1.0], priority=1)
    model = spec.compile()
    assert model.nu == 0 and model.nv == 1
    data = mujoco.MjData(model)
    best = 0.0
    for a, b in zip(joints[:-1], joints[1:], strict=True):
        for s in np.arange(17) / 17:
            data.mocap_pos[:] = a + s * (b - a)
            mujoco.mj_step(model, data)
        best = max(best, data.qpos[0])
    return best


def test_negatives_have_no_joint():
    lift, still = build_clip("lift"), build_clip("still")
    motion = animate(lift, 30, 7.5, 0)
    assert np.isnan(motion.q).all() and motion.contact[-1]
    # No single screw axis: the relative motions' rotation axes differ.
    steps = np.linalg.inv(motion.T_world_moving[8:20]) @ motion.T_world_moving[10:22]
    axes = np.array([cv2.Rodrigues(T[:3, :3])[0].ravel() for T in steps])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    assert (axes @ axes.T).min() < np.cos(np.radians(20))
    motion = animate(still, 30, 7.5, 0)
    assert not motion.contact.any() and not motion.q.any()


def test_static_camera_stands_and_handheld_camera_drifts():
    fixed, held = (animate(build_clip(n), 60, 15.0, 0).T_camera_world for n in ("demo", "demo_handheld"))
    assert np.all(fixed == fixed[0])
    centres = np.linalg.inv(held)[:, :3, 3]
    assert 0.003 < np.ptp(centres, axis=0).max() < 0.08


@pytest.mark.parametrize("name", list_clips())
def test_every_object_compiles_and_states_its_joint(name, tmp_path):
    clip = build_clip(name)
    write_mjcf(clip.model, tmp_path / "object.xml")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "object.xml"))
    assert model.nu == 0
    if clip.model.kind is None:
        return
    joint = model.joint("joint")
    expected = {"revolute": mujoco.mjtJoint.mjJNT_HINGE, "prismatic": mujoco.mjtJoint.mjJNT_SLIDE}[clip.model.kind]
    assert int(joint.type[0]) == int(expected)
    assert np.allclose(joint.axis, clip.model.axis) and np.allclose(joint.range, clip.model.q_range)
    assert 0 < clip.model.q_end <= clip.model.q_range[1]


@pytest.mark.parametrize("side", ["right", "left"])
def test_hand_mesh_is_closed_and_outward(side):
    mesh = build_hand(FLAT, side, cell=0.006)
    triangles = np.concatenate([mesh.quads[:, [0, 1, 2]], mesh.quads[:, [0, 2, 3]]])
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all()
    a, b, c = mesh.vertices[triangles].transpose(1, 0, 2)
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 > 5e-4
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), mesh.normals[triangles[:, 0]]) > 0).mean() > 0.99
    assert np.allclose(mesh.joints, landmarks(FLAT, side), atol=1e-6)


def test_landmarks_have_human_proportions_and_lie_under_the_skin():
    for pose in (FLAT, HandPose(flex=((45, 53, 4),) * 4)):
        x = landmarks(pose)
        assert 0.07 < np.linalg.norm(x[9] - x[0]) < 0.10
        depth = -_Skin(pose, 0)(x.astype(np.float32))
        assert depth.min() > 0.004 and depth.max() < 0.025
    assert landmarks(FLAT, "right")[4, 0] > 0 > landmarks(FLAT, "left")[4, 0]


def test_wrong_requests_say_what_is_there(tmp_path):
    with pytest.raises(ValueError, match="demo"):
        render_clip("nothing", tmp_path)
    with pytest.raises(ValueError, match="even size"):
        render_clip("demo", tmp_path, size=(161, 90))
    assert not any(tmp_path.iterdir())


def test_truth_json_is_plain(clips):
    facts = json.loads((clips["demo"].video.parent / "truth.json").read_text())
    assert facts["type"] == "revolute" and facts["unit"] == "rad" and facts["camera"] == "static"

"""Stage results and the scene folder's cues on disk."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from reconstruct import cues_io
from reconstruct.cues import HandReference, Hands, HandTrack, LinkMasks, ProviderInfo, Tracks
from reconstruct.depth import depth_scale
from reconstruct.errors import TaaError
from reconstruct.geometry import Geometry, LinkMesh
from reconstruct.joint.models import JointFit
from reconstruct.store import load_stage, pack, save_stage, stage_key, unpack
from reconstruct.video import Video

T, H, W = 12, 54, 96
RNG = np.random.default_rng(3)
MAKER = ProviderInfo("test", "1", "none")
LOOK_DOWN_Y = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 2.0], [0, 0, 0, 1.0]])


@pytest.fixture
def video(tmp_path):
    frames = RNG.integers(0, 255, (T, H, W, 3), np.uint8)
    return Video(tmp_path / "x.mp4", "0" * 64, (2 * W, 2 * H), np.arange(T) / 30, np.arange(T), T, frames, 0.5)


@pytest.fixture
def hands():
    track = HandTrack("left", RNG.random((T, 21, 2)), RNG.random((T, 21, 3)), np.ones(T), np.ones(T, bool))
    return Hands((track,), RNG.random((T, H, W)) > 0.5, MAKER)


@pytest.fixture
def fit():
    K = np.array([[150.0, 0, W - 0.5], [0, 150.0, H - 0.5], [0, 0, 1]])
    points = RNG.uniform(-0.4, 0.4, (40, 3))
    return JointFit("ok", "one joint", "revolute", {"revolute": 0.9}, np.array([0, 0, 1.0]), np.zeros(3),
                    None, np.linspace(0, 1, T), np.arange(T), K, LOOK_DOWN_Y, points, np.arange(40), False, "none",
                    {"axis_deg": 1.0, "point_m": 0.01, "q": np.full(T, 0.01)}, inliers=40, tracks=50)  # fmt: skip


def box(offset: float) -> LinkMesh:
    import trimesh

    mesh = trimesh.creation.box((0.2, 0.1, 0.3))
    mesh.apply_translation((offset, 0, 0))
    colours = np.tile(np.uint8([200, 30, 60, 255]), (len(mesh.vertices), 1))
    part = (np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return LinkMesh(part[0], part[1], colours, np.zeros(len(mesh.faces), bool), (part,))


def same(a, b) -> bool:
    if hasattr(a, "__dataclass_fields__"):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return type(a) is type(b) and a == b


def test_every_dataclass_survives_the_disk(tmp_path, hands, fit):
    tracks = Tracks(RNG.random((9, T, 2)), RNG.random((9, T)) > 0.5, np.zeros(9, int), MAKER, RNG.random((9, T, 2)) / 2,
                    RNG.random(9) > 0.5)  # fmt: skip
    masks = LinkMasks(hands.mask, ~hands.mask, hands.mask, np.ones(T))
    geometry = Geometry(box(0), box(1), {"mass": {"value": 1.0, "origin": "assumed"}}, ("a note",))
    reference = HandReference(np.arange(T) / 30, np.zeros(T), np.zeros((T, 21, 3)), np.ones(T, bool), np.ones(T, bool),
                              "left", ("another",))  # fmt: skip
    for n, value in enumerate((hands, tracks, fit, masks, geometry, reference)):
        save_stage(tmp_path / f"{n}.npz", "key", value)
        assert same(value, load_stage(tmp_path / f"{n}.npz", "key"))
        assert load_stage(tmp_path / f"{n}.npz", "another key") is None
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_a_damaged_result_is_made_again(tmp_path, fit):
    file = tmp_path / "joint.npz"
    save_stage(file, "key", fit)
    file.write_bytes(file.read_bytes()[:-200])
    assert load_stage(file, "key") is None
    assert load_stage(tmp_path / "none.npz", "key") is None


def test_objects_are_not_stored():
    with pytest.raises(TypeError, match="cannot store"):
        pack({"x": object()})
    with pytest.raises(TypeError, match="objects"):
        pack(np.array([object()]))
    tree, arrays = pack((np.float32(1.5), None, [True, "x"]))
    assert unpack(tree, arrays) == (1.5, None, [True, "x"])


def test_keys_depend_on_options_and_on_the_code(monkeypatch):
    key = stage_key("joint", ("joint",), {"video": "a"})
    assert key == stage_key("joint", ("joint",), {"video": "a"})
    assert key != stage_key("joint", ("joint",), {"video": "b"})
    assert key != stage_key("joint", ("joint", "motion.py"), {"video": "a"})


def test_own_cues_are_told_from_the_users(tmp_path):
    folder = cues_io.CueFolder(tmp_path)
    uv = RNG.random((5, T, 2))
    folder.write("tracks", {"uv": uv, "visible": np.ones((5, T), bool)})
    again = cues_io.CueFolder(tmp_path)
    assert again.given() == {}
    np.savez(tmp_path / "cues" / "tracks.npz", uv=uv + 1, visible=np.ones((5, T), bool))
    assert list(again.given()) == ["tracks"]
    again.write("tracks", {"uv": uv, "visible": np.ones((5, T), bool)})
    assert np.array_equal(again.read("tracks")["uv"], uv + 1), "a user's file must not be overwritten"


def test_bad_cues_are_one_clear_line(tmp_path):
    folder = cues_io.CueFolder(tmp_path)
    folder.folder.mkdir(parents=True)
    (folder.folder / "tracks.npz").write_text("nonsense")
    with pytest.raises(TaaError, match="numpy.savez"):
        folder.read("tracks")
    np.savez(folder.folder / "tracks.npz", uv=np.zeros((1, T, 2)))
    with pytest.raises(TaaError, match="no array 'visible'"):
        folder.read("tracks", "uv", "visible")
    np.savez(folder.folder / "hand.npz", side=np.array([{}], dtype=object))
    with pytest.raises(TaaError, match="cannot read"):
        folder.read("hand", "side")
    with pytest.raises(TaaError, match=r"expected \(any, 12, 2\)"):
        cues_io.tracks_from_cue({"uv": np.zeros((4, 3, 2)), "visible": np.ones((4, 3))}, T)


def test_tracks_start_where_they_are_first_seen():
    uv = RNG.random((2, T, 2))
    uv[1, :4] = np.nan
    tracks = cues_io.tracks_from_cue({"uv": uv, "visible": np.ones((2, T), bool)}, T)
    assert tracks.reference.tolist() == [0, 4] and not tracks.visible[1, 3]


def test_hand_joints_turn_into_camera_axes(video):
    world = RNG.normal(size=(T, 21, 3))
    pose = np.tile(np.linalg.inv(LOOK_DOWN_Y), (T, 1, 1))
    cue = {
        "joints_world": world,
        "joints_uv": np.zeros((T, 21, 2)),
        "valid": np.arange(T) != 5,
        "side": np.array("right"),
    }
    hands = cues_io.hands_from_cue(cue, {"T_world_camera": pose}, video, np.zeros((T, H, W), bool))
    hand = hands.tracks[0]
    expected = world[0] @ LOOK_DOWN_Y[:3, :3].T
    np.testing.assert_allclose(hand.metric[0], expected - expected.mean(0), atol=1e-12)
    assert hand.side == "right" and not hand.valid[5] and np.isnan(hand.uv[5]).all()
    with pytest.raises(TaaError, match="camera.npz"):
        cues_io.hands_from_cue(cue, None, video, None)


def test_a_users_hand_is_measured_in_space_and_a_networks_is_not(video):
    joints = RNG.random((T, 21, 3))
    cue = {"joints_world": joints, "joints_uv": RNG.random((T, 21, 2)), "valid": np.arange(T) != 5,
           "side": np.array("right")}  # fmt: skip
    camera = {"T_world_camera": np.repeat(LOOK_DOWN_Y[None], T, 0)}
    mask = np.zeros((T, H, W), bool)

    def read(cue, camera=camera, maker=cues_io.GIVEN):
        return cues_io.hands_from_cue(cue, camera, video, mask, maker).tracks[0]

    hand = read(cue)
    np.testing.assert_allclose(hand.placed[0] @ LOOK_DOWN_Y[:3, :3].T + LOOK_DOWN_Y[:3, 3], joints[0], atol=1e-12)
    assert hand.placed_std == cues_io.PLACED_STD and np.isnan(hand.placed[5]).all()
    assert read(cue, maker=MAKER).placed is None
    assert read({**cue, "std": np.array(0.02)}, maker=MAKER).placed_std == 0.02
    assert read(cue, {**camera, "metric": np.array(False)}).placed is None
    for bad in (np.array(-1.0), np.array(np.nan), np.zeros(3)):
        with pytest.raises(TaaError, match="std of cues/hand.npz"):
            read({**cue, "std": bad})


def test_masks_of_any_size_come_to_working_size(video):
    large = np.zeros((T, 2 * H, 2 * W), bool)
    large[:, : H // 2 * 2] = True
    masks = cues_io.masks_from_cue({"moving": large, "static": ~large, "hand": ~large}, video)
    assert (
        masks.moving.shape == (T, H, W) and masks.moving[:, : H // 2].all() and not masks.moving[:, H // 2 + 1 :].any()
    )


def test_meshes_round_trip(tmp_path):
    folder = cues_io.CueFolder(tmp_path)
    folder.write_meshes(Geometry(box(0.0), box(1.0)))
    assert cues_io.CueFolder(tmp_path).given() == {}
    links = cues_io.meshes_from_cue(folder.folder)
    np.testing.assert_allclose(links["moving"].vertices.mean(0), [1.0, 0, 0], atol=1e-6)
    assert (links["moving"].colors[:, 0] == 200).all()
    (folder.folder / "meshes" / "moving.glb").write_bytes(b"glTF?")
    with pytest.raises(TaaError, match="binary glTF"):
        cues_io.meshes_from_cue(folder.folder)


def test_the_users_camera_defines_the_world(fit):
    T_world_camera = np.linalg.inv(LOOK_DOWN_Y)
    T_world_camera[:3, 3] += [5, 6, 7]
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    moved = cues_io.in_world_of(fit, {"T_world_camera": (turned @ T_world_camera)[None]})
    np.testing.assert_allclose(moved.project(moved.points), fit.project(fit.points), atol=1e-9)
    np.testing.assert_allclose(moved.T_camera_world, np.linalg.inv(turned @ T_world_camera), atol=1e-12)
    np.testing.assert_allclose(moved.axis, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(moved.point, [-5, -6, 7], atol=1e-12)


def test_depth_makes_the_joint_metric(fit):
    """The scene is 2.5 times as large as the fit: its depth maps say so, at a third of the picture's size."""
    size = (2 * W, 2 * H)
    pose = fit.link_pose(fit.q)
    world = np.einsum("tij,nj->tni", pose[:, :3, :3], fit.points) + pose[:, None, :3, 3]
    uv = fit.project(world).transpose(1, 0, 2)
    z = 2.5 * (world @ LOOK_DOWN_Y[:3, :3].T + LOOK_DOWN_Y[:3, 3])[..., 2]
    visible = ((uv >= 0) & (uv <= np.array(size) - 1)).all(-1)
    depth = np.full((T, size[1] // 3, size[0] // 3), np.nan)
    for t in range(T):
        for n in np.flatnonzero(visible[:, t]):
            u, v = np.round((uv[n, t] + 0.5) / 3 - 0.5).astype(int)
            depth[t, min(v, depth.shape[1] - 1), min(u, depth.shape[2] - 1)] = z[t, n]
    tracks = Tracks(uv, visible, np.zeros(40, int), MAKER)
    metric = depth_scale(fit, tracks, depth, size)
    assert metric.metric and metric.scale_source == "depth"
    assert np.linalg.norm(metric.T_camera_world[:3, 3]) == pytest.approx(5.0, rel=0.02)
    assert depth_scale(fit, tracks, np.full_like(depth, np.nan), size) is fit


def test_a_scene_of_cues_alone_has_sizes_and_times(tmp_path):
    folder = cues_io.CueFolder(tmp_path)
    folder.folder.mkdir(parents=True)
    np.savez(folder.folder / "tracks.npz", uv=np.zeros((3, T, 2)), visible=np.ones((3, T), bool))
    with pytest.raises(TaaError, match="size is unknown"):
        cues_io.video_of_cues(tmp_path)
    K = np.array([[900.0, 0, 959.5], [0, 900.0, 539.5], [0, 0, 1]])
    np.savez(folder.folder / "camera.npz", K=K)
    np.savez(folder.folder / "frames.npz", time=np.arange(T) / 10)
    video = cues_io.video_of_cues(tmp_path)
    assert video.size == (1920, 1080) and video.frames.shape == (T, 540, 960, 3) and video.time[-1] == 1.1
    assert cues_io.focal_of({"K": K}) == 900.0


def test_scene_facts_bring_back_the_frame_numbers(tmp_path, video):
    folder = cues_io.CueFolder(tmp_path)
    folder.write("tracks", {"uv": np.zeros((3, T, 2)), "visible": np.ones((3, T), bool)})
    folder.write("frames", {"time": video.time})
    cues_io.save_facts(tmp_path, video)
    again = cues_io.video_of_cues(tmp_path)
    assert again.size == video.size and again.sha256 == video.sha256 and np.array_equal(again.index, video.index)

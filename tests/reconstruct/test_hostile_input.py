"""Videos and cues that are broken or made to harm: a clear error or an honest answer, never a crash."""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruct import container, cues_io
from reconstruct.errors import Refused, TaaError
from reconstruct.film import read_mp4
from reconstruct.joint.models import JointFit
from reconstruct.store import load_stage, save_stage
from reconstruct.video import Video, load_video

# --- videos --------------------------------------------------------------------------------------------------------


def make(path: Path, size: str, *options: str, seconds: float = 1.0, rate: int = 20) -> Path:
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-v",
        "error",
        "-y",
        "-f",
        "lavfi",
        "-i",
        f"testsrc=size={size}:rate={rate}:duration={seconds}",
        *options,
        str(path),
    ]
    subprocess.run(command, check=True)
    return path


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("video") / "good.mp4"
    return make(path, "320x180", "-movflags", "+faststart", "-g", "5").read_bytes()


def error_of(path: Path) -> str:
    with pytest.raises(TaaError) as caught:
        load_video(path)
    text = str(caught.value)
    assert "\n" not in text and "; " in text, text
    return text


def test_truncated_videos(good: bytes, tmp_path: Path) -> None:
    for share in (0.0, 0.02, 0.3, 0.6, 0.9, 0.99):
        path = tmp_path / "cut.mp4"
        path.write_bytes(good[: int(share * len(good))])
        try:
            video = load_video(path)
        except TaaError as error:
            assert "; " in str(error)
        else:
            assert 2 <= len(video) <= 20 and (len(video) == 20 or video.notes)


def test_no_frame_and_one_frame(tmp_path: Path) -> None:
    assert "not a video" in error_of(make(tmp_path / "none.mp4", "320x180", "-vf", "select=0"))
    assert "fewer than two" in error_of(make(tmp_path / "one.mp4", "320x180", "-frames:v", "1"))


@pytest.mark.parametrize(
    "options, size, shape",
    [
        (("-vf", "scale=1:1", "-c:v", "ffv1"), "320x180", None),
        (("-c:v", "ffv1"), "1280x4", None),
        (("-c:v", "ffv1"), "321x181", (181, 321)),
        (("-pix_fmt", "gray", "-c:v", "ffv1"), "320x180", (180, 320)),
        (("-pix_fmt", "rgba", "-c:v", "png"), "320x180", (180, 320)),
        (("-pix_fmt", "yuv420p10le", "-c:v", "ffv1"), "320x180", (180, 320)),
    ],
)
def test_odd_sizes_and_pixels(tmp_path: Path, options: tuple, size: str, shape: tuple | None) -> None:
    path = make(tmp_path / "odd.mkv", size, *options)
    if shape is None:
        assert "content" in (text := error_of(path)) or "32 px" in text
        return
    video = load_video(path)
    assert video.frames.shape[1:] == (*shape, 3) and len(video) == 20


@pytest.mark.slow
def test_an_8k_video_is_shrunk(tmp_path: Path) -> None:
    video = load_video(make(tmp_path / "large.mp4", "7680x4320", "-preset", "ultrafast", seconds=0.2, rate=10))
    assert video.size == (7680, 4320) and video.frames.shape[1:3] == (540, 960)


def test_frames_beyond_8k_are_refused_before_one_is_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = make(tmp_path / "v.mp4", "320x180")
    monkeypatch.setattr(container, "MAX_PIXELS", 320 * 180 - 1)
    assert "shrink" in error_of(path)


def test_more_frames_than_anybody_films(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = make(tmp_path / "v.mp4", "320x180")
    monkeypatch.setattr("reconstruct.video.MAX_DECODED", 10)
    assert "more than 10 frames" in error_of(path)


@pytest.mark.parametrize("box, offset", [(b"stsz", 12), (b"stts", 12), (b"stsc", 12), (b"mvhd", 16), (b"mdhd", 20)])
def test_a_million_frames_claimed(good: bytes, tmp_path: Path, box: bytes, offset: int) -> None:
    raw = bytearray(good)
    at = raw.index(box) + offset
    raw[at : at + 4] = (1_000_000).to_bytes(4, "big")
    (tmp_path / "v.mp4").write_bytes(raw)
    try:
        video = load_video(tmp_path / "v.mp4")
    except TaaError:
        return
    assert len(video) <= 20


@pytest.mark.parametrize("seed", range(4))
def test_a_corrupt_middle(good: bytes, tmp_path: Path, seed: int) -> None:
    raw, rng = bytearray(good), np.random.default_rng(seed)
    start = raw.index(b"mdat") + 8
    for at in rng.integers(start + (len(raw) - start) // 3, len(raw), 40):
        raw[at] = rng.integers(256)
    (tmp_path / "v.mp4").write_bytes(raw)
    try:
        assert 2 <= len(load_video(tmp_path / "v.mp4")) <= 20
    except (TaaError, Refused) as error:
        assert "; " in str(error)


def test_the_extension_does_not_matter(good: bytes, tmp_path: Path) -> None:
    (tmp_path / "video.txt").write_bytes(good)
    assert len(load_video(tmp_path / "video.txt")) == 20
    for name, raw in (("zip.mp4", b"PK\x03\x04" + bytes(99)), ("page.mp4", b"<html>"), ("folder.mp4", None)):
        if raw is None:
            (tmp_path / name).mkdir()
        else:
            (tmp_path / name).write_bytes(raw)
        error_of(tmp_path / name)


PLAYLISTS = {
    "concat.mp4": "ffconcat version 1.0\nfile 'secret.mp4'\n",
    "hls.m3u8": "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nsecret.mp4\n#EXT-X-ENDLIST\n",
    "dash.mpd": '<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011"/>',
    "sdp.sdp": "v=0\no=- 0 0 IN IP4 127.0.0.1\nc=IN IP4 127.0.0.1\nm=video 9 RTP/AVP 96\n",
}


@pytest.mark.parametrize("name", PLAYLISTS)
def test_a_playlist_opens_no_other_file(good: bytes, tmp_path: Path, name: str) -> None:
    (tmp_path / "secret.mp4").write_bytes(good)
    (tmp_path / name).write_text(PLAYLISTS[name])
    assert "not a video" in error_of(tmp_path / name)
    with pytest.raises(TaaError, match="not a video"):  # the film in a stranger's asset
        next(read_mp4(tmp_path / name))


def test_time_stamps_that_jump(tmp_path: Path) -> None:
    path = make(tmp_path / "v.mkv", "320x180", "-vf", "setpts=PTS+gte(N\\,10)*86400/TB", "-fps_mode", "vfr")
    video = load_video(path)
    assert len(video) == 20 and video.time[-1] < 2 and any("jump" in note for note in video.notes)


# --- cues ----------------------------------------------------------------------------------------------------------

T = 6
VIDEO = Video(Path("v"), "", (64, 64), np.arange(T) / 30, np.arange(T), T, np.zeros((T, 64, 64, 3), np.uint8), 1.0)
CAMERA = {"K": np.diag([60.0, 60, 1]), "T_world_camera": np.tile(np.eye(4), (T, 1, 1))}
HAND = {
    "joints_world": np.zeros((T, 21, 3)),
    "joints_uv": np.ones((T, 21, 2)),
    "valid": np.ones(T, bool),
    "side": np.array("left"),
}
NO_HAND = np.zeros((T, 64, 64), bool)
FIT = JointFit("ok", "", axis=np.array([0, 0, 1.0]), point=np.zeros(3), T_camera_world=np.eye(4))

odd = st.sampled_from(
    [
        np.zeros((T, 2)),
        np.full((2, T, 2), np.nan),
        np.full((2, T, 2), np.inf),
        np.full((2, T), "yes"),
        np.zeros((0, T, 2)),
        np.array(3.0),
        np.full((T, 4, 4), np.nan),
        np.zeros((T, 4, 4)),
        np.eye(4) * 1e200,
        np.full((T, 21, 3), np.inf),
        np.full((T, 21, 2), 1e30),
        np.array(["left"]),
        np.array("up"),
        np.zeros((T, 0, 0)),
        np.full((T, 5, 5), -np.inf, np.float32),
        np.ones((T, 5, 5), bool),
        np.zeros((3, 3)),
        -np.eye(3),
        np.full((T, 3, 3), 1e300),
        np.array(b"x"),
        np.zeros(T, complex),
    ]
)


@settings(max_examples=150, deadline=None)
@given(
    st.dictionaries(
        st.sampled_from(["uv", "visible", "K", "T_world_camera", *HAND, "moving", "static", "hand", "depth", "metric"]),
        odd,
        min_size=1,
        max_size=3,
    )
)
def test_any_cue_is_taken_or_refused(changes: dict) -> None:
    tracks = {"uv": np.ones((2, T, 2)), "visible": np.ones((2, T), bool), **changes}
    masks = {name: NO_HAND for name in ("moving", "static", "hand")} | changes
    camera, hand, depth = CAMERA | changes, HAND | changes, {"depth": np.ones((T, 4, 4))} | changes
    for use in (
        lambda: cues_io.tracks_from_cue(tracks, T),
        lambda: cues_io.masks_from_cue(masks, VIDEO),
        lambda: cues_io.hands_from_cue(hand, camera, VIDEO, NO_HAND),
        lambda: cues_io.focal_of(camera),
        lambda: cues_io.in_world_of(FIT, camera),
        lambda: cues_io.metric_depth_from_cue(depth, T),
    ):
        try:
            made = use()
        except TaaError as error:
            assert "\n" not in str(error)
            continue
        if hasattr(made, "uv"):
            assert np.isfinite(made.uv[made.visible]).all()
        if isinstance(made, JointFit):
            assert np.isfinite(made.axis).all() and np.isfinite(made.point).all()


def test_object_arrays_and_strangers_archives(tmp_path: Path) -> None:
    folder = cues_io.CueFolder(tmp_path)
    (tmp_path / "cues").mkdir()
    file = tmp_path / "cues" / "tracks.npz"
    np.savez(file, uv=np.array([{"a": 1}], dtype=object), visible=np.zeros(1))
    with pytest.raises(TaaError, match="plain arrays.*; write it"):
        folder.read("tracks", "uv")
    for raw in (b"", b"PK\x03\x04", b"\x80\x04N."):
        file.write_bytes(raw)
        with pytest.raises(TaaError, match="cannot read"):
            folder.read("tracks", "uv")


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "{}",
        '{"size": [0, 0]}',
        "nonsense",
        "[" * 9000,
        '{"size": [1e999, 1], "index": [0], "video": 1, "sha256": 2, "decoded": 3, "focal_px": 4}',
    ],
)
def test_scene_facts_of_a_stranger(tmp_path: Path, text: str) -> None:
    (tmp_path / "cues").mkdir()
    np.savez(tmp_path / "cues" / "tracks.npz", uv=np.zeros((3, T, 2)), visible=np.ones((3, T), bool))
    (tmp_path / "scene.json").write_text(text)
    (tmp_path / "cues" / "written.json").write_text(text)
    with pytest.raises(TaaError, match="scene.json"):
        cues_io.video_of_cues(tmp_path)
    assert set(cues_io.CueFolder(tmp_path).given()) == {"tracks"}


def test_meshes_of_a_stranger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "meshes" / "moving.glb"
    file.parent.mkdir()
    good = trimesh.creation.box().export(file_type="glb")
    length = int.from_bytes(good[12:16], "little")
    tree = json.loads(good[20 : 20 + length])

    def put(changed: dict) -> None:
        text = json.dumps(changed).encode()
        text += b" " * (-len(text) % 4)
        rest = good[20 + length :]
        head = b"glTF" + (2).to_bytes(4, "little") + (20 + len(text) + len(rest)).to_bytes(4, "little")
        file.write_bytes(head + len(text).to_bytes(4, "little") + b"JSON" + text + rest)

    put(tree)
    assert len(cues_io.meshes_from_cue(tmp_path, ["meshes/moving.glb"])["moving"].faces) == 12
    (tmp_path / "secret.bin").write_bytes(bytes(5000))
    put(tree | {"buffers": [{"uri": "../secret.bin", "byteLength": 5000}]})
    opened: list[str] = []
    monkeypatch.setattr(trimesh.resolvers.FilePathResolver, "get", lambda self, name: opened.append(name))
    try:
        cues_io.meshes_from_cue(tmp_path, ["meshes/moving.glb"])
    except TaaError:
        pass
    assert not opened
    claimed = json.loads(json.dumps(tree))
    for accessor in claimed["accessors"]:
        accessor["count"] = 10**9
    for changed in ({}, {"scenes": [{"nodes": [99]}]}, claimed):
        put(changed)
        with pytest.raises(TaaError, match="mesh|faces"):
            cues_io.meshes_from_cue(tmp_path, ["meshes/moving.glb"])
    far = trimesh.creation.box()
    far.vertices[0] = 1e30
    file.write_bytes(far.export(file_type="glb"))
    with pytest.raises(TaaError, match="too far"):
        cues_io.meshes_from_cue(tmp_path, ["meshes/moving.glb"])


@pytest.mark.slow
def test_a_mesh_that_cuts_through_itself_is_cut_or_given_up_in_time() -> None:
    """The fuzzer's: a box with corners moved through its faces, on which the decomposition may run for ever."""
    from reconstruct.geometry.given import bounded_solid, make_solid

    corners = (
        np.array(
            [[-5, -5, -5], [-5, -5, 5], [-5, 5, -5], [-5, 5, 5], [10, -5, -5], [5, -5, 0], [0, 0, -5.0001], [5, 5, 5]]
        )
        / 10
    )
    faces = np.array(
        [
            [1, 3, 0],
            [4, 1, 0],
            [0, 3, 2],
            [2, 4, 0],
            [1, 7, 3],
            [5, 1, 4],
            [5, 7, 1],
            [3, 7, 2],
            [6, 4, 2],
            [2, 7, 6],
            [6, 5, 4],
            [7, 5, 6],
        ]
    )
    # Whether it ends depends on the build of the decomposition and its threads; that somebody waits for it must not.
    with pytest.raises(TaaError, match="convex parts in time"):
        bounded_solid(corners, faces, seconds=0.05)
    # The wrapped surface has an answer whatever the given one is.
    solid = make_solid(corners, faces, wrapped=True)
    assert solid.wrapped and len(solid.parts) >= 1 and trimesh.Trimesh(solid.vertices, solid.faces).is_watertight
    begin = time.monotonic()
    try:
        assert len(bounded_solid(corners, faces, seconds=8.0).parts) >= 1
    except TaaError as error:
        assert "convex parts" in str(error)
    assert time.monotonic() - begin < 60
    box = trimesh.creation.box()
    ((vertices, _),) = bounded_solid(np.asarray(box.vertices), np.asarray(box.faces)).parts
    assert len(vertices) == 8


@settings(max_examples=40, deadline=None)
@given(st.binary(max_size=200))
def test_a_kept_result_that_is_broken_is_made_again(raw: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "hands.npz"
        save_stage(file, "key", {"a": np.arange(3)})
        whole = file.read_bytes()
        assert load_stage(file, "key")["a"].tolist() == [0, 1, 2] and load_stage(file, "other") is None
        file.write_bytes(raw)
        assert load_stage(file, "key") is None
        file.write_bytes(whole[: max(0, len(whole) - len(raw) - 1)])
        assert load_stage(file, "key") is None

"""Decoding real files: rotation, odd times, corrupt starts, cuts, focal metadata, the temporary store."""

import gc
import subprocess
import tempfile
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np
import pytest

from reconstruct.errors import Refused, TaaError
from reconstruct.video import Video, choose_frames, count_unsettled, load_video

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "videos"


def scene(seed: int, h: int = 180, w: int = 320) -> np.ndarray:
    """A textured picture: rectangles of random colours."""
    rng = np.random.default_rng(seed)
    image = np.full((h, w, 3), rng.integers(60, 190, 3), np.uint8)
    for _ in range(60):
        x, y = rng.integers(0, w), rng.integers(0, h)
        colour = tuple(int(c) for c in rng.integers(0, 255, 3))
        cv2.rectangle(image, (int(x), int(y)), (int(x + rng.integers(8, 60)), int(y + rng.integers(8, 40))), colour, -1)
    return image


def with_disc(image: np.ndarray, i: int) -> np.ndarray:
    out = image.copy()
    cv2.circle(out, (30 + 5 * i, 90), 25, (40, 200, 240), -1)
    return out


def ffmpeg(*args: str) -> None:
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", *args], check=True)


def write(path: Path, frames: list[np.ndarray], *args: str, fps: float = 30) -> Path:
    """Encode frames (H.264, nearly lossless) with further ffmpeg output options."""
    h, w = frames[0].shape[:2]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", "-f", "rawvideo", "-pix_fmt", "bgr24",
               "-s", f"{w}x{h}", "-r", str(fps), "-i", "-", "-c:v", "libx264", "-crf", "12", "-pix_fmt", "yuv420p",
               *args, str(path)]  # fmt: skip
    subprocess.run(command, input=b"".join(f.tobytes() for f in frames), check=True)
    return path


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Path:
    frames = [with_disc(scene(0), i) for i in range(24)]
    return write(tmp_path_factory.mktemp("video") / "plain.mp4", frames)


def test_every_frame_at_its_time(plain):
    video = load_video(plain)
    assert video.size == (320, 180) and video.scale == 1.0 and len(video) == video.decoded == 24
    np.testing.assert_allclose(video.time, np.arange(24) / 30, atol=1e-3)
    assert np.abs(video.frames[10].astype(int) - with_disc(scene(0), 10)).mean() < 6
    assert video.notes == () and video.focal_px is None


def test_working_frames_are_shrunk_and_pixels_convert_both_ways(plain):
    video = load_video(plain, long_side=160)
    assert video.frames.shape == (24, 90, 160, 3) and video.size == (320, 180)
    uv = np.array([[0.0, 0.0], [319.0, 179.0], [10.5, 3.25]])
    np.testing.assert_allclose(video.to_full(video.to_work(uv)), uv)
    np.testing.assert_allclose(video.to_work(np.array([-0.5, -0.5])), [-0.5, -0.5])


def test_rotation_metadata_turns_the_frames_upright(plain, tmp_path):
    turned = tmp_path / "turned.mp4"
    ffmpeg("-display_rotation", "90", "-i", str(plain), "-c", "copy", str(turned))
    video = load_video(turned)
    assert video.size == (180, 320)
    upright = np.rot90(load_video(plain).frames[5])
    assert np.abs(video.frames[5].astype(int) - upright).mean() < 3


def test_variable_frame_rate_keeps_container_times(plain, tmp_path):
    uneven = tmp_path / "uneven.mp4"
    ffmpeg("-i", str(plain), "-vf", "select=not(eq(n\\,7)+eq(n\\,8)+eq(n\\,15))", "-fps_mode", "vfr", str(uneven))
    video = load_video(uneven)
    kept = [i for i in range(24) if i not in (7, 8, 15)]
    np.testing.assert_allclose(video.time, np.array(kept) / 30, atol=2e-3)


def test_fast_clips_are_thinned_evenly_in_time():
    time = np.arange(240) / 240.0
    chosen = choose_frames(time)
    assert set(np.diff(chosen)) == {8}
    uneven = np.sort(np.random.default_rng(0).uniform(0, 100, 9000))
    chosen = choose_frames(uneven)
    assert len(chosen) <= 900 and chosen[0] == 0 and np.diff(uneven[chosen]).min() >= 1 / 31


def test_unsettled_start_is_dropped(tmp_path):
    frames = [with_disc(scene(0), i) for i in range(30)]
    for i, gain in enumerate((0.2, 0.2, 2.0, 2.0)):
        frames[i] = np.clip(frames[i] * gain, 0, 255).astype(np.uint8)
    video = load_video(write(tmp_path / "hunting.mp4", frames))
    assert video.index[0] == 4 and "4 leading frames" in video.notes[0]
    assert video.time[0] == pytest.approx(4 / 30, abs=1e-3)


@pytest.mark.parametrize("gain, dropped", [(0.97, 20), (1.03, 20), (0.99, 0), (1.0, 0)])
def test_an_exposure_that_settles_over_many_frames_is_dropped(gain, dropped):
    """Twenty frames of 3 % are more than half a stop; of 1 % not, and a disc that moves meanwhile is no gain."""
    frames = [with_disc(scene(0, 72, 128) * 0.5, i).astype(float) for i in range(60)]
    frames = [frame * gain ** max(20 - i, 0) for i, frame in enumerate(frames)]
    assert count_unsettled(np.asarray(frames).round().astype(np.uint8), np.arange(60) / 30) == dropped


def test_a_picture_that_brightens_for_long_is_kept():
    thumbs = np.asarray([scene(0, 18, 32) * 0.5 * 1.012**i for i in range(80)]).clip(0, 255).astype(np.uint8)
    assert count_unsettled(thumbs, np.arange(80) / 30) == 0


def test_a_late_light_switch_is_kept():
    thumbs = np.repeat(scene(0, 18, 32)[None], 60, 0)
    thumbs[40:] //= 2
    assert count_unsettled(thumbs, np.arange(60) / 30) == 0


def test_grey_filler_before_the_first_key_frame_is_dropped(tmp_path):
    frames = [np.full((180, 320, 3), 128, np.uint8)] * 3 + [with_disc(scene(0), i) for i in range(20)]
    video = load_video(write(tmp_path / "filler.mp4", frames))
    assert video.index[0] == 3


def test_camera_cut_is_one_clear_line(tmp_path):
    frames = [with_disc(scene(0), i) for i in range(20)] + [with_disc(scene(9), i) for i in range(20)]
    with pytest.raises(Refused, match=r"cuts at 0\.67 s; give one unbroken shot"):
        load_video(write(tmp_path / "cut.mp4", frames))


def test_what_follows_a_cut_at_the_very_end_is_dropped(tmp_path):
    frames = [with_disc(scene(0), i) for i in range(40)] + [with_disc(scene(9), i) for i in range(3)]
    video = load_video(write(tmp_path / "tail.mp4", frames))
    assert video.index[-1] == 39 and len(video) == len(video.frames) == 40
    assert "3 frames after a cut at the very end dropped" in video.notes


@pytest.mark.parametrize("what", ["flash", "pan", "passing hand"])
def test_what_is_not_a_cut(tmp_path, what):
    wide = scene(0, 180, 1400)
    frames = [with_disc(wide[:, :320], 0) for _ in range(30)]
    if what == "flash":
        frames[20] = np.clip(frames[20] * 2.5 + 40, 0, 255).astype(np.uint8)
    elif what == "pan":
        frames = [np.ascontiguousarray(wide[:, 35 * i : 35 * i + 320]) for i in range(30)]
    else:
        for i in range(30):
            cv2.ellipse(frames[i], (-150 + 22 * i, 90), (110, 100), 0, 0, 360, (120, 150, 200), -1)
    assert len(load_video(write(tmp_path / "uncut.mp4", frames))) == 30


def test_focal_length_from_metadata(plain, tmp_path):
    tagged = tmp_path / "tagged.mov"
    ffmpeg("-i", str(plain), "-c", "copy", "-movflags", "use_metadata_tags",
           "-metadata", "com.apple.quicktime.camera.focal_length.35mm_equivalent=26", str(tagged))  # fmt: skip
    video = load_video(tagged)
    assert video.focal_px == pytest.approx(26 / 43.27 * np.hypot(320, 180), rel=1e-3)
    assert "26 mm" in video.notes[-1]


def test_users_errors(tmp_path):
    with pytest.raises(TaaError, match="no such file"):
        load_video(tmp_path / "nothing.mp4")
    (tmp_path / "text.mp4").write_text("not a video")
    with pytest.raises(TaaError, match="not a video"):
        load_video(tmp_path / "text.mp4")
    cv2.imwrite(str(tmp_path / "picture.png"), scene(0))
    with pytest.raises(TaaError, match="picture"):
        load_video(tmp_path / "picture.png")


def test_the_temporary_store_goes_with_the_video(plain, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    video = load_video(plain)
    assert len(list(tmp_path.glob("taa-*"))) == 1
    tail: Video = video.with_frames(video.frames[5:])
    del video
    gc.collect()
    assert tail.frames[0].any() and len(list(tmp_path.glob("taa-*"))) == 1
    del tail
    gc.collect()
    assert not list(tmp_path.glob("taa-*"))


def test_full_disk_is_an_error_and_leaves_nothing(plain, tmp_path, monkeypatch):
    def no_space(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr("os.posix_fallocate", no_space)
    with pytest.raises(OSError, match="No space left"):
        load_video(plain)
    assert not list(tmp_path.glob("taa-*"))


@pytest.mark.parametrize(("name", "count"), [("microwave01.avi", 229), ("kitchen_pot.mp4", 33)])
def test_shared_clips(name, count):
    """microwave01 begins torn, its exposure hunts and settles; kitchen_pot claims more frames than decode."""
    if not (SHARED / name).is_file():
        pytest.skip(f"{name} is not there")
    video = load_video(SHARED / name)
    assert len(video) == count and len(video.notes) == 1

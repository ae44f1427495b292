"""Camera compensation on warped textures."""

import cv2
import numpy as np
import pytest

from reconstruct.errors import TaaError
from reconstruct.motion import _without_jumps, estimate_camera_motion, stabilise
from tests.reconstruct.joint_scenes import make_video


def texture(seed=0, size=(360, 480)):
    rng = np.random.default_rng(seed)
    image = cv2.resize(rng.integers(0, 255, (45, 60, 3), dtype=np.uint8), size[::-1], interpolation=cv2.INTER_CUBIC)
    return cv2.GaussianBlur(image, (0, 0), 1.5)


def as_video(frames, folder):
    store = np.lib.format.open_memmap(folder / "frames_work.npy", mode="w+", dtype=np.uint8, shape=frames.shape)
    store[:] = frames
    video = make_video(len(frames))
    return video.with_frames(store)


def test_static_camera_is_left_alone(tmp_path):
    rng = np.random.default_rng(0)
    base = texture()
    frames = np.stack(
        [np.clip(base + rng.normal(scale=2, size=base.shape), 0, 255).astype(np.uint8) for _ in range(12)]
    )
    frames[6:, 100:200, 150:300] = 90  # something large moves in front
    video = as_video(frames, tmp_path)
    same, motion = stabilise(video)
    assert motion.static
    assert same is video


def test_drift_is_removed(tmp_path):
    base = texture(1)
    frames, truth = [], []
    for t in range(16):
        angle, dx, dy = 0.002 * t, 1.5 * t, -0.8 * t
        M = np.array([[np.cos(angle), -np.sin(angle), dx], [np.sin(angle), np.cos(angle), dy]])
        frames.append(cv2.warpAffine(base, M, (480, 360), borderMode=cv2.BORDER_REFLECT))
        truth.append(M)
    video = as_video(np.stack(frames), tmp_path)
    stable, motion = stabilise(video)
    assert not motion.static
    inner = np.s_[60:300, 80:400]
    before = np.abs(frames[-1][inner].astype(int) - frames[0][inner]).mean()
    after = np.abs(stable.frames[-1][inner].astype(int) - frames[0][inner]).mean()
    assert after < 0.2 * before
    p = np.array([[[240.0, 180.0]]])
    moved = cv2.perspectiveTransform(p, np.vstack([truth[-1], [0, 0, 1]]))
    back = cv2.perspectiveTransform(moved, motion.H[-1])
    assert np.linalg.norm(back - p) < 0.5
    assert any("drifts" in n for n in stable.notes)


def test_what_the_object_stands_on_rests_though_the_wall_behind_dominates(tmp_path):
    """A travelling camera moves a desk against the wall; something swings up before the wall."""
    w, h, foot, T = 720, 540, 450, 24
    wall, desk = (cv2.resize(texture(seed), (960, 720)) for seed in (2, 3))
    desk[:, :260], desk[:, 560:] = 128, 128  # plain but for the object's own place
    frames, passed = [], 0.35 * np.arange(T)  # px by which the desk passes the wall
    for t in range(T):
        view = np.array([[1, 0, -0.5 * t], [0, 1, 0]])
        frame = cv2.warpAffine(wall, view, (w, h))
        view[0, 2] -= passed[t]
        frame[foot:] = cv2.warpAffine(desk, view, (w, h))[foot:]
        hinge = np.array([400 + view[0, 2], foot])
        tip = hinge + 340 * np.array([np.cos(0.3 + 0.05 * t), -np.sin(0.3 + 0.05 * t)])
        cv2.line(frame, tuple(hinge.astype(int)), tuple(tip.astype(int)), (20, 20, 20), 24)
        frames.append(frame)
    _, motion = stabilise(as_video(np.stack(frames), tmp_path))
    assert not motion.static
    here = np.array([400.0, 490.0])
    off = [
        np.linalg.norm(cv2.perspectiveTransform((here - [0.5 * t + passed[t], 0])[None, None], motion.H[t]) - here)
        for t in range(T)
    ]
    assert np.quantile(off, 0.9) < 1.0


def test_a_jump_is_mended_and_a_steady_pan_is_none():
    """A hand that starts to turn at once moves the picture by a few px a frame from the first on."""
    T = 30
    pan = np.tile(np.eye(3), (T, 1, 1))
    pan[:, 0, 2], pan[:, 1, 2] = 2.0 * np.arange(T), -1.5 * np.arange(T) + 12 * np.sin(0.4 * np.arange(T))
    every = np.ones(T, bool)
    assert np.array_equal(_without_jumps(pan, every, (360, 480)), pan)
    jumped = pan.copy()
    jumped[11, 0, 2] += 15
    mended = _without_jumps(jumped, every, (360, 480))
    assert np.abs(mended - pan)[:, :2, 2].max() < 2.0


def test_cut_is_one_clear_line(tmp_path):
    frames = np.stack([texture(0)] * 4 + [texture(5)] * 4)
    with pytest.raises(TaaError, match="camera cut"):
        estimate_camera_motion(as_video(frames, tmp_path))


def test_textureless_picture_is_taken_as_static(tmp_path):
    motion = estimate_camera_motion(as_video(np.full((5, 360, 480, 3), 120, np.uint8), tmp_path))
    assert motion.static
    assert not motion.support.any()

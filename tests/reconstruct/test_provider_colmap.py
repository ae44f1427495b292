"""COLMAP: its own model format read back as cameras, and the real thing on a rendered walk past textured boards."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from reconstruct.errors import TaaError
from reconstruct.providers.colmap import read_model
from reconstruct.providers.make import provide
from reconstruct.video import Video
from tests.reconstruct.provider_scenes import small_request

W, H, FRAMES = 360, 240, 10
K = np.array([[320.0, 0, (W - 1) / 2], [0, 320.0, (H - 1) / 2], [0, 0, 1]])


def walk(still: bool = False) -> np.ndarray:
    """(T, 4, 4) camera to world: a metre to the left, turning by 20 degrees."""
    out = np.tile(np.eye(4), (FRAMES, 1, 1))
    for t, a in enumerate(np.linspace(0, 1, FRAMES)):
        out[t, :3, :3] = Rotation.from_euler("y", -10 + 20 * a, degrees=True).as_matrix()
        out[t, :3, 3] = (0, 0, 0) if still else (0.5 - a, 0.1 * np.sin(3 * a), 0.1 * a)
    return out


def texture(side: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    out = sum(cv2.resize(rng.uniform(0, 255, (k, k, 3)).astype(np.float32), (side, side), interpolation=cv2.INTER_CUBIC)
              for k in (4, 8, 16, 32, 64, 128))  # fmt: skip
    return cv2.normalize(out, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def picture(pose: np.ndarray) -> np.ndarray:
    """Boards at several depths, the far ones first."""
    rng = np.random.default_rng(0)
    boards = [((-3.0, -2.5, 4.0), 6.0, texture(512, 1))]
    boards += [((rng.uniform(-1.6, 1.2), rng.uniform(-1.1, 0.6), z), rng.uniform(0.5, 0.9), texture(256, n + 2))
               for n, z in enumerate(np.linspace(3.5, 2.0, 9))]  # fmt: skip
    world, out = np.linalg.inv(pose), np.zeros((H, W, 3), np.uint8)
    for (x, y, z), size, image in boards:
        s = size / image.shape[0]
        A = np.array([[s, 0, x], [0, s, y], [0, 0, z]])
        M = K @ (world[:3, :3] @ A + np.outer(world[:3, 3], [0, 0, 1]))
        covered = cv2.warpPerspective(np.full(image.shape[:2], 255, np.uint8), M, (W, H)) > 127
        out[covered] = cv2.warpPerspective(image, M, (W, H))[covered]
    return out


def video(frames: np.ndarray | None = None) -> Video:
    frames = np.zeros((FRAMES, H, W, 3), np.uint8) if frames is None else frames
    order = np.arange(FRAMES)
    return Video(Path("x.mp4"), "0" * 64, (2 * W, 2 * H), order / 10, order, FRAMES, frames, 0.5)


def relative_error(got: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Largest turn in degrees and shift in m between two ways, relative to the first pose, scale taken out."""
    a, b = np.linalg.inv(got[0]) @ got, np.linalg.inv(true[0]) @ true
    turn = Rotation.from_matrix(np.swapaxes(a[:, :3, :3], 1, 2) @ b[:, :3, :3]).magnitude().max()
    s = np.linalg.norm(b[-1, :3, 3]) / np.linalg.norm(a[-1, :3, 3])
    return float(np.degrees(turn)), float(np.abs(s * a[:, :3, 3] - b[:, :3, 3]).max())


def model(poses: np.ndarray, frames: list[int]) -> pycolmap.Reconstruction:
    """A reconstruction of working frames, as COLMAP keeps it: pixels from the corner, world to camera."""
    out = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=W, height=H, params=[320.0, W / 2, H / 2], camera_id=1)
    out.add_camera_with_trivial_rig(camera)
    for n, t in enumerate(frames):
        image = pycolmap.Image(name=f"{t:06d}.png", camera_id=1, image_id=n + 1)
        out.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.linalg.inv(poses[t])[:3]))
    for xyz in np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (50, 3)):
        out.add_point3D(xyz, pycolmap.Track(), np.zeros(3, np.uint8))
    return out


def test_a_model_is_read_as_cameras_of_all_frames():
    poses = walk()
    some = [0, 2, 3, 5, 7, 9]
    got_K, got, note = read_model(model(poses, some), video(), np.array(some))
    assert np.allclose(got_K, [[640, 0, W - 0.5], [0, 640, H - 0.5], [0, 0, 1]]), "full px, from a pixel's centre"
    assert np.allclose(got[some], poses[some], atol=1e-6) and note == ()
    turn, away = relative_error(got, poses)
    assert turn < 0.1 and away < 0.01, "what is between is interpolated"
    _, _, note = read_model(model(poses, some), video(), np.arange(8))
    assert "lacks 2 of 8" in note[0]


def test_what_cannot_be_told_is_refused():
    with pytest.raises(TaaError, match="placed only 3 of 10 frames"):
        read_model(model(walk(), [0, 1, 2]), video(), np.arange(FRAMES))
    with pytest.raises(TaaError, match="does not change its place"):
        read_model(model(walk(still=True), list(range(FRAMES))), video(), np.arange(FRAMES))


@pytest.mark.slow
def test_structure_from_motion_finds_the_way(tmp_path):
    poses = walk()
    request = small_request(tmp_path, {}, {"camera": "colmap"}, video(np.stack([picture(p) for p in poses])))
    provide("camera", "camera", request)
    cue = request.folder.read("camera", "K", "T_world_camera")
    turn, away = relative_error(cue["T_world_camera"], poses)
    assert turn < 0.5 and away < 0.01 and cue["K"][0, 0] == pytest.approx(640, rel=0.05)
    assert not bool(cue["metric"]) and request.folder.maker("camera").version.startswith("pycolmap")

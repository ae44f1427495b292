"""Synthetic clips without pixels: a true hand on a true link, and what a monocular hand network would say of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from reconstruct.cues import Hands, HandTrack, ProviderInfo
from reconstruct.geometry import Geometry, LinkMesh
from reconstruct.joint.models import JointFit
from reconstruct.synth.clips import Clip, build_clip
from reconstruct.synth.hand_model import landmarks
from reconstruct.video import Video

SIZE = (1280, 720)
FACES = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6],
                  [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip


@dataclass(frozen=True)
class Scene:
    """One clip: what is true, and what is seen; contact (T,) bool and joints (T, 21, 3) m are true."""

    clip: Clip
    contact: np.ndarray
    joints: np.ndarray
    fit: JointFit
    geometry: Geometry
    hands: Hands
    video: Video


def _link(clip: Clip, name: str) -> LinkMesh:
    boxes = [b for b in clip.model.boxes if b.link == name]
    parts = [(b.corners(), FACES) for b in boxes]
    vertices = np.concatenate([p[0] for p in parts])
    faces = np.concatenate([FACES + 8 * i for i in range(len(parts))])
    colors = np.full((len(vertices), 4), 200, np.uint8)
    return LinkMesh(vertices, faces, colors, np.zeros(len(faces), bool), tuple(parts))


def _ease(s: np.ndarray) -> np.ndarray:
    s = np.clip(s, 0, 1)
    return s**3 * (10 - 15 * s + 6 * s * s)


def _look_at(camera: np.ndarray, target: np.ndarray) -> np.ndarray:
    forward = (target - camera) / np.linalg.norm(target - camera)
    right = np.cross(forward, [0.0, 0, 1])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    T[:3, 3] = -T[:3, :3] @ camera
    return T


def make_scene(name: str, seed: int = 0, frames: int = 90, hand_size: float = 1.1, pixel_noise: float = 2.0,
               drift: float = 0.1, gap: tuple[int, int] | None = (40, 48)) -> Scene:
    """A clip whose hand is ``hand_size`` times what the network believes, with landmark noise and a gap.

    The hand arrives in a fifth of the time, drives the link, and leaves in the last fifth.
    """
    clip = build_clip(name, seed)
    rng = np.random.default_rng(seed)
    s = np.arange(frames) / (frames - 1)
    q = _ease((s - 0.24) / 0.54) * clip.model.q_end
    contact = (s >= 0.2) & (s <= 0.81)
    away = 1 - _ease(s / 0.2) + _ease((s - 0.81) / 0.19)
    offset = (away**2)[:, None] * clip.far + (2 * away * (1 - away))[:, None] * clip.near
    T = clip.T_world_hand
    local = landmarks(clip.pose, clip.side) @ T[:3, :3].T + T[:3, 3]
    pose = clip.model.link_pose(q)
    joints = np.einsum("tij,tnj->tni", pose[:, :3, :3], local + offset[:, None]) + pose[:, None, :3, 3]
    focal = clip.focal * SIZE[0]
    K = np.array([[focal, 0, SIZE[0] / 2 - 0.5], [0, focal, SIZE[1] / 2 - 0.5], [0, 0, 1]])
    camera_world = _look_at(clip.camera, clip.target)
    camera = joints @ camera_world[:3, :3].T + camera_world[:3, 3]
    uv = camera @ K.T
    uv = uv[..., :2] / uv[..., 2:] + gaussian_filter1d(rng.normal(0, pixel_noise * 1.5, uv[..., :2].shape), 1.0, axis=0)
    slow = gaussian_filter1d(rng.normal(0, 1, frames), 12.0, mode="nearest")
    wander = 1.0 + drift * slow / max(slow.std(), 1e-9)
    metric = camera - camera.mean(1, keepdims=True) + gaussian_filter1d(rng.normal(0, 0.008, camera.shape), 2.0, axis=0)
    metric = metric / hand_size * wander[:, None, None]
    inside = ((uv > 0) & (uv < SIZE)).all(-1).mean(1) > 0.7
    valid = inside.copy()
    if gap is not None:
        valid[gap[0] : gap[1]] = False
    uv[~valid], metric[~valid] = np.nan, np.nan
    track = HandTrack(clip.side, uv, metric, np.where(valid, 0.95, 0.0), valid)
    hands = Hands((track,), np.zeros((frames, 1, 1), bool), ProviderInfo("truth", "0", "none"))
    moving, static = _link(clip, "moving"), _link(clip, "static")
    points = moving.vertices[rng.integers(0, len(moving.vertices), 60)]
    points = points + 0.2 * (moving.vertices.mean(0) - points) * rng.random((60, 1))
    fit = JointFit("ok", "", clip.model.kind, {clip.model.kind: 1.0}, clip.model.axis, clip.model.point, None, q,
                   np.arange(frames), K, camera_world, points, np.arange(60), True, "given",
                   {"axis_deg": 0.0, "point_m": 0.0, "q": np.zeros(frames)}, None, 0.5, 60, 60, None)  # fmt: skip
    video = Video(Path(f"{name}.mp4"), "0" * 64, SIZE, np.arange(frames) / 30.0, np.arange(frames), frames,
                  np.zeros((frames, 1, 1, 3), np.uint8), 1.0)  # fmt: skip
    return Scene(clip, contact, joints, fit, Geometry(static, moving), hands, video)

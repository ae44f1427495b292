"""Point tracks of a simulated joint seen by a pinhole camera: exact, noisy, or with impostors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reconstruct.cues import ProviderInfo, Tracks
from reconstruct.joint.models import JointFit, joint_transform
from reconstruct.video import Video

W, H, FOCAL = 960, 540, 768.0


@dataclass(frozen=True)
class Scene:
    """A joint in the camera frame (right, down, forward; metres), its states and the tracks of its points."""

    kind: str
    axis: np.ndarray
    point: np.ndarray
    q: np.ndarray
    tracks: Tracks
    video: Video


def make_video(frames: int) -> Video:
    """A video without pixels: the joint fit reads sizes and times only."""
    blank = np.broadcast_to(np.zeros((1, 1, 1, 3), np.uint8), (frames, H, W, 3))
    return Video(Path("none.mp4"), "0" * 64, (W, H), np.arange(frames) / 30, np.arange(frames), frames, blank, 1.0)


def project(xyz: np.ndarray) -> np.ndarray:
    return xyz[..., :2] / xyz[..., 2:] * FOCAL + [(W - 1) / 2, (H - 1) / 2]


def made(verdict: str, degrees: float, residual_px: float, ids, std: float = 2.0, count: int | None = None,
         kind: str = "revolute") -> JointFit:  # fmt: skip
    """A joint of some tracks whose axis is so far off x, stated to `std` deg; `count` of them agree, all when None."""
    axis = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0.0])
    return JointFit(verdict, "made", kind, axis=axis, T_camera_world=np.eye(4), std={"axis_deg": std}, point_track=ids,
                    residual_px=residual_px, inliers=len(ids) if count is None else count)  # fmt: skip


def make_scene(kind: str, axis, point, size, q_end: float, frames: int = 60, points: int = 90, impostors: int = 60,
               noise: float = 0.5, back: bool = False, seed: int = 0) -> Scene:  # fmt: skip
    """Points of a link that turns about (or slides along) an axis, static points, and impostors.

    Args:
        size: (3, 2) ranges of the link's points about `point`, m.
        q_end: state at the end of the stroke; with `back` the link returns.
        impostors: points that move otherwise (a hand, shadows, edge points that slide).
    """
    rng = np.random.default_rng(seed)
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    point = np.asarray(point, float)
    s = np.clip((np.arange(frames) - 8) / (frames - 16), 0, 1)
    s = 3 * s**2 - 2 * s**3
    q = q_end * (np.sin(np.pi * s) if back else s)
    size = np.asarray(size, float)
    X = point + rng.uniform(size[:, 0], size[:, 1], (points, 3))
    T = joint_transform(kind, axis, point, q)
    moving = project(np.einsum("tij,nj->nti", T[:, :3, :3], X) + T[:, :3, 3])
    static = np.repeat(rng.uniform([20, 20], [W - 20, H - 20], (60, 2))[:, None], frames, axis=1)
    start = rng.uniform([100, 100], [W - 100, H - 100], (impostors, 1, 2))
    direction = rng.normal(size=(impostors, 1, 2)) * 90
    wave = rng.normal(size=(impostors, 1, 2)) * 40
    u = s[None, :, None]
    other = start + direction * u + wave * np.sin(2 * np.pi * u * rng.uniform(0.5, 1.5, (impostors, 1, 1)))
    uv = np.concatenate([moving, static, other]) + rng.normal(scale=noise, size=(points + 60 + impostors, frames, 2))
    visible = ((uv > 0) & (uv < [W, H])).all(-1)
    # Every track lives for a part of the video only.
    first = rng.integers(0, frames // 3, len(uv))
    last = rng.integers(2 * frames // 3, frames, len(uv))
    t = np.arange(frames)
    visible &= (t >= first[:, None]) & (t <= last[:, None])
    uv = np.where(visible[..., None], uv, np.nan).astype(np.float32)
    tracks = Tracks(uv, visible, first, ProviderInfo("made", "0", "Apache-2.0"))
    return Scene(kind, axis, point, q, tracks, make_video(frames))

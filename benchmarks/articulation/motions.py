"""What the joint does and where the camera is: seven motions, a static and an orbiting camera, and one in a hand."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.articulation.objects import Model

SIZE = (640, 480)
FOCAL = 600.0
SMALL_ANGLE, SMALL_SHIFT = np.radians(10.0), 0.03
ORBIT = np.radians(50.0)
RATE = 24
"""Frames a second."""
HELD_M, HELD_DEG, SWAYS_HZ = 0.02, 1.5, (0.4, 1.0, 3.0)
"""By which a camera in a hand leaves its first place and direction at most, and how quickly it sways."""
MOTIONS = ("open", "half", "close", "return", "pause", "hurry", "twice")
"""The seven motions; each of their key states below is (time, state) in shares of the video and of the joint's range,
and is jittered."""
_KEYS = {
    "open": ((0.08, 0.0), (0.92, 1.0)),
    "half": ((0.10, 0.0), (0.90, 0.5)),
    "close": ((0.06, 0.95), (0.85, 0.05)),
    "return": ((0.05, 0.05), (0.45, 0.85), (0.60, 0.85), (0.95, 0.10)),
    "pause": ((0.05, 0.35), (0.40, 0.65), (0.60, 0.65), (0.95, 1.0)),
    "hurry": ((0.30, 0.15), (0.62, 0.85)),
    "twice": ((0.02, 0.2), (0.25, 0.8), (0.50, 0.3), (0.75, 0.9), (0.98, 0.4)),
}


@dataclass(frozen=True)
class Shot:
    """A motion seen by a camera.

    Attributes:
        q: (T,) true state.  K: (3, 3) px.  T_world_camera: (T, 4, 4).
    """

    q: np.ndarray
    K: np.ndarray
    T_world_camera: np.ndarray


def states(motion: str, limits: tuple[float, float], kind: str, small: bool, frames: int,
           rng: np.random.Generator) -> np.ndarray:  # fmt: skip
    """(T,) states of one motion.

    Args:
        small: the same motion shrunk to 10 deg or 3 cm (or the whole range where that is less), anywhere in the range.
    """
    low, high = limits
    keys = np.array(_KEYS[motion])
    time = np.clip(keys[:, 0] + rng.uniform(-0.03, 0.03, len(keys)), 0, 1)
    level = np.clip(keys[:, 1] + rng.uniform(-0.06, 0.06, len(keys)), 0, 1)
    if rng.random() < 0.5 and abs(low) > abs(high):
        level = 1 - level  # ranges that end in 0 are closed there; either end may come first
    span = high - low
    if small:
        extent = min(SMALL_ANGLE if kind == "revolute" else SMALL_SHIFT, span)
        shape = (level - level.min()) / np.ptp(level)
        start = rng.uniform(low, high - extent)
        keyed = start + extent * shape
    else:
        keyed = low + span * level
    t = np.linspace(0, 1, frames)
    out = np.full(frames, keyed[0])
    for k in range(len(keyed) - 1):
        s = np.clip((t - time[k]) / max(time[k + 1] - time[k], 1e-3), 0, 1)
        out += (keyed[k + 1] - keyed[k]) * s * s * (3 - 2 * s)
    return out


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(4, 4) T_world_camera (right, down, forward) of a camera held upright."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = eye
    return T


def pixel_rays(uv: np.ndarray, K: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
    """(..., 3) unit directions in the world of pixels (..., 2)."""
    d = np.concatenate([(uv - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones((*uv.shape[:-1], 1))], axis=-1)
    d = d @ T_world_camera[:3, :3].T
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def intrinsics() -> np.ndarray:
    return np.array([[FOCAL, 0, (SIZE[0] - 1) / 2], [0, FOCAL, (SIZE[1] - 1) / 2], [0, 0, 1.0]])


def shoot(model: Model, motion: str, orbit: bool, small: bool, frames: int, rng: np.random.Generator) -> Shot:
    """The motion, filmed so that the moving link fills a good part of the picture and is seen throughout.

    The camera's direction is drawn from the best third of 40 around the object by how many pixels of the moving link
    are seen at three states: a person films the side on which something happens.
    """
    q = states(motion, model.limits, model.kind, small, frames, rng)
    K = intrinsics()
    ends = np.array([q.min(), (q.min() + q.max()) / 2, q.max()])
    swept = np.concatenate([model.corners(s, moving=True) for s in ends])
    centre = (swept.min(0) + swept.max(0)) / 2
    radius = np.linalg.norm(swept - centre, axis=1).max()
    distance = rng.uniform(1.15, 1.5) * radius / np.sin(np.arctan(SIZE[1] / 2 / FOCAL))
    grid = np.stack(np.meshgrid(np.arange(8, SIZE[0], 16.0), np.arange(8, SIZE[1], 16.0)), axis=-1).reshape(-1, 2)
    azimuths, elevations = rng.uniform(0, 2 * np.pi, 40), np.radians(rng.uniform(8, 48, 40))
    seen = np.zeros(40)
    for k in range(40):
        T = look_at(_eye(centre, distance, azimuths[k], elevations[k]), centre)
        rays = pixel_rays(grid, K, T)
        shares = []
        for s in ends:
            _, geom = model.cast(s, T[:3, 3], rays)
            shares.append(np.count_nonzero((geom >= 0) & model.moving_geoms[geom]))
        seen[k] = min(shares) + 0.2 * np.mean(shares)
    k = rng.choice(np.argsort(-seen)[:13])
    sweep = np.zeros(frames)
    if orbit:
        sweep = ORBIT * np.linspace(-0.5, 0.5, frames) * rng.choice([-1, 1])
    lift = np.radians(4.0) * np.sin(2 * sweep + rng.uniform(0, 6)) * orbit
    eyes = [_eye(centre, distance, azimuths[k] + a, elevations[k] + e) for a, e in zip(sweep, lift, strict=True)]
    return Shot(q, K, np.stack([look_at(eye, centre) for eye in eyes]))


def in_a_hand(shot: Shot, unit: float, rng: np.random.Generator) -> Shot:
    """The motion before a camera that a hand holds: from its first pose on it goes to and fro, slowly and quickly.

    Args:
        shot: before a camera at rest.  unit: of its lengths, in m.  rng: of the sway.

    Returns:
        The same states, with T_world_camera (T, 4, 4) that starts from the first one's.
    """
    t = np.arange(len(shot.q)) / RATE

    def sway() -> np.ndarray:
        x = sum(rng.normal(size=3) * np.sin(2 * np.pi * f * t[:, None] + rng.uniform(0, 6, 3)) / f for f in SWAYS_HZ)
        x = x - x[0]
        return x / np.linalg.norm(x, axis=1).max()

    T = shot.T_world_camera.copy()
    T[:, :3, 3] += np.einsum("tij,tj->ti", T[:, :3, :3], HELD_M / unit * sway())
    T[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(np.radians(HELD_DEG) * sway()).as_matrix()
    return replace(shot, T_world_camera=T)


def _eye(centre: np.ndarray, distance: float, azimuth: float, elevation: float) -> np.ndarray:
    c = np.cos(elevation)
    return centre + distance * np.array([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)])

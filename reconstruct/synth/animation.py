"""How a clip moves: the hand arrives, drives the part and leaves; the camera stands or wavers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruct.synth.staging import Clip, pose_matrix

FRAME_RATE = 30.0


@dataclass(frozen=True)
class Motion:
    """Every frame's state.

    Attributes:
        time (T,) s; q (T,) rad or m (NaN without a joint); contact (T,) bool.
        T_world_moving (T, 4, 4): the moving link relative to its place at frame 0.
        T_world_hand (T, 4, 4); T_camera_world (T, 4, 4).
    """

    time: np.ndarray
    q: np.ndarray
    contact: np.ndarray
    T_world_moving: np.ndarray
    T_world_hand: np.ndarray
    T_camera_world: np.ndarray


def _wander(n: int, amount: float, seconds: float, rng: np.random.Generator, rate: float) -> np.ndarray:
    """(n, 3) smooth random motion that starts at 0."""
    from scipy.interpolate import CubicSpline

    knots = max(4, int(np.ceil(n / rate / seconds)) + 3)
    x = CubicSpline(np.linspace(0, 1, knots), rng.normal(0, amount, (knots, 3)))(np.linspace(0, 1, n))
    return x - x[0]


def _ease(s: np.ndarray) -> np.ndarray:
    """Minimum-jerk blend from 0 to 1."""
    s = np.clip(s, 0, 1)
    return s**3 * (10 - 15 * s + 6 * s * s)


def look_at(camera: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(4, 4) T_camera_world of a level camera (right, down, forward)."""
    f = (target - camera) / np.linalg.norm(target - camera)
    r = np.cross(f, [0.0, 0, 1])
    r /= np.linalg.norm(r)
    R = np.stack([r, np.cross(f, r), f])
    return pose_matrix(R, -R @ camera)


def animate(clip: Clip, frames: int, rate: float, seed: int) -> Motion:
    """When everything is where: the hand arrives, rests, drives the part, rests, leaves."""
    rng = np.random.default_rng(seed)
    s = np.arange(frames) / max(frames - 1, 1)
    arrive, start, end, leave = 0.20, 0.24, 0.78, 0.81
    progress = _ease((s - start) / (end - start))
    # A person is not a servo: the speed wavers, yet never turns back.
    waver = 0.03 * np.sin(2 * np.pi * (2 * progress + rng.uniform()))
    progress = np.clip(progress + (waver - waver[0]) * 4 * progress * (1 - progress), 0, 1)
    held_on = clip.free_path is not None  # what is not attached would fall if let go
    contact = (s >= arrive) & ((s <= leave) | held_on) & clip.touches
    if not clip.touches:
        progress = np.zeros(frames)
    if clip.free_path is not None:
        q, T_moving = np.full(frames, np.nan), np.stack([clip.free_path(v) for v in progress])
    else:
        q = progress * clip.model.q_end
        T_moving = clip.model.link_pose(q)
    tremble, turn = _wander(frames, 0.0012, 0.4, rng, rate), _wander(frames, 0.010, 0.5, rng, rate)
    slip = _wander(frames, 0.0004, 0.8, rng, rate)
    away = 1 - _ease(s / arrive)
    if not held_on:
        away += _ease((s - leave) / (1 - leave))
    T_hand = np.empty((frames, 4, 4))
    for t in range(frames):
        a = away[t]
        # A curve from `far` that ends along `near`, so that fingers slip behind a handle rather than through it.
        bend = clip.near + 0.2 * (clip.far - clip.near)
        offset = 3 * a * (1 - a) ** 2 * clip.near + 3 * a * a * (1 - a) * bend + a**3 * clip.far + 2 * a * tremble[t]
        local = pose_matrix(Rotation.from_rotvec(a * a * (turn[t] + [0.15, 0.0, -0.12])).as_matrix(), np.zeros(3))
        held = clip.T_world_hand.copy()
        held[:3, 3] += offset + slip[t] * (1 - a)
        T_hand[t] = T_moving[t] @ held @ local
    if not clip.touches:
        T_hand[:, :3, 3] += (np.sin(np.pi * s) ** 2 * 0.05 * np.sin(2 * np.pi * 2.5 * s))[:, None] * np.array(
            [1.0, 0, 0.3]
        )
    base = look_at(clip.camera, clip.target)
    move, tilt = _wander(frames, clip.drift[0], 0.9, rng, rate), _wander(frames, clip.drift[1], 0.9, rng, rate)
    T_camera = np.stack([pose_matrix(Rotation.from_rotvec(tilt[t]).as_matrix(), move[t]) @ base for t in range(frames)])
    return Motion(np.arange(frames) / rate, q, contact, T_moving, T_hand, T_camera)

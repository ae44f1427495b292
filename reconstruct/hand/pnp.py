"""Where a hand is in the camera's frame: its metric landmarks placed so that they project onto its image landmarks."""

from __future__ import annotations

import numpy as np

from reconstruct.cues import HandTrack
from reconstruct.hand.skeleton import HAND_SIZE_STD, one_anatomy, palm_pixels

TURN_STD = np.deg2rad(12.0)
"""How far the network's idea of the hand's orientation is trusted."""
PIXEL_STD = 0.04
"""Landmark noise in palm sizes."""


def _place(metric: np.ndarray, uv: np.ndarray, K: np.ndarray, pixel_std: float) -> tuple[np.ndarray, float] | None:
    """Camera-frame landmarks (21, 3) and the depth's relative std without the hand-size term; None if implausible."""
    import cv2
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    rays = np.column_stack([uv, np.ones(21)]) @ np.linalg.inv(K).T
    # The network looks along the crop's own ray; turn its axes from there to the camera's.
    ray = rays.mean(0) / np.linalg.norm(rays.mean(0))
    turn = np.cross([0.0, 0.0, 1.0], ray)
    angle = np.arcsin(np.clip(np.linalg.norm(turn), 0, 1))
    prior = Rotation.from_rotvec(turn / max(np.linalg.norm(turn), 1e-12) * angle)
    shape = prior.apply(metric)
    ok, _, start = cv2.solvePnP(shape, uv, K, None, flags=cv2.SOLVEPNP_SQPNP)
    # u (Z + t_z) = f (X + t_x) is linear in the translation: used where the free pose flips behind the camera.
    rows = np.zeros((42, 3))
    rows[0::2, 0], rows[1::2, 1] = 1.0, 1.0
    rows[0::2, 2], rows[1::2, 2] = -rays[:, 0], -rays[:, 1]
    right = np.column_stack([rays[:, 0] * shape[:, 2] - shape[:, 0], rays[:, 1] * shape[:, 2] - shape[:, 1]]).ravel()
    linear = np.linalg.lstsq(rows, right, rcond=None)[0]
    if not np.isfinite(linear).all() or linear[2] <= 0:
        if not ok or start[2, 0] <= 0:
            return None
        linear = start.ravel()

    def residual(x: np.ndarray) -> np.ndarray:
        camera = Rotation.from_rotvec(x[:3]).apply(shape) + x[3:]
        seen = camera @ K.T
        error = (seen[:, :2] / np.maximum(seen[:, 2:], 1e-6) - uv) / pixel_std
        return np.concatenate([error.ravel(), x[:3] / TURN_STD])

    fit = least_squares(residual, np.concatenate([np.zeros(3), linear]), loss="soft_l1", x_scale=[0.1] * 3 + [0.1] * 3,
                        max_nfev=30)  # fmt: skip
    camera = Rotation.from_rotvec(fit.x[:3]).apply(shape) + fit.x[3:]
    if camera[:, 2].min() <= 0.02:
        return None
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac)
    spread = max(1.0, 2.0 * fit.cost / 42)
    return camera, float(np.sqrt(max(covariance[5, 5], 0.0) * spread) / fit.x[5])


def hand_positions(hand: HandTrack, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A hand's landmarks in the camera's frame.

    Args:
        hand: one hand.
        K: (3, 3) or (T, 3, 3) intrinsics, full px.

    Returns:
        (T, 21, 3) m, right-down-forward, NaN where the hand is not valid or no pose is plausible; and the standard
        deviation (T,) of its depth, m, hand-size spread included.
    """
    n = len(hand.valid)
    out, std = np.full((n, 21, 3), np.nan), np.full(n, np.nan)
    metric = one_anatomy(np.where(hand.valid[:, None, None], hand.metric, np.nan))
    for t in np.flatnonzero(hand.valid):
        noise = PIXEL_STD * max(float(palm_pixels(hand.uv[t])), 1.0)
        placed = _place(metric[t], hand.uv[t], K if K.ndim == 2 else K[t], noise)
        if placed is not None:
            out[t] = placed[0]
            depth = placed[0][:, 2].mean()
            std[t] = depth * np.hypot(placed[1], HAND_SIZE_STD)
    # A single frame at another depth is a failed pose, not a jump of the hand.
    depth = out[..., 2].mean(-1)
    seen = np.flatnonzero(np.isfinite(depth))
    for t in seen:
        around = seen[np.abs(seen - t) <= 7]
        if abs(np.log(depth[t] / np.median(depth[around]))) > 0.5:
            out[t], std[t] = np.nan, np.nan
    return out, std

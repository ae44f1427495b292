"""Where a hand is in the camera's frame, from its landmarks in the picture.

The network's landmarks in space have the right pose, more or less, but not the right shape: bones come out longer or
shorter with pose and view, and a hand's depth that rests on them is off by -11 to +17 %. The palm however is rigid. Its
five joints with a mean adult's distances, placed so that they project onto their landmarks, give depth and orientation
(perspective-n-point; the network's orientation is only a weak prior). The fingers then follow joint by joint: each
joint lies on its landmark's ray, one bone from the joint before it, on the nearer or the farther side as the network
says (C. J. Taylor, Reconstruction of articulated objects from point correspondences in a single image, 2000).
"""

from __future__ import annotations

import numpy as np

from reconstruct.cues import HandTrack
from reconstruct.hand.skeleton import ADULT, FINGERS, HAND_SIZE_STD, PALM, PALM_SHAPE, PARENT, palm_pixels

TURN_STD = np.deg2rad(12.0)
"""How far the network's idea of the palm's orientation is trusted."""
PIXEL_STD = 0.04
"""Landmark noise in palm sizes."""


def _palm(metric: np.ndarray, rays: np.ndarray, uv: np.ndarray, K: np.ndarray, side: str, pixel_std: float
          ) -> tuple[np.ndarray, np.ndarray, float] | None:  # fmt: skip
    """Palm joints (5, 3) m in the camera's frame, the turn (3, 3) from the network's axes to the camera's, and the
    depth's relative std without the hand-size term; None if implausible."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    # The network looks along the crop's own ray; turn its axes from there to the camera's.
    ray = rays.mean(0) / np.linalg.norm(rays.mean(0))
    turn = np.cross([0.0, 0.0, 1.0], ray)
    angle = np.arcsin(np.clip(np.linalg.norm(turn), 0, 1))
    prior = Rotation.from_rotvec(turn / max(np.linalg.norm(turn), 1e-12) * angle)
    palm = list(PALM)
    shape = PALM_SHAPE * ([1, 1, 1] if side == "right" else [-1, 1, 1])
    shape = shape - shape.mean(0)
    seen = prior.apply(metric[palm] - metric[palm].mean(0))
    shape = Rotation.align_vectors(seen, shape)[0].apply(shape)
    spread = np.linalg.norm(uv[palm] - uv[palm].mean(0))
    if not spread > 1e-6:
        return None
    depth = float(K[0, 0] * np.linalg.norm(shape[:, :2]) / spread)

    def residual(x: np.ndarray) -> np.ndarray:
        camera = Rotation.from_rotvec(x[:3]).apply(shape) + x[3:]
        image = camera @ K.T
        error = (image[:, :2] / np.maximum(image[:, 2:], 1e-6) - uv[palm]) / pixel_std
        return np.concatenate([error.ravel(), x[:3] / TURN_STD])

    fit = least_squares(residual, np.concatenate([np.zeros(3), ray / ray[2] * depth]), loss="soft_l1",
                        x_scale=[0.1] * 6, max_nfev=40)  # fmt: skip
    correction = Rotation.from_rotvec(fit.x[:3])
    camera = correction.apply(shape) + fit.x[3:]
    if camera[:, 2].min() <= 0.02:
        return None
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac)
    looseness = max(1.0, 2.0 * fit.cost / 10)
    std = float(np.sqrt(max(covariance[5, 5], 0.0) * looseness) / fit.x[5])
    return camera, (correction * prior).as_matrix(), std


def _onto_ray(start: np.ndarray, ray: np.ndarray, length: float, hint: np.ndarray) -> np.ndarray:
    """The end (3,) of a bone from start on a ray through the camera, the solution nearer to the direction hint."""
    ray = ray / np.linalg.norm(ray)
    middle = float(start @ ray)
    rest = length**2 - (float(start @ start) - middle**2)
    if rest <= 0:  # too far from the ray: as near to it as the bone reaches
        way = middle * ray - start
        return start + way / max(np.linalg.norm(way), 1e-9) * length
    ends = [(middle + s * np.sqrt(rest)) * ray for s in (-1, 1)]
    return max(ends, key=lambda end: float((end - start) @ hint))


def _place(metric: np.ndarray, uv: np.ndarray, K: np.ndarray, side: str, pixel_std: float
           ) -> tuple[np.ndarray, float] | None:  # fmt: skip
    """Camera-frame landmarks (21, 3) and the depth's relative std without the hand-size term; None if implausible."""
    rays = np.column_stack([uv, np.ones(21)]) @ np.linalg.inv(K).T
    found = _palm(metric, rays, uv, K, side, pixel_std)
    if found is None:
        return None
    palm, turn, std = found
    out = np.empty((21, 3))
    out[list(PALM)] = palm
    for finger in FINGERS:
        for joint in finger[0 if finger[0] == 1 else 1 :]:
            parent = PARENT[joint]
            hint = turn @ (metric[joint] - metric[parent])
            out[joint] = _onto_ray(out[parent], rays[joint], ADULT[joint], hint / max(np.linalg.norm(hint), 1e-9))
    return (out, std) if out[:, 2].min() > 0.02 else None


def hand_positions(hand: HandTrack, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A hand's landmarks in the camera's frame.

    Args:
        hand: one hand.
        K: (3, 3) or (T, 3, 3) intrinsics, full px.

    Returns:
        (T, 21, 3) m, right-down-forward, NaN where the hand is not valid or no pose is plausible; and the standard
        deviation (T,) of its depth, m, hand-size spread included. Landmarks that were measured in space are returned
        as they are, with their own.
    """
    n = len(hand.valid)
    if hand.placed is not None:
        return hand.placed.copy(), np.where(hand.valid, hand.placed_std or 0.0, np.nan)
    out, std = np.full((n, 21, 3), np.nan), np.full(n, np.nan)
    for t in np.flatnonzero(hand.valid):
        noise = PIXEL_STD * max(float(palm_pixels(hand.uv[t])), 1.0)
        placed = _place(hand.metric[t], hand.uv[t], K if K.ndim == 2 else K[t], hand.side, noise)
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

"""Metres from depth maps, where the scene folder has them."""

from __future__ import annotations

import numpy as np

from reconstruct.cues import Tracks
from reconstruct.hand.scale import rescale
from reconstruct.joint.models import JointFit

SAME_SURFACE = 0.05  # neighbouring inverse depths that differ by less, relatively, are of one surface
MIN_LOOKS = 20


def depth_scale(fit: JointFit, tracks: Tracks, depth: np.ndarray, size: tuple[int, int]) -> JointFit:
    """Make a joint metric by the depth of its own points.

    Args:
        fit: a joint up to scale.  tracks: the tracks it was fitted to.
        depth: (T, H, W) m along the optical axis at any size, NaN where unknown.
        size: (width, height) of the full-size frame, px.

    Returns:
        A metric joint with ``scale_source`` "depth" and ``std["scale"]`` (relative), or the joint unchanged
        where fewer than 20 looks at its points have a depth.
    """
    if fit.metric or fit.q is None or fit.points is None or fit.point_track is None:
        return fit
    T = len(depth)
    members = np.asarray(fit.point_track, int)
    pose = fit.link_pose(np.asarray(fit.q, float))
    ratios, owner = [], []
    for t in range(min(T, len(pose))):
        world = fit.points @ pose[t, :3, :3].T + pose[t, :3, 3]
        z = (world @ fit.T_camera_world[:3, :3].T + fit.T_camera_world[:3, 3])[:, 2]
        seen = np.flatnonzero(tracks.visible[members, t] & np.isfinite(z) & (z > 0))
        uv = tracks.uv[members[seen], t]
        metres = sample_depth(depth[t : t + 1], uv[:, None], size)[:, 0]
        good = np.isfinite(metres) & (metres > 0)
        ratios.append(np.log(metres[good] / z[seen[good]]))
        owner.append(seen[good])
    values, owners = np.concatenate(ratios), np.concatenate(owner)
    if len(values) < MIN_LOOKS:
        return fit
    middle = float(np.median(values))
    scatter = 1.4826 * float(np.median(np.abs(values - middle)))
    # One point's looks err alike: count points, not looks.
    return rescale(fit, float(np.exp(middle)), scatter / np.sqrt(len(np.unique(owners))), "depth")


def sample_depth(depth: np.ndarray, uv: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Depth at places of the picture.

    Within one surface the inverse depths of the four pixels around a place are interpolated, as inverse depth is affine
    over the picture of a plane. Where they are not of one surface the nearest pixel counts: between a near and a far
    surface there is nothing.

    Args:
        depth: (T, h, w) along the optical axis at any size, NaN where unknown.  uv: (N, T, 2) full px.
        size: (width, height) full px.

    Returns:
        (N, T), NaN where nothing is known.
    """
    T, h, w = depth.shape
    at = (np.nan_to_num(uv, nan=-1e6, posinf=-1e6, neginf=-1e6) + 0.5) * (w / size[0], h / size[1]) - 0.5
    at = np.clip(at, -1e6, 1e6)
    near = np.floor(at + 0.5).astype(int)
    inside = (near >= 0).all(-1) & (near < (w, h)).all(-1)
    near, low = np.clip(near, 0, (w - 1, h - 1)), np.clip(np.floor(at).astype(int), 0, (max(w - 2, 0), max(h - 2, 0)))
    frame = np.arange(T)[None]
    a, b = np.moveaxis(at - low, -1, 0)
    x, y, right, below = low[..., 0], low[..., 1], min(1, w - 1), min(1, h - 1)
    nearest = np.asarray(depth[frame, near[..., 1], near[..., 0]], float)
    with np.errstate(divide="ignore", invalid="ignore"):
        corner = [1.0 / np.asarray(depth[frame, v, u], float) for v in (y, y + below) for u in (x, x + right)]
        one = np.ptp(corner, axis=0) < SAME_SURFACE * np.min(np.abs(corner), axis=0)  # False where one is NaN
        weights = [(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b]
        value = 1.0 / sum(f * c for f, c in zip(weights, corner, strict=True))
    return np.where(inside, np.where(one & np.isfinite(value), value, nearest), np.nan)

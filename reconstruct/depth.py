"""Metres from depth maps, where the scene folder has them."""

from __future__ import annotations

import numpy as np

from reconstruct.cues import Tracks
from reconstruct.hand.scale import rescale
from reconstruct.joint.models import JointFit

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
    T, H, W = depth.shape
    members = np.asarray(fit.point_track, int)
    pose = fit.link_pose(np.asarray(fit.q, float))
    ratios, owner = [], []
    for t in range(min(T, len(pose))):
        world = fit.points @ pose[t, :3, :3].T + pose[t, :3, 3]
        z = (world @ fit.T_camera_world[:3, :3].T + fit.T_camera_world[:3, 3])[:, 2]
        seen = np.flatnonzero(tracks.visible[members, t] & np.isfinite(z) & (z > 0))
        uv = tracks.uv[members[seen], t]
        column = np.clip(np.round((uv[:, 0] + 0.5) * W / size[0] - 0.5).astype(int), 0, W - 1)
        row = np.clip(np.round((uv[:, 1] + 0.5) * H / size[1] - 0.5).astype(int), 0, H - 1)
        metres = np.asarray(depth[t, row, column], float)
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

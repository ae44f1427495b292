"""The joint with depth from what lies in a scene folder: tracks with 3D points, or tracks and depth maps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from reconstruct.cues import Tracks
from reconstruct.depth import sample_depth
from reconstruct.errors import TaaError
from reconstruct.joint.models import JointFit, placed
from reconstruct.joint.rigid.several import fit_joints
from reconstruct.joint.world import assumed_up, world_from_camera


def fit_from_cues(tracks: Tracks, camera: Mapping[str, np.ndarray], depth: np.ndarray | None = None,
                  xyz_world: np.ndarray | None = None, moving: np.ndarray | None = None, size: tuple[int, int] = (0, 0),
                  metric: bool = True, seed: int = 0) -> JointFit:  # fmt: skip
    """Joint from tracks with depth; other links that move are its ``further``.

    Args:
        tracks: uv in full px.
        camera: K (3, 3) or (T, 3, 3) and, unless the camera rests, T_world_camera (T, 4, 4).
        depth: (T, H, W) along the optical axis, any size.  xyz_world: (N, T, 3), used where there is one.
        moving: (T, h, w) bool, the moving link's pixels, any size.
        size: (width, height) of the full picture.

    Returns:
        A JointFit in the world of the cameras; in one with an assumed z-up where no camera pose is given.

    Raises:
        TaaError: an array has the wrong shape.
    """
    N, T = tracks.visible.shape
    Ks = np.asarray(camera["K"], float).reshape(-1, 3, 3)
    if len(Ks) not in (1, T):
        raise TaaError(f"K of cues/camera.npz has {len(Ks)} matrices for {T} frames; give one, or one a frame")
    K = Ks[0]
    posed = "T_world_camera" in camera
    pose = np.asarray(camera["T_world_camera"], float).reshape(-1, 4, 4) if posed else np.eye(4)[None]
    if len(pose) not in (1, T):
        raise TaaError(f"T_world_camera of cues/camera.npz has {len(pose)} poses for {T} frames; give one a frame")
    pose = np.broadcast_to(pose, (T, 4, 4))
    uv = np.asarray(tracks.uv, float)
    if xyz_world is not None:
        if xyz_world.shape != (N, T, 3):
            raise TaaError(f"xyz_world of cues/tracks.npz has shape {xyz_world.shape}, expected {(N, T, 3)}")
        inverse = np.linalg.inv(pose)
        z = np.einsum("tj,ntj->nt", inverse[:, 2, :3], np.asarray(xyz_world, float)) + inverse[:, 2, 3]
    else:
        z = np.where(tracks.visible, sample_depth(np.asarray(depth), uv, size), np.nan)
    link = None
    if moving is not None:
        inside = sample(moving.astype(np.float32), uv, tracks.visible, size)
        link = np.nan_to_num(np.nansum(inside, axis=1) / np.maximum(tracks.visible.sum(1), 1)) > 0.5
    if len(Ks) > 1:  # a zoom, or a network's own estimate a frame: every picture as the first lens would show it
        to_first = K @ np.linalg.inv(Ks)
        uv = np.einsum("tij,ntj->nti", to_first[:, :2, :2], uv) + to_first[:, :2, 2]
    fit = fit_joints(uv, tracks.visible, z, K, pose, link, metric, seed)
    return fit if posed or fit.verdict == "refused" else _upright(fit)


def sample(maps: np.ndarray, uv: np.ndarray, visible: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(N, T) values of (T, H, W) maps at the nearest pixel of tracks (full px of a picture of that size), else NaN.

    The nearest pixel and no mean: between a near and a far surface there is nothing.
    """
    T, H, W = maps.shape
    out = np.full(visible.shape, np.nan)
    scale = np.array([W, H]) / np.array(size)
    for t in range(T):
        rows = np.flatnonzero(visible[:, t])
        at = np.round((uv[rows, t] + 0.5) * scale - 0.5).astype(int)
        good = ((at >= 0) & (at < [W, H])).all(1)
        out[rows[good], t] = maps[t, at[good, 1], at[good, 0]]
    return out


def _upright(fit: JointFit) -> JointFit:
    """From the resting camera's frame to a z-up world by the same assumptions as without depth."""
    far = int(np.argmax(np.abs(fit.q)))
    T = fit.link_pose(fit.q[far])
    up, how = assumed_up(fit.type, fit.axis, fit.points, fit.points @ T[:3, :3].T + T[:3, 3])
    origin = np.median(fit.points, axis=0) if fit.point is None else fit.point
    T_world = world_from_camera(up, fit.axis, origin)
    return replace(placed(fit, T_world), reason=f"{fit.reason}; {how}",
                   further=tuple(placed(other, T_world) for other in fit.further))  # fmt: skip

"""The joint straight from 3D tracks, by rigid registration alone: an independent check of cues."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def rigid(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R, d of the best b = R a + d (Kabsch), a third of the points trimmed."""
    keep = np.ones(len(a), bool)
    for _ in range(4):
        p, q = a[keep], b[keep]
        u, _, vt = np.linalg.svd((q - q.mean(0)).T @ (p - p.mean(0)))
        R = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        d = q.mean(0) - R @ p.mean(0)
        r = np.linalg.norm(a @ R.T + d - b, axis=1)
        keep = r <= np.quantile(r, 0.67)
    return R, d


def joint_between(a: np.ndarray, b: np.ndarray) -> tuple[str, np.ndarray, np.ndarray | None, float]:
    """Type, axis, point and |q| of the motion between two states of a link's points (N, 3)."""
    R, d = rigid(a, b)
    turn = Rotation.from_matrix(R).as_rotvec()
    angle = float(np.linalg.norm(turn))
    size = np.linalg.norm(np.ptp(a, axis=0))
    if angle * size < 0.3 * np.linalg.norm(d):
        return "prismatic", d / np.linalg.norm(d), None, float(np.linalg.norm(d))
    axis = turn / angle
    point = np.linalg.lstsq(np.eye(3) - R, d - (d @ axis) * axis, rcond=None)[0]
    return "revolute", axis, point, angle


def axis_error(axis: np.ndarray, point: np.ndarray | None, true_axis: np.ndarray, true_point: np.ndarray | None,
               centre: np.ndarray) -> tuple[float, float]:  # fmt: skip
    """Angle in degrees, and the distance of the axes at the plane through ``centre`` across the true one."""
    angle = float(np.degrees(np.arctan2(np.linalg.norm(np.cross(axis, true_axis)), abs(axis @ true_axis))))
    if point is None or true_point is None:
        return angle, 0.0
    a = true_axis / np.linalg.norm(true_axis)
    foot = true_point + ((centre - true_point) @ a) * a
    hit = point + axis * ((centre - point) @ a) / (axis @ a)
    return angle, float(np.linalg.norm(hit - foot))

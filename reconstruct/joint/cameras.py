"""A moving camera: the rigid motions of the static scene and of the link, and the joint between them.

Tracks of a rigid body give the camera's path relative to it, up to scale (groups.py). Of the two largest groups one is
the static scene, the other the link; the joint is the motion of one path against the other, which also gives the ratio
of their scales: linear for a hinge. Which of them rests no picture can tell: it is taken to be the one before which the
camera's path is smoother, since the path before the other has the joint's starts and stops in it as well.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruct.joint.groups import MIN_GROUP, Rigid
from reconstruct.joint.polish import Bundle
from reconstruct.joint.twist import Twist, twist_of_joint

STILL_SHARE = 0.15
"""A camera moves if fewer tracks than this share stay where they are."""


def camera_moves(uv: np.ndarray, diagonal: float) -> bool:
    """True if hardly any track of (N, T, 2) keeps its place."""
    seen = np.isfinite(uv[..., 0])
    long = np.flatnonzero(seen.mean(1) > 0.5)
    if len(long) < 2 * MIN_GROUP:
        return False
    low, high = np.nanquantile(uv[long], [0.05, 0.95], axis=1)
    return bool(np.mean(np.linalg.norm(high - low, axis=-1) < 0.004 * diagonal) < STILL_SHARE)


def rougher(one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray], centre: np.ndarray,
            degree: int = 4) -> bool:  # fmt: skip
    """True if the second of two camera paths (R, t), body to camera, is the rougher one.

    A path is six numbers a frame: where a point of the body is in the picture, the logarithm of its depth, and the
    turn. Roughness is what polynomials in time leave of them (an arc of a circle needs no more than the fourth degree),
    each over its noise, which differs much: the place in the picture is known far better than the camera's.

    Args:
        centre: (3,) the point, in the frame that both bodies share in the first picture.
    """
    left, jitter = [], []
    for R, t in (one, other):
        T = len(R)
        p = R @ centre + t
        turn = Rotation.from_matrix(R[T // 2].T @ R).as_rotvec()
        path = np.concatenate([p[:, :2] / p[:, 2:], np.log(np.maximum(p[:, 2:], 1e-6)), turn], axis=1)
        basis = np.polynomial.legendre.legvander(np.linspace(-1, 1, T), degree)
        left.append(np.mean((path - basis @ np.linalg.lstsq(basis, path, rcond=None)[0]) ** 2, axis=0))
        jitter.append(np.mean(np.diff(path, 3, axis=0) ** 2, axis=0) / 20)  # white noise grows by 1 + 9 + 9 + 1
    noise = np.minimum(*jitter) + 1e-18
    return bool(np.sum(left[1] / noise) > np.sum(left[0] / noise))


def before_the_link(twist: Twist, q: np.ndarray, R: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The camera's path (T, 3, 3), (T, 3) with the link for the world, from that with the scene for it."""
    turn, shift = twist.pose(q)
    moved = twist.anchor + shift - np.einsum("tij,j->ti", turn, twist.anchor)
    return R @ turn, np.einsum("tij,tj->ti", R, moved) + t


def joints_between(static: Rigid, link: Rigid) -> dict[str, Bundle]:
    """A hinge and a slide between two camera paths: starts for the bundle adjustment, in the static body's frame.

    With X = ratio * X_link in the first camera's frame, the link moves by D_t = R_t' A_t and
    d_t = R_t' (ratio a_t - t_t). A hinge has d_t = (I - D_t) c: linear in c and the ratio. Frames that do not show both
    bodies have no say; their states are between those around.
    """
    both = np.flatnonzero(static.shown & link.shown)
    if len(both) < 3:
        return {}
    every, R = np.arange(len(static.R)), static.R[both]
    D = np.swapaxes(R, 1, 2) @ link.R[both]
    p = np.einsum("tji,tj->ti", R, link.t[both])
    s = np.einsum("tji,tj->ti", R, static.t[both])
    out: dict[str, Bundle] = {}
    turns = Rotation.from_matrix(D).as_rotvec()
    points = link.X[link.members]

    _, _, vt = np.linalg.svd(turns)
    axis = vt[0]
    if axis @ turns[int(np.argmax(np.linalg.norm(turns, axis=1)))] < 0:
        axis = -axis
    A = np.concatenate([-(np.eye(3) - D), p[..., None]], axis=-1)  # [c, ratio]
    sides = np.concatenate([A.reshape(-1, 4), [[*(0.05 * axis), 0.0]]])  # the point is free along the axis
    b = np.concatenate([s.reshape(-1), [0.0]])
    w = np.ones(len(b))
    for _ in range(10):
        v = np.linalg.lstsq(sides * w[:, None], b * w, rcond=None)[0]
        r = sides @ v - b
        w = 1 / np.sqrt(1 + (r / (1.5 * np.median(np.abs(r)) + 1e-9)) ** 2)
    if v[3] > 0.05:
        middle = v[3] * np.median(points, axis=0)
        point = v[:3] - axis * ((v[:3] - middle) @ axis)
        if np.linalg.norm(middle - point) > 1e-6:
            twist, speed = twist_of_joint("revolute", axis, point, middle)
            q = np.interp(every, both, np.unwrap(turns @ axis))
            out["revolute"] = Bundle("revolute", twist, (q - q[0]) * speed, v[3] * points)
    best = (np.inf, 1.0)
    for ratio in np.exp(np.linspace(np.log(0.3), np.log(3.0), 200)):
        d = ratio * p - s
        sv = np.linalg.svd(d, compute_uv=False)
        if sv[0] > 0 and sv[1] < best[0]:
            best = (float(sv[1]), float(ratio))
    d = best[1] * p - s
    along = np.linalg.svd(d)[2][0]
    q = d @ along
    if abs(q.min()) > q.max():
        along, q = -along, -q
    q = np.interp(every, both, q)
    middle = best[1] * np.median(points, axis=0)
    out["prismatic"] = Bundle("prismatic", Twist(middle, along, np.zeros(3)), q - q[0], best[1] * points)
    return out

"""From lifted points to first joints: rigid poses by trimmed Kabsch, then axes from random subsets of the poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruct.joint.rigid.twist import Twist, make

TRIM = 3.0
"""Residuals beyond so many times their median are left out of the next round."""


@dataclass(frozen=True)
class Poses:
    """The link as a free rigid body.

    Attributes:
        frames: (F,) frames with a pose.  R: (F, 3, 3), d: (F, 3): x_t = R x_anchor + d.
        confidence: (F,) reciprocal of the median residual squared times the number of points that agree.
        points: (N, 3) the link in the anchor frame, NaN where it could not be told.
        anchor: frame number.
        residual: (F,) median residual, m.
    """

    frames: np.ndarray
    R: np.ndarray
    d: np.ndarray
    confidence: np.ndarray
    points: np.ndarray
    anchor: int
    residual: np.ndarray


def kabsch(a: np.ndarray, b: np.ndarray, rounds: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R, d with b ~ R a + d by least squares, trimmed: starts from the best of small samples.

    Returns:
        R (3, 3), d (3,), residuals (n,).
    """
    rng = np.random.default_rng(len(a))
    best, best_cost = None, np.inf
    for k in range(12):
        rows = np.arange(len(a)) if k == 0 else rng.choice(len(a), min(len(a), 4), replace=False)
        R, d = _procrustes(a[rows], b[rows])
        e = np.linalg.norm(a @ R.T + d - b, axis=1)
        cost = np.median(e)
        if cost < best_cost:
            best, best_cost = e, cost
    e = best
    for _ in range(rounds):
        keep = e <= max(TRIM * np.median(e), 1e-9)
        R, d = _procrustes(a[keep], b[keep])
        e = np.linalg.norm(a @ R.T + d - b, axis=1)
    return R, d, e


def _procrustes(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    ca, cb = a.mean(0), b.mean(0)
    u, _, vt = np.linalg.svd((b - cb).T @ (a - ca))
    R = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return R, cb - R @ ca


def register(world: np.ndarray, rounds: int = 2) -> Poses | None:
    """Poses of all frames against the one that shares most points with the others; None if too few points do.

    Points that are hidden in the anchor frame join as soon as a frame that sees them has a pose.

    Args:
        world: (N, T, 3) lifted points of the link, NaN where unknown.
    """
    known = np.isfinite(world[..., 0])
    T = known.shape[1]
    shared = known.T.astype(float) @ known
    np.fill_diagonal(shared, 0)
    anchor = int(np.argmax(np.minimum(shared, np.median(shared)).sum(1) + 1e-3 * shared.sum(1)))
    points = np.where(known[:, anchor, None], world[:, anchor], np.nan)
    poses: dict[int, tuple] = {anchor: (np.eye(3), np.zeros(3), 1e-6, int(known[:, anchor].sum()))}
    left = set(range(T)) - {anchor}
    fixed = False
    for _ in range(rounds):
        while left:
            have = np.isfinite(points[:, 0])
            counts = {t: int((known[:, t] & have).sum()) for t in left}
            t = max(left, key=lambda t: counts[t])
            if counts[t] < 6:
                break
            left.discard(t)
            rows = np.flatnonzero(known[:, t] & have)
            R, d, e = kabsch(points[rows], world[rows, t])
            poses[t] = (R, d, float(np.median(e)), int((e < TRIM * np.median(e)).sum()))
            if not fixed:
                new = known[:, t] & ~have
                points[new] = (world[new, t] - d) @ R
        # Second round: every point from all frames, then every pose from these points.
        frames = np.array(sorted(poses))
        R, d = np.stack([poses[t][0] for t in frames]), np.stack([poses[t][1] for t in frames])
        back = np.einsum("tji,ntj->nti", R, world[:, frames] - d)
        with np.errstate(all="ignore"):
            some = np.isfinite(back[..., 0]).any(1)
            points[some] = np.nanmedian(back[some], axis=1)
        if not fixed:
            fixed = True
            left = set(frames) - {anchor}
    frames = np.array(sorted(poses))
    if len(frames) < 3:
        return None
    R, d, e, n = (np.stack([np.asarray(poses[t][k]) for t in frames]) for k in range(4))
    return Poses(frames, R, d, n / np.maximum(e, np.median(e) / 3 + 1e-9) ** 2, points, anchor, e)


def hypotheses(poses: Poses, rng: np.random.Generator, count: int = 60) -> list[tuple[Twist, np.ndarray]]:
    """First joints with their states in the poses' frames, best first: slides, hinges and screws.

    A slide's direction is the dominant displacement of the centroid; a hinge's axis the dominant relative rotation
    vector, its pivot solves (I - R_t) c = d_t on the plane through the centroid; a screw keeps the shift along the
    axis. Each is drawn from random triples of frames as well as from all, and judged by the poses' robust distance.
    """
    centre = np.nanmedian(poses.points, axis=0)
    off = poses.points - centre
    size = float(np.sqrt(np.nanmedian(np.sum(off**2, axis=1)))) or 1.0
    shift = poses.R @ centre + poses.d - centre
    turn = Rotation.from_matrix(poses.R).as_rotvec()
    w = poses.confidence / poses.confidence.max()
    F = len(poses.frames)
    found: list[tuple[float, Twist, np.ndarray]] = []
    amount = w * (np.sum(shift**2, 1) + size**2 * np.sum(turn**2, 1))
    few = min(3, int(np.count_nonzero(amount / amount.sum()))) if amount.sum() > 0 else 0
    if few == 0:
        return []
    for k in range(count):
        rows = np.arange(F) if k == 0 else rng.choice(F, few, replace=False, p=amount / amount.sum())
        direction = _dominant(shift[rows], w[rows])
        twist, _ = make("prismatic", np.zeros(3), direction, centre, size)
        found.append(_judged(twist, shift @ twist.v, poses, shift, turn, w, size))
        axis = _dominant(turn[rows], w[rows])
        q = np.unwrap(turn @ axis)  # a lid turns by more than half a turn; between key frames by less
        if np.abs(q[rows]).max() < 1e-4:
            continue
        # (I - R_t)(c - centre) = shift_t, without the part along the axis.
        A = (np.eye(3) - poses.R[rows]).reshape(-1, 3)
        flat = shift[rows] - (shift[rows] @ axis)[:, None] * axis
        weight = np.repeat(np.sqrt(w[rows]), 3)
        A = np.vstack([A * weight[:, None], axis * weight.max()])
        c = np.linalg.lstsq(A, np.append(flat.ravel() * weight, 0.0), rcond=None)[0]
        pitch = float(np.sum(w * q * (shift @ axis)) / np.sum(w * q**2))
        for kind in ("revolute", "screw"):
            v = -np.cross(axis, c) + (pitch * axis if kind == "screw" else 0.0)
            twist, length = make(kind, axis, v, centre, size)
            found.append(_judged(twist, q * length, poses, shift, turn, w, size))
    found.sort(key=lambda f: f[0])
    return [(t, s) for _, t, s in found]


def _dominant(vectors: np.ndarray, w: np.ndarray) -> np.ndarray:
    _, _, vt = np.linalg.svd(vectors * np.sqrt(w)[:, None], full_matrices=False)
    return vt[0]


def _judged(twist: Twist, s, poses: Poses, shift, turn, w, size) -> tuple[float, Twist, np.ndarray]:
    made = twist.poses(s)
    miss = np.einsum("tij,j->ti", made[:, :3, :3], twist.origin) + made[:, :3, 3] - twist.origin - shift
    rest = Rotation.from_matrix(np.swapaxes(made[:, :3, :3], 1, 2) @ poses.R).magnitude()
    e = np.sqrt(np.sum(miss**2, axis=1) + size**2 * rest**2)
    tolerance = 3 * np.median(poses.residual) + 1e-6
    return float(np.sum(w * np.minimum(e, 5 * tolerance))), twist, s

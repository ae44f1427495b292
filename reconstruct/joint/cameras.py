"""A moving camera: the rigid motions of the static scene and of the link, and the joint between them.

Tracks of a rigid body give the camera's path relative to it, up to scale (structure from motion: essential matrix,
resection, bundle adjustment). The largest rigid group is taken for the static scene, the next one is the link; the
joint then is the motion of one path against the other, which also gives the ratio of their scales: linear for a hinge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruct.joint.polish import Bundle
from reconstruct.joint.twist import Twist, skew, twist_of_joint

MIN_GROUP = 15
STILL_SHARE = 0.15
"""A camera moves if fewer tracks than this share stay where they are."""


@dataclass(frozen=True)
class Rigid:
    """A rigid body and the camera's path about it.

    Attributes:
        R, t: (T, 3, 3), (T, 3) body to camera; the body's frame is the first camera, its median depth 1.
        X: (N, 3) points of all tracks (meaningful for members).
        members: (N,) bool.  sigma: noise of one coordinate, px.
    """

    R: np.ndarray
    t: np.ndarray
    X: np.ndarray
    members: np.ndarray
    sigma: float


def camera_moves(uv: np.ndarray, diagonal: float) -> bool:
    """True if hardly any track of (N, T, 2) keeps its place."""
    seen = np.isfinite(uv[..., 0])
    long = np.flatnonzero(seen.mean(1) > 0.5)
    if len(long) < 2 * MIN_GROUP:
        return False
    low, high = np.nanquantile(uv[long], [0.05, 0.95], axis=1)
    return bool(np.mean(np.linalg.norm(high - low, axis=-1) < 0.004 * diagonal) < STILL_SHARE)


def rigid_group(uv: np.ndarray, focal: float, candidates: np.ndarray, seed: int = 0) -> Rigid | None:
    """The largest rigid group among tracks.

    Args:
        uv: (N, T, 2) px from the principal point, NaN where not seen.
        focal: px.
        candidates: (N,) bool.

    Returns:
        None if no group of MIN_GROUP tracks is found that is seen in the first frame.
    """
    import cv2

    cv2.setRNGSeed(seed)
    x = uv / focal
    T = uv.shape[1]
    seen = np.isfinite(x[..., 0]) & candidates[:, None]
    best: tuple[int, int, np.ndarray, np.ndarray, np.ndarray] | None = None
    for k in np.unique(np.linspace(T // 4, T - 1, 6).round().astype(int)):
        both = np.flatnonzero(seen[:, 0] & seen[:, k])
        if len(both) < MIN_GROUP:
            continue
        E, _ = cv2.findEssentialMat(x[both, 0], x[both, k], np.eye(3), cv2.RANSAC, 0.9999, 1.5 / focal)
        if E is None or E.shape != (3, 3):
            continue
        count, R, t, good = cv2.recoverPose(E, x[both, 0], x[both, k], np.eye(3))
        # Enough parallax for depth, and most tracks.
        turned = x[both, 0] @ R[:2, :2].T + R[:2, 2]
        turned /= (x[both, 0] @ R[2, :2] + R[2, 2])[:, None]
        parallax = np.median(np.linalg.norm(turned - x[both, k], axis=-1)) * focal
        worth = int(count * min(parallax / 8.0, 1.0))
        if best is None or worth > best[0]:
            best = (worth, int(k), R, t.ravel(), both[good.ravel() > 0])
    if best is None or len(best[4]) < MIN_GROUP:
        return None
    _, k, R, t, ids = best
    poses: list[tuple[np.ndarray, np.ndarray] | None] = [None] * T
    poses[0], poses[k] = (np.eye(3), np.zeros(3)), (R, t)
    members = np.zeros(len(uv), bool)
    members[ids] = True
    X = _triangulated(x, seen, poses, np.zeros((len(uv), 3)))
    for order in (range(k - 1, 0, -1), range(k + 1, T), range(1, T)):
        for f in order:
            use = np.flatnonzero(members & seen[:, f] & (X[:, 2] > 0.05))
            if len(use) < 8:
                continue
            near = min((g for g in range(T) if poses[g] is not None), key=lambda g: abs(g - f))
            guess = poses[near]
            rv, tv = Rotation.from_matrix(guess[0]).as_rotvec(), guess[1].copy()
            ok, rv, tv, inliers = cv2.solvePnPRansac(
                X[use], x[use, f], np.eye(3), None, rv, tv, True, 60, 3.0 / focal, 0.999, flags=cv2.SOLVEPNP_ITERATIVE
            )
            if ok and inliers is not None and len(inliers) >= 8:
                poses[f] = (Rotation.from_rotvec(rv.ravel()).as_matrix(), tv.ravel())
        X = _triangulated(x, seen, poses, X)
        members = _fits(x, seen, poses, X, focal) & candidates
        if members.sum() < MIN_GROUP:
            return None
    poses = _filled(poses)
    R, t = np.stack([p[0] for p in poses]), np.stack([p[1] for p in poses])
    sigma = 1.0
    for _ in range(2):
        R, t, X, sigma = _adjust(x, seen & members[:, None], R, t, X, focal)
        X = np.where(members[:, None], X, _triangulated(x, seen, list(zip(R, t, strict=True)), X))
        members = _fits(x, seen, list(zip(R, t, strict=True)), X, focal, 2.5 * sigma) & candidates
        if members.sum() < MIN_GROUP:
            return None
    unit = float(np.median(X[members, 2]))
    if unit <= 0:
        return None
    return Rigid(R, t / unit, X / unit, members, sigma)


def _filled(poses: list) -> list:
    """Frames without a pose take the nearest one's."""
    known = [k for k, p in enumerate(poses) if p is not None]
    return [poses[min(known, key=lambda g: abs(g - k))] for k in range(len(poses))]


def _triangulated(x: np.ndarray, seen: np.ndarray, poses: list, X: np.ndarray) -> np.ndarray:
    """Linear triangulation over all frames with a pose, reweighted once by depth and residual."""
    for sweep in range(3):
        A, b = np.zeros((len(x), 3, 3)), np.zeros((len(x), 3))
        for k, pose in enumerate(poses):
            if pose is None:
                continue
            R, t = pose
            z = X @ R[2] + t[2]
            w = np.where(seen[:, k], 1.0, 0.0)
            if sweep:
                err = np.linalg.norm((X @ R[:2].T + t[:2]) / np.maximum(z, 1e-3)[:, None] - x[:, k], axis=-1)
                w = w / np.maximum(z, 1e-2) ** 2 / (1 + (np.clip(np.nan_to_num(err), 0, 1e3) / 0.004) ** 2) ** 2
            for axis in range(2):
                row = np.nan_to_num(x[:, k, axis])[:, None] * R[2] - R[axis]
                rhs = t[axis] - np.nan_to_num(x[:, k, axis]) * t[2]
                A += w[:, None, None] * row[:, :, None] * row[:, None]
                b += (w * rhs)[:, None] * row
        damp = (1e-9 * np.trace(A, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)
        X = np.linalg.solve(A + damp, b[..., None])[..., 0]
    return X


def _fits(x: np.ndarray, seen: np.ndarray, poses: list, X: np.ndarray, focal: float, px: float = 2.0) -> np.ndarray:
    r = np.full(seen.shape, np.nan)
    for k, pose in enumerate(poses):
        if pose is None:
            continue
        Y = X @ pose[0].T + pose[1]
        e = np.linalg.norm(Y[:, :2] / np.maximum(Y[:, 2:], 1e-3) - x[:, k], axis=-1) * focal
        r[:, k] = np.where(seen[:, k], e, np.nan)
    enough = np.isfinite(r).sum(1) >= 4
    out = np.zeros(len(x), bool)
    out[enough] = np.nanmedian(r[enough], axis=1) < px
    return out & (X[:, 2] > 0.02)


def _adjust(x, seen, R, t, X, focal, iterations: int = 8):
    """Robust bundle adjustment of all poses but the first, and points (Schur complement)."""
    T = len(R)
    ids = np.flatnonzero(seen.any(1))
    x, seen, P = np.nan_to_num(x[ids]), seen[ids], X[ids].copy()
    N = len(ids)
    damping = 1e-4

    def project(R, t, P):
        Y = np.einsum("tij,nj->nti", R, P) + t
        r = (Y[..., :2] / np.maximum(Y[..., 2:], 1e-3) - x) * focal
        return Y, np.where(seen[..., None], r, 0.0)

    Y, r = project(R, t, P)
    for step in range(iterations):
        r2 = np.sum(r**2, axis=-1)
        sigma = float(np.sqrt(max(np.median(r2[seen]) / (2 * np.log(2)), 1e-4)))
        scale = 4.0 * sigma * (2.0 if step < 2 else 1.0)
        g = scale**2 / (scale**2 + r2)
        w, cost = seen * g**2, float(np.sum(seen * scale**2 * (1 - g)))
        z = np.maximum(Y[..., 2], 1e-3)
        J = np.zeros((N, T, 2, 3))
        J[..., 0, 0] = J[..., 1, 1] = focal / z
        J[..., 0, 2], J[..., 1, 2] = -focal * Y[..., 0] / z**2, -focal * Y[..., 1] / z**2
        Jc = np.concatenate([J @ -skew(Y - t), J], axis=-1)  # (N, T, 2, 6)
        Jx = J @ R
        wJc = w[..., None, None] * Jc
        Hc = np.einsum("ntia,ntib->tab", wJc, Jc, optimize=True)
        gc = np.einsum("ntia,nti->ta", wJc, r)
        Hx = np.einsum("nt,ntia,ntib->nab", w, Jx, Jx, optimize=True)
        gx = np.einsum("nt,ntia,nti->na", w, Jx, r, optimize=True)
        C = np.einsum("ntia,ntib->ntab", wJc, Jx, optimize=True)  # (N, T, 6, 3)
        for _ in range(4):
            inv = np.linalg.inv(Hx + (damping * np.einsum("nii->ni", Hx) + 1e-9)[..., None] * np.eye(3))
            CI = (C @ inv[:, None]).reshape(N, 6 * T, 3)
            S = -np.tensordot(CI, C.reshape(N, 6 * T, 3), axes=([0, 2], [0, 2]))
            for k in range(T):
                S[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += Hc[k]
            rhs = gc.ravel() - np.einsum("npj,nj->p", CI, gx)
            S[np.arange(6), np.arange(6)] += 1e8 * np.trace(S) / len(S)  # the first camera is the frame
            S += (damping * np.abs(np.diag(S)) + 1e-9 * np.trace(S) / len(S)) * np.eye(len(S))
            dc = -np.linalg.solve(S, rhs)
            dx = -np.einsum("nab,nb->na", inv, gx + np.einsum("ntab,ta->nb", C, dc.reshape(T, 6)))
            turn = Rotation.from_rotvec(dc.reshape(T, 6)[:, :3]).as_matrix()
            R2, t2, P2 = turn @ R, t + dc.reshape(T, 6)[:, 3:], P + dx
            Y2, r_2 = project(R2, t2, P2)
            cost2 = float(np.sum(seen * scale**2 * (1 - scale**2 / (scale**2 + np.sum(r_2**2, axis=-1)))))
            if cost2 < cost:
                R, t, P, Y, r = R2, t2, P2, Y2, r_2
                damping = max(damping / 10, 1e-9)
                break
            damping *= 10
        else:
            break
    X = X.copy()
    X[ids] = P
    return R, t, X, sigma


def joints_between(static: Rigid, link: Rigid) -> dict[str, Bundle]:
    """A hinge and a slide between two camera paths: starts for the bundle adjustment, in the static body's frame.

    With X = ratio * X_link in the first camera's frame, the link moves by D_t = R_t' A_t and
    d_t = R_t' (ratio a_t - t_t). A hinge has d_t = (I - D_t) c: linear in c and the ratio.
    """
    D = np.swapaxes(static.R, 1, 2) @ link.R
    p = np.einsum("tji,tj->ti", static.R, link.t)
    s = np.einsum("tji,tj->ti", static.R, static.t)
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
            q = np.unwrap(turns @ axis)
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
    middle = best[1] * np.median(points, axis=0)
    out["prismatic"] = Bundle("prismatic", Twist(middle, along, np.zeros(3)), q - q[0], best[1] * points)
    return out

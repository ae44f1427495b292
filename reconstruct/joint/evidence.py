"""Evidence for and against a joint: held-out frames, and a free rigid body as the rival."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from reconstruct.joint.bundle import Observations, State, refine, reprojection, transport
from reconstruct.joint.select import SCORE_PX, explained


def held_out_costs(s: State, obs: Observations, fold: int = 3, scale: float = SCORE_PX) -> np.ndarray:
    """(N,) robust cost of every track in frames that its fit did not see.

    Each third of the key frames is left out in turn: joint and depths come from the others, and only the
    state of the left-out frame is then fitted to it (one number for all tracks).
    """
    K = len(obs.frames)
    cost = np.zeros(len(obs.ref))
    for part in range(fold):
        out = np.arange(K) % fold == part
        ref_lost = out[obs.ref]
        train = replace(obs, seen=obs.seen & ~out)
        # Tracks whose reference key is left out get another one.
        other = np.where(train.seen.any(1), train.seen.argmax(1), obs.ref)
        train = replace(train, ref=np.where(ref_lost, other, obs.ref))
        X, _ = transport(s, obs)
        depth = np.maximum(X[np.arange(len(obs.ref)), train.ref, 2], 1e-3)
        fitted = refine(replace(s, depth=depth), train, scales=(3.0,), iterations=6)
        q = fitted.q.copy()
        test = replace(obs, ref=train.ref)
        for k in np.flatnonzero(out):
            q[k] = _state_of_frame(fitted, q, test, k)
        X, _ = transport(replace(fitted, q=q), test)
        r2 = np.sum(reprojection(X, test) ** 2, axis=-1)
        usable = obs.seen & out & train.seen.any(1)[:, None]
        cost += np.where(usable, r2 / (1 + r2 / scale**2), 0).sum(1)
    return cost


def _state_of_frame(s: State, q: np.ndarray, obs: Observations, k: int) -> float:
    """Robust Gauss-Newton on one state."""
    value = float(np.interp(k, [k - 1, k + 1], [q[max(k - 1, 0)], q[min(k + 1, len(q) - 1)]]))
    use = obs.seen[:, k]
    if not use.any():
        return value
    one = replace(obs, seen=obs.seen & (np.arange(obs.seen.shape[1]) == k))
    h = 1e-4 * max(np.ptp(q), 1e-3)
    for _ in range(6):
        r = []
        for delta in (0.0, h):
            trial = q.copy()
            trial[k] = value + delta
            r.append(reprojection(transport(replace(s, q=trial), one)[0], one)[:, k])
        J = (r[1] - r[0]) / h
        w = obs.weight * use / (1 + np.sum(r[0] ** 2, axis=-1) / SCORE_PX**2) ** 2
        step = -np.sum(w[:, None] * J * r[0]) / (np.sum(w[:, None] * J * J) + 1e-12)
        value += float(np.clip(step, -0.3 * np.ptp(q), 0.3 * np.ptp(q)))
    return value


def type_probability(costs: dict[str, np.ndarray], obs: Observations) -> dict[str, float]:
    """Probability of each type from held-out costs.

    Residuals of one track are strongly correlated in time, and those of neighbours in space: each track counts
    as one observation with its density weight, not as one per frame, and the noise is the better model's own.
    """
    names = list(costs)
    per = {n: costs[n] / np.maximum(obs.seen.sum(1), 1) for n in names}
    total = {n: float(np.sum(obs.weight * per[n])) for n in names}
    lead = min(total, key=total.get)
    noise = max(float(np.sum(obs.weight * per[lead]) / obs.weight.sum()), 0.05)
    log = np.array([-0.5 * (total[n] - total[lead]) / noise for n in names])
    p = np.exp(np.clip(log, -50, 0))
    p /= p.sum()
    return {n: float(v) for n, v in zip(names, p, strict=True)}


@dataclass(frozen=True)
class FreeMotion:
    """Median residuals, working px: of the joint, and of the same points moving freely in every frame."""

    joint_px: float
    free_px: float


def free_motion(s: State, obs: Observations, link: np.ndarray, rounds: int = 8) -> FreeMotion | None:
    """How much better a free rigid body explains the link's tracks than the joint does.

    Alternates pose from points (robust PnP) and points from poses (linear triangulation along every frame).

    Returns:
        None if too few tracks overlap to tell.
    """
    import cv2

    sub = np.flatnonzero(link)
    X, _ = transport(s, obs)
    if len(sub) < 8:
        return None
    seen, xy = obs.seen[sub], obs.xy[sub]
    K = seen.shape[1]
    # Points in the link frame of the key frame that most tracks see.
    base = int(np.argmax(seen.sum(0)))
    dq = replace(s, depth=s.depth[sub])
    part = replace(obs, xy=xy, seen=seen, ref=obs.ref[sub], weight=obs.weight[sub])
    P = transport(dq, part)[0][:, base]
    joint = np.linalg.norm(reprojection(X, obs)[sub], axis=-1)
    poses: list[tuple[np.ndarray, np.ndarray] | None] = [None] * K
    for _ in range(rounds):
        for k in range(K):
            use = seen[:, k]
            if use.sum() < 8:
                poses[k] = None
                continue
            r0, t0 = poses[k] if poses[k] is not None else _relative_pose(s, base, k)
            ok, rv, tv = cv2.solvePnP(P[use], xy[use, k], np.eye(3), None, r0.copy(), t0.copy(), True, cv2.SOLVEPNP_ITERATIVE)
            poses[k] = (rv, tv) if ok else None
        P = _triangulate(xy, seen, poses, P)
    free = np.full(joint.shape, np.nan)
    for k in range(K):
        if poses[k] is None:
            continue
        proj, _ = cv2.projectPoints(P, *poses[k], np.eye(3), None)
        free[:, k] = np.linalg.norm(proj[:, 0] - xy[:, k], axis=-1) / obs.px
    both = seen & np.isfinite(free)
    # Frames near the base state say nothing: everything fits there.
    away = np.abs(s.q - s.q[base]) > 0.15 * np.ptp(s.q)
    both &= away[None]
    if both.sum() < 30:
        return None
    return FreeMotion(float(np.median(joint[both])), float(np.median(free[both])))


def _relative_pose(s: State, base: int, k: int) -> tuple[np.ndarray, np.ndarray]:
    from scipy.spatial.transform import Rotation

    d = s.q[k] - s.q[base]
    if s.kind == "prismatic":
        return np.zeros((3, 1)), (d * s.axis).reshape(3, 1)
    R = Rotation.from_rotvec(d * s.axis)
    return (d * s.axis).reshape(3, 1), (s.point - R.apply(s.point)).reshape(3, 1)


def _triangulate(xy: np.ndarray, seen: np.ndarray, poses: list, P: np.ndarray) -> np.ndarray:
    import cv2

    A, b = np.zeros((len(P), 3, 3)), np.zeros((len(P), 3))
    for k, pose in enumerate(poses):
        if pose is None:
            continue
        R, t = cv2.Rodrigues(pose[0])[0], pose[1].ravel()
        for axis in range(2):
            row = xy[:, k, axis][:, None] * R[2] - R[axis]     # row . X = t_axis - x t_z
            rhs = t[axis] - xy[:, k, axis] * t[2]
            w = seen[:, k] / np.maximum((P @ R[2] + t[2]) ** 2, 1e-6)
            A += w[:, None, None] * row[:, :, None] * row[:, None, :]
            b += (w * rhs)[:, None] * row
    damp = 1e-3 * np.trace(A, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    return np.linalg.solve(A + damp + 1e-9 * np.eye(3), (b + (damp @ P[..., None])[..., 0])[..., None])[..., 0]


__all__ = ["FreeMotion", "explained", "free_motion", "held_out_costs", "type_probability"]

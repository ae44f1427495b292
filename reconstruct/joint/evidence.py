"""Evidence for and against a joint: held-out frames, and a free rigid body as the rival."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from reconstruct.joint.bundle import Observations, State, refine, reprojection, transport
from reconstruct.joint.select import SCORE_PX, explained, explained_by


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


FAR_HINGE = 2.0
"""A hinge farther from the link than this many link sizes is unusual; the odds fall with the ratio's square."""


def type_probability(states: dict[str, State], obs: Observations) -> dict[str, float]:
    """Probability of each type from held-out frames.

    A flexible model explains stray tracks that are not on the link, so types are compared on the tracks that
    both explain, where these are at least half of what the better one explains. Residuals of one track are
    strongly correlated in time, and those of neighbours in space: each track counts as one observation with
    its density weight. A hinge has one more parameter than a slide (Schwarz's criterion), and a hinge many link
    sizes away is a slide in all but name.
    """
    names = list(states)
    if len(names) == 1:
        return {names[0]: 1.0}
    costs = {n: held_out_costs(states[n], obs) for n in names}
    links = {n: explained(states[n], obs)[1] > 0.5 for n in names}
    common = np.logical_and.reduce([links[n] for n in names])
    if common.sum() < 0.5 * max(links[n].sum() for n in names):
        common = np.logical_or.reduce([links[n] for n in names])
    log = {}
    effective = max(float(obs.weight[common].sum()), 2.0)
    for n in names:
        mean = float(
            (obs.weight[common] * costs[n][common]).sum() / (obs.weight[common] @ obs.seen[common].sum(1) + 1e-9)
        )
        parameters = 3 if n == "revolute" else 2
        log[n] = -effective * np.log(max(mean, 0.05)) - 0.5 * parameters * np.log(effective)
        if n == "revolute":
            log[n] -= 2 * np.log(max(hinge_distance(states[n], obs, common) / FAR_HINGE, 1.0))
    top = max(log.values())
    p = {n: float(np.exp(max(v - top, -50.0))) for n, v in log.items()}
    return {n: v / sum(p.values()) for n, v in p.items()}


def hinge_distance(s: State, obs: Observations, link: np.ndarray) -> float:
    """Distance of the hinge from the link's middle, over the link's size."""
    X, _ = transport(s, obs)
    base = int(np.argmax(obs.seen[link].sum(0)))
    P = X[link & obs.seen[:, base], base]
    if len(P) < 4:
        return 0.0
    size = np.linalg.norm(np.quantile(P, 0.9, axis=0) - np.quantile(P, 0.1, axis=0))
    return float(np.median(np.linalg.norm(np.cross(P - s.point, s.axis), axis=1)) / max(size, 1e-9))


@dataclass(frozen=True)
class FreeMotion:
    """The joint against the same body moving freely.

    Attributes:
        joint_px, free_px: median residuals, working px, of the body's tracks that move most.
        unexplained: share of these tracks that follow the free body but not the joint.
    """

    joint_px: float
    free_px: float
    unexplained: float


def free_motion(s: State, obs: Observations, rounds: int = 8) -> FreeMotion | None:
    """How much better a free rigid body explains the tracks than the joint does.

    Starts from the joint's own motion and alternates pose from points (PnP on the current consensus) and
    points from poses (linear triangulation over all frames); the consensus may grow.

    Returns:
        None if too few tracks overlap to tell.
    """
    import cv2

    K = obs.seen.shape[1]
    X, _ = transport(s, obs)
    link = explained(s, obs)[1] > 0.5
    if link.sum() < 8:
        return None
    base = int(np.argmax(obs.seen[link].sum(0)))
    P = X[:, base].copy()
    poses: list[tuple[np.ndarray, np.ndarray] | None] = [_relative_pose(s, base, k) for k in range(K)]
    members = link
    for _ in range(rounds):
        for k in range(K):
            use = obs.seen[:, k] & members
            if use.sum() < 8:
                poses[k] = None
                continue
            r0, t0 = poses[k] or _relative_pose(s, base, k)
            ok, rv, tv = cv2.solvePnP(
                P[use], obs.xy[use, k], np.eye(3), None, r0.copy(), t0.copy(), True, cv2.SOLVEPNP_ITERATIVE
            )
            poses[k] = (rv, tv) if ok else None
        P = _triangulate(obs.xy, obs.seen, poses, P)
        free = _free_residuals(P, poses, obs)
        members = explained_by(free**2, obs, np.isfinite(free))[0] > 0.5
        if members.sum() < 8:
            return None
    valid = obs.seen & np.isfinite(free)
    if valid[members].sum() < 30:
        return None
    # What moves little follows any motion: the half that moves most decides.
    seen_xy = np.where(obs.seen[..., None], obs.xy, np.nan)
    extent = np.linalg.norm(np.nanmax(seen_xy, axis=1) - np.nanmin(seen_xy, axis=1), axis=-1)
    far = members & (extent >= np.median(extent[members]))
    joint2 = np.sum(reprojection(X, obs) ** 2, axis=-1)
    return FreeMotion(
        float(np.median(np.sqrt(joint2[far][valid[far]]))),
        float(np.median(free[far][valid[far]])),
        float(np.mean(~link[far])),
    )


def _free_residuals(P: np.ndarray, poses: list, obs: Observations) -> np.ndarray:
    import cv2

    free = np.full(obs.seen.shape, np.nan)
    for k, pose in enumerate(poses):
        if pose is not None:
            proj, _ = cv2.projectPoints(P, *pose, np.eye(3), None)
            free[:, k] = np.linalg.norm(proj[:, 0] - obs.xy[:, k], axis=-1) / obs.px
    return free


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
            row = xy[:, k, axis][:, None] * R[2] - R[axis]  # row . X = t_axis - x t_z
            rhs = t[axis] - xy[:, k, axis] * t[2]
            w = seen[:, k] / np.maximum((P @ R[2] + t[2]) ** 2, 1e-6)
            A += w[:, None, None] * row[:, :, None] * row[:, None, :]
            b += (w * rhs)[:, None] * row
    damp = 1e-3 * np.trace(A, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    return np.linalg.solve(A + damp + 1e-9 * np.eye(3), (b + (damp @ P[..., None])[..., 0])[..., None])[..., 0]

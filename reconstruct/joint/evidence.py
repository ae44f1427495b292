"""Evidence against a joint: motion that it leaves unexplained, and a free rigid body as the rival."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from reconstruct.joint.bundle import Observations, State, reprojection, transport
from reconstruct.joint.groups import adjust
from reconstruct.joint.paths import held
from reconstruct.joint.polish import Bundle, Sightings, noise, residuals
from reconstruct.joint.select import explained, explained_by


@dataclass(frozen=True)
class Bridged:
    """How well the joint explains the motion from one state to the next.

    Attributes:
        error: mean over the stroke of a step's prediction error over its length in the picture, each at most 1.
        supported: share of the stroke over which at least MIN_BRIDGE tracks are followed.
    """

    error: float
    supported: float


MIN_BRIDGE = 3
STEPS = 10


def bridged(b: Bundle, s: Sightings) -> Bridged:
    """The joint step by step: a body that rests, is carried away and rests again agrees with many joints at its rests.

    The stroke is cut into STEPS pieces of equal path in q (there and back count); in each piece, the displacement of
    the tracks that live through it is compared with the predicted one.
    """
    path = np.concatenate([[0], np.cumsum(np.abs(np.diff(b.q)))])
    cuts = np.unique(np.searchsorted(path, np.linspace(0, path[-1], STEPS + 1)).clip(0, len(path) - 1))
    predicted = s.uv + residuals(b, replace(s, slip=None))
    errors, lengths = [], []
    for k, m in zip(cuts[:-1], cuts[1:], strict=True):
        both = s.seen[:, k] & s.seen[:, m]
        if both.sum() < MIN_BRIDGE:
            errors.append(np.nan)
            lengths.append(path[m] - path[k])
            continue
        along = None if s.slip is None else s.slip[both, m]
        moved = held(s.uv[both, m] - s.uv[both, k], along)
        wrong = held(predicted[both, m] - predicted[both, k], along) - moved
        size = np.linalg.norm(moved, axis=-1)
        far = size >= np.median(size)
        # Two noisy ends miss each other by 1.7 standard deviations in the median.
        excess = max(float(np.median(np.linalg.norm(wrong[far], axis=-1))) - 2.5 * b.sigma, 0.0)
        errors.append(excess / max(float(np.median(size[far])), 3 * b.sigma))
        lengths.append(path[m] - path[k])
    e, w = np.array(errors), np.array(lengths)
    known = np.isfinite(e)
    if not known.any():
        return Bridged(1.0, 0.0)
    return Bridged(float(np.average(np.minimum(e[known], 1.0), weights=w[known])), float(w[known].sum() / w.sum()))


MOST_POSES, MOST_POINTS = 30, 150


def looser(b: Bundle, s: Sightings) -> float | None:
    """How many times better the joint's own points follow a body that moves freely: the ratio of the two fits' noise.

    Six numbers a pose in place of one always fit a little better; that much is taken out.

    Args:
        b: the fitted joint.  s: its observations, (n, T).

    Returns:
        About 1 where the joint says all, or None if there are too few observations.
    """
    path = np.concatenate([[0], np.cumsum(np.abs(np.diff(b.q)))])
    some = np.unique(np.searchsorted(path, np.linspace(0, path[-1], MOST_POSES)).clip(0, len(path) - 1))
    lasting = np.flatnonzero(s.seen[:, some].sum(1) >= 6)
    ids = lasting[np.unique(np.linspace(0, len(lasting) - 1, min(len(lasting), MOST_POINTS)).round().astype(int))]
    seen = s.seen[ids][:, some]
    # A pose that few points hold is bent by them.
    held = seen.sum(0) >= 6
    some, seen = some[held], seen[:, held]
    numbers, unknown = 2 * int(seen.sum()), 6 * len(some) + 3 * len(ids)
    if len(some) < 6 or numbers < 1.05 * unknown:
        return None
    focal = s.focal * float(np.exp(b.log_focal))
    R, shift = b.twist.pose(b.q[some])
    t = b.twist.anchor + shift - R @ b.twist.anchor
    if s.R is not None and s.t is not None:
        R, t = s.R[some] @ R, np.einsum("tij,tj->ti", s.R[some], t) + s.t[some]
    on_joint = np.where(seen[..., None], residuals(b, s)[ids][:, some], 0.0)
    x = np.where(seen[..., None], s.uv[ids][:, some], np.nan) / focal
    slip = None if s.slip is None else s.slip[ids][:, some]
    _, _, _, free = adjust(x, seen, R, t, b.X[ids], focal, iterations=25, slip=slip)
    fair = np.sqrt(numbers / (numbers - unknown))
    return float(noise(on_joint, seen) / max(free * fair, 1e-6))


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
            off = held(proj[:, 0] - obs.xy[:, k], None if obs.slip is None else obs.slip[:, k])
            free[:, k] = np.linalg.norm(off, axis=-1) / obs.px
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

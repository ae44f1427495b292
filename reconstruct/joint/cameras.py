"""A moving camera: the rigid motions of the static scene and of the link, and the joint between them.

Tracks of a rigid body give the camera's path relative to it, up to scale (groups.py). Of the two largest groups one is
the static scene, the other the link; the joint is the motion of one path against the other, which also gives the ratio
of their scales: linear for a hinge. Which of them rests no picture can tell: it is taken to be the one before which the
camera's path is smoother, since the path before the other has the joint's starts and stops in it as well.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from reconstruct.joint.groups import MIN_GROUP, Rigid
from reconstruct.joint.paths import held
from reconstruct.joint.polish import ROBUST_SIGMAS, Bundle, Sightings, positions, residuals, robust_loss
from reconstruct.joint.twist import Twist, skew, twist_of_joint

STILL_SHARE = 0.15
"""A camera moves if fewer tracks than this share stay where they are."""
DEGREE = 4
"""Of the polynomials that a smooth path follows."""
LEAST_RATIO = 0.05
"""Of the link's scale to the scene's that is believed of a hinge between noisy paths."""
TELLS = 10.0
"""Log-likelihood by which a path has to be smoother to be the one before the scene."""


def camera_moves(uv: np.ndarray, diagonal: float) -> bool:
    """True if hardly any track of (N, T, 2) keeps its place."""
    seen = np.isfinite(uv[..., 0])
    long = np.flatnonzero(seen.mean(1) > 0.5)
    if len(long) < 2 * MIN_GROUP:
        return False
    low, high = np.nanquantile(uv[long], [0.05, 0.95], axis=1)
    return bool(np.mean(np.linalg.norm(high - low, axis=-1) < 0.004 * diagonal) < STILL_SHARE)


def smoother_before_the_link(b: Bundle, s: Sightings) -> bool:
    """True if the camera's path before the link is clearly smoother than that before the scene.

    A path is six numbers a frame: where a point of the body is in the picture, the logarithm of its depth, and the
    turn. Roughness is what polynomials in time leave of them (an arc of a circle needs no more than the fourth degree),
    as the tracks see it: squared residuals over their noise by which they contradict that smooth path, with the states
    free. Numbers alone do not tell: a step to the side and a turn look nearly alike, and each of the two is known far
    worse than what they do together.

    Args:
        b: the fitted joint with the camera's path.  s: its sightings of link and scene.
    """
    assert b.R is not None and b.t is not None
    frames = np.arange(len(b.q)) if s.frames is None else s.frames
    time = np.interp(frames, [frames[0], frames[-1]], [-1.0, 1.0])
    basis = np.polynomial.legendre.legvander(time, min(DEGREE, len(time) - 2))
    H, by_state = _information(b, s)
    left = []
    # The camera before the link goes along with the state: what holds both is written in the one or in the other.
    for path, along in (((b.R, b.t), 0.0), (before_the_link(b.twist, b.q, b.R, b.t), by_state)):
        change = np.tile(np.eye(7), (len(b.q), 1, 1))
        change[:, :6, 6] -= along
        both = np.swapaxes(change, 1, 2) @ H @ change
        alone = both[:, :6, :6] - both[:, :6, 6:] * both[:, 6:, :6] / (both[:, 6:, 6:] + 1e-12)
        chart, slope = _chart(*path, b.twist.anchor)
        inverse = np.linalg.inv(slope)
        weight = np.swapaxes(inverse, 1, 2) @ alone @ inverse
        left.append(_left_over(chart, weight, basis))
    return left[0] - left[1] > 2 * TELLS


def _information(b: Bundle, s: Sightings) -> tuple[np.ndarray, np.ndarray]:
    """(T, 7, 7) of the camera's small turn and step and the state, in every frame, the points given; and (T, 6) the
    turn and step of the camera before the resting link that a unit of the state amounts to."""
    world, cam = positions(b, s)
    assert b.R is not None and b.t is not None and s.link is not None
    scale = ROBUST_SIGMAS * b.sigma
    w = robust_loss(residuals(b, s, cam), s, scale)[1] / b.sigma**2
    z = np.maximum(cam[..., 2], 1e-3)
    by_point = np.zeros((*cam.shape[:2], 2, 3))
    by_point[..., 0, 0] = by_point[..., 1, 1] = s.focal * np.exp(b.log_focal) / z
    by_point[..., 2] = -by_point[..., 0, :1] * cam[..., :2] / z[..., None]
    # The link's points go along by w x (x - g) + d, which is a turn w and a step d - w x g of the world they are in.
    turn = np.einsum("tij,j->ti", b.R, b.twist.curvature)
    step = np.einsum("tij,j->ti", b.R, b.twist.direction - np.cross(b.twist.curvature, b.twist.anchor))
    step += np.cross(b.t, turn)
    J = np.zeros((*cam.shape[:2], 2, 7))
    J[..., :3] = -by_point @ skew(cam)
    J[..., 3:6] = by_point
    along = np.concatenate([turn, step], axis=1)
    J[..., 6] = np.where(s.link[:, None, None], np.einsum("ntij,tj->nti", J[..., :6], along), 0.0)
    J = np.stack([held(J[..., k], s.slip) for k in range(7)], axis=-1)
    return np.einsum("nt,ntia,ntib->tab", w, J, J), along


def _chart(R: np.ndarray, t: np.ndarray, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(T, 6) of a path, and its derivatives (T, 6, 6) by a small turn and step of the camera."""

    def numbers(R: np.ndarray, t: np.ndarray) -> np.ndarray:
        p = R @ centre + t
        turn = Rotation.from_matrix(middle.T @ R).as_rotvec()
        return np.concatenate([p[:, :2] / p[:, 2:], np.log(np.maximum(p[:, 2:], 1e-6)), turn], axis=1)

    middle, h = R[len(R) // 2], 1e-6
    here, slope = numbers(R, t), np.zeros((len(R), 6, 6))
    for k in range(6):
        small = h * np.eye(6)[k]
        turned = Rotation.from_rotvec(small[:3]).as_matrix()
        slope[..., k] = (numbers(turned @ R, t @ turned.T + small[3:]) - here) / h
    return here, slope


def _left_over(path: np.ndarray, weight: np.ndarray, basis: np.ndarray) -> float:
    """Weighted squares that the best combination of the basis (T, D) leaves of a path (T, K) with weights (T, K, K)."""
    K, D = path.shape[1], basis.shape[1]
    A = np.einsum("td,te,tij->diej", basis, basis, weight).reshape(D * K, D * K)
    y = np.einsum("td,tij,tj->di", basis, weight, path).reshape(-1)
    off = path - basis @ np.linalg.lstsq(A, y, rcond=1e-12)[0].reshape(D, K)
    return float(np.einsum("ti,tij,tj->", off, weight, off))


def before_the_link(twist: Twist, q: np.ndarray, R: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The camera's path (T, 3, 3), (T, 3) with the link for the world, from that with the scene for it."""
    turn, shift = twist.pose(q)
    moved = twist.anchor + shift - np.einsum("tij,j->ti", turn, twist.anchor)
    return R @ turn, np.einsum("tij,tj->ti", R, moved) + t


def joints_between(static: Rigid, link: Rigid) -> dict[str, list[Bundle]]:
    """A hinge and slides between two camera paths: starts for the bundle adjustment, in the static body's frame.

    With X = ratio * X_link in the first camera's frame, the link moves by D_t = R_t' A_t and
    d_t = R_t' (ratio a_t - t_t). A hinge has d_t = (I - D_t) c: linear in c and the ratio, which is 1 where none is
    found. Frames that do not show both bodies have no say; their states are between those around. A slide's ratio is
    the one by which its path is straightest, or shortest: a hundredth more of the camera's path would hide a stroke of
    a hundredth.

    Args:
        static, link: the two bodies, with T frames each and in units of their own.

    Returns:
        Of each type the starts, with states (T,) and the link's (n, 3) points in the static body's units; none where
        fewer than three frames show both bodies.
    """
    both = np.flatnonzero(static.shown & link.shown)
    if len(both) < 3:
        return {}
    # Where both are in sight first the link has not moved; what is found is brought back at the end.
    begin = static.R[both[0]], static.t[both[0]]
    if both[0] > 0:
        static, link = _seen_from(static, both[0]), _seen_from(link, both[0])
    every, R = np.arange(len(static.R)), static.R[both]
    D = np.swapaxes(R, 1, 2) @ link.R[both]
    p = np.einsum("tji,tj->ti", R, link.t[both])
    s = np.einsum("tji,tj->ti", R, static.t[both])
    out: dict[str, list[Bundle]] = {}
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
    ratio = v[3]
    if ratio <= LEAST_RATIO:  # hidden by what the paths have drifted: parts of one object are about as far away
        ratio = 1.0
        v = np.linalg.lstsq(sides[:, :3] * w[:, None], (b - ratio * sides[:, 3]) * w, rcond=None)[0]
    middle = ratio * np.median(points, axis=0)
    point = v[:3] - axis * ((v[:3] - middle) @ axis)
    if np.linalg.norm(middle - point) > 1e-6:
        twist, speed = twist_of_joint("revolute", axis, point, middle)
        q = np.interp(every, both, np.unwrap(turns @ axis))
        out["revolute"] = [Bundle("revolute", twist, (q - q[0]) * speed, ratio * points)]

    def crooked(log_ratio: float) -> float:
        """By how much the link's path is no straight line: its second singular value."""
        return float(np.linalg.svd(np.exp(log_ratio) * p - s, compute_uv=False)[1])

    grid = np.linspace(np.log(0.3), np.log(3.0), 200)
    k = int(np.argmin([crooked(x) for x in grid]))
    around = grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)]
    straight = minimize_scalar(crooked, bounds=around, method="bounded").x
    short = float(np.sum(p * s) / max(np.sum(p * p), 1e-12))
    out["prismatic"] = []
    for ratio in (float(np.exp(straight)), short):
        if ratio <= 0:
            continue
        d = ratio * p - s
        along = np.linalg.svd(d)[2][0]
        q = d @ along
        if abs(q.min()) > q.max():
            along, q = -along, -q
        q = np.interp(every, both, q)
        slide = Twist(ratio * np.median(points, axis=0), along, np.zeros(3))
        out["prismatic"].append(Bundle("prismatic", slide, q - q[0], ratio * points))
    return {kind: [_before(b, *begin) for b in several] for kind, several in out.items()} if both[0] > 0 else out


def _seen_from(body: Rigid, frame: int) -> Rigid:
    """The body in the frame of another camera than its own."""
    R = body.R @ body.R[frame].T
    return replace(body, R=R, t=body.t - R @ body.t[frame], X=body.X @ body.R[frame].T + body.t[frame])


def _before(b: Bundle, R: np.ndarray, t: np.ndarray) -> Bundle:
    """A joint in a camera's frame in the world's; R (3, 3), t (3,) world to camera."""
    w = b.twist
    twist = Twist((w.anchor - t) @ R, w.direction @ R, w.curvature @ R)
    return replace(b, twist=twist, X=(b.X - t) @ R)

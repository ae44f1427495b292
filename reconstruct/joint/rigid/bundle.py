"""Joint, states, points and depth errors together: least squares over every track residual, in its noise's metric."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from reconstruct.joint.rigid.normal import OWN, normal_equations, reduced_step
from reconstruct.joint.rigid.observe import FLOOR, MOST, Noise, Observations, robust_mean
from reconstruct.joint.rigid.twist import Twist

CUT = 16.3
"""Squared residual over its noise beyond which an observation is wrong (99.9 % of three unit normals)."""


@dataclass(frozen=True)
class State:
    """A joint with everything it is estimated together with.

    Attributes:
        twist: the motion.  s: (T,) state of every frame along it, 0 in frame `anchor`.
        points: (N, 3) world, at s = 0.  field: (T, 3) coefficients of each frame's depth error.
        anchor: the frame in which s is 0 by definition.
    """

    twist: Twist
    s: np.ndarray
    points: np.ndarray
    field: np.ndarray
    anchor: int


def residuals(st: State, obs: Observations, noise: Noise) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N, T, 3) residuals over their noise (u, v, log depth; 0 where there is none), world and camera points."""
    poses = st.twist.poses(st.s)
    X, cam = np.empty((*obs.seen.shape, 3)), np.empty((*obs.seen.shape, 3))
    link, rest = obs.link, ~obs.link
    X[link], X[rest] = _carried(st.points[link], poses), st.points[rest, None]
    cam[link] = _carried(st.points[link], obs.T_camera_world @ poses)
    cam[rest] = _carried(st.points[rest], obs.T_camera_world)
    z = np.maximum(cam[..., 2], 1e-6)
    r = np.zeros(X.shape)
    focal = obs.K[[0, 1], [0, 1]]
    r[..., :2] = (cam[..., :2] / z[..., None] * focal + obs.K[:2, 2] - obs.uv) / noise.px
    r[..., 2] = (np.log(z) + np.einsum("ntk,tk->nt", obs.basis, st.field) - obs.log_depth) / noise.depth
    r[..., :2] *= obs.seen[..., None]
    r[..., 2] *= obs.ranged
    return r, X, cam


def _carried(points: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """(N, T, 3) points (N, 3) under poses (T, 4, 4): one matrix product for all frames."""
    matrix = poses[:, :3, :3].reshape(-1, 3).T
    return (points @ matrix).reshape(len(points), len(poses), 3) + poses[:, :3, 3]


def weigh(r: np.ndarray, obs: Observations, scale: float | None) -> tuple[np.ndarray, float]:
    """(N, T) weights and the cost: Geman-McClure of that scale, (None) one within CUT and zero beyond, or (inf) one."""
    r2 = np.sum(r**2, axis=-1)
    if scale == np.inf:
        return obs.seen.astype(float), float(np.sum(r2 * obs.seen))
    if scale is None:
        inside = obs.seen & (r2 < CUT)
        return inside.astype(float), float(np.sum(np.where(obs.seen, np.minimum(r2, CUT), 0.0)))
    g = scale**2 / (scale**2 + r2)
    return obs.seen * g**2, float(np.sum(obs.seen * scale**2 * (1 - g)))


def bending(st: State, obs: Observations) -> np.ndarray:
    """(T - 2,) information on second differences of the states, from how those bend that tracks tie to each other.

    Hands move things smoothly, so that states that few tracks hold, or that none ties to the others, follow their
    neighbours: there the scale is 1.5 x the 90 % quantile of the second differences. Where three tracks and more are
    seen in all three frames the tracks tell, and a hand that starts or stops at once bends sharply in few frames: the
    scale is the root mean square there, if that is more. Straight motion costs nothing, so the end points are kept.
    """
    seen = obs.seen[obs.link]
    tied = (seen[:, 2:] & seen[:, 1:-1] & seen[:, :-2]).sum(0) >= 3
    bent = np.abs(np.diff(st.s, 2))
    least = max(1e-5 * np.ptp(st.s), 1e-12)
    if tied.sum() < 5:
        # Tracks of every few frames only: how the states bend between those, per frame.
        knots = np.flatnonzero(seen.sum(0) >= 3)
        if len(knots) < 7:
            return np.broadcast_to(loose(st.s), bent.shape)
        speed = np.diff(st.s[knots]) / np.diff(knots)
        rate = 2 * np.abs(np.diff(speed)) / (knots[2:] - knots[:-2])
        return np.full(bent.shape, 1 / max(1.5 * np.quantile(rate, 0.9), least) ** 2)
    usual = max(1.5 * np.quantile(bent[tied], 0.9), least)
    sharp = max(np.sqrt(np.mean(bent[tied] ** 2)), usual)
    return 1 / np.where(tied, sharp, usual) ** 2


def bridged(st: State, obs: Observations) -> State:
    """The state with stretches of frames that no three tracks tie to each other set to go on at their common speed.

    Shifting the states of a stretch and turning its points back is a valley that bends: least squares creeps along it.
    """
    seen = obs.seen[obs.link]
    first = np.where(seen.any(1), seen.argmax(1), obs.seen.shape[1])
    last = np.where(seen.any(1), obs.seen.shape[1] - 1 - seen[:, ::-1].argmax(1), -1)
    gaps = np.arange(obs.seen.shape[1] - 1)
    open_ = ((first[:, None] <= gaps) & (last[:, None] > gaps)).sum(0) < 3
    s, points = st.s.copy(), st.points.copy()
    rows = np.flatnonzero(obs.link)
    for run in np.split(np.flatnonzero(open_), np.flatnonzero(np.diff(np.flatnonzero(open_)) > 1) + 1):
        if len(run) == 0 or run[0] < 2 or run[-1] + 3 >= len(s):
            continue  # nothing before or behind it: the prior alone carries on
        a, b = int(run[0]), int(run[-1]) + 1  # last frame before, first frame behind
        back, ahead = min(a, 3), min(len(s) - 1 - b, 3)
        speed = ((s[a] - s[a - back]) / back + (s[b + ahead] - s[b]) / ahead) / 2
        shift = s[a] + speed * (b - a) - s[b]
        # The side without the anchor moves.
        if st.anchor <= a:
            side, move = slice(b, None), first > a
        else:
            side, move, shift = slice(None, a + 1), last < b, -shift
        s[side] += shift
        pose = st.twist.poses(np.array([-shift]))[0]
        which = rows[move & seen.any(1)]
        points[which] = points[which] @ pose[:3, :3].T + pose[:3, 3]
        s[a : b + 1] = np.linspace(s[a], s[b], b - a + 1)
    return replace(st, s=s, points=points)


def loose(s: np.ndarray) -> float:
    """A prior on second differences that only fills gaps: ten times the whole range."""
    return float(1e-2 / max(np.ptp(s), 1e-9) ** 2)


def refine(st: State, obs: Observations, noise: Noise, scale: float | None, iterations: int = 10,
           stiff: np.ndarray | float | None = None, tolerance: float = 1e-5) -> tuple[State, float]:  # fmt: skip
    """Levenberg-Marquardt with one robust kernel; returns the state and its cost (without the states' prior)."""
    stiff = loose(st.s) if stiff is None else stiff
    d = st.twist.basis().shape[1]
    rows = d + OWN * np.arange(len(st.s))
    r, X, cam = residuals(st, obs, noise)
    w, cost = weigh(r, obs, scale)
    cost += prior(st, noise, stiff)
    damping = 1e-4
    for _ in range(iterations):
        n = normal_equations(st, obs, noise, r, X, cam, w, stiff)
        better = False
        for _ in range(4):
            step, dp = reduced_step(n, damping, d + OWN * st.anchor)
            twist, factor = st.twist.moved(step[:d])
            s = (st.s + step[rows]) * factor
            field = st.field + np.stack([step[rows + 1 + k] for k in range(3)], axis=-1)
            trial = State(twist, s, st.points + dp, field, st.anchor)
            rt, Xt, camt = residuals(trial, obs, noise)
            wt, ct = weigh(rt, obs, scale)
            ct += prior(trial, noise, stiff)
            if ct <= cost:
                better = ct < cost * (1 - tolerance)
                st, r, X, cam, w, cost = trial, rt, Xt, camt, wt, ct
                damping = max(damping / 10, 1e-9)
                break
            damping *= 20
        if not better:
            break
    return st, cost - prior(st, noise, stiff) + prior(st, noise, 0.0)


def prior(st: State, noise: Noise, stiff: np.ndarray | float) -> float:
    """What the depth errors and the bending of the states cost."""
    return float(np.sum((st.field / noise.field) ** 2) + np.sum(stiff * np.diff(st.s, 2) ** 2))


def points_of(st: State, obs: Observations) -> State:
    """The state with its points where its own motion carries them all to (robust means of lifted points)."""
    world = obs.lift(st.field)
    poses = st.twist.poses(st.s)
    back = np.einsum("tji,ntj->nti", poses[:, :3, :3], world - poses[:, :3, 3])
    return replace(st, points=robust_mean(np.where(obs.link[:, None, None], back, world)))


def estimate_noise(r: np.ndarray, st: State, obs: Observations, noise: Noise) -> Noise:
    """Noise from the residuals of what agrees (median absolute deviations), never more than MOST."""
    r2 = np.sum(r**2, axis=-1)
    good = obs.seen & (r2 < 4 * CUT)
    if good.sum() < 50:
        return noise
    # A point takes three degrees of freedom from its own residuals.
    seen = good.sum(1)
    give = np.sqrt(seen.sum() * 3 / max((seen * 3 - 3).clip(0).sum() - OWN * obs.seen.shape[1], 1.0))
    mad = lambda x: 1.4826 * float(np.median(np.abs(x)))  # noqa: E731
    px = min(give * noise.px * mad(r[..., :2][good]), MOST.px)
    depth, field = noise.depth, noise.field
    with_depth = good & obs.ranged
    if with_depth.sum() > 50:
        depth = min(noise.depth * mad(r[..., 2][with_depth]), MOST.depth)
        field = min(float(np.sqrt(np.mean(st.field**2))) * 1.1, MOST.field)
    return Noise(max(px, FLOOR.px), max(depth, FLOOR.depth), max(field, FLOOR.field))

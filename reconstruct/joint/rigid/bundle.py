"""Joint, states, points and depth errors together: least squares over every track residual, in its noise's metric."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from reconstruct.joint.rigid.observe import FLOOR, MOST, Noise, Observations, robust_mean
from reconstruct.joint.rigid.twist import Twist, skew

OWN = 4
"""Unknowns of each frame: the state and three coefficients of its depth error."""
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


@dataclass(frozen=True)
class Normal:
    """Normal equations with the points still in them.

    Attributes:
        H: (P, P), g: (P,) of joint (d) and frames (4 each).  Hpp: (N, 3, 3), gp: (N, 3) of the points.
        L: (P, N, 3) coupling.
    """

    H: np.ndarray
    g: np.ndarray
    Hpp: np.ndarray
    gp: np.ndarray
    L: np.ndarray


def residuals(st: State, obs: Observations, noise: Noise) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N, T, 3) residuals over their noise (u, v, log depth; 0 where there is none), world and camera points."""
    poses = st.twist.poses(st.s)
    moved = np.einsum("tij,nj->nti", poses[:, :3, :3], st.points) + poses[:, :3, 3]
    X = np.where(obs.link[:, None, None], moved, st.points[:, None])
    cam = np.einsum("tij,ntj->nti", obs.T_camera_world[:, :3, :3], X) + obs.T_camera_world[:, :3, 3]
    z = np.maximum(cam[..., 2], 1e-6)
    r = np.zeros(X.shape)
    focal = obs.K[[0, 1], [0, 1]]
    r[..., :2] = (cam[..., :2] / z[..., None] * focal + obs.K[:2, 2] - obs.uv) / noise.px
    r[..., 2] = (np.log(z) + np.einsum("ntk,tk->nt", obs.basis, st.field) - obs.log_depth) / noise.depth
    r[..., :2] *= obs.seen[..., None]
    r[..., 2] *= obs.ranged
    return r, X, cam


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


def bending(s: np.ndarray) -> float:
    """Information on a second difference of the states, from how they bend: 1 / (1.5 x the 90 % quantile)^2.

    Hands move things smoothly, so that states that few tracks hold, or that none ties to the others, follow their
    neighbours. Straight motion costs nothing, so the end points are kept.
    """
    if len(s) < 5:
        return 0.0
    return float(1 / max(1.5 * np.quantile(np.abs(np.diff(s, 2)), 0.9), 1e-5 * np.ptp(s), 1e-12) ** 2)


def loose(s: np.ndarray) -> float:
    """A prior on second differences that only fills gaps: ten times the whole range."""
    return float(1e-2 / max(np.ptp(s), 1e-9) ** 2)


def normal_equations(st: State, obs: Observations, noise: Noise, r, X, cam, w, stiff: float) -> Normal:
    """Analytic Jacobians, all frames at once; `stiff` is the information on second differences of the states."""
    N, T = obs.seen.shape
    z = np.maximum(cam[..., 2], 1e-6)
    fx, fy = obs.K[0, 0], obs.K[1, 1]
    P = np.zeros((N, T, 3, 3))
    P[..., 0, 0], P[..., 1, 1] = fx / z / noise.px, fy / z / noise.px
    P[..., 0, 2], P[..., 1, 2] = -fx * cam[..., 0] / z**2 / noise.px, -fy * cam[..., 1] / z**2 / noise.px
    P[..., 2, 2] = obs.ranged / z / noise.depth
    P *= np.sqrt(w)[..., None, None]
    r = r * np.sqrt(w)[..., None]
    W = np.einsum("ntij,tjk->ntik", P, obs.T_camera_world[:, :3, :3], optimize=True)
    link = obs.link
    C = np.array(W)
    turn = st.twist.poses(st.s)[:, :3, :3]
    C[link] = np.einsum("ntij,tjk->ntik", W[link], turn, optimize=True)
    # A joint's step moves world points by a twist of each frame about the origin; so does the frame's own state.
    to_frame = st.twist.spatial_jacobian(st.s) @ st.twist.basis()  # (T, 6, d)
    d = to_frame.shape[-1]
    six = np.concatenate([to_frame, np.broadcast_to(st.twist.xi[None, :, None], (T, 6, 1))], axis=-1)
    Y = np.concatenate([-skew(X[link] - st.twist.origin), np.broadcast_to(np.eye(3), (*X[link].shape, 3))], axis=-1)
    A = W[link] @ (Y @ six)  # (links, T, 3, d + 1)
    size = d + OWN * T
    H, g = np.zeros((size, size)), np.zeros(size)
    F = obs.basis / noise.depth * (np.sqrt(w) * obs.ranged)[..., None]  # of the third residual only
    L = np.zeros((size, N, 3))
    rl = r[link]
    H[:d, :d] = np.einsum("ntig,ntih->gh", A[..., :d], A[..., :d], optimize=True)
    g[:d] = np.einsum("ntig,nti->g", A[..., :d], rl, optimize=True)
    own = np.zeros((T, OWN, OWN))
    own[:, 0, 0] = np.einsum("nti,nti->t", A[..., d], A[..., d])
    own[:, 1:, 1:] = np.einsum("ntk,ntl->tkl", F, F, optimize=True) + np.eye(3) / noise.field**2
    own[:, 0, 1:] = np.einsum("nt,ntk->tk", A[:, :, 2, d], F[link], optimize=True)
    own[:, 1:, 0] = own[:, 0, 1:]
    cross = np.zeros((T, d, OWN))
    cross[..., 0] = np.einsum("ntig,nti->tg", A[..., :d], A[..., d], optimize=True)
    cross[..., 1:] = np.einsum("ntg,ntk->tgk", A[:, :, 2, :d], F[link], optimize=True)
    rows = d + OWN * np.arange(T)
    g[rows] = np.einsum("nti,nti->t", A[..., d], rl)
    for k in range(OWN):
        H[:d, rows + k] = cross[..., k].T
        for m in range(OWN):
            H[rows + k, rows + m] = own[:, k, m]
    H[d:, :d] = H[:d, d:].T
    by_field = np.einsum("ntk,nt->tk", F, r[..., 2], optimize=True) + st.field / noise.field**2
    for k in range(3):
        g[rows + 1 + k] = by_field[:, k]
        L[rows + 1 + k] = np.swapaxes(F[..., k, None] * C[..., 2, :], 0, 1)
    L[:d, link] = np.einsum("ntig,ntik->gnk", A[..., :d], C[link], optimize=True)
    L[np.ix_(rows, np.flatnonzero(link))] = np.einsum("nti,ntik->tnk", A[..., d], C[link], optimize=True)
    Hpp = np.einsum("ntij,ntik->njk", C, C, optimize=True)
    gp = np.einsum("ntij,nti->nj", C, r, optimize=True)
    if T > 2 and stiff > 0:
        D2 = np.diff(np.eye(T), 2, axis=0)
        bend = stiff * (D2.T @ D2)
        H[np.ix_(rows, rows)] += bend
        g[rows] += bend @ st.s
    return Normal(H, g, Hpp, gp, L)


def reduced(n: Normal, damping: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points eliminated: (P, P) information, (P,) gradient, (N, 3, 3) inverse of the points' blocks."""
    trace = np.trace(n.Hpp, axis1=1, axis2=2)
    Hpp = n.Hpp + (damping * np.einsum("nii->ni", n.Hpp)[:, :, None] + 1e-9 * (trace + 1e-9)[:, None, None]) * np.eye(3)
    inverse = np.linalg.inv(Hpp)
    size = len(n.g)
    left = np.einsum("anj,njk->ank", n.L, inverse, optimize=True).reshape(size, -1)
    S = n.H + damping * np.diag(np.diag(n.H)) - left @ n.L.reshape(size, -1).T
    return S, n.g - left @ n.gp.ravel(), inverse


def solve(S: np.ndarray, g: np.ndarray, fixed: int) -> np.ndarray:
    """Step of the reduced system with one unknown held."""
    free = np.ones(len(g), bool)
    free[fixed] = False
    scale = 1 / np.sqrt(np.maximum(np.diag(S)[free], 1e-30))
    A = S[np.ix_(free, free)] * scale[:, None] * scale + 1e-12 * np.eye(free.sum())
    out = np.zeros(len(g))
    out[free] = -scale * np.linalg.solve(A, scale * g[free])
    return out


def refine(st: State, obs: Observations, noise: Noise, scale: float | None, iterations: int = 10,
           stiff: float | None = None, tolerance: float = 1e-5) -> tuple[State, float]:  # fmt: skip
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
            S, g, inverse = reduced(n, damping)
            step = solve(S, g, d + OWN * st.anchor)
            dp = -np.einsum("njk,nk->nj", inverse, n.gp + np.einsum("anj,a->nj", n.L, step, optimize=True))
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


def prior(st: State, noise: Noise, stiff: float) -> float:
    """What the depth errors and the bending of the states cost."""
    return float(np.sum((st.field / noise.field) ** 2) + stiff * np.sum(np.diff(st.s, 2) ** 2))


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

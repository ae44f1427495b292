"""Joint bundle adjustment: one axis, one pivot, one q_t for all tracks of all reference frames.

Unknown: the joint (revolute: axis direction and pivot, prismatic: direction), the state in every key
frame and each track's depth. Every track's depth is eliminated by the Schur complement, so that a step
costs a small dense solve. Residuals are robust (Geman-McClure with a shrinking scale: graduated
non-convexity, Yang et al. 2020), so shadows, sliding edge points and hands drop out by themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruct.joint.hypotheses import perpendicular_basis
from reconstruct.joint.paths import held


@dataclass(frozen=True)
class Observations:
    """Tracks in key frames.

    Attributes:
        xy: (N, K, 2) normalised image coordinates (0 where not seen).
        seen: (N, K) bool.
        ref: (N,) key frame whose ray carries the track's depth.
        weight: (N,) weight of each track.
        px: ray units per working px (1 / focal in working px).
        frames: (K,) frame numbers.
        slip: (N, K, 2) along what the picture holds badly, see paths.py; None if there is none.
    """

    xy: np.ndarray
    seen: np.ndarray
    ref: np.ndarray
    weight: np.ndarray
    px: float
    frames: np.ndarray
    slip: np.ndarray | None = None

    def of(self, tracks: np.ndarray) -> Observations:
        """Of some of the tracks."""
        slip = None if self.slip is None else self.slip[tracks]
        return replace(self, xy=self.xy[tracks], seen=self.seen[tracks], ref=self.ref[tracks],
                       weight=self.weight[tracks], slip=slip)  # fmt: skip

    @property
    def ref_rays(self) -> np.ndarray:
        """(N, 3) rays in each track's own reference key frame."""
        xy = self.xy[np.arange(len(self.ref)), self.ref]
        return np.concatenate([xy, np.ones((len(xy), 1))], axis=1)


@dataclass(frozen=True)
class State:
    """A joint with states and depths, camera frame, up to scale.

    Attributes:
        kind: "revolute" or "prismatic".
        axis: (3,).  point: (3,), unit length and perpendicular to the axis; zeros if prismatic.
        q: (K,) state in every key frame (rad, or length).
        depth: (N,) depth of each track on its reference ray.
        cost: robust cost, px^2 units.
        rms: (N,) root mean square reprojection error of each track, working px.
    """

    kind: str
    axis: np.ndarray
    point: np.ndarray
    q: np.ndarray
    depth: np.ndarray
    cost: float = np.inf
    rms: np.ndarray | None = None


def transport(s: State, obs: Observations) -> tuple[np.ndarray, np.ndarray]:
    """Points of all tracks in all key frames.

    Returns:
        (N, K, 3) positions in the camera frame, and (N, K, 3) derivatives by depth.
    """
    rays = obs.ref_rays
    if s.kind == "prismatic":
        X = (s.depth[:, None] * rays)[:, None] + ((s.q[None, :] - s.q[obs.ref][:, None])[..., None] * s.axis)
        return X, np.broadcast_to(rays[:, None], X.shape)
    dq = s.q[None, :] - s.q[obs.ref][:, None]  # (N, K)
    cos, sin = np.cos(dq)[..., None], np.sin(dq)[..., None]
    a, c = s.axis, s.point

    def rotate(v: np.ndarray) -> np.ndarray:  # (N, 3) -> (N, K, 3), Rodrigues
        along = (v @ a)[:, None, None] * a
        return along + cos * (v[:, None] - along) + sin * np.cross(a, v)[:, None]

    D = rotate(rays)
    X = s.depth[:, None, None] * D + c - rotate(np.broadcast_to(c, rays.shape))
    return X, D


def reprojection(X: np.ndarray, obs: Observations) -> np.ndarray:
    """(N, K, 2) residuals in working px, as far as the picture holds them; 0 where not seen."""
    z = np.maximum(X[..., 2:], 1e-3)
    r = held((X[..., :2] / z - obs.xy) / obs.px, obs.slip)
    behind = X[..., 2] < 1e-3
    r = np.where(behind[..., None], 1e3, r)
    return np.where(obs.seen[..., None], r, 0.0)


def solve_depths(s: State, obs: Observations, sweeps: int = 2, scale: float = 4.0) -> State:
    """Best depth of each track for a given joint and states (robust, linear in the depth)."""
    one = replace(s, depth=np.ones(len(obs.ref)))
    X1, D = transport(one, obs)
    C = X1 - D  # X = depth * D + C
    xy = obs.xy
    # x * (depth Dz + Cz) = depth Dx + Cx, and the same for y
    A = held(D[..., :2] - xy * D[..., 2:], obs.slip)
    b = held(xy * C[..., 2:] - C[..., :2], obs.slip)
    w = obs.seen.astype(float)
    lam = np.ones(len(obs.ref))
    for k in range(sweeps + 1):
        ww = w[..., None]
        lam = np.sum(ww * A * b, axis=(1, 2)) / (np.sum(ww * A * A, axis=(1, 2)) + 1e-12)
        lam = np.clip(lam, 0.02, 50.0)
        z = np.maximum(lam[:, None] * D[..., 2] + C[..., 2], 1e-3)
        r2 = np.sum((lam[:, None, None] * A - b) ** 2, axis=-1) / (z * obs.px) ** 2
        w = obs.seen / z**2 / (1 + r2 / (scale * (4.0 if k == 0 else 1.0)) ** 2) ** 2
    return replace(s, depth=lam)


def robust_cost(r: np.ndarray, obs: Observations, scale: float) -> tuple[float, np.ndarray]:
    """Geman-McClure cost over all observations and its IRLS weights (N, K)."""
    r2 = np.sum(r**2, axis=-1)
    g = scale**2 / (scale**2 + r2)
    rho = scale**2 * (1 - g)
    w = obs.weight[:, None] * obs.seen
    return float(np.sum(w * rho)), w * g**2


def refine(
    s: State, obs: Observations, scales: tuple[float, ...] = (8.0, 4.0, 2.0), iterations: int = 12, smooth: float = 0.02
) -> State:
    """Levenberg-Marquardt over joint, states and depths with a shrinking robust scale (working px).

    Args:
        smooth: weight of second differences of q relative to an observation's weight.
    """
    N, K = obs.seen.shape
    second = _second_difference(obs.frames)
    range_q = max(np.ptp(s.q), 1e-3)
    for scale in scales:
        damping = 1e-3
        X, D = transport(s, obs)
        r = reprojection(X, obs)
        cost, w = robust_cost(r, obs, scale)
        prior = smooth * obs.weight.sum() * scale**2 / range_q**2 * (second.T @ second)
        cost += float(s.q @ prior @ s.q)
        for _ in range(iterations):
            Hm, g, Hll, Hgl, gl = normal_equations(s, obs, X, D, r, w)
            Hm[-K:, -K:] += prior
            g[-K:] += prior @ s.q
            improved = False
            for _ in range(4):
                dl = Hll * (1 + damping) + 1e-12
                S = Hm + damping * np.diag(np.diag(Hm) + 1e-9) - (Hgl / dl) @ Hgl.T
                rhs = -(g - Hgl @ (gl / dl))
                try:
                    step = np.linalg.solve(S + 1e-10 * np.trace(S) / len(S) * np.eye(len(S)), rhs)
                except np.linalg.LinAlgError:
                    damping *= 10
                    continue
                depth = s.depth + np.clip(-(gl + Hgl.T @ step) / dl, -0.5 * s.depth, s.depth)
                trial = _apply(s, step, depth, K)
                Xt, Dt = transport(trial, obs)
                rt = reprojection(Xt, obs)
                ct, wt = robust_cost(rt, obs, scale)
                ct += float(trial.q @ prior @ trial.q)
                if ct < cost:
                    improved = ct < cost * (1 - 1e-6)
                    s, X, D, r, w, cost = trial, Xt, Dt, rt, wt, ct
                    damping = max(damping / 5, 1e-7)
                    break
                damping *= 8
            if not improved:
                break
    r2 = np.sum(r**2, axis=-1)
    rms = np.sqrt(r2.sum(1) / np.maximum(obs.seen.sum(1), 1))
    return replace(s, cost=cost, rms=rms)


def _second_difference(frames: np.ndarray) -> np.ndarray:
    """(K-2, K) second differences for uneven frame spacing, in units of the mean spacing."""
    f = frames / max(np.mean(np.diff(frames)), 1e-9)
    K = len(f)
    D = np.zeros((max(K - 2, 0), K))
    for k in range(1, K - 1):
        h0, h1 = f[k] - f[k - 1], f[k + 1] - f[k]
        D[k - 1, k - 1 : k + 2] = np.array([2 / (h0 * (h0 + h1)), -2 / (h0 * h1), 2 / (h1 * (h0 + h1))])
    return D


def _apply(s: State, step: np.ndarray, depth: np.ndarray, K: int) -> State:
    """A step in the joint's tangent coordinates; the gauges (|point| = 1, q[0] fixed) are kept."""
    q = s.q + step[-K:]
    basis = perpendicular_basis(s.axis)
    turn = basis @ step[:2]
    if s.kind == "prismatic":
        axis = s.axis + turn
        axis /= np.linalg.norm(axis)
        # Gauge: the median depth stays 1.
        f = np.median(depth)
        return replace(s, axis=axis, q=(q - q[0]) / f, depth=depth / f)
    R = Rotation.from_rotvec(turn).as_matrix()
    axis, point = R @ s.axis, R @ s.point
    point = Rotation.from_rotvec(axis * step[2]).as_matrix() @ point
    point = point - (point @ axis) * axis
    return replace(s, axis=axis, point=point / np.linalg.norm(point), q=q - q[0], depth=depth)


def normal_equations(s: State, obs: Observations, X, D, r, w):
    """Gauss-Newton blocks: (joint, q) dense part, per-track depth part, coupling."""
    N, K = obs.seen.shape
    z = np.maximum(X[..., 2], 1e-3)

    def image(dX: np.ndarray) -> np.ndarray:  # (N, K, 3) -> (N, K, 2) px
        return held((dX[..., :2] - X[..., :2] / z[..., None] * dX[..., 2:]) / z[..., None] / obs.px, obs.slip)

    Jl = image(D)
    if s.kind == "prismatic":
        dq = (s.q[None, :] - s.q[obs.ref][:, None])[..., None]
        basis = perpendicular_basis(s.axis)
        Jg = [image(dq * basis[:, k]) for k in range(2)]
        Jq = image(np.broadcast_to(s.axis, X.shape))
    else:
        # Derivatives by the joint are numerical (three of them): the analytic ones are long and no faster.
        Jg = []
        h = 1e-5
        for k in range(3):
            step = np.zeros(3 + K)
            step[k] = h
            Xk, _ = transport(_apply(s, step, s.depth, K), obs)
            Jg.append(image((Xk - X) / h))
        Jq = image(np.cross(s.axis, X - s.point))
    G = len(Jg)
    J = np.stack(Jg, axis=-1)  # (N, K, 2, G)
    P = G + K
    H, g = np.zeros((P, P)), np.zeros(P)
    wJ = w[..., None, None] * J
    H[:G, :G] = np.einsum("nkig,nkih->gh", wJ, J)
    g[:G] = np.einsum("nkig,nki->g", wJ, r)
    # q enters twice: + in the observed frame, - in the reference frame (the derivative of the relative angle).
    wJq = w[..., None] * Jq
    qq = np.sum(wJq * Jq, axis=-1)  # (N, K)
    qr = np.sum(wJq * r, axis=-1)
    gq = np.einsum("nkig,nki->nkg", wJ, Jq)  # (N, K, G)
    lq = np.sum(w[..., None] * Jl * Jq, axis=-1)  # (N, K)
    own = np.zeros((N, K))
    own[np.arange(N), obs.ref] = 1.0
    H[G:, G:] = np.diag(qq.sum(0)) - qq.T @ own - own.T @ qq + own.T @ (qq.sum(1)[:, None] * own)
    H[:G, G:] = gq.sum(0).T - gq.sum(1).T @ own
    H[G:, :G] = H[:G, G:].T
    g[G:] = qr.sum(0) - own.T @ qr.sum(1)
    Hll = np.einsum("nk,nki,nki->n", w, Jl, Jl)
    gl = np.einsum("nk,nki,nki->n", w, Jl, r)
    Hgl = np.zeros((P, N))
    Hgl[:G] = np.einsum("nkig,nki->gn", wJ, Jl)
    Hgl[G:] = lq.T - (own * lq.sum(1)[:, None]).T
    return H, g, Hll, Hgl, gl

"""Joint bundle adjustment: one axis, one pivot, one q_t for all tracks of all reference frames.

Unknown: the joint (revolute: axis direction and pivot, prismatic: direction), the state in every key
frame and each track's depth. Every track's depth is eliminated by the Schur complement, so that a step
costs a small dense solve. Residuals are robust (Geman-McClure with a shrinking scale: graduated
non-convexity, Yang et al. 2020), so shadows, sliding edge points and hands drop out by themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
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
    X, D = np.empty((*obs.seen.shape, 3)), np.empty((*obs.seen.shape, 3))
    _carried(rays, s.depth, s.q, obs.ref, s.axis, s.point, X, D)
    return X, D


@njit(cache=True, nogil=True, inline="always")
def _turned(v0: float, v1: float, v2: float, a: np.ndarray, cos: float, sin: float) -> tuple[float, float, float]:
    """A vector turned about an axis (Rodrigues)."""
    along = (1.0 - cos) * (v0 * a[0] + v1 * a[1] + v2 * a[2])
    return (along * a[0] + cos * v0 + sin * (a[1] * v2 - a[2] * v1),
            along * a[1] + cos * v1 + sin * (a[2] * v0 - a[0] * v2),
            along * a[2] + cos * v2 + sin * (a[0] * v1 - a[1] * v0))  # fmt: skip


@njit(cache=True, nogil=True)
def _carried(rays: np.ndarray, depth: np.ndarray, q: np.ndarray, ref: np.ndarray, a: np.ndarray, c: np.ndarray,
             X: np.ndarray, D: np.ndarray) -> None:  # fmt: skip
    """Points that turn about an axis a through c, and their derivatives by depth, (N, K, 3)."""
    for n in range(X.shape[0]):
        for k in range(X.shape[1]):
            dq = q[k] - q[ref[n]]
            cos, sin = np.cos(dq), np.sin(dq)
            d = _turned(rays[n, 0], rays[n, 1], rays[n, 2], a, cos, sin)
            p = _turned(c[0], c[1], c[2], a, cos, sin)
            for i in range(3):
                D[n, k, i] = d[i]
                X[n, k, i] = depth[n] * d[i] + c[i] - p[i]


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
    h = 1e-5
    if s.kind == "prismatic":
        moved, still = perpendicular_basis(s.axis).T, np.zeros((2, 3))
    else:
        # Derivatives by the joint are numerical (three of them): the analytic ones are long and no faster.
        steps = [_apply(s, np.concatenate([h * one, np.zeros(K)]), s.depth, K) for one in np.eye(3)]
        moved, still = np.array([x.axis for x in steps]), np.array([x.point for x in steps])
    G = len(moved)
    H, g, Hll, gl, Hgl = np.zeros((G + K, G + K)), np.zeros(G + K), np.zeros(N), np.zeros(N), np.zeros((G + K, N))
    slip = np.zeros((0, 0, 2)) if obs.slip is None else obs.slip
    _sum(np.asarray(X), np.ascontiguousarray(D), r, w, slip, obs.ref_rays, s.depth, s.q, obs.ref, s.axis, s.point,
         np.ascontiguousarray(moved), still, s.kind == "prismatic", h, 1 / obs.px, H, g, Hll, gl, Hgl)  # fmt: skip
    return np.triu(H) + np.triu(H, 1).T, g, Hll, Hgl, gl


@njit(cache=True, nogil=True)
def _sum(X: np.ndarray, D: np.ndarray, r: np.ndarray, w: np.ndarray, slip: np.ndarray, rays: np.ndarray,
         depth: np.ndarray, q: np.ndarray, ref: np.ndarray, axis: np.ndarray, point: np.ndarray, moved: np.ndarray,
         still: np.ndarray, slides: bool, h: float, f: float, H: np.ndarray, g: np.ndarray, Hll: np.ndarray,
         gl: np.ndarray, Hgl: np.ndarray) -> None:  # fmt: skip
    """Into H's upper half, g, Hll, gl and Hgl.

    Args:
        moved, still: (G, 3) axes and points a step h of the joint's parameters away; of a slide, its axis' tangents.
    """
    G = len(moved)
    J, Jq, Jl, d = np.zeros((2, G)), np.zeros(2), np.zeros(2), np.zeros(3)
    for n in range(X.shape[0]):
        own = ref[n]
        for k in range(X.shape[1]):
            wt = w[n, k]
            if wt == 0.0:
                continue
            z = max(X[n, k, 2], 1e-3)
            x0, x1 = X[n, k, 0] / z, X[n, k, 1] / z
            u0, u1 = 0.0, 0.0
            if slip.shape[0] > 0:
                u0, u1 = slip[n, k, 0], slip[n, k, 1]
            dq = q[k] - q[own]
            cos, sin = np.cos(dq), np.sin(dq)
            for j in range(G + 2):
                if j == G + 1:
                    for i in range(3):
                        d[i] = D[n, k, i]
                elif slides:
                    for i in range(3):
                        d[i] = axis[i] if j == G else dq * moved[j, i]
                elif j == G:
                    y0, y1, y2 = X[n, k, 0] - point[0], X[n, k, 1] - point[1], X[n, k, 2] - point[2]
                    d[0] = axis[1] * y2 - axis[2] * y1
                    d[1] = axis[2] * y0 - axis[0] * y2
                    d[2] = axis[0] * y1 - axis[1] * y0
                else:
                    v = _turned(rays[n, 0], rays[n, 1], rays[n, 2], moved[j], cos, sin)
                    p = _turned(still[j, 0], still[j, 1], still[j, 2], moved[j], cos, sin)
                    for i in range(3):
                        d[i] = (depth[n] * v[i] + still[j, i] - p[i] - X[n, k, i]) / h
                e0, e1 = (d[0] - x0 * d[2]) / z * f, (d[1] - x1 * d[2]) / z * f
                along = u0 * e0 + u1 * e1
                e0 -= u0 * along
                e1 -= u1 * along
                if j < G:
                    J[0, j], J[1, j] = e0, e1
                elif j == G:
                    Jq[0], Jq[1] = e0, e1
                else:
                    Jl[0], Jl[1] = e0, e1
            e0, e1 = wt * r[n, k, 0], wt * r[n, k, 1]
            # q enters twice: + in the observed frame, - in the reference frame (of the relative angle).
            for j in range(G):
                s0, s1 = wt * J[0, j], wt * J[1, j]
                g[j] += J[0, j] * e0 + J[1, j] * e1
                for m in range(j, G):
                    H[j, m] += s0 * J[0, m] + s1 * J[1, m]
                both = s0 * Jq[0] + s1 * Jq[1]
                H[j, G + k] += both
                H[j, G + own] -= both
                Hgl[j, n] += s0 * Jl[0] + s1 * Jl[1]
            qq, qr = wt * (Jq[0] * Jq[0] + Jq[1] * Jq[1]), Jq[0] * e0 + Jq[1] * e1
            lq = wt * (Jl[0] * Jq[0] + Jl[1] * Jq[1])
            if k != own:
                H[G + k, G + k] += qq
                H[G + own, G + own] += qq
                H[G + min(k, own), G + max(k, own)] -= qq
                g[G + k] += qr
                g[G + own] -= qr
                Hgl[G + k, n] += lq
                Hgl[G + own, n] -= lq
            Hll[n] += wt * (Jl[0] * Jl[0] + Jl[1] * Jl[1])
            gl[n] += Jl[0] * e0 + Jl[1] * e1

"""The normal equations of the bundle and their solution, at a cost linear in tracks and frames.

Unknowns are the joint (d), each frame's own (its state and its depth error) and each track's point. Points are
eliminated exactly. What is left is dense: small problems are factorised, large ones solved by conjugate gradients that
never form it, with the frames' diagonal blocks and the joint's border as preconditioner.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from reconstruct.joint.rigid.observe import Noise, Observations
from reconstruct.joint.rigid.twist import skew

if TYPE_CHECKING:
    from reconstruct.joint.rigid.bundle import State

OWN = 4
"""Unknowns of each frame: the state and three coefficients of its depth error."""
CHUNK = 40_000
"""Observations whose derivatives are held at a time."""
DENSE_FRAMES = 200
"""Up to so many frames the reduced system is factorised."""


@dataclass(frozen=True)
class Normal:
    """Normal equations with the points still in them; unknowns in the order joint, then frame by frame.

    Attributes:
        joint: (d, d).  cross: (T, d, 4).  own: (T, 4, 4).
        stiff: (T - 2,) information on second differences of the states.
        g: (d + 4 T,).  Hpp: (N, 3, 3), gp: (N, 3) of the points.
        Lj: (N, d, 3), Lt: (N, T, 4, 3) couplings of the points with joint and frames.
    """

    joint: np.ndarray
    cross: np.ndarray
    own: np.ndarray
    stiff: np.ndarray
    g: np.ndarray
    Hpp: np.ndarray
    gp: np.ndarray
    Lj: np.ndarray
    Lt: np.ndarray

    @property
    def d(self) -> int:
        return len(self.joint)

    @property
    def frames(self) -> int:
        return len(self.own)

    def dense(self) -> np.ndarray:
        """(P, P) information of joint and frames."""
        d, T = self.d, self.frames
        H = np.zeros((d + OWN * T, d + OWN * T))
        H[:d, :d] = self.joint
        H[:d, d:] = self.cross.transpose(1, 0, 2).reshape(d, -1)
        H[d:, :d] = H[:d, d:].T
        H[d:, d:].reshape(T, OWN, T, OWN)[np.arange(T), :, np.arange(T)] = self.own
        if T > 2:
            D2 = np.diff(np.eye(T), 2, axis=0)
            rows = d + OWN * np.arange(T)
            H[np.ix_(rows, rows)] += D2.T @ (self.stiff[:, None] * D2)
        return H

    def coupling(self) -> np.ndarray:
        """(P, N, 3)."""
        N = len(self.Lj)
        return np.concatenate([self.Lj, self.Lt.reshape(N, -1, 3)], axis=1).transpose(1, 0, 2)

    def times(self, x: np.ndarray) -> np.ndarray:
        """(P,) the information times x."""
        d, T = self.d, self.frames
        xj, xt = x[:d], x[d:].reshape(T, OWN)
        out_t = np.einsum("tpq,tq->tp", self.own, xt) + np.einsum("tdp,d->tp", self.cross, xj)
        if T > 2:
            bend = self.stiff * np.diff(xt[:, 0], 2)
            out_t[:-2, 0] += bend
            out_t[1:-1, 0] -= 2 * bend
            out_t[2:, 0] += bend
        return np.concatenate([self.joint @ xj + np.einsum("tdp,tp->d", self.cross, xt), out_t.ravel()])

    def to_points(self, x: np.ndarray) -> np.ndarray:
        """(N, 3) L^T x."""
        N = len(self.Lj)
        by_frames = np.matmul(x[None, None, self.d :].astype(self.Lt.dtype), self.Lt.reshape(N, -1, 3))[:, 0]
        return np.einsum("ndj,d->nj", self.Lj, x[: self.d]) + by_frames

    def from_points(self, y: np.ndarray) -> np.ndarray:
        """(P,) L y."""
        N = len(self.Lj)
        # One product a track: a single large one would copy the couplings.
        by_frames = np.zeros(len(self.g) - self.d)
        lt, y32 = self.Lt.reshape(N, -1, 3), y.astype(self.Lt.dtype)
        for k in range(0, N, 64):
            by_frames += np.matmul(lt[k : k + 64], y32[k : k + 64, :, None])[..., 0].sum(0)
        return np.concatenate([np.einsum("ndj,nj->d", self.Lj, y), by_frames])


def normal_equations(st: State, obs: Observations, noise: Noise, r, X, cam, w,
                     stiff: np.ndarray | float) -> Normal:  # fmt: skip
    """Analytic Jacobians, some tracks at a time; `stiff` is the information on second differences of the states."""
    N, T = obs.seen.shape
    stiff = np.broadcast_to(stiff, max(T - 2, 0))
    d = st.twist.basis().shape[1]
    turn = st.twist.poses(st.s)[:, :3, :3]
    # A joint's step moves world points by a twist of each frame about the origin; so does the frame's own state.
    to_frame = st.twist.spatial_jacobian(st.s) @ st.twist.basis()  # (T, 6, d)
    six = np.concatenate([to_frame, np.broadcast_to(st.twist.xi[None, :, None], (T, 6, 1))], axis=-1)
    joint, cross, own = np.zeros((d, d)), np.zeros((T, d, OWN)), np.zeros((T, OWN, OWN))
    gj, gt = np.zeros(d), np.zeros((T, OWN))
    Hpp, gp = np.zeros((N, 3, 3)), np.zeros((N, 3))
    Lj = np.zeros((N, d, 3))
    Lt = np.zeros((N, T, OWN, 3), np.float64 if T <= DENSE_FRAMES else np.float32)
    step = max(1, CHUNK // T)
    for link in (True, False):
        members = np.flatnonzero(obs.link == link)
        for k in range(0, len(members), step):
            n = members[k : k + step]
            root = np.sqrt(w[n])
            e = r[n] * root[..., None]
            C = _image(cam[n], obs.ranged[n], obs.K, noise, root) @ obs.T_camera_world[:, :3, :3]
            F = obs.basis[n] / noise.depth * (root * obs.ranged[n])[..., None]  # of the third residual only
            own[:, 1:, 1:] += np.einsum("ntk,ntl->tkl", F, F, optimize=True)
            gt[:, 1:] += np.einsum("ntk,nt->tk", F, e[..., 2], optimize=True)
            if link:
                y = X[n] - st.twist.origin
                Y = np.concatenate([-skew(y), np.broadcast_to(np.eye(3), (*y.shape, 3))], axis=-1)
                A = C @ (Y @ six)  # (n, T, 3, d + 1)
                C = C @ turn
                Aj, a = A[..., :d], A[..., d]
                joint += np.einsum("ntig,ntih->gh", Aj, Aj, optimize=True)
                gj += np.einsum("ntig,nti->g", Aj, e, optimize=True)
                own[:, 0, 0] += np.einsum("nti,nti->t", a, a)
                mixed = np.einsum("nt,ntk->tk", a[..., 2], F, optimize=True)
                own[:, 0, 1:] += mixed
                own[:, 1:, 0] += mixed
                cross[..., 0] += np.einsum("ntig,nti->tg", Aj, a, optimize=True)
                cross[..., 1:] += np.einsum("ntg,ntk->tgk", Aj[:, :, 2], F, optimize=True)
                gt[:, 0] += np.einsum("nti,nti->t", a, e)
                Lj[n] = np.einsum("ntig,ntik->ngk", Aj, C, optimize=True)
                Lt[n, :, 0] = np.einsum("nti,ntik->ntk", a, C, optimize=True)
            Lt[n, :, 1:] = F[..., None] * C[:, :, 2, None, :]
            Hpp[n] = np.einsum("ntij,ntik->njk", C, C, optimize=True)
            gp[n] = np.einsum("ntij,nti->nj", C, e, optimize=True)
    own[:, 1:, 1:] += np.eye(3) / noise.field**2
    gt[:, 1:] += st.field / noise.field**2
    if T > 2:
        bend = stiff * np.diff(st.s, 2)
        gt[:-2, 0] += bend
        gt[1:-1, 0] -= 2 * bend
        gt[2:, 0] += bend
    return Normal(joint, cross, own, stiff, np.concatenate([gj, gt.ravel()]), Hpp, gp, Lj, Lt)


def _image(cam: np.ndarray, ranged: np.ndarray, K: np.ndarray, noise: Noise, root: np.ndarray) -> np.ndarray:
    """(n, T, 3, 3) u, v and log depth over their noise by the point in the camera frame, times sqrt of the weight."""
    z = np.maximum(cam[..., 2], 1e-6)
    P = np.zeros((*z.shape, 3, 3))
    for k in range(2):
        P[..., k, k] = K[k, k] / z / noise.px
        P[..., k, 2] = -K[k, k] * cam[..., k] / z**2 / noise.px
    P[..., 2, 2] = ranged / z / noise.depth
    return P * root[..., None, None]


def point_inverse(n: Normal, damping: float = 0.0) -> np.ndarray:
    """(N, 3, 3) inverse of the points' blocks."""
    trace = np.trace(n.Hpp, axis1=1, axis2=2)
    more = damping * np.einsum("nii->ni", n.Hpp)[:, :, None] + 1e-9 * (trace + 1e-9)[:, None, None]
    return np.linalg.inv(n.Hpp + more * np.eye(3))


def reduced(n: Normal, inverse: np.ndarray, damping: float = 0.0) -> np.ndarray:
    """(P, P) information of joint and frames with the points eliminated."""
    H = n.dense()
    L = n.coupling()
    left = np.einsum("anj,njk->ank", L, inverse, optimize=True).reshape(len(H), -1)
    return H + damping * np.diag(np.diag(H)) - left @ L.reshape(len(H), -1).T


def reduced_step(n: Normal, damping: float, fixed: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton step of joint and frames with one unknown held, and of the points."""
    inverse = point_inverse(n, damping)
    g = n.g - n.from_points(np.einsum("njk,nk->nj", inverse, n.gp))
    if n.frames <= DENSE_FRAMES:
        step = -_factorised(reduced(n, inverse, damping), g, fixed)
    else:
        step = -Reduced(n, inverse, damping, fixed).solve(g)
    return step, -np.einsum("njk,nk->nj", inverse, n.gp + n.to_points(step))


def _factorised(S: np.ndarray, g: np.ndarray, fixed: int) -> np.ndarray:
    free = np.ones(len(g), bool)
    free[fixed] = False
    scale = 1 / np.sqrt(np.maximum(np.diag(S)[free], 1e-30))
    A = S[np.ix_(free, free)] * scale[:, None] * scale + 1e-12 * np.eye(free.sum())
    out = np.zeros(len(g))
    out[free] = scale * np.linalg.solve(A, scale * g[free])
    return out


class Reduced:
    """The reduced system as a product, and its solution by preconditioned conjugate gradients.

    Args:
        fixed: index of the unknown that is held.
    """

    def __init__(self, n: Normal, inverse: np.ndarray, damping: float, fixed: int) -> None:
        self.n, self.inverse, self.damping, self.fixed = n, inverse, damping, fixed
        d, T = n.d, n.frames
        root = np.linalg.cholesky(inverse).astype(n.Lt.dtype)
        blocks, border = np.array(n.own), np.array(n.cross)
        corner = np.array(n.joint)
        for k in range(0, len(n.Lj), max(1, CHUNK // T)):
            some = slice(k, k + max(1, CHUNK // T))
            lt, lj = n.Lt[some] @ root[some, None], n.Lj[some] @ root[some]
            blocks -= np.einsum("ntpj,ntqj->tpq", lt, lt, optimize=True)
            border -= np.einsum("ndj,ntpj->tdp", lj, lt, optimize=True)
            corner -= np.einsum("ndj,nej->de", lj, lj, optimize=True)
        if T > 2:
            blocks[:-2, 0, 0] += n.stiff
            blocks[1:-1, 0, 0] += 4 * n.stiff
            blocks[2:, 0, 0] += n.stiff
        diagonal = np.einsum("tpp->tp", blocks)
        blocks += (damping + 1e-9) * diagonal[:, :, None] * np.eye(OWN) + 1e-12 * np.eye(OWN)
        hold, place = divmod(fixed - d, OWN)
        blocks[hold, place] = blocks[hold, :, place] = border[hold, :, place] = 0.0
        blocks[hold, place, place] = 1.0
        self.blocks = np.linalg.inv(blocks)
        self.border = np.einsum("tdp,tpq->tdq", border, self.blocks)
        corner = corner * (1 + damping * np.eye(d)) - np.einsum("tdp,tep->de", self.border, border)
        values, vectors = np.linalg.eigh(corner)
        self.corner = vectors / np.maximum(values, 1e-9 * values[-1]) @ vectors.T

    def times(self, x: np.ndarray) -> np.ndarray:
        x = np.array(x)
        x[self.fixed] = 0.0
        n = self.n
        diagonal = np.concatenate([np.diag(n.joint), np.einsum("tpp->tp", n.own).ravel()])
        y = n.times(x) + self.damping * diagonal * x
        y -= n.from_points(np.einsum("njk,nk->nj", self.inverse, n.to_points(x)))
        y[self.fixed] = 0.0
        return y

    def precondition(self, r: np.ndarray) -> np.ndarray:
        """The inverse of the arrow of the frames' blocks and the joint's border."""
        d = self.n.d
        rt = r[d:].reshape(-1, OWN)
        xj = self.corner @ (r[:d] - np.einsum("tdp,tp->d", self.border, rt))
        xt = np.einsum("tpq,tq->tp", self.blocks, rt) - np.einsum("tdp,d->tp", self.border, xj)
        out = np.concatenate([xj, xt.ravel()])
        out[self.fixed] = 0.0
        return out

    def solve(self, g: np.ndarray, most: int = 60, tolerance: float = 1e-4) -> np.ndarray:
        """x of S x = g, to a relative residual in the preconditioner's metric."""
        r = np.array(g, float)
        r[self.fixed] = 0.0
        x = np.zeros_like(r)
        z = self.precondition(r)
        p, rz = z, float(r @ z)
        start = rz
        for _ in range(most):
            if rz <= tolerance**2 * start or start <= 0:
                break
            Sp = self.times(p)
            bent = float(p @ Sp)
            if bent <= 0:
                break
            alpha = rz / bent
            x += alpha * p
            r -= alpha * Sp
            z = self.precondition(r)
            rz, old = float(r @ z), rz
            p = z + rz / old * p
        return x


def covariance(n: Normal, fixed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Covariance of joint (d, d), of joint with states (d, T), and of the states with those of frame 0 taken off.

    Returns:
        (d, d), (d, T) of the joint with every state, (T, 3): variance of each state, variance of that of frame 0
        repeated, and covariance of both. With many frames the states' own part is that of their diagonal blocks.
    """
    d, T = n.d, n.frames
    inverse = point_inverse(n)
    rows = d + OWN * np.arange(T)
    if n.frames <= DENSE_FRAMES:
        S = reduced(n, inverse)
        free = np.ones(len(S), bool)
        free[fixed] = False
        scale = 1 / np.sqrt(np.maximum(np.diag(S)[free], 1e-30))
        A = S[np.ix_(free, free)] * scale[:, None] * scale
        cov = np.zeros_like(S)
        cov[np.ix_(free, free)] = np.linalg.inv(A + 1e-11 * np.eye(len(A))) * scale[:, None] * scale
        states = cov[np.ix_(rows, rows)]
        return cov[:d, :d], cov[:d, rows], np.stack([np.diag(states), np.full(T, states[0, 0]), states[0]], axis=-1)
    system = Reduced(n, inverse, 0.0, fixed)
    columns = np.stack([system.solve(e, most=200, tolerance=1e-6) for e in np.eye(d, len(n.g))])
    joint = (columns[:, :d] + columns[:, :d].T) / 2
    first = system.solve(np.eye(1, len(n.g), rows[0])[0], most=200, tolerance=1e-6)[rows]
    through = np.einsum("td,de,te->t", system.border[..., 0], joint, system.border[..., 0])
    own = system.blocks[:, 0, 0] + through
    own[(fixed - d) // OWN] = 0.0
    return joint, columns[:, rows], np.stack([own, np.full(T, max(first[0], 0.0)), first], axis=-1)

"""Gauss-Newton blocks of one joint's bundle adjustment, summed over all sightings in one compiled pass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from reconstruct.joint.polish import Bundle, Sightings


@dataclass(frozen=True)
class Normal:
    """Gauss-Newton blocks: dense (twist, focal, q, and six numbers of each free camera), points, coupling.

    Attributes:
        H: (P, P).  g: (P,).  Hp: (N, 3, 3).  gp: (N, 3).  C: (P, N, 3).  Z: (6, G) tangent basis of the twist.
        scores: (N, P) each track's part of g.
        lead: number of unknowns before q.
    """

    H: np.ndarray
    g: np.ndarray
    Hp: np.ndarray
    gp: np.ndarray
    C: np.ndarray
    Z: np.ndarray
    scores: np.ndarray
    lead: int

    def held(self, S: np.ndarray, right: np.ndarray, T: int) -> tuple[np.ndarray, np.ndarray]:
        """The reduced system with q[0] and the first camera held still."""
        S, right = S.copy(), right.copy()
        fixed = [self.lead, *range(self.lead + T, min(self.lead + T + 6, len(S)))]
        S[fixed], S[:, fixed], right[fixed] = 0.0, 0.0, 0.0
        S[fixed, fixed] = np.trace(S) / len(S)
        return S, right

    def reduced(self, damping: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Schur complement, its right side, and the points' inverse blocks."""
        diagonal = np.einsum("nii->ni", self.Hp)
        floor = 1e-9 * diagonal.sum(1, keepdims=True) + 1e-12
        inv = np.linalg.inv(self.Hp + (damping * diagonal + floor)[..., None] * np.eye(3))
        # inv = L L', so that the product is one of a matrix with itself, which costs half.
        L = np.linalg.cholesky(0.5 * (inv + inv.swapaxes(1, 2)))
        M = (self.C.swapaxes(0, 1) @ L).swapaxes(0, 1).reshape(len(self.C), -1)
        return self.H - M @ M.T, self.g - M @ np.einsum("nij,ni->nj", L, self.gp).ravel(), inv


def normal_equations(
    b: Bundle, s: Sightings, world: np.ndarray, cam: np.ndarray, r: np.ndarray, w: np.ndarray
) -> Normal:
    """Blocks of the weighted problem; parameters are (twist tangent, log focal, q_1 .. q_T, cameras).

    Args:
        b: the joint.  s: N sightings in T frames.  world, cam: (N, T, 3) points.  r: (N, T, 2) px.  w: (N, T) weights.
    """
    N, T = s.seen.shape
    tw = b.twist
    Z = tw.tangent(b.kind)
    R, p = tw.pose(b.q)
    by_twist = tw.displacement_by_direction(b.q) @ Z[:3] + tw.displacement_by_curvature(b.q) @ Z[3:]  # (T, 3, G)
    turn = b.q[:, None, None] * (tw.left_jacobian(b.q) @ Z[3:])  # rotation vector's change, (T, 3, G)
    camera = s.R if b.R is None else b.R
    shift = np.zeros((T, 3)) if b.t is None else b.t
    A = Z.shape[1] + (s.focal_std > 0)
    size = A + T + (6 * T if s.free else 0)
    # Empty stands for none: compiled code knows one type an argument.
    slip = np.zeros((0, 0, 2)) if s.slip is None else s.slip
    turned = np.zeros((0, 3, 3)) if camera is None else camera
    link = np.ones(N, bool) if s.link is None else s.link
    n = Normal(np.zeros((size, size)), np.zeros(size), np.zeros((N, 3, 3)), np.zeros((N, 3)), np.zeros((size, N, 3)), Z,
               np.zeros((N, size)), A)  # fmt: skip
    whole = lambda x: np.ascontiguousarray(x, float)  # noqa: E731
    _sum(whole(world), whole(cam), whole(r), whole(w), whole(slip), whole(turned), whole(shift), R, whole(p),
         whole(by_twist), whole(turn), link, whole(tw.anchor), whole(tw.direction), whole(tw.curvature),
         s.focal * float(np.exp(b.log_focal)), s.free, A, n.H, n.g, n.Hp, n.gp, n.C, n.scores)  # fmt: skip
    n.H[...] = np.triu(n.H) + np.triu(n.H, 1).T
    n.g[...] = n.scores.sum(0)
    return n


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _sum(world: np.ndarray, cam: np.ndarray, r: np.ndarray, w: np.ndarray, slip: np.ndarray, camera: np.ndarray,
         shift: np.ndarray, R: np.ndarray, p: np.ndarray, by_twist: np.ndarray, turn: np.ndarray, link: np.ndarray,
         anchor: np.ndarray, direction: np.ndarray, curvature: np.ndarray, f: float, free: bool, A: int, H: np.ndarray,
         g: np.ndarray, Hp: np.ndarray, gp: np.ndarray, C: np.ndarray, scores: np.ndarray) -> None:  # fmt: skip
    """Into H's upper half, Hp, gp, C and scores."""
    N, T = w.shape
    G = by_twist.shape[2]
    P, Q, Jx, Jg = np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, A))
    Jq, Jc, y, d = np.zeros(2), np.zeros((2, 6)), np.zeros(3), np.zeros(3)
    for n in range(N):
        for t in range(T):
            wt = w[n, t]
            if wt == 0.0:
                continue
            z = max(cam[n, t, 2], 1e-3)
            x0, x1 = cam[n, t, 0], cam[n, t, 1]
            P[0, 0], P[0, 1], P[0, 2] = f / z, 0.0, -f * x0 / (z * z)
            P[1, 0], P[1, 1], P[1, 2] = 0.0, f / z, -f * x1 / (z * z)
            f0, f1 = f * x0 / z, f * x1 / z
            if slip.shape[0] > 0:
                u0, u1 = slip[n, t, 0], slip[n, t, 1]
                for k in range(3):
                    along = u0 * P[0, k] + u1 * P[1, k]
                    P[0, k] -= u0 * along
                    P[1, k] -= u1 * along
                along = u0 * f0 + u1 * f1
                f0 -= u0 * along
                f1 -= u1 * along
            # Q is P turned into the world.
            for i in range(2):
                for k in range(3):
                    if camera.shape[0] > 0:
                        Q[i, k] = P[i, 0] * camera[t, 0, k] + P[i, 1] * camera[t, 1, k] + P[i, 2] * camera[t, 2, k]
                    else:
                        Q[i, k] = P[i, k]
            if link[n]:
                for k in range(3):
                    y[k] = world[n, t, k] - p[t, k] - anchor[k]
                    d[k] = world[n, t, k] - anchor[k]
                v0 = curvature[1] * d[2] - curvature[2] * d[1] + direction[0]
                v1 = curvature[2] * d[0] - curvature[0] * d[2] + direction[1]
                v2 = curvature[0] * d[1] - curvature[1] * d[0] + direction[2]
                for i in range(2):
                    for k in range(3):
                        Jx[i, k] = Q[i, 0] * R[t, 0, k] + Q[i, 1] * R[t, 1, k] + Q[i, 2] * R[t, 2, k]
                    Jq[i] = Q[i, 0] * v0 + Q[i, 1] * v1 + Q[i, 2] * v2
                for a in range(G):
                    r0, r1, r2 = turn[t, 0, a], turn[t, 1, a], turn[t, 2, a]
                    d0 = by_twist[t, 0, a] + r1 * y[2] - r2 * y[1]
                    d1 = by_twist[t, 1, a] + r2 * y[0] - r0 * y[2]
                    d2 = by_twist[t, 2, a] + r0 * y[1] - r1 * y[0]
                    for i in range(2):
                        Jg[i, a] = Q[i, 0] * d0 + Q[i, 1] * d1 + Q[i, 2] * d2
            else:
                Jx[:], Jq[:], Jg[:] = Q, 0.0, 0.0
            if A > G:
                Jg[0, G], Jg[1, G] = f0, f1
            e0, e1 = wt * r[n, t, 0], wt * r[n, t, 1]
            for a in range(A):
                s0, s1 = wt * Jg[0, a], wt * Jg[1, a]
                scores[n, a] += Jg[0, a] * e0 + Jg[1, a] * e1
                for c in range(a, A):
                    H[a, c] += s0 * Jg[0, c] + s1 * Jg[1, c]
                H[a, A + t] += s0 * Jq[0] + s1 * Jq[1]
                for k in range(3):
                    C[a, n, k] += s0 * Jx[0, k] + s1 * Jx[1, k]
            q0, q1 = wt * Jq[0], wt * Jq[1]
            H[A + t, A + t] += q0 * Jq[0] + q1 * Jq[1]
            scores[n, A + t] = Jq[0] * e0 + Jq[1] * e1
            for k in range(3):
                C[A + t, n, k] = q0 * Jx[0, k] + q1 * Jx[1, k]
                gp[n, k] += Jx[0, k] * e0 + Jx[1, k] * e1
                for j in range(3):
                    Hp[n, k, j] += wt * (Jx[0, k] * Jx[0, j] + Jx[1, k] * Jx[1, j])
            if not free:
                continue
            for k in range(3):
                d[k] = cam[n, t, k] - shift[t, k]
            for i in range(2):
                # P times minus the cross product's matrix of d.
                Jc[i, 0] = P[i, 2] * d[1] - P[i, 1] * d[2]
                Jc[i, 1] = P[i, 0] * d[2] - P[i, 2] * d[0]
                Jc[i, 2] = P[i, 1] * d[0] - P[i, 0] * d[1]
                for k in range(3):
                    Jc[i, 3 + k] = P[i, k]
            row = A + T + 6 * t
            for c in range(6):
                s0, s1 = wt * Jc[0, c], wt * Jc[1, c]
                scores[n, row + c] = Jc[0, c] * e0 + Jc[1, c] * e1
                for a in range(A):
                    H[a, row + c] += s0 * Jg[0, a] + s1 * Jg[1, a]
                H[A + t, row + c] += s0 * Jq[0] + s1 * Jq[1]
                for a in range(c, 6):
                    H[row + c, row + a] += s0 * Jc[0, a] + s1 * Jc[1, a]
                for k in range(3):
                    C[row + c, n, k] = s0 * Jx[0, k] + s1 * Jx[1, k]

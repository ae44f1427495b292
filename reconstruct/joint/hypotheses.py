"""Global search: axis lines from one window of tracks, without a starting guess.

For an axis direction a, a total angle and a motion profile, the rotations R_t are known, and a track's
unknown depth lambda and the pivot c (perpendicular to a) enter linearly:

    X_t = lambda R_t x_0 + (I - R_t) c,    X_t,xy - x_t X_t,z = 0.

The depth is eliminated per track, which leaves a 2 x 2 form in c; its smallest eigenvector over small
random subsets of tracks gives pivots, and a truncated reprojection error over all tracks ranks them.
A prismatic direction d enters in the same way: X_t = lambda x_0 + s_t d. What slides along edges counts for less
(paths.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reconstruct.joint.paths import held

ANGLES = np.radians([15.0, 35.0, 60.0, 90.0, 120.0])


@dataclass(frozen=True)
class Hypothesis:
    """A joint in the camera frame (right, down, forward), up to scale.

    Attributes:
        kind: "revolute" or "prismatic".
        axis: (3,) unit.  point: (3,) pivot perpendicular to the axis, unit length (revolute).
        frames: (m,) frames of the window.  q: (m,) states there (rad; units of |point| or of depth).
        score: explained motion, larger is better.
    """

    kind: str
    axis: np.ndarray
    point: np.ndarray | None
    frames: np.ndarray
    q: np.ndarray
    score: float


def hemisphere(count: int) -> np.ndarray:
    """(count, 3) nearly even unit directions with z >= 0 (Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    z = i / count
    phi = np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)


def perpendicular_basis(a: np.ndarray) -> np.ndarray:
    """(..., 3) unit -> (..., 3, 2) orthonormal vectors perpendicular to it."""
    helper = np.where(np.abs(a[..., :1]) < 0.7, np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))
    b1 = np.cross(a, helper)
    b1 /= np.linalg.norm(b1, axis=-1, keepdims=True)
    return np.stack([b1, np.cross(a, b1)], axis=-1)


def _rotate(a: np.ndarray, angle: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Rodrigues' formula, broadcasting: axes (..., 3), angles (...,), vectors (..., 3)."""
    cos, sin = np.cos(angle)[..., None], np.sin(angle)[..., None]
    along = np.sum(a * v, axis=-1, keepdims=True) * a
    return along + cos * (v - along) + sin * np.cross(a, v)


def _off_ray(X: np.ndarray, x: np.ndarray, seen: np.ndarray, slip: np.ndarray | None) -> np.ndarray:
    """(..., 2) by how much points (..., 3) miss the rays x, times their depth; 0 where not seen. Linear in X."""
    r = (X[..., :2] - x[..., :2] * X[..., 2:]) * seen[..., None]
    return held(r, None if slip is None else np.broadcast_to(slip, r.shape))


def _motion2(rays: np.ndarray, slip: np.ndarray | None) -> np.ndarray:
    """(n,) largest squared way from the reference frame, the first, ray units."""
    return np.nanmax(np.sum(held(rays[:, 1:, :2] - rays[:, :1, :2], slip) ** 2, axis=-1), axis=1, initial=0.0)


def _smallest_eigenvector_2x2(M: np.ndarray) -> np.ndarray:
    """(..., 2, 2) symmetric -> (..., 2) unit eigenvector of the smaller eigenvalue."""
    a, b, d = M[..., 0, 0], M[..., 0, 1], M[..., 1, 1]
    angle = 0.5 * np.arctan2(2 * b, a - d)  # of the larger one
    return np.stack([-np.sin(angle), np.cos(angle)], axis=-1)


def revolute_hypotheses(
    rays: np.ndarray,
    frames: np.ndarray,
    profile: np.ndarray,
    weight: np.ndarray,
    tol: float,
    rng: np.random.Generator,
    directions: int = 160,
    subsets: int = 40,
    keep: int = 6,
    whole: np.ndarray | None = None,
    slip: np.ndarray | None = None,
) -> list[Hypothesis]:
    """Axis lines from one window.

    Args:
        rays: (n, m, 3) rays (x, y, 1) of n tracks in m frames; frame 0 is the reference. NaN if not seen.
        frames: (m,) frame numbers.
        profile: (m,) or (n, m) motion profile, 0 at the reference; 1 is the angle that is searched.
        weight: (n,) weight of each track (its motion, its share of the picture).
        tol: truncation of the reprojection error, in ray units (px / focal).
        rng: for the subsets.
        directions, subsets, keep: size of the search and number of results.
        whole: profile in `frames` that the hypotheses carry (default: `profile`).
        slip: (n, m, 2) as in paths.py.
    """
    n, m, _ = rays.shape
    whole = profile if whole is None else whole
    slip = None if slip is None else slip[:, 1:]
    per_track = np.broadcast_to(profile, (n, m))
    shared = profile.ndim == 1
    seen = np.isfinite(rays[..., 0])
    x = np.where(seen[..., None], rays, 0.0)
    dirs = hemisphere(directions)
    angles = np.concatenate([ANGLES, -ANGLES])
    picks = np.stack([rng.choice(n, size=min(5, n), replace=False, p=weight / weight.sum()) for _ in range(subsets)])
    motion2 = _motion2(rays, slip)
    found: list[tuple[float, np.ndarray, np.ndarray, float]] = []
    for theta in angles:
        q = theta * (profile[None] if shared else per_track)[:, 1:]  # (1 or n, m-1)
        basis = perpendicular_basis(dirs)
        y = _rotate(dirs[:, None, None], q[None], x[None, :, :1])  # (d, n, m-1, 3)
        A = _off_ray(y, x[None, :, 1:], seen[None, :, 1:], slip)
        C = np.stack(  # (I - R) basis, (d, 1 or n, m-1, 2, 3)
            [
                basis[:, None, None, :, k] - _rotate(dirs[:, None, None], q[None], basis[:, None, None, :, k])
                for k in range(2)
            ],
            axis=-2,
        )
        B = [_off_ray(C[..., k, :], x[None, :, 1:], seen[None, :, 1:], slip) for k in range(2)]
        flat = A.reshape(*A.shape[:2], -1)
        sides = np.stack(B, axis=-1).reshape(*flat.shape, 2)  # (d, n, (m-1) 2, 2)
        AA = np.sum(flat**2, axis=-1) + 1e-12
        AB = (flat[:, :, None] @ sides)[:, :, 0]
        BB = sides.swapaxes(-1, -2) @ sides
        M = BB - AB[..., :, None] * AB[..., None, :] / AA[..., None, None]
        scale = np.trace(BB, axis1=-1, axis2=-2)[..., None, None] + 1e-12
        c = _smallest_eigenvector_2x2((M / scale)[:, picks].sum(axis=2))  # (d, subsets, 2)
        lam = -(c @ AB.swapaxes(-1, -2)) / AA[:, None]
        sign = np.where(np.median(np.sign(lam), axis=-1, keepdims=True) < 0, -1.0, 1.0)
        c, lam = c * sign, lam * sign
        forms = np.stack([M[..., 0, 0], 2 * M[..., 0, 1], M[..., 1, 1]])  # c' M c as one product
        squares = np.stack([c[..., 0] ** 2, c[..., 0] * c[..., 1], c[..., 1] ** 2], axis=-1)
        err2 = squares @ np.moveaxis(forms, 0, 1) / np.maximum(seen[:, 1:].sum(1), 1)
        err2 = err2 / np.maximum(lam, 1e-3) ** 2
        good = np.clip(1 - err2 / tol**2, 0, None) * (lam > 0) * (motion2 > tol**2)
        score = good @ weight
        best = np.argsort(-score, axis=None)[: 4 * keep]
        for flat in best:
            d, s = np.unravel_index(flat, score.shape)
            found.append((float(score[d, s]), dirs[d], basis[d] @ c[d, s], float(theta)))
    found.sort(key=lambda f: -f[0])
    out: list[Hypothesis] = []
    for score, a, c, theta in found:
        if any(
            abs(h.axis @ a) > 0.98 and abs(h.point @ c) > 0.97 and np.sign(h.q.sum()) == np.sign((theta * whole).sum())
            for h in out
        ):
            continue
        out.append(Hypothesis("revolute", a, c, frames, theta * whole, score))
        if len(out) >= keep:
            break
    return out


def prismatic_hypotheses(
    rays: np.ndarray,
    frames: np.ndarray,
    profile: np.ndarray,
    weight: np.ndarray,
    tol: float,
    rng: np.random.Generator,
    directions: int = 600,
    keep: int = 3,
    whole: np.ndarray | None = None,
    slip: np.ndarray | None = None,
) -> list[Hypothesis]:
    """Slide directions from one window; arguments as for :func:`revolute_hypotheses`.

    With a common slide s_t d, |d| = 1, every track's depth follows linearly; depths are relative to the stroke.
    """
    n, m, _ = rays.shape
    whole = profile if whole is None else whole
    seen = np.isfinite(rays[..., 0])
    x = np.where(seen[..., None], rays, 0.0)
    dirs = np.concatenate([hemisphere(directions // 2), -hemisphere(directions // 2)])
    slip = None if slip is None else slip[:, 1:]
    A = _off_ray(np.broadcast_to(x[:, :1], x[:, 1:].shape), x[:, 1:], seen[:, 1:], slip)
    B = _off_ray(dirs[:, None, None], x[None, :, 1:], seen[None, :, 1:], slip)
    B = B * np.broadcast_to(profile, (n, m))[None, :, 1:, None]
    AA = np.einsum("nmi,nmi->n", A, A) + 1e-12
    lam = -np.einsum("nmi,dnmi->dn", A, B) / AA
    r = np.einsum("nmi,dn->dnmi", A, lam) + B
    err2 = np.einsum("dnmi,dnmi->dn", r, r) / np.maximum(seen[:, 1:].sum(1), 1) / np.maximum(lam, 1e-3) ** 2
    motion2 = _motion2(rays, slip)
    score = (np.clip(1 - err2 / tol**2, 0, None) * (lam > 0) * (motion2 > tol**2)) @ weight
    out: list[Hypothesis] = []
    for d in np.argsort(-score):
        if any(h.axis @ dirs[d] > 0.97 for h in out):
            continue
        depth = np.median(lam[d][lam[d] > 0]) if (lam[d] > 0).any() else 1.0
        out.append(Hypothesis("prismatic", dirs[d], None, frames, whole / depth, float(score[d])))
        if len(out) >= keep:
            break
    return out

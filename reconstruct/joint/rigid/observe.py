"""Tracks with depth in the metric of their noise: pixels across the ray, the logarithm of depth along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Noise:
    """Standard deviations of an observation.

    Attributes:
        px: of a track's place, px.  depth: of the logarithm of depth, independent in every sample.
        field: of the coefficients of the smooth error that all depths of a frame share.
    """

    px: float = 1.5
    depth: float = 0.015
    field: float = 0.02


FLOOR, MOST = Noise(0.02, 1e-4, 1e-4), Noise(3.0, 0.1, 0.1)


@dataclass(frozen=True)
class Observations:
    """What was seen, N tracks in T frames.

    Attributes:
        uv: (N, T, 2) px, 0 where not seen.  log_depth: (N, T), 0 where not seen.
        seen, ranged: (N, T) bool, has a place, has a depth as well.
        K: (3, 3) px.  T_camera_world: (T, 4, 4).
        link: (N,) bool, taken for the moving link; the others are taken to rest.
        basis: (N, T, 3) functions of the place that make up a frame's depth error: a scale and two tilts.
    """

    uv: np.ndarray
    log_depth: np.ndarray
    seen: np.ndarray
    ranged: np.ndarray
    K: np.ndarray
    T_camera_world: np.ndarray
    link: np.ndarray
    basis: np.ndarray

    def of(self, tracks: np.ndarray, frames: np.ndarray) -> Observations:
        """Some tracks in some frames."""
        pick = np.ix_(tracks, frames)
        return Observations(self.uv[pick], self.log_depth[pick], self.seen[pick], self.ranged[pick], self.K,
                            self.T_camera_world[frames], self.link[tracks], self.basis[pick])  # fmt: skip

    def lift(self, field: np.ndarray | None = None) -> np.ndarray:
        """(N, T, 3) world points of observations with a depth, NaN elsewhere; `field` (T, 3) is the depths' error."""
        logz = self.log_depth if field is None else self.log_depth - np.einsum("ntk,tk->nt", self.basis, field)
        z = np.where(self.ranged, np.exp(logz), np.nan)
        x = (self.uv - self.K[:2, 2]) / self.K[[0, 1], [0, 1]] * z[..., None]
        R, t = self.T_camera_world[:, :3, :3], self.T_camera_world[:, :3, 3]
        return np.einsum("tji,ntj->nti", R, np.concatenate([x, z[..., None]], axis=-1) - t)


def observe(uv: np.ndarray, visible: np.ndarray, depth: np.ndarray, K: np.ndarray, T_world_camera: np.ndarray,
            link: np.ndarray) -> Observations:  # fmt: skip
    """From tracks (N, T, 2) px and depths (N, T) along the optical axis."""
    seen = visible & np.isfinite(uv).all(-1)
    ranged = seen & np.isfinite(depth) & (np.nan_to_num(depth) > 0)
    uv = np.where(seen[..., None], uv, 0.0)
    half = np.maximum(K[:2, 2] + 0.5, 1.0)
    x = np.where(seen[..., None], (uv - K[:2, 2]) / half, 0.0)
    basis = np.concatenate([np.full((*seen.shape, 1), np.sqrt(1 / 3)), x], axis=-1)
    logz = np.log(np.where(ranged, depth, 1.0))
    return Observations(uv, logz, seen, ranged, np.asarray(K, float), np.linalg.inv(T_world_camera), link, basis)


def static_field(obs: Observations, rounds: int = 4) -> tuple[np.ndarray, Noise]:
    """(T, 3) the depths' smooth error in every frame as the resting points see it, and how large such errors are.

    Each resting point has one place in the world; what its depths deviate from it in a frame, with a prior of the
    field's size, is that frame's error. Alternates between places (robust means) and fields. Their common part cannot
    be seen by a camera that rests and stays zero on average.
    """
    T = obs.seen.shape[1]
    rest = np.flatnonzero(~obs.link & (obs.ranged.sum(1) >= 2))
    field, noise = np.zeros((T, 3)), Noise()
    if len(rest) < 4:
        return field, noise
    some = obs.of(rest, np.arange(T))
    R, t = some.T_camera_world[:, :3, :3], some.T_camera_world[:, :3, 3]
    for _ in range(rounds):
        X = robust_mean(some.lift(field))
        z = np.einsum("tj,nj->nt", R[:, 2], X) + t[:, 2]
        r = np.where(some.ranged & (z > 0), some.log_depth - np.log(np.maximum(z, 1e-9)), 0.0)
        e = r - np.einsum("ntk,tk->nt", some.basis, field)
        w = some.ranged / (1 + (e / (3 * noise.depth)) ** 2) ** 2 / noise.depth**2
        H = np.einsum("nt,ntk,ntl->tkl", w, some.basis, some.basis) + np.eye(3) / noise.field**2
        field = np.linalg.solve(H, np.einsum("nt,ntk,nt->tk", w, some.basis, r)[..., None])[..., 0]
        spread = 1.4826 * float(np.median(np.abs(e[some.ranged])))
        noise = Noise(noise.px, float(np.clip(spread, noise.depth / 3, MOST.depth)),
                      float(np.clip(1.5 * np.sqrt(np.mean(field**2)), noise.field / 3, MOST.field)))  # fmt: skip
    return field, noise


def robust_mean(points: np.ndarray, rounds: int = 3) -> np.ndarray:
    """(N, 3) means over frames of (N, T, 3) points (NaN where unknown) with far ones weighed down."""
    finite = np.isfinite(points[..., 0])
    mean = np.nan_to_num(_median(points))
    values = np.where(finite[..., None], points, 0.0)
    for _ in range(rounds):
        d2 = np.sum((values - mean[:, None]) ** 2, axis=-1)
        middle = np.nan_to_num(_median(np.where(finite, d2, np.nan)), nan=1.0)
        w = finite / (1 + d2 / (4 * middle[:, None] + 1e-12)) ** 2
        mean = np.einsum("nt,ntj->nj", w, values) / np.maximum(w.sum(1), 1e-12)[:, None]
    return mean


def _median(x: np.ndarray) -> np.ndarray:
    """Lower median over axis 1 of what is not NaN; NaN where nothing is."""
    ordered = np.sort(x, axis=1)  # NaN last
    count = np.isfinite(x).sum(axis=1, keepdims=True)
    return np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis=1)[:, 0]

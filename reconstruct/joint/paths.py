"""Tracks as this room hands them on: places, and how far each may have slid along an edge.

A window on an edge shows how far the edge went, not how far a point went along it (the aperture problem; Hildreth,
1984). Trackers give such points a place all the same, off by pixels along the edge and exact to a tenth of a pixel
across. Residuals along it therefore count for as much less as they are worse, everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree


@dataclass(frozen=True)
class Paths:
    """Tracks.

    Attributes:
        uv: (N, T, 2) px, NaN where not seen.
        slip: (N, T, 2) as in :class:`reconstruct.cues.Tracks`; None if all directions are held alike.
    """

    uv: np.ndarray
    slip: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.uv)

    def __getitem__(self, rows: np.ndarray) -> Paths:
        """Some of the tracks."""
        return Paths(self.uv[rows], None if self.slip is None else self.slip[rows])

    def __sub__(self, origin: np.ndarray) -> Paths:
        """The same with another origin, (2,) px."""
        return Paths(self.uv - origin, self.slip)

    @property
    def seen(self) -> np.ndarray:
        """(N, T) bool."""
        return np.isfinite(self.uv[..., 0])

    def at(self, frames: np.ndarray) -> Paths:
        """In some frames."""
        return Paths(self.uv[:, frames], None if self.slip is None else self.slip[:, frames])

    def moved(self) -> np.ndarray:
        """(N, T, 2) px from each track's place in the middle of the frames that see it, as far as the picture holds it:
        what slides along a resting edge does not move."""
        if self.slip is None:
            return self.uv
        seen = self.seen
        nth = np.cumsum(seen, axis=1)
        middle = np.argmax(nth > nth[:, -1:] // 2, axis=1)
        return held(self.uv - self.uv[np.arange(len(self)), middle][:, None], self.slip)


def held(r: np.ndarray, slip: np.ndarray | None) -> np.ndarray:
    """Differences of places with what lies along the slip reduced to what it is worth.

    Args:
        r: (..., 2) px, or (..., 2, k) of derivatives.  slip: (..., 2) or None.
    """
    if slip is None:
        return r
    if r.ndim == slip.ndim:
        return r - slip * np.sum(slip * r, axis=-1, keepdims=True)
    return r - slip[..., None] * np.sum(slip[..., None] * r, axis=-2, keepdims=True)


def linked_frames(seen: np.ndarray, least: int) -> np.ndarray:
    """(T,) int: which part each frame is in, of those that chains of so many tracks hold together; -1 for frames that
    fewer show.

    Args:
        seen: (N, T) bool.
    """
    out = np.full(seen.shape[1], -1)
    shown = np.flatnonzero(seen.sum(0) >= least)
    if len(shown):
        some = seen[:, shown].astype(np.float32)
        out[shown] = connected_components(some.T @ some >= least, directed=False)[1]
    return out


def beside(uv: np.ndarray, seen: np.ndarray, some: np.ndarray, px: float) -> np.ndarray:
    """(N,) bool, tracks that are near one of some for more than half of the frames that show them.

    Args:
        uv: (N, T, 2) px.  seen: (N, T) bool.  some: (N,) bool.  px: how near.
    """
    near = np.zeros(len(seen), int)
    for t in range(seen.shape[1]):
        here, there = np.flatnonzero(seen[:, t]), some & seen[:, t]
        if there.any():
            near[here] += cKDTree(uv[there, t]).query(uv[here, t])[0] < px
    return 2 * near > seen.sum(1)

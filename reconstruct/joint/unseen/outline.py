"""A link's straight edges in space, and where in a picture they are: the state of a known joint without any track.

Edges that are followed for some frames in which the joint's states are known are lines in space. In any other frame
the states at which they project onto straight edges of the picture, of their direction, are few (chamfer matching with
orientation; Barrow et al., 1977; Shotton et al., 2008). What is in the same place in the frames with known states
rests, and is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from reconstruct.providers.edge_tracks import Segments

BINS, ASIDE_DEG = 12, 15.0
"""Directions that pictures are kept in, and how far from the middle of one a segment's may be."""
MISS_PX, FAR_PX = 2.0, 6.0
"""Scale of how far a line may miss an edge, and the distance that is not told from larger ones."""
KEPT = 64
"""Pictures whose edges are kept drawn, some 4 MB each."""
RESTS, RESTS_PX, LOOKS = 0.5, 1.5, 24
"""Share of the frames with known states in which an edge has to be in one place to rest, how near, and how many are
looked at."""
SPACING_PX, MOST, WORTH = 5.0, 200, 20.0
"""Between the points of a line that are looked at, how many of all at most, and what a line counts for at most."""


@dataclass(frozen=True)
class Outline:
    """Points of lines of the link.

    Attributes:
        X: (n, 3) in state 0, camera frame.  along: (n, 3) in the line's direction.  weight: (n,).  line: (n,) whose.
    """

    X: np.ndarray
    along: np.ndarray
    weight: np.ndarray
    line: np.ndarray

    def speed(self, pose: Callable[[np.ndarray], np.ndarray], q: np.ndarray, focal: float) -> float:
        """px that most points go for a unit of the state, about the one of some states (m,) where it is most."""
        h = 1e-4
        both = projected(self, pose, (q[:, None] + [0.0, h]).ravel(), focal)[0].reshape(len(q), 2, len(self.X), 2)
        way = np.linalg.norm(both[:, 1] - both[:, 0], axis=-1)
        return float(np.quantile(way, 0.8, axis=1).max() / h)


class Edges:
    """The straight edges of a film's pictures, without those that rest.

    Args:
        segments: of each of T pictures.  covered: (T, h, w) bool, under hands.  centre: (2,) px, the principal point.
        known: (T,) bool, frames whose states are known.
    """

    def __init__(self, segments: Sequence[Segments], covered: np.ndarray, centre: np.ndarray, known: np.ndarray):
        self.segments, self.covered, self.centre = segments, covered, centre
        there = np.flatnonzero(known)
        looks = there[np.unique(np.linspace(0, len(there) - 1, min(len(there), LOOKS)).round().astype(int))]
        count = np.zeros((BINS, *covered.shape[1:]), np.uint8)
        for t in looks:
            count += _distances(_drawn(segments[t], covered.shape[1:]), RESTS_PX + 1) < RESTS_PX
        self.rests = count >= np.maximum(RESTS * (~covered[looks]).sum(0), 1)
        self._near: dict[int, np.ndarray] = {}

    def share(self, t: int, outline: Outline, pose: Callable[[np.ndarray], np.ndarray], q: np.ndarray, focal: float
              ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """(m,) share of the outline in states q (m,) that is on edges of picture t, of what is in sight, and (m,) what
        share that is."""
        p, way, depth = projected(outline, pose, q, focal)
        k = ((np.degrees(np.arctan2(way[..., 1], way[..., 0])) % 180) * BINS / 180).astype(int) % BINS
        h, w = self.covered.shape[1:]
        x, y = np.moveaxis(np.nan_to_num(p + self.centre, nan=-1, posinf=-1, neginf=-1).round().astype(int), -1, 0)
        inside = (x >= 0) & (x < w) & (y >= 0) & (y < h) & (depth > 0)
        x, y = np.clip(x, 0, w - 1), np.clip(y, 0, h - 1)
        weight = outline.weight * (inside & ~self.covered[t][y, x])
        total = weight.sum(1)
        on = (weight * self.near(t)[k, y, x]).sum(1) / 255
        return on / np.maximum(total, 1e-9), total / outline.weight.sum()

    def near(self, t: int) -> np.ndarray:
        """(BINS, h, w) uint8: 255 on an edge of picture t of about each direction, less beside it."""
        if t not in self._near:
            if len(self._near) >= KEPT:
                self._near.pop(next(iter(self._near)))
            drawn = _drawn(self.segments[t], self.covered.shape[1:]) & ~self.rests
            self._near[t] = (255 * np.exp(-0.5 * (_distances(drawn, FAR_PX) / MISS_PX) ** 2)).astype(np.uint8)
        return self._near[t]


def projected(outline: Outline, pose: Callable[[np.ndarray], np.ndarray], q: np.ndarray, focal: float
              ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """(m, n, 2) px from the principal point and (m, n, 2) direction there of an outline's points in states q (m,), and
    (m, n) their depths."""
    G = pose(q)
    Y = np.einsum("mij,nj->mni", G[:, :3, :3], outline.X) + G[:, None, :3, 3]
    D = np.einsum("mij,nj->mni", G[:, :3, :3], outline.along)
    z = np.maximum(Y[..., 2:], 1e-6)
    return focal * Y[..., :2] / z, D[..., :2] * z - Y[..., :2] * D[..., 2:], Y[..., 2]


def _drawn(segments: Segments, shape: tuple[int, int]) -> np.ndarray:
    """(BINS, h, w) bool: pixels of segments of about each direction."""
    import cv2

    out = np.zeros((BINS, *shape), np.uint8)
    half = segments.along * segments.length[:, None] / 2
    ends = np.stack([segments.middle - half, segments.middle + half], axis=1)
    angle = np.degrees(np.arctan2(segments.along[:, 1], segments.along[:, 0]))
    for k in range(BINS):
        off = np.abs((angle - (k + 0.5) * 180 / BINS + 90) % 180 - 90)
        for a, b in (ends[off < ASIDE_DEG] * 16).round().astype(int):
            cv2.line(out[k], a.tolist(), b.tolist(), 1, shift=4)
    return out.astype(bool)


def _distances(drawn: np.ndarray, most: float) -> np.ndarray:
    """(BINS, h, w) px to the nearest pixel of about each direction, ``most`` at most."""
    import cv2

    out = np.full(drawn.shape, most, np.float32)
    for k in np.flatnonzero(drawn.any((1, 2))):
        out[k] = np.minimum(cv2.distanceTransform((~drawn[k]).astype(np.uint8), cv2.DIST_L2, 5), most)
    return out

"""What is known of where points lie: a link's near each other, of a plate in one plane, and what rests near the link.

All are squares in px^2 beside those of the pictures, so that a standard deviation of each weighs as one of the noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from reconstruct.joint.normal import Normal

if TYPE_CHECKING:
    from reconstruct.joint.polish import Bundle, Sightings

REACH = 1.5
"""Link sizes from the middle up to which a point may lie anywhere."""
NEARBY, BEYOND = 4.0, 0.05
"""Depth of a resting scene over the link's up to which, or down to one over it, it may lie anywhere; and the standard
deviation of the logarithm beyond."""


def extent(X: np.ndarray, tail: float = 0.05) -> float:
    """Diagonal of the box around points (N, k) that leaves such a share of them out at either end of each axis."""
    return float(np.linalg.norm(np.quantile(X, 1 - tail, axis=0) - np.quantile(X, tail, axis=0)))


def seen_across(X: np.ndarray, depth: float) -> np.ndarray:
    """(N, 2) places of points (N, 3), camera frame, across the line of sight as if all lay at one depth: a stray far
    before or behind the others makes them no larger."""
    return X[:, :2] / np.maximum(X[:, 2:], 1e-3) * depth


@dataclass(frozen=True)
class Reach:
    """How far a link's points may lie from its middle: what is farther costs the squared distance from that sphere.

    A point on an edge that goes along its own image has no depth but this, and a joint of the wrong type takes up what
    contradicts it in points far before or behind the link.

    Attributes:
        middle: (3,).  radius: of the sphere.  weight: (N,) px^2 over a squared length, 0 of a resting scene's points.
    """

    middle: np.ndarray
    radius: float
    weight: np.ndarray

    @classmethod
    def of(cls, b: Bundle, s: Sightings, sigma: float) -> Reach:
        """The link's size is read across the line of sight, and is one standard deviation beyond the sphere."""
        link = np.ones(len(b.X), bool) if s.link is None else s.link
        X = b.X[link]
        middle = np.median(X, axis=0)
        size = extent(seen_across(X, middle[2]))
        weight = 0.0 if size <= 0 else s.lasting * (sigma / size) ** 2
        return cls(middle, REACH * size, np.where(link, weight, 0.0))

    def cost(self, X: np.ndarray) -> float:
        """Of points (N, 3), px^2."""
        return float(self.weight @ np.maximum(np.linalg.norm(X - self.middle, axis=1) - self.radius, 0) ** 2)

    def slopes(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N, 3, 3) and (N, 3) of half the cost by the points."""
        d = X - self.middle
        far = np.linalg.norm(d, axis=1)
        out = d / np.maximum(far, 1e-12)[:, None]
        beyond = np.maximum(far - self.radius, 0)
        H = (self.weight * (beyond > 0))[:, None, None] * out[:, :, None] * out[:, None]
        return H, (self.weight * beyond)[:, None] * out


@dataclass(frozen=True)
class Flat:
    """How far the points of a link leave its plane, which it turns in: what does costs its squared distance from it.

    A point in a plane at right angles to the axis has no depth of its own, and how the plane lies is seen in how the
    circles in it are foreshortened.

    Attributes:
        height: of the plane along the axis, from the twist's anchor. It is no unknown: nothing holds the scale.
        weight: (N,) px^2 over a squared length; empty where the link may have any shape.
    """

    height: float
    weight: np.ndarray

    @classmethod
    def of(cls, b: Bundle, s: Sightings, sigma: float) -> Flat:
        """The plane through the middle of the points of N tracks; sigma: their noise, px."""
        if s.flat is None:
            return cls(0.0, np.zeros(0))
        size = extent(b.X)
        weight = s.weight * s.lasting * (sigma / max(s.flat * size, 1e-9)) ** 2
        return cls(float(np.median((b.X - b.twist.anchor) @ b.twist.axis)), weight)

    def off(self, b: Bundle) -> np.ndarray:
        """(N,) distances of the points from the plane."""
        return (b.X - b.twist.anchor) @ b.twist.axis - self.height

    def cost(self, b: Bundle) -> float:
        """Of all points, px^2; 0 where the link may have any shape."""
        return float(self.weight @ self.off(b) ** 2) if len(self.weight) else 0.0

    def slopes(self, b: Bundle) -> tuple[np.ndarray, np.ndarray]:
        """(N, 3, 3) and (N, 3) of half the cost by the points."""
        a = b.twist.axis
        if not len(self.weight):
            return np.zeros((len(b.X), 3, 3)), np.zeros((len(b.X), 3))
        return self.weight[:, None, None] * np.outer(a, a), (self.weight * self.off(b))[:, None] * a

    def add(self, n: Normal, b: Bundle) -> None:
        """Into the normal equations."""
        if not len(self.weight):
            return
        G = n.Z.shape[1]
        by_step = (b.X - b.twist.anchor) @ b.twist.axis_by_step(n.Z)  # (N, G)
        H, g = self.slopes(b)
        weighted = self.weight[:, None] * by_step
        scores = weighted * self.off(b)[:, None]
        n.Hp[...] += H
        n.gp[...] += g
        n.H[:G, :G] += by_step.T @ weighted
        n.g[:G] += scores.sum(0)
        n.scores[:, :G] += scores
        n.C[:G] += weighted.T[:, :, None] * b.twist.axis


@dataclass(frozen=True)
class Nearby:
    """How far the resting scene before a moving camera lies before or behind the link.

    What holds the camera's path holds its steps over the scene's depth alone. With the scene at infinity a camera at
    rest goes as far as it likes, and along with a joint of the wrong type until nothing contradicts that.

    Attributes:
        unit: depth of the link.  weight: (N,) px^2 over a squared logarithm, 0 of the link's points.
    """

    unit: float
    weight: np.ndarray

    @classmethod
    def of(cls, b: Bundle, s: Sightings, sigma: float) -> Nearby:
        """Of the points of N tracks; sigma: noise of the link's, px."""
        if s.link is None or s.link.all():
            return cls(1.0, np.zeros(0))
        unit = max(float(np.median(b.X[s.link, 2])), 1e-9)
        return cls(unit, np.where(s.link, 0.0, s.lasting * (sigma / BEYOND) ** 2 / np.sum(~s.link)))

    def _beyond(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N,) depths, and by how much their logarithms are out of bounds."""
        z = np.maximum(X[:, 2], 1e-6 * self.unit)
        log = np.log(z / self.unit)
        return z, np.sign(log) * np.maximum(np.abs(log) - np.log(NEARBY), 0.0)

    def cost(self, X: np.ndarray) -> float:
        """Of points (N, 3) in the first camera's frame, px^2."""
        return float(self.weight @ self._beyond(X)[1] ** 2) if len(self.weight) else 0.0

    def slopes(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N, 3, 3) and (N, 3) of half the cost by the points."""
        H, g = np.zeros((len(X), 3, 3)), np.zeros((len(X), 3))
        if len(self.weight):
            z, off = self._beyond(X)
            H[:, 2, 2] = self.weight * (off != 0) / z**2
            g[:, 2] = self.weight * off / z
        return H, g

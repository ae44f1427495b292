"""One family for slide, hinge and screw: motion along a constant twist.

A twist (w, v) at an origin o moves a point x with velocity w x (x - o) + v; after "time" s the link has the pose
exp(s (w, v)). A slide is w = 0, a hinge w . v = 0, a screw the rest: the slide is the limit of a hinge whose axis goes
to infinity, and no parameter becomes singular on the way (with an axis and a pivot the pivot would run away).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

KINDS = ("prismatic", "revolute", "screw")


@dataclass(frozen=True)
class Twist:
    """A twist of the scaled length 1.

    Attributes:
        kind: "prismatic" (w = 0), "revolute" (w . v = 0) or "screw".
        w: (3,) rad per unit of s.  v: (3,) length per unit of s, of the point that is at `origin`.
        origin: (3,) world.  size: length of the link, which makes w and v comparable: |size w|^2 + |v|^2 = 1.
    """

    kind: str
    w: np.ndarray
    v: np.ndarray
    origin: np.ndarray
    size: float

    @property
    def xi(self) -> np.ndarray:
        """(6,) angular part first."""
        return np.concatenate([self.w, self.v])

    def basis(self) -> np.ndarray:
        """(6, d) orthonormal (in scaled coordinates) directions in which the twist may change; d is 2, 4 or 5."""
        scale = np.repeat([self.size, 1.0], 3)
        own = self.xi * scale
        rows = [own]
        if self.kind == "prismatic":
            rows += [np.eye(6)[k] for k in range(3)]
        elif self.kind == "revolute":
            rows.append(np.concatenate([self.v, self.w]) / scale)
        _, values, vt = np.linalg.svd(np.stack(rows))
        return vt[np.count_nonzero(values > 1e-12) :].T / scale[:, None]

    def moved(self, step: np.ndarray) -> tuple[Twist, float]:
        """The twist after a step in its basis, and the factor by which its states grow (the scaled length stays 1)."""
        xi = self.xi + self.basis() @ step
        return make(self.kind, xi[:3], xi[3:], self.origin, self.size)

    def poses(self, s: np.ndarray) -> np.ndarray:
        """(T, 4, 4) exp(s (w, v)) about the origin, in world coordinates."""
        s = np.asarray(s, float)
        R, V = rotation(s[:, None] * self.w)
        T = np.tile(np.eye(4), (len(s), 1, 1))
        T[:, :3, :3] = R
        T[:, :3, 3] = self.origin + np.einsum("tij,tj->ti", V, s[:, None] * self.v) - R @ self.origin
        return T

    def spatial_jacobian(self, s: np.ndarray) -> np.ndarray:
        """(T, 6, 6): how exp(s xi) turns and shifts, in world axes about the origin, when xi changes.

        s times the left Jacobian of SE(3), by its power series (20 terms are exact to rounding for half turns).
        """
        ad = np.zeros((6, 6))
        W, V = skew(self.w), skew(self.v)
        ad[:3, :3] = ad[3:, 3:] = W
        ad[3:, :3] = V
        power, out = np.eye(6), np.zeros((len(s), 6, 6))
        factor = np.array(s, float)  # s^(n+1) / (n+1)!
        for n in range(24):
            out += factor[:, None, None] * power
            power = power @ ad
            factor = factor * s / (n + 2)
        return out

    def joint(self) -> tuple[np.ndarray, np.ndarray | None, float | None, float]:
        """Unit axis, point on it (None of a slide; the one nearest to the origin), pitch (of a screw), and dq/ds."""
        if self.kind == "prismatic":
            rate = np.linalg.norm(self.v)
            return self.v / rate, None, None, float(rate)
        rate = np.linalg.norm(self.w)
        axis = self.w / rate
        point = self.origin + np.cross(self.w, self.v) / rate**2
        return axis, point, float(axis @ self.v / rate) if self.kind == "screw" else None, float(rate)


def make(kind: str, w: np.ndarray, v: np.ndarray, origin: np.ndarray, size: float) -> tuple[Twist, float]:
    """A twist of that kind nearest to (w, v), normalised; and the length it had."""
    if kind == "prismatic":
        w = np.zeros(3)
    elif kind == "revolute":
        n2 = w @ w
        if n2 > 0:
            v = v - (v @ w) * w / n2
    length = float(np.sqrt(size**2 * (w @ w) + v @ v))
    return Twist(kind, w / length, v / length, origin, size), length


def skew(v: np.ndarray) -> np.ndarray:
    """(..., 3, 3) cross-product matrices."""
    x, y, z = np.moveaxis(np.asarray(v, float), -1, 0)
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)


def rotation(phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(T, 3) rotation vectors -> (T, 3, 3) rotations and (T, 3, 3) left Jacobians; smooth at zero."""
    a2 = np.sum(phi**2, axis=-1)
    a = np.sqrt(a2)
    small = a < 1e-4
    safe = np.where(small, 1.0, a)
    A = np.where(small, 1 - a2 / 6, np.sin(safe) / safe)[:, None, None]
    B = np.where(small, 0.5 - a2 / 24, (1 - np.cos(safe)) / safe**2)[:, None, None]
    C = np.where(small, 1 / 6 - a2 / 120, (safe - np.sin(safe)) / safe**3)[:, None, None]
    K = skew(phi)
    K2 = K @ K
    return np.eye(3) + A * K + B * K2, np.eye(3) + B * K + C * K2

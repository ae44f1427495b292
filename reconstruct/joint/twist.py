"""One family for every joint of one degree of freedom: a constant twist, written at a point of the link.

The link moves by exp(q xi). At the anchor g the twist's velocity is the unit vector d, so q is the path length there;
w is the rotation per unit of that length, the curvature of the path:

    x_t = g + exp(q_t w) (x - g) + q_t V(q_t w) d,      dx_t / dq = w x (x_t - g) + d.

A slide is w = 0, reached smoothly by hinges that lie farther and farther away; a hinge has w perpendicular to d;
a screw has both parts, its pitch is (w . d) / |w|^2. (Lynch and Park, Modern Robotics, chapter 3.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruct.joint.hypotheses import perpendicular_basis


def skew(v: np.ndarray) -> np.ndarray:
    """(..., 3) -> (..., 3, 3) with skew(a) @ b = a x b."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def _coefficients(angle: np.ndarray) -> tuple[np.ndarray, ...]:
    """sin(t)/t, (1 - cos t)/t^2, (t - sin t)/t^3 and their derivatives over t, all smooth at 0."""
    t = np.asarray(angle, float)
    small = np.abs(t) < 1e-2
    s = np.where(small, 1.0, t)
    sin, cos = np.sin(s), np.cos(s)
    t2 = t**2
    a = np.where(small, 1 - t2 / 6 + t2**2 / 120, sin / s)
    b = np.where(small, 0.5 - t2 / 24 + t2**2 / 720, (1 - cos) / s**2)
    c = np.where(small, 1 / 6 - t2 / 120 + t2**2 / 5040, (s - sin) / s**3)
    da = np.where(small, -1 / 3 + t2 / 30, (s * cos - sin) / s**3)
    db = np.where(small, -1 / 12 + t2 / 180, (s * sin - 2 * (1 - cos)) / s**4)
    dc = np.where(small, -1 / 60 + t2 / 1260, (s * (1 - cos) - 3 * (s - sin)) / s**5)
    return a, b, c, da, db, dc


@dataclass(frozen=True)
class Twist:
    """A joint's motion.

    Attributes:
        anchor: (3,) g.  direction: (3,) d, unit.  curvature: (3,) w, 1 / length.
    """

    anchor: np.ndarray
    direction: np.ndarray
    curvature: np.ndarray

    @property
    def axis(self) -> np.ndarray:
        """(3,) unit: of rotation, or of the slide where there is none."""
        k = np.linalg.norm(self.curvature)
        return self.curvature / k if k > 0 else self.direction

    @property
    def point(self) -> np.ndarray:
        """(3,) the point of the rotation axis that is nearest to the anchor."""
        return self.anchor + np.cross(self.curvature, self.direction) / (self.curvature @ self.curvature)

    @property
    def pitch(self) -> float:
        """Length per radian along the axis."""
        return float(self.curvature @ self.direction / (self.curvature @ self.curvature))

    def pose(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (T, 3, 3) about the anchor and its displacements (T, 3)."""
        q = np.asarray(q, float)
        phi = q[:, None] * self.curvature
        R = Rotation.from_rotvec(phi).as_matrix()
        _, b, c, *_ = _coefficients(np.linalg.norm(phi, axis=-1))
        a = _coefficients(np.linalg.norm(phi, axis=-1))[0]
        d = self.direction
        V = a[:, None] * d + b[:, None] * np.cross(phi, d) + c[:, None] * phi * (phi @ d)[:, None]
        return R, q[:, None] * V

    def displacement_by_curvature(self, q: np.ndarray) -> np.ndarray:
        """(T, 3, 3) derivatives of the anchor's displacement by w."""
        phi = q[:, None] * self.curvature
        d = self.direction
        a, b, c, da, db, dc = _coefficients(np.linalg.norm(phi, axis=-1))
        cross, dot = np.cross(phi, d), phi @ d
        slope = da[:, None] * d + db[:, None] * cross + dc[:, None] * phi * dot[:, None]
        D = slope[:, :, None] * phi[:, None] - b[:, None, None] * skew(d)
        D += c[:, None, None] * (dot[:, None, None] * np.eye(3) + phi[:, :, None] * d)
        return (q**2)[:, None, None] * D

    def displacement_by_direction(self, q: np.ndarray) -> np.ndarray:
        """(T, 3, 3) derivatives of the anchor's displacement by d: q V(q w)."""
        phi = q[:, None] * self.curvature
        a, b, c, *_ = _coefficients(np.linalg.norm(phi, axis=-1))
        V = a[:, None, None] * np.eye(3) + b[:, None, None] * skew(phi)
        V += c[:, None, None] * phi[:, :, None] * phi[:, None]
        return q[:, None, None] * V

    def left_jacobian(self, q: np.ndarray) -> np.ndarray:
        """(T, 3, 3) of the rotations exp(q w)."""
        phi = q[:, None] * self.curvature
        a, b, c, *_ = _coefficients(np.linalg.norm(phi, axis=-1))
        J = a[:, None, None] * np.eye(3) + b[:, None, None] * skew(phi)
        return J + c[:, None, None] * phi[:, :, None] * phi[:, None]

    def axis_by_step(self, steps: np.ndarray) -> np.ndarray:
        """(3, G) derivatives of the axis by steps (6, G) of direction and curvature."""
        k = float(np.linalg.norm(self.curvature))
        if k == 0:
            return steps[:3]
        return (np.eye(3) - np.outer(self.axis, self.axis)) @ steps[3:] / k

    def tangent(self, kind: str) -> np.ndarray:
        """(6, G) basis of the steps (direction, curvature) that keep |d| = 1 and the kind's constraint."""
        basis = np.zeros((6, 5))
        basis[:3, :2] = perpendicular_basis(self.direction)
        basis[3:, 2:] = np.eye(3)
        if kind == "prismatic":
            return basis[:, :2]
        if kind == "screw":
            return basis
        # Hinge: w . d = 0 has to stay.
        row = np.concatenate([self.curvature @ basis[:3, :2], self.direction])
        _, _, vt = np.linalg.svd(row[None])
        return basis @ vt[1:].T

    def moved(self, step: np.ndarray, kind: str) -> Twist:
        """A step (6,) taken and the constraints restored."""
        d = self.direction + step[:3]
        d = d / np.linalg.norm(d)
        w = self.curvature + step[3:]
        if kind == "prismatic":
            w = np.zeros(3)
        elif kind == "revolute":
            w = w - (w @ d) * d
        return Twist(self.anchor, d, w)


def twist_of_joint(kind: str, axis: np.ndarray, point: np.ndarray | None, anchor: np.ndarray) -> tuple[Twist, float]:
    """The same motion as a twist, and the path length at the anchor for one unit of q (rad, or length).

    The anchor must not lie on a hinge's axis.
    """
    if kind == "prismatic":
        return Twist(anchor, axis / np.linalg.norm(axis), np.zeros(3)), 1.0
    velocity = np.cross(axis, anchor - point)
    speed = float(np.linalg.norm(velocity))
    return Twist(anchor, velocity / speed, axis / speed), speed

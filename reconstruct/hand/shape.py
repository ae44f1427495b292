"""The moving link as the hand meets it: signed distance to its convex parts, and the faces that can be pushed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reconstruct.geometry import LinkMesh
from reconstruct.joint.models import JointFit


class LinkShape:
    """Union of a link's convex parts, in the link's frame (the world's at q = 0), metres.

    The distance outside is that to the farthest face plane: exact in front of a face, a lower bound at an edge.
    """

    def __init__(self, link: LinkMesh) -> None:
        from scipy.spatial import ConvexHull, QhullError

        self.planes: list[np.ndarray] = []
        self.points, self.normals = np.zeros((0, 3)), np.zeros((0, 3))
        self.link = link
        parts = [np.asarray(vertices, float) for vertices, _ in link.parts] or [np.asarray(link.vertices, float)]
        samples = []
        for vertices in parts:
            try:
                hull = ConvexHull(vertices)
            except QhullError:  # flat: no hand can push it in the simulation either
                continue
            self.planes.append(np.unique(np.round(hull.equations, 9), axis=0))
            samples.append((vertices, hull))
        if not samples:
            raise ValueError("the moving link has no solid part")
        corners = np.concatenate(parts)
        self.size = float(np.linalg.norm(np.ptp(corners, axis=0)))
        self.centre = corners.mean(0)
        rng = np.random.default_rng(0)
        share = sum(h.area for _, h in samples)
        points, normals = [], []
        for vertices, hull in samples:
            a, b, c = (vertices[hull.simplices[:, i]] for i in range(3))
            area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
            pick = rng.choice(len(area), max(8, int(1500 * hull.area / share)), p=area / area.sum())
            s, t = np.sqrt(rng.random(len(pick))), rng.random(len(pick))
            points.append((1 - s)[:, None] * a[pick] + (s * (1 - t))[:, None] * b[pick] + (s * t)[:, None] * c[pick])
            normals.append(hull.equations[pick, :3])
        points, normals = np.concatenate(points), np.concatenate(normals)
        free = self.distance(points + 1e-3 * normals)[0] > 5e-4  # not where two parts meet
        self.points, self.normals = points[free], normals[free]

    def with_parts(self, parts: tuple[tuple[np.ndarray, np.ndarray], ...]) -> LinkShape:
        """The link with further convex parts, each (vertices (v, 3), faces (f, 3))."""
        own = self.link.parts or ((self.link.vertices, self.link.faces),)
        return LinkShape(replace(self.link, parts=(*own, *parts)))

    def thickness(self, x: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """m (...,) of the thickest part that a ray from x (..., 3) along a unit direction (3,) passes through."""
        flat = np.asarray(x, float).reshape(-1, 3)
        best = np.zeros(len(flat))
        for planes in self.planes:
            height, rate = flat @ planes[:, :3].T + planes[:, 3], planes[:, :3] @ direction
            with np.errstate(divide="ignore", invalid="ignore"):
                meets = -height / rate
            into = np.where(rate < -1e-9, meets, 0.0).max(1)
            out = np.where(rate > 1e-9, meets, np.inf).min(1)
            beside = ((np.abs(rate) <= 1e-9) & (height > 0)).any(1)
            best = np.maximum(best, np.where(beside, 0.0, out - np.maximum(into, 0.0)))
        return best.reshape(x.shape[:-1])

    def distance(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Signed distance (...,) m, negative inside, and outward normal (..., 3) at x (..., 3)."""
        flat = np.asarray(x, float).reshape(-1, 3)
        best, normal = np.full(len(flat), np.inf), np.zeros((len(flat), 3))
        for planes in self.planes:
            height = flat @ planes[:, :3].T + planes[:, 3]
            top = height.argmax(1)
            value = height[np.arange(len(flat)), top]
            nearer = value < best
            best[nearer], normal[nearer] = value[nearer], planes[top[nearer], :3]
        return best.reshape(x.shape[:-1]), normal.reshape(x.shape)


def drive_direction(fit: JointFit, x: np.ndarray, sign: float) -> np.ndarray:
    """Unit direction (..., 3) in which points x (..., 3) of the link move, link frame."""
    if fit.type == "prismatic":
        return np.broadcast_to(sign * fit.axis, x.shape)
    v = sign * np.cross(np.broadcast_to(fit.axis, x.shape), x - fit.point)
    if fit.type == "screw":
        v = v + sign * (fit.pitch or 0.0) * fit.axis
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)


def lever(fit: JointFit, x: np.ndarray) -> np.ndarray:
    """Distance (...,) m from the axis; ones for a prismatic joint."""
    if fit.type == "prismatic":
        return np.ones(x.shape[:-1])
    return np.linalg.norm(np.cross(np.broadcast_to(fit.axis, x.shape), x - fit.point), axis=-1)

"""What a drawer's front pulls behind it: a tray that no view decides, completed by extrusion along the slide.

A front that slides square to its face out of a body, by q, uncovers what lies at least q deep behind it: a drawer. Its
tray lies on other planes than the front, mostly in shadow, and is lost to the silhouettes. What must be there is put
there and marked ``assumed``: a bottom, two sides and a back, open at the top.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from shapely.geometry import Polygon

from reconstruct.geometry.collision import Part
from reconstruct.geometry.outline import Shape
from reconstruct.geometry.plane import LinkPlane
from reconstruct.geometry.solids import closing_direction, from_arrays, hull, to_arrays
from reconstruct.joint.models import JointFit

if TYPE_CHECKING:
    from manifold3d import Manifold

EXTENSION = 0.75
"""Share of its depth by which a drawer on common single slides comes out (three-quarter extension); the tray is as deep
as the travel over this, as far as the body behind the front has room, and never less than the travel."""
INSET = 0.05
"""Between the tray and the front's edge, of the front's smaller side: the body's wall and the slides."""
HEIGHT = 0.8
"""Of the tray's sides, in parts of the front's height less the inset."""
WALL = 0.025
"""Thickness, in parts of the front's smaller side; at least 6 mm."""
RECTANGULAR = 0.75
"""Intersection over union of a front with its best rectangle below which nobody knows what is behind it."""


@dataclass(frozen=True)
class Tray:
    """World frame, at q = 0.

    Attributes:
        plates: convex bottom, sides and back, each (vertices, faces).
        room: the tray with all that could lie in it, one convex part: the body is kept out of it.
        depth: behind the front.
    """

    plates: tuple[Part, ...]
    room: Part
    depth: float


def assume_tray(fit: JointFit, plane: LinkPlane, shape: Shape, end: float, depth: float) -> Tray | None:
    """The tray behind a drawer's front, or None where the moving link is not one.

    It is one when it slides along its own normal, away from the side that was seen as it closes, when it stands
    upright (the world's z is up) and when its outline is a rectangle, more or less: the picture often adds what lies
    below, of the same make and in the shadow of the same arm.

    Args:
        end: the state at which it is closed.
        depth: of the body behind the closed front.
    """
    low, high = shape.bounds
    inward = closing_direction(fit, plane.to_world((low + high) / 2), end)
    up = plane.pose[:3, :2].T @ np.array([0.0, 0.0, 1.0])
    if fit.type != "prismatic" or float(plane.pose[:3, 2] @ inward) > -0.9 or np.linalg.norm(up) < 0.7:
        return None
    # The front's rectangle with its second side upwards, in the plane.
    v = up / np.linalg.norm(up)
    turn = np.stack([[v[1], -v[0]], v])
    outline = max(shape.slices, key=lambda s: s.outline.area).outline
    outline = outline if isinstance(outline, Polygon) else outline.convex_hull
    a, b, share = best_rectangle(np.asarray(outline.exterior.coords)[:-1] @ turn.T)
    if share < RECTANGULAR:
        return None
    travel = float(np.ptp(fit.q))
    small = float((b - a).min())
    inset = INSET * small
    wall = max(WALL * small, 0.006 if fit.metric else 0.0)
    a, b = a + inset, b - inset
    b[1] = a[1] + HEIGHT * (b[1] - a[1])
    if (b - a).min() < 6 * wall:
        return None
    depth = max(travel, min(travel / EXTENSION, depth - wall))
    back = float(low[2])
    front = back + 0.25 * float(high[2] - low[2])  # into the front, so that they are one body

    def plate(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Part:
        flat = np.array([[s, t] for s in x for t in y]) @ turn
        corners = np.array([[*uv, n] for uv in flat for n in z])
        return to_arrays(hull(plane.to_world(corners)))

    inside = (back - depth, front)
    plates = (
        plate((a[0], b[0]), (a[1], a[1] + wall), inside),
        plate((a[0], a[0] + wall), (a[1], b[1]), inside),
        plate((b[0] - wall, b[0]), (a[1], b[1]), inside),
        plate((a[0], b[0]), (a[1], b[1]), (back - depth, back - depth + wall)),
    )
    return Tray(plates, plate((a[0], b[0]), (a[1], b[1]), inside), depth)


def best_rectangle(ring: np.ndarray, cells: int = 32) -> tuple[np.ndarray, np.ndarray, float]:
    """The rectangle along the axes that agrees most with a polygon (k, 2): its low and high corner, and their
    intersection over union.

    A ragged side or a neighbour taken in moves it less than they move the bounding box.
    """
    import cv2

    low, high = ring.min(0), ring.max(0)
    cell = (high - low) / cells
    grid = np.zeros((cells, cells), np.uint8)
    cv2.fillPoly(grid, [np.round(((ring - low) / cell - 0.5) * 16).astype(np.int32)], 1, shift=4)
    total = np.zeros((cells + 1, cells + 1))
    total[1:, 1:] = grid.cumsum(0).cumsum(1)
    i, j = np.triu_indices(cells + 1, 1)  # all pairs of a first and a last line
    inside = total[j][:, j] - total[j][:, i] - total[i][:, j] + total[i][:, i]
    area = np.outer(j - i, j - i)
    share = inside / (area + grid.sum() - inside)
    rows, columns = np.unravel_index(int(share.argmax()), share.shape)
    a, b = np.array([i[columns], i[rows]]), np.array([j[columns], j[rows]])
    return low + a * cell, low + b * cell, float(share.max())


def with_tray(solid: Manifold, tray: Tray) -> Manifold:
    """The front and its tray as one solid."""
    from manifold3d import Manifold, OpType

    return Manifold.batch_boolean([solid, *(from_arrays(v, f) for v, f in tray.plates)], OpType.Add)

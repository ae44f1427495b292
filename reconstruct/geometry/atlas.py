"""A picture for a mesh: faces that look the same way share a chart, charts share an image, texels are points.

The mesh stays as coarse as its shape, and all detail is in the image, so that an asset is small and looks like what was
filmed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reconstruct.geometry import Skin

CONE = np.cos(np.radians(25.0))
"""Faces of one chart look no farther than this from its first face."""
BUDGET = 480 * 480
"""Texels of an image, at most about."""
MARGIN = 2
"""Texels around a chart that carry its colours on, so that no filter reaches another chart."""


@dataclass(frozen=True)
class Atlas:
    """Where a mesh's faces lie in an image, and which point of the surface each texel is.

    Attributes:
        vertices (V, 3), faces (F, 3): the mesh.
        corners: (F, 3, 2) px (column, row) of the faces' corners.
        normals: (F, 3, 3) unit, smooth within a chart.
        size: (height, width) px.
        texel: (n, 2) (row, column) of the texels that lie on a face or just beside one.
        points, directions: (n, 3) their places on the surface and its normals there.
    """

    vertices: np.ndarray
    faces: np.ndarray
    corners: np.ndarray
    normals: np.ndarray
    size: tuple[int, int]
    texel: np.ndarray
    points: np.ndarray
    directions: np.ndarray

    def skin(self, colours: np.ndarray) -> Skin:
        """The mesh with its picture; ``colours`` (n, 3) uint8 RGB of the texels. Texels off the faces repeat others."""
        from scipy.ndimage import distance_transform_edt

        image = np.zeros((*self.size, 3), np.uint8)
        empty = np.ones(self.size, bool)
        image[self.texel[:, 0], self.texel[:, 1]] = colours
        empty[self.texel[:, 0], self.texel[:, 1]] = False
        near = distance_transform_edt(empty, return_distances=False, return_indices=True)
        height, width = self.size
        uv = (self.corners + 0.5) / [width, height]
        uv[..., 1] = 1 - uv[..., 1]
        return Skin(self.vertices, self.faces, uv, self.normals, image[near[0], near[1]])


def make_atlas(vertices: np.ndarray, faces: np.ndarray, density: float) -> Atlas:
    """Charts of a closed mesh in one image.

    Args:
        vertices, faces: (V, 3), (F, 3).
        density: texels per unit of length that the video can fill; less is used where the image would be too large.
    """
    cross = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    area = np.linalg.norm(cross, axis=1) / 2
    normal = cross / np.maximum(2 * area[:, None], 1e-30)
    chart = charts_of(faces, normal, area)
    flat = _flatten(vertices, faces, chart, normal, area)
    extent = np.array([np.ptp(f.reshape(-1, 2), axis=0) for f in flat])
    density = min(density, float(np.sqrt(BUDGET / max(extent.prod(1).sum(), 1e-30))))
    members = [np.flatnonzero(chart == k) for k in range(len(flat))]
    boxes = np.maximum(np.ceil(extent * density).astype(int), 1) + 1 + 2 * MARGIN
    place, size = _pack(boxes)
    corners = np.empty((len(faces), 3, 2))
    for k, f in enumerate(flat):
        corners[members[k]] = (f - f.reshape(-1, 2).min(0)) * density + place[k] + MARGIN
    normals = _chart_normals(faces, chart, cross)
    rows, points, directions = [], [], []
    for k in range(len(flat)):
        texel, owner, weight = _rasterise(corners[members[k]], place[k], boxes[k])
        face = members[k][owner]
        rows.append(texel)
        points.append(np.einsum("nk,nkd->nd", weight, vertices[faces[face]]))
        directions.append(np.einsum("nk,nkd->nd", weight.clip(0, 1), normals[face]))
    towards = np.concatenate(directions)
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    return Atlas(vertices, faces, corners, normals, size, np.concatenate(rows), np.concatenate(points), towards)


def charts_of(faces: np.ndarray, normal: np.ndarray, area: np.ndarray) -> np.ndarray:
    """(F,) chart of each face: grown over edges from the largest face that has none, within a cone around it."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    same = (edges[order[1:]] == edges[order[:-1]]).all(1)
    a, b = owner[order[:-1][same]], owner[order[1:][same]]
    neighbours: list[list[int]] = [[] for _ in faces]
    for i, j in zip(a, b, strict=True):
        neighbours[i].append(int(j))
        neighbours[j].append(int(i))
    chart = np.full(len(faces), -1)
    count = 0
    for seed in np.argsort(-area, kind="stable"):
        if chart[seed] >= 0:
            continue
        chart[seed] = count
        queue = [int(seed)]
        while queue:
            for j in neighbours[queue.pop()]:
                if chart[j] < 0 and normal[j] @ normal[seed] > CONE:
                    chart[j] = count
                    queue.append(j)
        count += 1
    return chart


def _flatten(vertices: np.ndarray, faces: np.ndarray, chart: np.ndarray, normal: np.ndarray,
             area: np.ndarray) -> list[np.ndarray]:  # fmt: skip
    """Each chart's faces (f, 3, 2), projected along its mean normal and turned to lie along its longer side."""
    out = []
    for k in range(chart.max() + 1):
        members = np.flatnonzero(chart == k)
        up = (normal[members] * area[members, None]).sum(0)
        up /= max(np.linalg.norm(up), 1e-30)
        side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        side /= np.linalg.norm(side)
        basis = np.stack([side, np.cross(up, side)], axis=1)
        flat = vertices[faces[members]] @ basis
        spread = flat.reshape(-1, 2) - flat.reshape(-1, 2).mean(0)
        _, axes = np.linalg.eigh(spread.T @ spread)
        # Both columns turned together: a reflection would mirror the picture.
        turn = np.stack([axes[:, 1], [-axes[1, 1], axes[0, 1]]], axis=1)
        out.append(flat @ turn)
    return out


def _pack(boxes: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """Places (k, 2) (column, row) of boxes (k, 2) (width, height) on shelves, tallest first; and (height, width)."""
    width = int(max(boxes[:, 0].max(), np.sqrt(1.1 * boxes.prod(1).sum())))
    place = np.zeros((len(boxes), 2), int)
    x = y = shelf = 0
    for k in np.argsort(-boxes[:, 1], kind="stable"):
        w, h = boxes[k]
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        place[k] = x, y
        x, shelf = x + w, max(shelf, h)
    return place, (int(y + shelf), width)


def _chart_normals(faces: np.ndarray, chart: np.ndarray, cross: np.ndarray) -> np.ndarray:
    """(F, 3, 3) unit normals at the faces' corners, averaged over the faces of the same chart that share the corner."""
    _, key = np.unique(np.stack([np.repeat(chart, 3), faces.ravel()], axis=1), axis=0, return_inverse=True)
    total = np.zeros((key.max() + 1, 3))
    np.add.at(total, key.ravel(), np.repeat(cross, 3, axis=0))
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
    return total[key.ravel()].reshape(-1, 3, 3)


def _rasterise(corners: np.ndarray, place: np.ndarray, box: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Texels within or just beside the triangles of one chart.

    Args:
        corners: (f, 3, 2) px.  place, box: the chart's corner and size, px.

    Returns:
        (n, 2) (row, column), (n,) the triangle that is nearest, (n, 3) barycentric coordinates in it.
    """
    w, h = (int(v) for v in box)
    best = np.full((h, w), -np.inf)
    owner = np.zeros((h, w), int)
    weight = np.zeros((h, w, 3))
    for i, tri in enumerate(corners - place):
        a, b, c = tri
        det = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
        if abs(det) < 1e-9:
            continue
        low = np.maximum(np.floor(tri.min(0)).astype(int) - MARGIN, 0)
        high = np.minimum(np.ceil(tri.max(0)).astype(int) + MARGIN + 1, [w, h])
        x, y = np.meshgrid(np.arange(low[0], high[0]) - a[0], np.arange(low[1], high[1]) - a[1])
        u = (x * (c[1] - a[1]) - y * (c[0] - a[0])) / det
        v = (y * (b[0] - a[0]) - x * (b[1] - a[1])) / det
        bary = np.stack([1 - u - v, u, v], axis=-1)
        # How far inside, px: the least distance to the sides, negative outside.
        heights = abs(det) / np.maximum(np.linalg.norm(tri[[2, 0, 1]] - tri[[1, 2, 0]], axis=1), 1e-9)
        inside = (bary * heights).min(-1)
        window = (slice(low[1], high[1]), slice(low[0], high[0]))
        better = (inside > best[window]) & (inside > -MARGIN)
        best[window][better] = inside[better]
        owner[window][better] = i
        weight[window][better] = bary[better]
    row, column = np.nonzero(np.isfinite(best))
    return np.stack([row + place[1], column + place[0]], axis=1), owner[row, column], weight[row, column]

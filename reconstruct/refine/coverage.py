"""Differentiable silhouettes of articulated meshes: face ids from a painter's raster, coverage at the edges in torch.

Which face covers a pixel does not change under a small step; how much of a pixel next to an edge is covered does. So
the ids are drawn once a step without a derivative, and only the pixels at silhouette edges get one: the place where the
edge crosses the line between two pixel centres (Laine et al. 2020, "Modular primitives for
high-performance differentiable rendering", analytic antialiasing).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

SUBPIXEL_BITS = 5
FINER = 4
"""The raster is drawn this many times finer and read at pixel centres: OpenCV also fills the pixels under the outline,
which would widen every face by half a pixel of its own grid."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh without what a raster does not need.

    Attributes:
        vertices: (V, 3) world, at q = 0.  faces: (F, 3) int.
    """

    vertices: np.ndarray
    faces: np.ndarray


@dataclass(frozen=True)
class Edges:
    """Where silhouette edges cross the lines between neighbouring pixel centres, E of them.

    Attributes:
        inside, outside: (E,) flat pixel indices; the link is visible at ``inside`` and not at ``outside``.
        place: (E,) share of the way from inside to outside at which the link ends, carries the derivative.
        uv: (E, 2) px of the crossing, carries the derivative.
        share: (E,) of an edge's motion counted in this direction; a slanted edge crosses rows and columns alike.
    """

    inside: torch.Tensor
    outside: torch.Tensor
    place: torch.Tensor
    uv: torch.Tensor
    share: torch.Tensor


def face_ids(uv: np.ndarray, depth: np.ndarray, faces: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Index of the face seen at each pixel, -1 where there is none.

    Args:
        uv: (V, 2) px.  depth: (V,) along the optical axis.  faces: (F, 3), outward normals or not.
        size: (width, height) px.

    Returns:
        (height, width) int32.
    """
    w, h = size
    ids = np.full((FINER * (h - 1) + 1, FINER * (w - 1) + 1), -1, np.int32)
    corners = uv[faces]
    near = depth[faces].min(1) > 1e-6
    onto = (corners[..., 0].max(1) >= 0) & (corners[..., 0].min(1) <= w - 1)
    onto &= (corners[..., 1].max(1) >= 0) & (corners[..., 1].min(1) <= h - 1) & np.isfinite(corners).all((1, 2))
    drawn = np.flatnonzero(near & onto)
    order = drawn[np.argsort(-depth[faces[drawn]].mean(1), kind="stable")]
    fixed = np.round(np.clip(corners, -4 * w, 5 * w) * FINER * (1 << SUBPIXEL_BITS)).astype(np.int32)
    for k in order:
        cv2.fillConvexPoly(ids, fixed[k], int(k), cv2.LINE_8, SUBPIXEL_BITS)
    return np.ascontiguousarray(ids[::FINER, ::FINER])


@dataclass(frozen=True)
class Topology:
    """Edges of a mesh and the faces beside them.

    Attributes:
        ends: (M, 2) vertices of each edge.
        beside: (M, 2) its faces; the second is -1 at a rim and where three or more meet.
    """

    ends: np.ndarray
    beside: np.ndarray

    @staticmethod
    def of(faces: np.ndarray) -> Topology:
        """Of faces (F, 3)."""
        pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        owner = np.tile(np.arange(len(faces)), 3)
        ends, which, count = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
        order = np.argsort(which.ravel(), kind="stable")
        first = np.concatenate([[0], np.cumsum(count)[:-1]])
        beside = np.full((len(ends), 2), -1)
        beside[:, 0] = owner[order[first]]
        two = count == 2
        beside[two, 1] = owner[order[first[two] + 1]]
        return Topology(ends, beside)

    def outline(self, uv: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """(S,) edges at which the mesh turns away from the camera, or ends, in a picture with vertices at uv (V, 2)."""
        p, q, r = (uv[faces[:, k]] for k in range(3))
        front = (q[:, 0] - p[:, 0]) * (r[:, 1] - p[:, 1]) > (q[:, 1] - p[:, 1]) * (r[:, 0] - p[:, 0])
        return np.flatnonzero((self.beside[:, 1] < 0) | (front[self.beside[:, 0]] != front[self.beside[:, 1]]))


def link_edges(ids: np.ndarray, uv: torch.Tensor, depth: np.ndarray, faces: np.ndarray, of_link: np.ndarray,
               topology: Topology) -> Edges:  # fmt: skip
    """Silhouette edges of one link in a drawn picture.

    An edge between the link and what is behind it belongs to the link, one between the link and what hides it to the
    other link.

    Args:
        ids: (H, W) of :func:`face_ids`.  uv: (V, 2) px, carries the derivative.  depth: (V,).
        faces: (F, 3) of both links.  of_link: (F,) bool, the faces of the link.  topology: of ``faces``.
    """
    h, w = ids.shape
    seen = np.concatenate([of_link, [False]])[ids].ravel()
    face_depth = np.concatenate([depth[faces].mean(1), [np.inf]])
    index = np.arange(h * w).reshape(h, w)
    pairs = np.concatenate([np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], 1),
                            np.stack([index[:-1].ravel(), index[1:].ravel()], 1)])  # fmt: skip
    pairs = pairs[seen[pairs[:, 0]] != seen[pairs[:, 1]]]
    inside = np.where(seen[pairs[:, 0]], pairs[:, 0], pairs[:, 1])
    outside = pairs.sum(1) - inside
    flat = ids.ravel()
    own = face_depth[flat[inside]] <= face_depth[flat[outside]]
    start = np.stack([inside % w, inside // w], 1).astype(float)
    along = np.stack([outside % w, outside // w], 1) - start

    corners = uv.detach().numpy()
    outline = topology.outline(corners, faces)
    edge_own = of_link[topology.beside[outline, 0]]
    best = np.full(len(pairs), -1)
    for mine in (True, False):
        rows, these = np.flatnonzero(own == mine), outline[edge_own == mine]
        if len(rows) and len(these):
            best[rows] = _nearest_crossing(start[rows], along[rows], corners[topology.ends[these]], these)
    ok = best >= 0
    inside, outside, start, along, best = inside[ok], outside[ok], start[ok], along[ok], best[ok]

    ends = torch.from_numpy(topology.ends[best])
    p, d = uv[ends[:, 0]], uv[ends[:, 1]] - uv[ends[:, 0]]
    o, v = torch.from_numpy(start), torch.from_numpy(along)
    rhs = p - o
    s = (rhs[:, 1] * d[:, 0] - rhs[:, 0] * d[:, 1]) / (v[:, 1] * d[:, 0] - v[:, 0] * d[:, 1])
    with torch.no_grad():
        share = (v[:, 1] * d[:, 0] - v[:, 0] * d[:, 1]).square() / d.square().sum(1)
    return Edges(torch.from_numpy(inside), torch.from_numpy(outside), s, o + s[:, None] * v, share)


def _nearest_crossing(start: np.ndarray, along: np.ndarray, edges: np.ndarray, names: np.ndarray) -> np.ndarray:
    """(E,) name of the edge that crosses each pair of pixel centres, -1 where none does.

    Args:
        start, along: (E, 2) the inside centre and the step to the outside one, px.
        edges: (S, 2, 2) ends, px.  names: (S,).
    """
    p, d = edges[:, 0], edges[:, 1] - edges[:, 0]
    det = along[:, None, 1] * d[:, 0] - along[:, None, 0] * d[:, 1]
    rhs = p[None] - start[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (rhs[..., 1] * d[:, 0] - rhs[..., 0] * d[:, 1]) / det
        r = (along[:, None, 0] * rhs[..., 1] - along[:, None, 1] * rhs[..., 0]) / det
    # A raster and a vertex that has moved since it was drawn differ by a fraction of a pixel.
    valid = (s > -0.4) & (s < 1.4) & (r >= -1e-9) & (r <= 1 + 1e-9)
    off = np.where(valid, np.abs(s - 0.5), np.inf)
    best = off.argmin(1)
    return np.where(np.isfinite(off[np.arange(len(best)), best]), names[best], -1)


def coverage(ids: np.ndarray, of_link: np.ndarray, edges: Edges) -> torch.Tensor:
    """(H, W) share of each pixel that the link covers, with derivatives at its edges.

    Args:
        ids: of :func:`face_ids`.  of_link: (F,) bool.  edges: of :func:`link_edges` for the same link.
    """
    seen = np.concatenate([of_link, [False]])[ids]
    flat = torch.from_numpy(seen.ravel().astype(float))
    more = torch.zeros_like(flat).index_add(0, edges.outside, edges.share * (edges.place - 0.5).clamp(min=0.0))
    less = torch.zeros_like(flat).index_add(0, edges.inside, edges.share * (0.5 - edges.place).clamp(min=0.0))
    return (flat + more - less).clamp(0.0, 1.0).reshape(ids.shape)

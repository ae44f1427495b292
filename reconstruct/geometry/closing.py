"""One closed surface from a mesh that somebody gave: overlapping pieces united, open ones wrapped.

A mesh of a scene is often a heap of closed pieces that overlap or touch (boxes put together, an image-to-3D network's
shells), or a surface with holes. Convex decomposition needs one closed surface that does not cut through itself.

- :func:`unite` is exact: every piece is a solid, their boolean union is the surface (manifold3d).
- :func:`wrap` always has an answer: what a flood from outside cannot reach through the surface, on a grid, is inside,
  and the zero level of the distance is the surface. It is a fraction of a cell larger than what it wraps, which gives
  sheets a thickness.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reconstruct.errors import TaaError

WRAP_CELLS = 72
"""Cells along the longest side when a surface is wrapped."""
SHELL = 0.6
"""How far the wrapped surface stands off, in cells: enough that a sheet between two grid points is not lost."""
CONVEX = 0.97
"""Share of its convex hull's volume above which a piece counts as convex."""


@dataclass(frozen=True)
class Union:
    """Pieces of a mesh as one solid.

    Attributes:
        vertices: (V, 3).  faces: (F, 3) of the closed surface round all pieces.
        pieces: each (vertices (v, 3), faces (f, 3)), outward.
        convex: every piece is its convex hull, or nearly.
    """

    vertices: np.ndarray
    faces: np.ndarray
    pieces: tuple[tuple[np.ndarray, np.ndarray], ...]
    convex: bool


def unite(vertices: np.ndarray, faces: np.ndarray) -> Union | None:
    """Boolean union of the connected pieces of a mesh, or None where one of them is no solid.

    Args:
        vertices: (V, 3).  faces: (F, 3). Pieces that are inside out are turned.
    """
    from manifold3d import Error, Manifold, OpType

    from reconstruct.geometry.solids import from_arrays, hull, to_arrays

    for merged in (False, True):
        solids = []
        for v, f in _pieces(vertices, faces, merged):
            solid = from_arrays(v, f)
            if solid.status() == Error.NoError and solid.volume() < 0:
                solid = from_arrays(v, f[:, ::-1])
            if solid.status() != Error.NoError or solid.volume() <= 0:
                solids = []
                break
            solids.append(solid)
        if solids:
            break
    else:
        return None
    whole = Manifold.batch_boolean(solids, OpType.Add) if len(solids) > 1 else solids[0]
    if whole.status() != Error.NoError or whole.is_empty():
        return None
    pieces = tuple(to_arrays(s) for s in solids)
    convex = all(s.volume() > CONVEX * hull(v).volume() for s, (v, _) in zip(solids, pieces, strict=True))
    return Union(*to_arrays(whole), pieces, convex)


def _pieces(vertices: np.ndarray, faces: np.ndarray, merged: bool) -> list[tuple[np.ndarray, np.ndarray]]:
    """Connected pieces; a face without area belongs to none.

    Args:
        merged: corners at one place are one. A file with its own corners for every face holds no piece otherwise, but
            of two boxes that lie against each other it makes one thing that is no solid.
    """
    import trimesh

    size = float(np.ptp(vertices, axis=0).max())
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if merged:
        digits = max(0, int(np.ceil(6 - np.log10(size))))
        mesh.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=digits)
    mesh.update_faces(mesh.nondegenerate_faces())
    if not len(mesh.faces):
        return []
    groups = trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(len(mesh.faces)), min_len=1)
    out = []
    for group in groups:
        used, index = np.unique(mesh.faces[group], return_inverse=True)
        out.append((np.asarray(mesh.vertices)[used], index.reshape(-1, 3)))
    return out


def wrap(vertices: np.ndarray, faces: np.ndarray, cells: int = WRAP_CELLS) -> tuple[np.ndarray, np.ndarray]:
    """A closed surface around any mesh, holes of up to two cells closed.

    Args:
        vertices: (V, 3).  faces: (F, 3).  cells: along the longest side; what is finer is lost.

    Raises:
        TaaError: the mesh has no area.
    """
    from scipy import ndimage
    from scipy.spatial import cKDTree

    corners = np.asarray(vertices, float)[np.asarray(faces)]
    cell = float(np.ptp(corners.reshape(-1, 3), axis=0).max()) / cells
    samples = _spread(corners, 0.45 * cell)
    low = samples.min(0) - 4 * cell
    counts = np.ceil((samples.max(0) + 4 * cell - low) / cell).astype(int) + 1
    wall = np.zeros(counts, bool)
    spot = np.floor((samples - low) / cell).astype(int)
    for corner in np.ndindex(2, 2, 2):  # all grid points round a sample: no flood passes between them
        wall[tuple((spot + corner).T)] = True
    # Holes of up to two cells: what closing shuts the flood out of counts as inside.
    shut = ndimage.binary_closing(wall, iterations=2)
    pieces, _ = ndimage.label(~shut)
    enclosed = ~shut & (pieces != pieces[0, 0, 0])
    field = np.full(wall.shape, -2.0 * cell)
    near = ndimage.binary_dilation(wall, iterations=2)
    where = np.argwhere(near)
    distance = cKDTree(samples).query(low + cell * where)[0]
    field[near] = SHELL * cell - distance
    field[shut & ~wall] = np.maximum(field[shut & ~wall], SHELL * cell)
    field[enclosed] = np.maximum(SHELL * cell, np.abs(field[enclosed]))
    return zero_level(field, low, cell)


def _spread(corners: np.ndarray, spacing: float) -> np.ndarray:
    """(n, 3) points on triangles (F, 3, 3), neighbours no farther apart than ``spacing``."""
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    steps = np.maximum(1, np.ceil(sides / spacing)).astype(int)
    out = []
    for n in np.unique(steps):
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        keep = i + j <= n
        weight = np.stack([i[keep], j[keep], n - i[keep] - j[keep]], axis=1) / n
        out.append(np.einsum("wc,fcd->fwd", weight, corners[steps == n]).reshape(-1, 3))
    if not out:
        raise TaaError("the mesh has no faces; export a surface")
    return np.concatenate(out)


def zero_level(field: np.ndarray, low: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Closed surface of the zero level of a field on a grid, positive inside; small pieces are dropped.

    Args:
        field: (nx, ny, nz), first point at ``low`` (3,), points ``cell`` apart.

    Raises:
        TaaError: nothing is inside.
    """
    from manifold3d import Manifold

    from reconstruct.geometry.solids import largest_piece, to_arrays

    if not (field > 0).any():
        raise TaaError("the meshes given do not agree on any solid; give better meshes or fewer")
    nx, ny, nz = field.shape
    values = field.tolist()

    def at(x: float, y: float, z: float) -> float:
        """Trilinear interpolation, in plain Python: the caller asks one point at a time."""
        u, v, w = (x - low[0]) / cell, (y - low[1]) / cell, (z - low[2]) / cell
        i, j, k = int(u), int(v), int(w)
        if u < 0 or v < 0 or w < 0 or i >= nx - 1 or j >= ny - 1 or k >= nz - 1:
            return -cell
        a, b, c = u - i, v - j, w - k
        p, r = values[i], values[i + 1]
        near = (p[j][k] * (1 - c) + p[j][k + 1] * c) * (1 - b) + (p[j + 1][k] * (1 - c) + p[j + 1][k + 1] * c) * b
        far = (r[j][k] * (1 - c) + r[j][k + 1] * c) * (1 - b) + (r[j + 1][k] * (1 - c) + r[j + 1][k + 1] * c) * b
        return near * (1 - a) + far * a

    high = low + cell * (np.array(field.shape) - 1)
    solid = Manifold.level_set(at, [*low.tolist(), *high.tolist()], cell, 0.0)
    if solid.is_empty():
        raise TaaError("the meshes given do not agree on any solid; give better meshes or fewer")
    return to_arrays(largest_piece(solid, 0.05).simplify(0.3 * cell))

"""Signed distances to closed quad meshes, and seeded 3D noise: what the hand and the objects are made of."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import reduce

import numpy as np
from numpy.typing import ArrayLike

Sdf = Callable[[np.ndarray], np.ndarray]
"""(N, 3) points in metres -> (N,) signed distances in metres, negative inside."""


def tapered_capsule(x: np.ndarray, a: ArrayLike, b: ArrayLike, ra: float, rb: float) -> np.ndarray:
    """(N,) distance from (N, 3) points to a capsule whose radius runs linearly from ra at a to rb at b."""
    a, b = np.asarray(a, np.float32), np.asarray(b, np.float32)
    ba = b - a
    pa = x - a
    h = np.clip(pa @ ba / max(float(ba @ ba), 1e-12), 0.0, 1.0)
    return np.linalg.norm(pa - h[:, None] * ba, axis=1) - (ra + (rb - ra) * h)


def smooth_min(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    """Union of two distances whose crease is filled over a width k, m."""
    h = np.maximum(k - np.abs(a - b), 0.0) / k
    return np.minimum(a, b) - h * h * k * 0.25


def smooth_union(parts: Iterable[np.ndarray], k: float) -> np.ndarray:
    """Smooth minimum of several distances, from the first to the last."""
    return reduce(lambda a, b: smooth_min(a, b, k), parts)


def gradient(sdf: Sdf, x: np.ndarray, step: float = 3e-4) -> np.ndarray:
    """(N, 3) unit outward normals by central differences."""
    g = np.stack([sdf(x + step * e) - sdf(x - step * e) for e in np.eye(3, dtype=np.float32)], axis=1)
    return g / np.maximum(np.linalg.norm(g, axis=1, keepdims=True), 1e-12)


def surface_quads(sdf: Sdf, lower: np.ndarray, upper: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Closed quad mesh of the zero level (naive surface nets, then Newton steps onto the level).

    Args:
        sdf: distance function.
        lower, upper: (3,) box that holds the whole surface, m.
        cell: grid spacing, m.

    Returns:
        vertices (V, 3) m and quads (F, 4), counter-clockwise seen from outside.
    """
    axes = [np.arange(lo - cell, hi + 2 * cell, cell, dtype=np.float32) for lo, hi in zip(lower, upper, strict=True)]
    shape = tuple(len(a) for a in axes)
    # Far from the surface only the sign matters: coarse blocks decide where the fine grid is evaluated.
    block = 4
    centres = [a[0] + cell * (np.arange(-(-len(a) // block)) * block + 0.5 * (block - 1)) for a in axes]
    far = sdf(np.stack(np.meshgrid(*centres, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32))
    far = far.reshape(tuple(len(c) for c in centres))
    value = np.kron(far, np.ones((block, block, block), np.float32))[: shape[0], : shape[1], : shape[2]]
    near = np.argwhere(np.abs(value) < 0.75 * block * cell + 0.006)
    origin = np.array([a[0] for a in axes], np.float32)
    value[tuple(near.T)] = sdf(origin + np.float32(cell) * near.astype(np.float32))
    inside = value < 0
    cells = tuple(n - 1 for n in shape)
    corners = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    count = np.zeros(cells, np.int32)
    total = np.zeros((*cells, 3), np.float32)

    def view(array: np.ndarray, o: tuple[int, ...]) -> np.ndarray:
        return array[o[0] : o[0] + cells[0], o[1] : o[1] + cells[1], o[2] : o[2] + cells[2]]

    for axis in range(3):
        for c in corners:
            if c[axis]:
                continue
            d = tuple(v + (m == axis) for m, v in enumerate(c))
            va, vb = view(value, c), view(value, d)
            cross = (va < 0) != (vb < 0)
            t = np.where(cross, va / np.where(cross, va - vb, 1.0), 0.0)
            for m in range(3):
                total[..., m] += np.where(cross, c[m] + (t if m == axis else 0.0), 0.0)
            count += cross
    used = count > 0
    number = np.full(cells, -1, np.int64)
    number[used] = np.arange(used.sum())
    where = np.argwhere(used)
    vertices = origin + cell * (where + total[used] / count[used][:, None])
    quads = []
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        low = tuple(slice(1, -1) if m != axis else slice(0, -1) for m in range(3))
        high = tuple(slice(1, -1) if m != axis else slice(1, None) for m in range(3))
        a_in, b_in = inside[low], inside[high]
        for sign, cross in ((1, a_in & ~b_in), (-1, ~a_in & b_in)):
            at = np.argwhere(cross)
            at[:, b] += 1
            at[:, c] += 1
            eb, ec = np.eye(3, dtype=int)[b], np.eye(3, dtype=int)[c]
            ring = [number[tuple((at - o).T)] for o in (eb + ec, ec, 0 * eb, eb)]
            quads.append(np.stack(ring if sign > 0 else ring[::-1], axis=1))
    for _ in range(2):
        n = gradient(sdf, vertices)
        vertices = (vertices - np.clip(sdf(vertices), -cell, cell)[:, None] * n).astype(np.float32)
    return vertices, np.concatenate(quads)


class Noise:
    """Smooth seeded value noise in [-1, 1] over space, the same for the same seed."""

    def __init__(self, seed: int, size: int = 32):
        self._table = np.random.default_rng(seed).uniform(-1.0, 1.0, (size, size, size)).astype(np.float32)

    def __call__(self, x: np.ndarray, wavelength: ArrayLike, octaves: int = 1) -> np.ndarray:
        """(N, 3) points in metres -> (N,) values; wavelength in metres, one a direction if an array."""
        from scipy.ndimage import map_coordinates

        out = np.zeros(len(x), np.float32)
        weight, total = 1.0, 0.0
        p = np.asarray(x, np.float32) / np.asarray(wavelength, np.float32)
        for _ in range(octaves):
            out += weight * map_coordinates(self._table, p.T, order=1, mode="grid-wrap")
            total += weight
            p, weight = p * 2.03 + 7.7, weight * 0.55
        return out / total

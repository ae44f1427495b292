"""Where the rays of pixels first meet a mesh, and what that says about depth: scale of a mesh, places of tracks."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

CELLS = 4_000_000
"""Ray-triangle pairs that are looked at at once."""


def first_hits(vertices: np.ndarray, faces: np.ndarray, K: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """(N,) depth at which each pixel's ray first meets a mesh, NaN where it does not; exact, whatever way faces turn.

    Args:
        vertices: (V, 3) camera frame, right, down, forward.  faces: (F, 3).  K: (3, 3).  uv: (N, 2) px of the same K.
    """
    uv = np.asarray(uv, float)
    out = np.full(len(uv), np.nan)
    corners = np.asarray(vertices, float)[np.asarray(faces)]
    corners = corners[(corners[..., 2] > 1e-9).all(1)]
    if not len(corners) or not len(uv):
        return out
    image = corners @ np.asarray(K, float).T
    image = image[..., :2] / image[..., 2:]
    a, b, c = image[:, 0], image[:, 1], image[:, 2]
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    good = np.abs(area) > 1e-12
    a, b, c, area, inverse = a[good], b[good], c[good], area[good], 1.0 / corners[good][..., 2]
    step = max(1, CELLS // max(1, len(a)))
    for start in range(0, len(uv), step):
        p = uv[start : start + step, None]
        finite = np.isfinite(p).all(-1)
        # Barycentric coordinates in the picture; 1 / z is linear there.
        w0 = ((b[:, 0] - p[..., 0]) * (c[:, 1] - p[..., 1]) - (b[:, 1] - p[..., 1]) * (c[:, 0] - p[..., 0])) / area
        w1 = ((c[:, 0] - p[..., 0]) * (a[:, 1] - p[..., 1]) - (c[:, 1] - p[..., 1]) * (a[:, 0] - p[..., 0])) / area
        w2 = 1.0 - w0 - w1
        inside = (w0 >= -1e-9) & (w1 >= -1e-9) & (w2 >= -1e-9) & finite
        nearness = np.where(inside, w0 * inverse[:, 0] + w1 * inverse[:, 1] + w2 * inverse[:, 2], 0.0).max(1)
        out[start : start + step] = np.where(nearness > 0, 1.0 / np.maximum(nearness, 1e-12), np.nan)
    return out


def scale_to(vertices: np.ndarray, faces: np.ndarray, K: np.ndarray, uv: np.ndarray, z: np.ndarray,
             least: int = 8) -> float | None:  # fmt: skip
    """Factor about the camera that brings a mesh's surface to known depths; None where fewer than ``least`` rays hit.

    A monocular mesh has the right outline at an unknown distance: only this factor is missing.

    Args:
        vertices: (V, 3) camera frame.  uv: (N, 2) px.  z: (N,) depth of what is seen there.
    """
    hit = first_hits(vertices, faces, K, uv)
    both = np.isfinite(hit) & np.isfinite(z) & (np.nan_to_num(z) > 0)
    if both.sum() < least:
        return None
    return float(np.exp(np.median(np.log(z[both] / hit[both]))))


def ground_tracks(xyz_world: np.ndarray, uv: np.ndarray, visible: np.ndarray,
                  meshes: Mapping[int, tuple[np.ndarray, np.ndarray]], K: np.ndarray, T_world_camera: np.ndarray,
                  most: float = 0.1) -> tuple[np.ndarray, int]:  # fmt: skip
    """Tracks with the depth of key frames replaced by the first meeting of their ray with that frame's mesh.

    A ray that misses, or whose hit lies more than a share ``most`` of its depth away from the lifted point (another
    surface), keeps the lifted point.

    Args:
        xyz_world: (N, T, 3) lifted.  uv: (N, T, 2) full px.  visible: (N, T).
        meshes: key frame -> vertices (V, 3) in that frame's camera, faces.  K: (T, 3, 3).  T_world_camera: (T, 4, 4).

    Returns:
        (N, T, 3), and how many places were replaced.
    """
    out, count = np.array(xyz_world, float), 0
    for frame, (vertices, faces) in meshes.items():
        seen = np.flatnonzero(visible[:, frame] & np.isfinite(uv[:, frame]).all(-1))
        if not len(seen):
            continue
        T = np.asarray(T_world_camera, float)[frame]
        z = (out[seen, frame] - T[:3, 3]) @ T[:3, 2]
        hit = first_hits(vertices, faces, K[frame], uv[seen, frame])
        ok = np.isfinite(hit) & (~np.isfinite(z) | (np.abs(hit / z - 1) < most))
        pixels = np.concatenate([uv[seen[ok], frame], np.ones((int(ok.sum()), 1))], axis=1)
        rays = pixels @ np.linalg.inv(K[frame]).T
        out[seen[ok], frame] = (rays * hit[ok, None]) @ T[:3, :3].T + T[:3, 3]
        count += int(ok.sum())
    return out, count

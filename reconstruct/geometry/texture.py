"""Colours from the video for the vertices of a mesh."""

from __future__ import annotations

import numpy as np

from reconstruct.joint.models import JointFit
from reconstruct.video import Video

TARGET_FACES = 4000
REMAP = 30_000
GREY = np.array([150.0, 150.0, 150.0])


def subdivide(vertices: np.ndarray, faces: np.ndarray, target: int = TARGET_FACES) -> tuple[np.ndarray, np.ndarray]:
    """Split long edges until a colour per vertex can carry a texture; the surface stays the same and closed."""
    from reconstruct.geometry.solids import from_arrays, to_arrays

    solid = from_arrays(vertices, faces)
    edge = float(np.sqrt(2.3 * solid.surface_area() / target))
    return to_arrays(solid.refine_to_length(edge))


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(F, 3) unit face normals and (V, 3) unit vertex normals (by area)."""
    cross = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    n = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(n, faces[:, k], cross)
    def unit(x: np.ndarray) -> np.ndarray:
        return x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-15)
    return unit(cross), unit(n)


def paint(video: Video, fit: JointFit, points: np.ndarray, normals: np.ndarray, frames: np.ndarray,
          allowed: np.ndarray, moves: bool, depth_of: list[tuple[np.ndarray, np.ndarray, bool]]
          ) -> tuple[np.ndarray, np.ndarray]:
    """Colour each point of a surface from the frames that see it most squarely.

    Args:
        video: stabilised.
        points, normals: (n, 3) world, q = 0; unit normals.
        frames: (F',) frames to take colours from.
        allowed: (F', h, w) bool, pixels that may be used in each.
        moves: whether this is the moving link.
        depth_of: meshes (vertices, faces, moves) that can hide a point.

    Returns:
        colors (n, 4) uint8 RGBA and seen (n,) bool. Unseen points take the colour of the nearest seen one, darkened.
    """
    import cv2

    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    camera = -fit.T_camera_world[:3, :3].T @ fit.T_camera_world[:3, 3]
    best = np.zeros((3, len(points)))
    colour = np.zeros((3, len(points), 3))
    still = np.eye(4)
    for k, t in enumerate(frames):
        T = fit.link_pose(float(fit.q[t]))
        own = T if moves else still
        x = points @ own[:3, :3].T + own[:3, 3]
        n = normals @ own[:3, :3].T
        to_camera = camera - x
        cosine = np.einsum("ij,ij->i", n, to_camera) / np.maximum(np.linalg.norm(to_camera, axis=1), 1e-12)
        uv = video.to_work(fit.project(x))
        z = x @ fit.T_camera_world[2, :3] + fit.T_camera_world[2, 3]
        px = np.round(np.nan_to_num(uv, nan=-9)).clip(-9, 99999).astype(int)
        h, w = allowed.shape[1:]
        ok = (z > 0) & (cosine > 0.15) & (px >= 0).all(1) & (px[:, 0] < w) & (px[:, 1] < h)
        pc = px.clip(0, [w - 1, h - 1])
        ok &= allowed[k][pc[:, 1], pc[:, 0]]
        ok &= z <= _nearest(fit, video, depth_of, T, pc, (w, h)) + 0.03 * size
        at = np.nan_to_num(uv, nan=-9).clip(0, [w - 1, h - 1]).astype(np.float32)
        c = np.empty((len(points), 3))
        for i in range(0, len(points), REMAP):  # OpenCV maps no more columns at once
            c[i : i + REMAP] = cv2.remap(video.frames[t], at[None, i : i + REMAP, 0], at[None, i : i + REMAP, 1],
                                         cv2.INTER_LINEAR)[0]  # fmt: skip
        weight = np.where(ok, cosine**2 + 1e-3, 0.0)
        # Keep the three best views of each vertex, best first.
        for slot in range(3):
            better = weight > best[slot]
            best[slot, better], weight[better] = weight[better], best[slot, better]
            colour[slot, better], c[better] = c[better], colour[slot, better]
    seen = best[0] > 0
    # A view almost as good as the best may vote; the median drops a passing highlight.
    votes = np.where((best > 0.5 * best[0])[..., None] & (best > 0)[..., None], colour, np.nan)
    out = np.tile(GREY * 0.6, (len(points), 1))
    if seen.any():
        ordered = np.sort(votes[:, seen], axis=0)
        count = np.isfinite(ordered[..., 0]).sum(0)
        middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None, :, None] // 2, 0)[0]
        out[seen] = middle
        if not seen.all():
            from scipy.spatial import cKDTree

            # What was not seen is likely to go on as what was seen beside it, and stays darker to be told apart.
            out[~seen] = 0.75 * middle[cKDTree(points[seen]).query(points[~seen])[1]]
    rgba = np.full((len(points), 4), 255, np.uint8)
    rgba[:, :3] = np.clip(out[:, ::-1], 0, 255)
    return rgba, seen


def _nearest(fit: JointFit, video: Video, meshes: list[tuple[np.ndarray, np.ndarray, bool]], T: np.ndarray,
             px: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(V,) depth of the nearest surface at each pixel, by drawing triangles far to near at a quarter of the size."""
    import cv2

    w, h = size[0] // 4 + 1, size[1] // 4 + 1
    buffer = np.full((h, w), np.inf, np.float32)
    tris, depths = [], []
    for vertices, faces, moves in meshes:
        x = vertices @ T[:3, :3].T + T[:3, 3] if moves else vertices
        z = x @ fit.T_camera_world[2, :3] + fit.T_camera_world[2, 3]
        uv = video.to_work(fit.project(x)) / 4
        fine = (z[faces] > 0).all(1) & np.isfinite(uv[faces]).all((1, 2)) & (np.abs(uv[faces]) < 1e4).all((1, 2))
        tris.append(uv[faces[fine]])
        depths.append(z[faces[fine]].max(1))
    if tris:
        tri, depth = np.concatenate(tris), np.concatenate(depths)
        for i in np.argsort(-depth, kind="stable"):
            cv2.fillConvexPoly(buffer, np.round(tri[i]).astype(np.int32), float(depth[i]))
    return buffer[px[:, 1] // 4, px[:, 0] // 4]

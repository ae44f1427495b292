"""Surfaces on disk: coloured meshes for the eye, convex parts for contact, and the inertia they stand for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from taa_envs.errors import AssetError

MAX_FACES = 20_000
COLOUR_STEP = 12  # grey levels within a face above which it is split, so that a coarse mesh keeps its picture
MIN_EDGE_SHARE = 1 / 150  # of the mesh's size: smaller faces are never split
SOLID_THICKNESS = 1e-5  # m; a collision part thinner than this is not a solid


class Link(Protocol):
    """A link's surface and collision parts; :class:`reconstruct.geometry.LinkMesh` is one.

    vertices: (V, 3) m.  faces: (F, 3).  colors: (V, 3) or (V, 4) uint8.  parts: convex (vertices (v, 3), faces (f, 3)).
    An attribute ``skin``, where there is one, is what it looks like: vertices, faces, uv (F, 3, 2), normals (F, 3, 3)
    and image (h, w, 3) uint8; without it each face takes the mean colour of its corners.
    """

    @property
    def vertices(self) -> np.ndarray: ...
    @property
    def faces(self) -> np.ndarray: ...
    @property
    def colors(self) -> np.ndarray: ...
    @property
    def parts(self) -> Sequence[tuple[np.ndarray, np.ndarray]]: ...


def _arrays(link: Link) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    vertices, faces = np.asarray(link.vertices, float), np.asarray(link.faces)
    colours = np.asarray(link.colors)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) < 3 or not np.isfinite(vertices).all():
        raise AssetError(f"mesh vertices must be (V, 3) finite numbers, have shape {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
        raise AssetError(f"mesh faces must be (F, 3) indices of its {len(vertices)} vertices, have shape {faces.shape}")
    if colours.shape[:1] != (len(vertices),) or colours.ndim != 2 or colours.shape[1] not in (3, 4):
        raise AssetError(f"mesh colours must be (V, 3) or (V, 4), have shape {colours.shape}")
    return vertices, faces.astype(np.int64), colours[:, :3].astype(float)


def _refine(vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split faces whose corners differ in colour until one colour a face will do."""
    from trimesh.remesh import subdivide

    smallest = MIN_EDGE_SHARE * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    for _ in range(6):
        corners = colours[faces]
        edges = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=2).max(axis=1)
        split = np.flatnonzero((np.ptp(corners, axis=1).max(axis=1) > COLOUR_STEP) & (edges > smallest))
        if not len(split) or len(faces) + 3 * len(split) > MAX_FACES:
            break
        vertices, faces, attributes = subdivide(vertices, faces, face_index=split,
                                                vertex_attributes={"colour": colours})
        colours = attributes["colour"]
    return vertices, faces, colours


def write_textured_obj(folder: Path, name: str, link: Link) -> None:
    """``name.obj`` and ``name.png``.

    Raises:
        AssetError: the link's arrays do not fit each other.
    """
    from PIL import Image

    skin = getattr(link, "skin", None)
    if skin is not None:
        vertices, faces, uv, normals, image = _skin_arrays(skin)
    else:
        vertices, faces, uv, image = _texel_a_face(link)
        normals = None
    Image.fromarray(image).save(folder / f"{name}.png", optimize=True)
    places, at = np.unique(np.round(uv.reshape(-1, 2), 5), axis=0, return_inverse=True)
    lines = [f"v {x:.5g} {y:.5g} {z:.5g}" for x, y, z in vertices]
    lines += [f"vt {u:.5f} {v:.5f}" for u, v in places]
    corners = np.stack([faces.ravel() + 1, at.ravel() + 1], axis=1)
    if normals is not None:
        directions, toward = np.unique(np.round(normals.reshape(-1, 3), 3), axis=0, return_inverse=True)
        lines += [f"vn {x:.3g} {y:.3g} {z:.3g}" for x, y, z in directions]
        corners = np.column_stack([corners, toward.ravel() + 1])
    words = ["/".join(str(i) for i in corner) for corner in corners]
    lines += [f"f {words[i]} {words[i + 1]} {words[i + 2]}" for i in range(0, len(words), 3)]
    (folder / f"{name}.obj").write_text("\n".join(lines) + "\n", encoding="ascii")


def _skin_arrays(skin: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    vertices, faces = np.asarray(skin.vertices, float), np.asarray(skin.faces)
    uv, normals, image = np.asarray(skin.uv, float), np.asarray(skin.normals, float), np.asarray(skin.image, np.uint8)
    if uv.shape != (len(faces), 3, 2) or normals.shape != (len(faces), 3, 3) or image.ndim != 3 or image.shape[2] != 3:
        raise AssetError(f"a skin needs uv (F, 3, 2), normals (F, 3, 3) and an image (h, w, 3), has {uv.shape}, "
                         f"{normals.shape} and {image.shape}")
    if not (np.isfinite(vertices).all() and np.isfinite(uv).all() and np.isfinite(normals).all()):
        raise AssetError("a skin's vertices, uv and normals must be finite")
    return vertices, faces, uv.clip(0, 1), normals, image


def _texel_a_face(link: Link) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """MuJoCo has no vertex colours, so each face gets a texel of its own.

    All three corners of a face name the centre of its texel: no seam, filter or mip level can mix faces.
    """
    vertices, faces, colours = _refine(*_arrays(link))
    side = int(np.ceil(np.sqrt(len(faces))))
    atlas = np.zeros((side * side, 3), np.uint8)
    atlas[:len(faces)] = np.clip(np.rint(colours[faces].mean(axis=1)), 0, 255)
    column, row = np.arange(len(faces)) % side, np.arange(len(faces)) // side
    uv = np.stack([(column + 0.5) / side, 1 - (row + 0.5) / side], axis=1)
    return vertices, faces, np.repeat(uv[:, None], 3, axis=1), atlas.reshape(side, side, 3)


def write_convex_part(path: Path, part: tuple[np.ndarray, np.ndarray]) -> bool:
    """Write the hull of a convex part; False if it is flat, which MuJoCo cannot collide with.

    Raises:
        AssetError: its vertices are not (v, 3) finite numbers.
    """
    from scipy.spatial import ConvexHull, QhullError

    points = np.asarray(part[0], float)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise AssetError(f"a collision part's vertices must be (v, 3) finite numbers, have shape {points.shape}")
    if len(points) < 4 or np.linalg.svd(points - points.mean(0), compute_uv=False)[-1] < SOLID_THICKNESS:
        return False
    try:
        hull = ConvexHull(points)
    except QhullError:
        return False
    index = np.full(len(points), -1)
    index[hull.vertices] = np.arange(len(hull.vertices))
    triangles = index[hull.simplices]
    corners = points[hull.simplices]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ij,ij->i", normal, hull.equations[:, :3]) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    lines = [f"v {x:.6g} {y:.6g} {z:.6g}" for x, y, z in points[hull.vertices]]
    lines += [f"f {a} {b} {c}" for a, b, c in triangles + 1]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return True


def link_inertia(link: Link, density: float, mass: float | None = None
                 ) -> tuple[float, np.ndarray, np.ndarray, float, str]:
    """Mass (kg), centre (3,) m, inertia about it (3, 3) kg m2, volume (m3), and a sentence on how.

    From the closed surface where it encloses a volume, from the union of the convex parts' hulls otherwise.

    Raises:
        AssetError: neither encloses a volume.
    """
    import trimesh

    vertices, faces, _ = _arrays(link)
    surface: Any = trimesh.Trimesh(vertices, faces, process=True)
    how = "volume of the closed surface times density"
    if not (surface.is_watertight and surface.volume > 0):
        hulls = [trimesh.PointCloud(np.asarray(p[0], float)).convex_hull for p in link.parts if len(p[0]) >= 4]
        if not hulls:
            raise AssetError("the moving link's surface is open and it has no collision part; close it")
        surface = trimesh.util.concatenate(hulls)
        how = "volume of the convex parts times density (the surface is not closed)"
    volume = float(surface.volume)
    scale = (mass / volume) if mass is not None else density
    tensor = scale * np.asarray(surface.moment_inertia)
    # MuJoCo wants moments that obey the triangle inequality with room to spare; a flat sheet sits on its edge.
    tensor = (tensor + tensor.T) / 2 + 1e-3 * np.trace(tensor) * np.eye(3)
    if not (volume > 0 and np.linalg.eigvalsh(tensor)[0] > 0):
        raise AssetError("the moving link encloses no volume; close its surface")
    return (volume * density if mass is None else mass, np.asarray(surface.center_mass, float), tensor, volume,
            how if mass is None else "mass given")

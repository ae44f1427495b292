"""Meshes of the links: masks, surfaces, collision parts, mass."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Skin:
    """A surface with a picture, world frame, at q = 0: the same solid as the link's mesh, in as few faces as will do.

    Attributes:
        vertices: (V, 3) m.  faces: (F, 3) int.
        uv: (F, 3, 2) of the faces' corners in [0, 1], v up.  normals: (F, 3, 3) there.
        image: (h, w, 3) uint8 RGB.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    normals: np.ndarray
    image: np.ndarray


@dataclass(frozen=True)
class LinkMesh:
    """One link as a closed surface, world frame, at q = 0.

    Attributes:
        vertices: (V, 3) m.  faces: (F, 3) int.  colors: (V, 4) uint8 RGBA.
        assumed: (F,) bool, faces that no pixel supports.
        parts: convex collision parts, each (vertices (v, 3), faces (f, 3)).
        skin: what it looks like, where a video coloured it.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    assumed: np.ndarray
    parts: tuple[tuple[np.ndarray, np.ndarray], ...]
    skin: Skin | None = None


@dataclass(frozen=True)
class Geometry:
    """The links. provenance: name -> {"value", "origin", "std"?} for every number used.

    further: moving links beside the first, of an object with several joints.
    """

    static: LinkMesh
    moving: LinkMesh
    provenance: dict = field(default_factory=dict)
    notes: tuple[str, ...] = field(default_factory=tuple)
    further: tuple[LinkMesh, ...] = ()

"""Meshes of the links: masks, surfaces, collision parts, mass."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class LinkMesh:
    """One link as a closed surface, world frame, at q = 0.

    Attributes:
        vertices: (V, 3) m.  faces: (F, 3) int.  colors: (V, 4) uint8 RGBA.
        assumed: (F,) bool, faces that no pixel supports.
        parts: convex collision parts, each (vertices (v, 3), faces (f, 3)).
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    assumed: np.ndarray
    parts: tuple[tuple[np.ndarray, np.ndarray], ...]


@dataclass(frozen=True)
class Geometry:
    """Both links. provenance: name -> {"value", "origin", "std"?} for every number used."""

    static: LinkMesh
    moving: LinkMesh
    provenance: dict = field(default_factory=dict)
    notes: tuple[str, ...] = field(default_factory=tuple)

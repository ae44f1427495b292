"""The report's 3D view: both links, the axis and the hand as plain arrays, and plotly.js packed into the page.

The page turns the moving link itself: it has the joint's axis and the state of every frame, so that one slider and the
video drive the same picture.
"""

from __future__ import annotations

import base64
import gzip
from functools import cache
from typing import Any

import numpy as np

from reconstruct.cues import HandReference
from reconstruct.geometry import Geometry, LinkMesh
from reconstruct.joint.models import JointFit

MAX_FACES = 60_000
"""Of one link in the page; a larger surface is thinned by leaving faces out of sight of a phone's memory."""
BONES = ((0, 1, 2, 3, 4), (0, 5, 6, 7, 8), (5, 9, 10, 11, 12), (9, 13, 14, 15, 16), (13, 17, 18, 19, 20), (0, 17))


def view(fit: JointFit, geometry: Geometry, reference: HandReference, time: np.ndarray) -> dict[str, Any]:
    """What the page's script draws, JSON-ready; arrays are base64 of little-endian float32 or uint32.

    Args:
        fit: with axis, point and q (T,).  geometry: both links at q = 0.
        reference: hand_joints (T, 21, 3) and hand_valid (T,), in the geometry's frame.
        time: (T,) s of the frames of the page's video.

    Returns:
        Links (vertices, faces, colours a vertex), axis (two ends), joint (type, axis, point), q and hand of every
        frame, and where to look from.
    """
    links = {"static": _link(geometry.static), "moving": _link(geometry.moving)}
    corners = np.concatenate([np.asarray(link.vertices, float) for link in (geometry.static, geometry.moving)])
    low, high = corners.min(0), corners.max(0)
    centre, size = (low + high) / 2, float(np.linalg.norm(high - low))
    axis = np.asarray(fit.axis, float)
    on = np.asarray(fit.point, float) if fit.point is not None else np.asarray(geometry.moving.vertices, float).mean(0)
    on = on + ((centre - on) @ axis) * axis
    T = np.asarray(fit.T_camera_world, float)
    eye = -T[:3, :3].T @ T[:3, 3] - centre
    q = np.asarray(fit.q, float)
    hand = np.asarray(reference.hand_joints, float)
    slide = fit.type == "prismatic"
    return {
        "links": links, "kind": fit.type, "axis": axis.tolist(), "pitch": float(fit.pitch or 0.0),
        "point": None if fit.point is None else np.asarray(fit.point, float).tolist(),
        "ends": [(on - 0.6 * size * axis).tolist(), (on + 0.6 * size * axis).tolist()],
        "q": _pack(q, np.float32), "low": float(np.nanmin(q)), "high": float(np.nanmax(q)),
        "time": _pack(np.asarray(time, float) - float(time[0]), np.float32),
        "hand": _pack(hand, np.float32) if len(hand) == len(q) else None, "bones": BONES,
        "seen": np.asarray(reference.hand_valid, bool).astype(int).tolist(),
        "factor": (1000.0 if fit.metric else 1.0) if slide else float(np.degrees(1.0)),
        "unit": ("mm" if fit.metric else "units") if slide else "°",
        "low_corner": low.tolist(), "high_corner": high.tolist(),
        "eye": (1.6 * eye / max(float(np.linalg.norm(eye)), 1e-9)).tolist(),
    }


@cache
def plotly_packed() -> str:
    """plotly.js, gzipped, in base64: a third of its size, unpacked by the browser. MIT licence, in its first lines."""
    import plotly.offline

    return base64.b64encode(gzip.compress(plotly.offline.get_plotlyjs().encode(), 9, mtime=0)).decode()


def _link(link: LinkMesh) -> dict[str, Any]:
    vertices, faces = np.asarray(link.vertices, float), np.asarray(link.faces)
    colours = np.asarray(link.colors)
    if len(faces) > MAX_FACES:
        faces = faces[np.linspace(0, len(faces) - 1, MAX_FACES).astype(int)]
    return {"xyz": _pack(vertices, np.float32), "ijk": _pack(faces, np.uint32), "rgb": _pack(colours[:, :3], np.uint8),
            "assumed": round(float(np.mean(link.assumed)), 3) if len(link.assumed) else 0.0}


def _pack(array: np.ndarray, kind: type) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype=np.dtype(kind).newbyteorder("<")).tobytes()).decode()

"""What a driving hand must be holding where the geometry shows nothing to hold.

Handles are thin, dark, and hidden by the hand that uses them: a mesh cut from silhouettes often has the handle's
picture painted on a flat face. The hand itself is the better witness. It is seen to move the part, contact alone moves
a part, and so there is something of the part before its finger tips in the direction of the motion. Where no face of
the geometry within the hand's own uncertainty can be pushed, the least that will do is added: a bar before the tips, on
two posts that stand on the nearest surface. It is an assumption and is marked as one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reconstruct.geometry import Geometry, LinkMesh
from reconstruct.hand.grip import PRESS, RADII, hidden, penetration
from reconstruct.hand.shape import LinkShape, drive_direction
from reconstruct.joint.models import JointFit

Part = tuple[np.ndarray, np.ndarray]
TIPS = (8, 12, 16)
THICK, POST = 0.008, 0.008  # m: bar along the motion, posts
MARGIN = 0.012  # m by which the bar's face goes beyond the tips, to either side: their place is known to a centimetre
CLEAR = 0.003  # m between finger tips and the surface that they reach behind the bar
STEPS = np.arange(0.0, 0.201, 0.004)  # m towards the camera
REACH = 0.08  # m, longest post: a hand farther off the part holds nothing of it
MIN_REACH = 0.006  # m, of a post that is worth adding


def _hull(points: np.ndarray) -> Part:
    from reconstruct.geometry.solids import hull, to_arrays

    return to_arrays(hull(points))


def _box(centre: np.ndarray, axes: np.ndarray, sizes: tuple[float, float, float]) -> np.ndarray:
    """(8, 3) corners; axes (3, 3) rows."""
    signs = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
    return centre + (signs * sizes) @ axes


def _in_front(shape: LinkShape, hand: np.ndarray, ray: np.ndarray) -> np.ndarray | None:
    """The hand (21, 3) moved towards the camera until it is clear of the link and none of its palm is behind it: it was
    seen, and a single view errs along the ray. None where it would have to come too far."""
    for step in STEPS:
        moved = hand - step * ray
        clear = shape.distance(moved[list(TIPS)])[0].min() >= RADII[TIPS[0]] + CLEAR
        if clear and penetration(shape, moved).max() < CLEAR and not hidden(shape, moved, ray):
            return moved
    return None


def assumed_handle(shape: LinkShape, fit: JointFit, sign: float, hand: np.ndarray, ray: np.ndarray
                   ) -> tuple[tuple[Part, ...], np.ndarray] | None:  # fmt: skip
    """A bar before the finger tips of a hand and its posts.

    Args:
        shape: the moving link.  fit: the joint, metric.  sign: of the drive along q.
        hand: (21, 3) m in the link's frame, where the hand was seen.  ray: (3,) unit viewing direction there.

    Returns:
        Convex parts (link frame, m), and the hand (21, 3) moved towards the camera where it had sunk into the link;
        None where it would have to be moved too far, or the tips are too far off the link.
    """
    moved = _in_front(shape, hand, ray)
    if moved is None:
        return None
    hand, tips = moved, moved[list(TIPS)]
    middle = tips.mean(0)
    forward = drive_direction(fit, middle, sign)
    along = tips[-1] - tips[0]
    along = along - (along @ forward) * forward
    if np.linalg.norm(along) < 0.01:  # fingers one before the other: any direction across will do
        along = np.linalg.svd(forward[None])[2][1]
    along = along / np.linalg.norm(along)
    axes = np.stack([forward, along, np.cross(forward, along)])
    # The tips press on the bar as on any face; a bar stands before the foremost one.
    ahead = float(((tips - middle) @ forward).max())
    centre = middle + (ahead + RADII[TIPS[0]] - PRESS + 0.5 * THICK) * forward
    place = (tips - middle) @ axes[1:].T
    length, height = np.ptp(place, axis=0) + 2 * MARGIN + np.array([2 * RADII[TIPS[0]], 0.0])
    centre = centre + 0.5 * (place.max(0) + place.min(0)) @ axes[1:]
    parts = [_hull(_box(centre, axes, (THICK, length, height)))]
    for side in (-1.0, 1.0):
        end = centre + side * 0.5 * (length - POST) * along
        foot = shape.points[int(np.linalg.norm(shape.points - end, axis=1).argmin())]
        gap = float(np.linalg.norm(foot - end))
        if gap > REACH:
            return None
        if gap > MIN_REACH:
            parts.append(_hull(np.concatenate([_box(end, axes, (THICK, POST, POST)), _box(foot, axes, (POST,) * 3)])))
    return tuple(parts), hand


def holding(geometry: Geometry, parts: tuple[Part, ...]) -> Geometry:
    """The geometry with parts added to the moving link, to its surface (marked assumed) and to its collision parts."""
    if not parts:
        return geometry
    entry = {"value": len(parts), "origin": "assumed",
             "note": "convex parts of a handle where the driving hand's finger tips pulled; the geometry shows none"}
    moving = geometry.moving
    for vertices, faces in parts:
        moving = _joined(moving, np.asarray(vertices, float), np.asarray(faces, int))
    return replace(geometry, moving=moving, provenance={**geometry.provenance, "moving.handle": entry})


def _joined(link: LinkMesh, vertices: np.ndarray, faces: np.ndarray) -> LinkMesh:
    """The link with one more convex part, in the colour of the surface nearest to it."""
    middle = vertices.mean(0)
    near = int(np.linalg.norm(link.vertices - middle, axis=1).argmin())
    skin = link.skin
    if skin is not None:
        corner = np.linalg.norm(skin.vertices[skin.faces] - middle, axis=2)
        f, c = np.unravel_index(int(corner.argmin()), corner.shape)
        a, b, d = (vertices[faces[:, i]] for i in range(3))
        normal = np.cross(b - a, d - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        skin = replace(skin, vertices=np.concatenate([skin.vertices, vertices]),
                       faces=np.concatenate([skin.faces, faces + len(skin.vertices)]),
                       uv=np.concatenate([skin.uv, np.broadcast_to(skin.uv[f, c], (len(faces), 3, 2))]),
                       normals=np.concatenate([skin.normals, np.repeat(normal[:, None], 3, 1)]))  # fmt: skip
    return replace(link, vertices=np.concatenate([link.vertices, vertices]),
                   faces=np.concatenate([link.faces, faces + len(link.vertices)]),
                   colors=np.concatenate([link.colors, np.repeat(link.colors[near][None], len(vertices), 0)]),
                   assumed=np.concatenate([link.assumed, np.ones(len(faces), bool)]),
                   parts=(*link.parts, (vertices, faces)), skin=skin)  # fmt: skip

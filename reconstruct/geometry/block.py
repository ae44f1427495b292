"""The static link: which end of the motion is its place, and a block there cut to what the picture shows of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from reconstruct.cues import LinkMasks
from reconstruct.geometry.layers import make_window, spread_frames, to_lab
from reconstruct.geometry.outline import Shape
from reconstruct.geometry.plane import LinkPlane
from reconstruct.geometry.solids import hull, static_box, to_arrays
from reconstruct.geometry.standing import Plate, cone, fill_hull, make_plate, project, separate, shown_through
from reconstruct.joint.models import JointFit
from reconstruct.video import Video

if TYPE_CHECKING:
    from manifold3d import Manifold

WIDEN = 0.8
"""Room across, in parts of the link's longest side, that the body of a bar that slides along itself may take: it is
wider than the bar. Bodies behind a face, and those under an arm, are about as wide as these."""
DISTINCT = 0.1
"""Contrast times share from which a region of the picture counts as a body of its own."""
CONTRAST = 0.4
"""A body that differs less from its surroundings is not cut out of them."""
FLAT = 0.85
"""Of a face's normal, upwards: beyond it the link lies flat."""


@dataclass(frozen=True)
class StaticBlock:
    """The static body before it is cut free of the moving part's path.

    Attributes:
        solid: the block.  end: the state at which the link is closed onto it.
        scores: {"start", "other"} of the two ends, and whether they differ enough: ``decided``.
        depth: of the block along the closing direction.
        seen: (h, w) bool, the body's pixels on the plate (the picture shrunk), or None where it could not be told
            from its surroundings.
        beneath: it lies behind the link's face, which slides along itself, and not where the link slides to.
    """

    solid: Manifold
    end: float
    scores: dict[str, float]
    decided: bool
    depth: float
    seen: np.ndarray | None
    beneath: bool = False


def place_block(video: Video, fit: JointFit, plane: LinkPlane, shape: Shape, masks: LinkMasks, costs: np.ndarray,
                surface: np.ndarray, clearance: float) -> StaticBlock:
    """Which end of the range is the closed one, and the body there.

    The block assumed at each end is drawn into the picture. For an end speak: colours like the link's (a body
    and its door, lid or arm are mostly of one make); pixels that differ from their surroundings (a wall or a
    table goes on, a body does not). Against it: hands that pass where it would be, a place outside the
    picture, and parts of the link that it would hide though they were seen.

    Args:
        costs: (T,) from :func:`reconstruct.geometry.layers.frame_costs`.
        surface: (n, 3) points of the moving link's surface, world at q = 0.
    """
    import cv2

    ends = [float(fit.q.min()), float(fit.q.max())]
    frames = spread_frames(fit, costs, 16)
    plate = make_plate(video, masks, frames)
    window = make_window(video, fit, plane)
    some = frames[:: max(1, len(frames) // 8)]
    link = np.concatenate([to_lab(window.crop(video.frames[t]))[window.crop(masks.moving[t])] for t in some])
    mean = _histogram(link)
    shrunk = np.stack([cv2.resize(masks.hand[t].astype(np.uint8), plate.size, interpolation=cv2.INTER_NEAREST) > 0
                       for t in frames])
    reach = shrunk.mean(0)
    colours = to_lab(plate.image)
    path = _covered(plate, fit, shape, plane, ends)
    slides_in_plane = fit.type == "prismatic" and abs(float(plane.pose[:3, 2] @ fit.axis)) < 0.7
    found, scores = [], []
    # A bar that slides along itself comes out of a body; a lid or a door that does so lies on one. What lies flat (the
    # world's z is up) rests on something wherever it is.
    flat = slides_in_plane and float(plane.pose[2, 2]) > FLAT
    kinds = (True,) if flat else (False, True) if slides_in_plane else (False,)
    places = [(end, beneath) for beneath in kinds for end in ends]
    for end, beneath in places:
        box, about = static_box(shape, plane, fit, end, clearance, beneath=beneath)
        corners, _ = to_arrays(box)
        uv = project(plate, fit, corners)
        region = fill_hull(plate, uv)
        inside = float(region.sum()) / max(_hull_area(uv), 1.0)
        # Leave out the hollow behind the closed link: only it and the moving part were ever there.
        here = region & ~path
        hands = float(reach[here].mean()) if here.any() else 0.0
        wide, area = box, region
        if slides_in_plane and not beneath:
            wide, _ = static_box(shape, plane, fit, end, clearance, WIDEN)
            area = fill_hull(plate, project(plate, fit, to_arrays(wide)[0]))
        # Where the block is too small its surroundings are the body itself: of two borders the clearer counts.
        margin = 2 * max(2, int(0.12 * np.sqrt(area.sum()))) + 1
        beyond = cv2.dilate(area.astype(np.uint8), np.ones((margin, margin), np.uint8)) > 0
        body, contrast = max((separate(plate, a) for a in (area, beyond)), key=lambda found: found[1])
        body = body & area
        # What the closed link hid in all frames is the body behind it, as far as anybody knows.
        shut = _covered(plate, fit, shape, plane, [end])
        whole = _joined(body | (shut & ~plate.known), shut)
        distinct = contrast * float((body & whole).sum()) / max(float(area.sum()), 1.0)
        free = (whole & ~path if distinct > DISTINCT else here) & plate.known
        likeness = float(np.minimum(_histogram(colours[free]), mean).sum()) if free.sum() > 20 else 0.0
        cut = _cut(plate, fit, wide, whole) if contrast > CONTRAST else None
        hides = shown_through(fit, masks, video, surface, to_arrays(box if cut is None else cut)[0], some)
        score = (likeness + distinct) * (1 - min(1.0, 2 * hands)) * min(1.0, inside) * (1 - hides) ** 2
        scores.append(score)
        found.append((box, cut, about["depth"], whole))
    chosen = int(np.argmax(scores))
    rival = max(score for (end, _), score in zip(places, scores, strict=True) if end != places[chosen][0])
    decided = scores[chosen] > 1.3 * rival + 0.02
    first = ends[int(np.argmin(np.abs(np.array(ends) - fit.q[0])))]
    best = {end: max(score for (e, _), score in zip(places, scores, strict=True) if e == end) for end in ends}
    box, cut, depth, whole = found[chosen]
    solid, seen = (box, None) if cut is None else (cut, whole)
    other = ends[1 - ends.index(first)]
    likeness = {"start": best[first], "other": best[other]}
    return StaticBlock(solid, places[chosen][0], likeness, decided, depth, seen, places[chosen][1])


def _cut(plate: Plate, fit: JointFit, wide: Manifold, region: np.ndarray) -> Manifold | None:
    """The block within the cone that the camera sees of a region; None if next to nothing of it is left."""
    corners, _ = to_arrays(wide)
    z = corners @ fit.T_camera_world[2, :3] + fit.T_camera_world[2, 3]
    near = max(0.5 * float(z.min()), 0.05 * float(z.max()))
    sight = cone(plate, fit, region, near, 2 * float(z.max()))
    if sight is None:
        return None
    rest = wide ^ sight
    if rest.is_empty() or rest.volume() < 0.03 * wide.volume():
        return None
    vertices, _ = to_arrays(rest)
    return hull(vertices)


def _joined(region: np.ndarray, shut: np.ndarray) -> np.ndarray:
    """The pieces of a region that reach the closed link."""
    import cv2

    _, labels = cv2.connectedComponents(region.astype(np.uint8))
    near = cv2.dilate(shut.astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
    touch = np.unique(labels[near & region])
    return np.isin(labels, touch[touch > 0])


def _covered(plate: Plate, fit: JointFit, shape: Shape, plane: LinkPlane, states: list[float]) -> np.ndarray:
    """(h, w) bool: pixels of the plate that the link's bounding block covers at any of the states."""
    low, high = shape.bounds
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    world = plane.to_world(corners)
    out = np.zeros(plate.image.shape[:2], bool)
    for q in states:
        T = fit.link_pose(q)
        out |= fill_hull(plate, project(plate, fit, world @ T[:3, :3].T + T[:3, 3]))
    return out


def _hull_area(uv: np.ndarray) -> float:
    from scipy.spatial import ConvexHull

    return float(ConvexHull(uv).volume)


def _histogram(lab: np.ndarray) -> np.ndarray:
    """Normalised colour histogram of (n, 3) pixels of :func:`to_lab`, blurred over neighbouring bins."""
    from scipy.ndimage import gaussian_filter

    count, _ = np.histogramdd(lab, bins=(10, 16, 16), range=((0, 160), (64, 192), (64, 192)))
    count = gaussian_filter(count, 0.7)
    return count / max(count.sum(), 1e-12)

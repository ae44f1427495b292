"""What stands out of the moving link's face: handles and knobs, by a plane sweep in the link's own frame.

The joint moves the link before the camera, which is the same as a camera that moves about the link: what stands out
of the face shifts against it (parallax). Each cell of the face's chart is looked at in many frames as if it lay at
one height after another over the face; at the right height its colours agree (plane sweep: Collins, A space-sweep
approach to true multi-image matching, CVPR 1996). Shadows and reflections slide over a face too, so that a region
counts only where tracked points stand at its height.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from shapely.geometry import MultiPolygon, Polygon

from reconstruct.cues import LinkMasks
from reconstruct.geometry.layers import Chart, make_window, spread_frames, to_lab
from reconstruct.geometry.outline import tidy, trace
from reconstruct.geometry.plane import LinkPlane, apply_homography, homography
from reconstruct.geometry.solids import hull, to_arrays
from reconstruct.joint.models import JointFit
from reconstruct.video import Video

if TYPE_CHECKING:
    from manifold3d import Manifold

FRAMES = 24
GRID = 160
"""Cells along the longer side of the chart."""
STEP, TOP = 0.008, 0.24
"""Heights over the face that are tried, in parts of its diagonal: every STEP up to TOP."""
LEAST = 0.03
"""What is lower than this, in the same parts, is left to the face."""
MISS = 25.0
"""Largest difference of two colours (:func:`reconstruct.geometry.layers.to_lab`) that counts."""
GAIN, SHARE = 4.0, 0.7
"""A raised cell's colours differ at its height by so much less than on the face, and by at most this share of it."""
QUIET = 8.0
"""Colours that differ by no more agree."""
SEEN = 6
"""Frames that must show a cell at a height."""
SQUARE = 0.15
"""Least cosine of the angle under which a frame sees the face."""
POINTS = 3
"""Tracked points that must stand in a region."""
APART = 0.3
"""By this share of a region's height its points and cells may differ from it."""
BRIDGE = 13
"""Cells across which an even surface is taken to stand out with its rims."""
MARGIN = 0.015
"""About a hand's mask nothing is looked at, in parts of the window's longer side."""
SMALLEST = 0.002
"""Area of a region, share of the face's."""
LONG = 2.5
"""A region this many times as long as wide is a bar on two posts, else a block."""


@dataclass(frozen=True)
class Raised:
    """Something that stands on the link's face.

    Attributes:
        outline: seen from the front, plane coordinates.
        height: of its front over the face, world units.
        points: how many tracked points stand in it.
        pieces: convex prisms (corners (k, 2) in plane coordinates, low, high), world units along the normal.
        bar: it is a bar on two posts; the gap behind it was not seen.
    """

    outline: Polygon
    height: float
    points: int
    pieces: tuple[tuple[np.ndarray, float, float], ...]
    bar: bool

    def solids(self, plane: LinkPlane) -> list[Manifold]:
        """The pieces in the world at q = 0."""
        return [hull(plane.to_world(np.array([[*c, z] for c in corners for z in (low, high)])))
                for corners, low, high in self.pieces]

    def parts(self, plane: LinkPlane) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
        """The pieces as vertices and faces in the world at q = 0."""
        return tuple(to_arrays(s) for s in self.solids(plane))


def find_raised(video: Video, fit: JointFit, plane: LinkPlane, face: Polygon | MultiPolygon, masks: LinkMasks,
                costs: np.ndarray) -> tuple[Raised, ...]:  # fmt: skip
    """Regions of the link's face that stand out of it.

    Args:
        face: the link's outline, plane coordinates; the face is where the plane is.
        costs: (T,) from :func:`reconstruct.geometry.layers.frame_costs`.
    """
    import cv2
    from shapely import contains_xy

    diagonal = float(np.hypot(*(np.array(face.bounds[2:]) - face.bounds[:2])))
    points = plane.to_plane(fit.points)
    points = points[(points[:, 2] > LEAST * diagonal) & (points[:, 2] < TOP * diagonal)
                    & contains_xy(face.buffer(0.05 * diagonal), points[:, 0], points[:, 1])]  # fmt: skip
    frames = spread_frames(fit, costs, FRAMES)
    frames = frames[plane.facing[frames] > SQUARE]
    if len(points) < POINTS or len(frames) < SEEN:
        return ()
    sweep = _sweep(video, fit, plane, face, diagonal, masks, frames)
    chart, levels = sweep.chart, sweep.levels
    centres = chart.centres()
    inside = contains_xy(face, centres[..., 0], centres[..., 1]) & (sweep.least < MISS)
    at_rest = sweep.cost[0] - sweep.least
    clear = inside & sweep.known & (at_rest > GAIN) & (sweep.least < SHARE * sweep.cost[0])
    # Where the hand covers the face behind it, what stands out is only not contradicted.
    free = inside & ~sweep.known & (sweep.least < QUIET)
    out: list[Raised] = []
    while (cells := _largest(sweep, inside, clear, free, points, LEAST * diagonal)) is not None:
        # About an edge that hides what is behind it cells agree at many heights: those at the region's own stay.
        height = float(np.median(levels[sweep.best[cells & clear]]))
        level = int(np.argmin(np.abs(levels - height)))
        own = np.abs(levels[sweep.best] - height) <= 0.5 * APART * height
        own |= sweep.cost[level] - sweep.least < 0.5 * GAIN
        core = cv2.morphologyEx((cells & own).astype(np.uint8), cv2.MORPH_OPEN, _square(3))
        region = trace(chart, core > 0, chart.cell)
        region = max(region.geoms, key=lambda g: g.area) if isinstance(region, MultiPolygon) else region
        # What is left has to be where the points are, or they stood beside it.
        around = region.buffer(2 * chart.cell)
        standing = contains_xy(around, points[:, 0], points[:, 1]) & (np.abs(points[:, 2] - height) <= APART * height)
        if region.area >= SMALLEST * face.area and standing.sum() >= POINTS:
            out.append(_built(region, height, int(standing.sum())))
        taken = cv2.dilate(cells.astype(np.uint8), _square(BRIDGE)) > 0
        clear, free = clear & ~taken, free & ~taken
    return tuple(out)


@dataclass(frozen=True)
class _Sweep:
    """Colours of a face's cells as if they lay at one height after another.

    Attributes:
        chart: cells over the face.
        levels: (L,) heights over it, world units, the first 0.
        cost: (L, rows, cols) how much a cell's colours differ between frames; 2 MISS where too few frames show it.
        known: (rows, cols) bool, enough frames show the cell on the face itself.
    """

    chart: Chart
    levels: np.ndarray
    cost: np.ndarray
    known: np.ndarray

    @cached_property
    def best(self) -> np.ndarray:
        """(rows, cols) level at which a cell's colours differ least."""
        return np.argmin(self.cost, axis=0)

    @cached_property
    def least(self) -> np.ndarray:
        """(rows, cols) its cost there."""
        return self.cost.min(0)


def _largest(sweep: _Sweep, inside: np.ndarray, clear: np.ndarray, free: np.ndarray, points: np.ndarray, lowest: float
             ) -> np.ndarray | None:  # fmt: skip
    """(rows, cols) bool, the connected cells at one height, among all heights, of which most stand out clearly and in
    which tracked points stand too."""
    import cv2

    chart, levels = sweep.chart, sweep.levels
    spots = np.round((points[:, :2] - chart.origin) / chart.cell).astype(int).clip(0, np.array(chart.shape[::-1]) - 1)
    largest, most = None, 0
    for height in levels[levels > lowest]:
        about = np.abs(levels - height) <= APART * height
        cells = (clear | free) & about[sweep.best]
        # An even surface agrees at any height: between cells that stand out it does so with them.
        even = inside & (sweep.cost[about].min(0) - sweep.least < 0.5 * GAIN)
        closed = cv2.morphologyEx(cells.astype(np.uint8), cv2.MORPH_CLOSE, _square(BRIDGE))
        closed = cv2.morphologyEx((closed & (cells | even)).astype(np.uint8), cv2.MORPH_CLOSE, _square(5))
        closed = cv2.morphologyEx(closed, cv2.MORPH_OPEN, _square(3))
        labels = cv2.connectedComponents(closed)[1]
        near = cv2.dilate(labels.astype(np.float32), _square(5))[spots[:, 1], spots[:, 0]]
        near = near[np.abs(points[:, 2] - height) <= APART * height].astype(int)
        told = np.bincount(labels[clear & cells], minlength=labels.max() + 1)
        whole = np.bincount(labels[cells], minlength=labels.max() + 1)
        support = np.bincount(near, minlength=labels.max() + 1)
        told = np.where((told >= 0.5 * whole) & (support >= POINTS), told, 0)
        told[0] = 0
        k = int(told.argmax())
        if told[k] > most:
            largest, most = labels == k, int(told[k])
    return largest


def _square(side: int) -> np.ndarray:
    return np.ones((side, side), np.uint8)


def _built(region: Polygon, height: float, count: int) -> Raised:
    """What to put where a region stands out by ``height``."""
    region = tidy(region)
    region = region if isinstance(region, Polygon) else region.convex_hull
    corners = np.asarray(region.minimum_rotated_rectangle.exterior.coords)[:4]
    sides = np.linalg.norm(np.diff(corners[:3], axis=0), axis=1)
    if sides[0] < sides[1]:
        corners, sides = np.roll(corners, -1, axis=0), sides[::-1]
    length, width = sides
    thick = min(width, 0.6 * height)
    low = -0.05 * height  # into the face, so that they are one body
    if length < LONG * width:
        outer = np.asarray(region.convex_hull.exterior.coords)[:-1]
        return Raised(region, height, count, ((outer, low, height),), False)
    along = (corners[1] - corners[0]) / length
    across = corners[3] - corners[0]
    foot = np.array([np.zeros(2), thick * along, thick * along + across, across])
    posts = ((corners[0] + foot, low, height), (corners[1] - thick * along + foot, low, height))
    return Raised(region, height, count, ((corners, height - thick, height), *posts), True)


def _sweep(video: Video, fit: JointFit, plane: LinkPlane, face: Polygon | MultiPolygon, diagonal: float,
           masks: LinkMasks, frames: np.ndarray) -> _Sweep:  # fmt: skip
    """Look at the cells at every height: mean distance of their colours from the median over frames, 5 x 5 together."""
    import cv2
    from shapely import contains_xy

    low, high = np.array(face.bounds[:2]), np.array(face.bounds[2:])
    cell = float((high - low).max() / GRID)
    columns, rows = np.ceil((high - low) / cell).astype(int) + 1
    chart = Chart(low, cell, (int(rows), int(columns)))
    window = make_window(video, fit, plane, max(video.frames.shape[1:3]))
    images = np.stack([to_lab(window.crop(video.frames[t])) for t in frames])
    # A driving hand stands before the face and rests on it: what its mask misses must not be taken for a handle.
    margin = _square(2 * max(2, round(MARGIN * max(window.size))) + 1)
    free = ~np.stack([cv2.dilate(window.crop(masks.hand[t]).astype(np.uint8), margin) > 0 for t in frames])
    S, weight = window.matrix(video), plane.facing[frames]
    grid = np.mgrid[: chart.shape[0], : chart.shape[1]][::-1].transpose(1, 2, 0).astype(float)

    def at(z: float) -> tuple[np.ndarray, np.ndarray]:
        """Colours (F, rows, cols, 3) of the cells at height z, and where they are known."""
        H = S @ homography(fit, plane, fit.q[frames], z) @ chart.to_plane_matrix()
        colours, known = [], []
        for k in range(len(frames)):
            uv = apply_homography(H[k], grid)
            inside = np.isfinite(uv).all(-1) & (uv > 1).all(-1) & (uv < np.array(window.size) - 2).all(-1)
            u, v = np.nan_to_num(uv).astype(np.float32).transpose(2, 0, 1)
            colours.append(cv2.remap(images[k], u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
            known.append(inside & (cv2.remap(free[k].astype(np.uint8), u, v, cv2.INTER_NEAREST) > 0))
        return np.stack(colours), np.stack(known)

    # A face that turns in the light grows brighter or darker as a whole.
    colours, known = at(0.0)
    centres = chart.centres()
    known &= contains_xy(face, centres[..., 0], centres[..., 1])
    bare = _middle(colours, known)
    shade = np.array([np.median((c - bare)[k], axis=0) if k.any() else np.zeros(3)
                      for c, k in zip(colours, known, strict=True)])  # fmt: skip
    levels = np.arange(0.0, TOP + 0.5 * STEP, STEP) * diagonal
    out, plain = np.empty((len(levels), *chart.shape), np.float32), None
    for n, z in enumerate(levels):
        colours, known = at(z)
        colours = colours - shade[:, None, None]
        miss = np.minimum(np.linalg.norm(colours - _middle(colours, known), axis=-1), MISS)
        w = np.where(known, weight[:, None, None], 0.0)
        enough = known.sum(0) >= SEEN
        plain = enough if plain is None else plain
        mean = np.where(enough, (w * miss).sum(0) / np.maximum(w.sum(0), 1e-9), MISS)
        out[n] = np.where(enough, cv2.blur(mean.astype(np.float32), (5, 5)), 2 * MISS)
    return _Sweep(chart, levels, out, plain)


def _middle(colours: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(rows, cols, 3) median over the frames that show a cell; 0 where none does."""
    filled = np.sort(np.where(known[..., None], colours, np.inf), axis=0)
    row = np.maximum(known.sum(0) - 1, 0) // 2
    out = np.take_along_axis(filled, np.broadcast_to(row[None, ..., None], (1, *filled.shape[1:])), 0)[0]
    return np.where(np.isfinite(out), out, 0.0)

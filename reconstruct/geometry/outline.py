"""The moving link as extruded outlines in its own frame: one slab, or a stack of slices carved by silhouettes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from shapely.geometry import MultiPolygon, Point, Polygon
from shapely.ops import unary_union

from reconstruct.cues import Hands, LinkMasks
from reconstruct.geometry.layers import Chart, make_chart, make_window, seed_polygon, spread_frames
from reconstruct.geometry.masks import KEY_FRAMES
from reconstruct.geometry.plane import LinkPlane, apply_homography, homography
from reconstruct.joint.models import JointFit
from reconstruct.video import Video

SIZE = 240
"""Silhouettes are compared at this long side, px."""
TIPS = (4, 8, 12, 16, 20)
RATIOS = (0.01, 0.02, 0.03, 0.045, 0.065, 0.09, 0.13, 0.18, 0.25, 0.35)
"""Thicknesses that are tried, in parts of the link's extent."""


@dataclass(frozen=True)
class Views:
    """Silhouettes to compare with. Shapes: frames (F,), mask and known (F, h, w) bool, H (F, 3, 3) plane to px."""

    frames: np.ndarray
    mask: np.ndarray
    known: np.ndarray
    weight: np.ndarray
    S: np.ndarray
    size: tuple[int, int]


@dataclass(frozen=True)
class Slice:
    """An outline (plane coordinates, holes allowed) extruded from height ``low`` to ``high`` along the normal."""

    outline: Polygon | MultiPolygon
    low: float
    high: float


@dataclass(frozen=True)
class Shape:
    """The moving link in plane coordinates.

    Attributes:
        slices: stacked along the normal.
        iou: mean intersection over union of its silhouettes with the masks.
        thickness_origin: "fitted" when the silhouettes prefer it over others, else "assumed".
        kind: "slab" or "stack".
        reach: how far the outline was extended to where the hand holds it, world units; 0 if it was not.
    """

    slices: tuple[Slice, ...]
    iou: float
    thickness_origin: str
    kind: str
    reach: float = 0.0

    @property
    def bounds(self) -> np.ndarray:
        """(2, 3) low and high corner in plane coordinates."""
        b = np.array([s.outline.bounds for s in self.slices])
        low = np.r_[b[:, :2].min(0), min(s.low for s in self.slices)]
        return np.stack([low, np.r_[b[:, 2:].max(0), max(s.high for s in self.slices)]])


def make_views(video: Video, fit: JointFit, plane: LinkPlane, masks: LinkMasks, costs: np.ndarray,
               count: int = KEY_FRAMES) -> Views:
    """Shrunk silhouettes of frames spread over q: as many as were cut at pixel level, hence the same ones."""
    import cv2

    frames = spread_frames(fit, costs, count)
    window = make_window(video, fit, plane, SIZE)
    mask = np.stack([window.crop(masks.moving[t]) for t in frames])
    hand = np.stack([cv2.dilate(window.crop(masks.hand[t]).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
                     for t in frames])
    weight = np.clip(masks.confidence[frames], 0.05, 1.0)
    return Views(frames, mask & ~hand, ~hand, weight, window.matrix(video), window.size)


def vote(views: Views, fit: JointFit, plane: LinkPlane, chart: Chart, offset: float = 0.0,
         frontal: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Share of the silhouettes that contain each cell at height ``offset``, and the weight behind it.

    Args:
        frontal: weigh frames by how squarely the plane faces the camera.
    """
    import cv2

    inside = np.zeros(chart.shape)
    total = np.zeros(chart.shape)
    M = views.S @ homography(fit, plane, fit.q[views.frames], offset) @ chart.to_plane_matrix()
    for k, t in enumerate(views.frames):
        w = views.weight[k] * (np.square(plane.facing[t]) + 0.01 if frontal else 1.0)
        back = (M[k] / np.linalg.norm(M[k])).astype(float)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        shape = (chart.shape[1], chart.shape[0])
        m = cv2.warpPerspective(views.mask[k].astype(np.float32), back, shape, flags=flags)
        known = cv2.warpPerspective(views.known[k].astype(np.float32), back, shape, flags=flags) > 0.9
        inside += w * m * known
        total += w * known
    return np.where(total > 0, inside / np.maximum(total, 1e-12), 0.0), total


def fill_unseen(cells: np.ndarray, unseen: np.ndarray) -> np.ndarray:
    """Cells that no frame shows (a hand or the picture's border hides them) are link where they lie between link
    cells, in their convex hull: what is hidden is unknown, not absent."""
    import cv2

    spots = np.argwhere(cells)[:, ::-1]
    if len(spots) < 3 or not unseen.any():
        return cells
    around = np.zeros(cells.shape, np.uint8)
    cv2.fillConvexPoly(around, cv2.convexHull(spots.astype(np.int32)), 1)
    return cells | (unseen & (around > 0))


def trace(chart: Chart, cells: np.ndarray, smooth: float) -> Polygon | MultiPolygon:
    """Cells -> polygons in plane coordinates, holes kept, corners simplified to ``smooth``."""
    import cv2

    big = cv2.resize(cells.astype(np.uint8) * 255, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
    contours, tree = cv2.findContours((big > 127).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return Polygon()
    rings = [((c[:, 0] + 0.5) / 2 - 0.5) * chart.cell + chart.origin for c in contours]
    polys = []
    for k, ring in enumerate(rings):
        if tree[0][k][3] >= 0 or len(ring) < 4:
            continue
        holes = [rings[j] for j in range(len(rings)) if tree[0][j][3] == k and len(rings[j]) >= 4]
        polys.append(Polygon(ring, holes).buffer(0))
    shape = unary_union(polys).buffer(smooth).buffer(-2 * smooth).buffer(smooth).simplify(smooth)
    return shape.buffer(0)


def tidy(shape: Polygon | MultiPolygon) -> Polygon | MultiPolygon:
    """Replace an outline by its rectangle or convex hull where it nearly is one (man-made parts mostly are)."""
    if shape.is_empty:
        return shape
    pieces = list(shape.geoms) if isinstance(shape, MultiPolygon) else [shape]
    largest = max(p.area for p in pieces)
    shape = unary_union([p for p in pieces if p.area > 0.05 * largest])
    solid = Polygon(shape.exterior) if isinstance(shape, Polygon) else shape
    hull = shape.convex_hull
    box = shape.minimum_rotated_rectangle
    if isinstance(shape, Polygon) and shape.area < 0.9 * solid.area:
        return shape
    if shape.area > 0.9 * box.area:
        return _fitted_rectangle(shape, box)
    return hull.simplify(0.01 * np.sqrt(hull.area)) if shape.area > 0.92 * hull.area else shape


def _fitted_rectangle(shape: Polygon | MultiPolygon, box: Polygon) -> Polygon:
    """The rectangle along ``box`` whose sides halve the ragged edge (the bounding one would stick out)."""
    corners = np.asarray(box.exterior.coords)[:4]
    x, y = corners[1] - corners[0], corners[3] - corners[0]
    lx, ly = np.linalg.norm(x), np.linalg.norm(y)
    frame = np.stack([x / lx, y / ly])
    pts = np.random.default_rng(0).random((4000, 2)) * [lx, ly]
    from shapely import contains_xy

    xy = corners[0] + pts @ frame
    pts = pts[contains_xy(shape, xy[:, 0], xy[:, 1])]
    # Of a uniform filling, the q-quantile lies a share q of the length inside each side.
    q = 0.02
    low, high = np.quantile(pts, q, axis=0), np.quantile(pts, 1 - q, axis=0)
    grow = q / (1 - 2 * q) * (high - low)
    low, high = np.maximum(low - grow, 0), np.minimum(high + grow, [lx, ly])
    c = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    return Polygon(corners[0] + c @ frame)


def rings_of(shape: Polygon | MultiPolygon) -> list[np.ndarray]:
    """All rings, exterior and interior, each (k, 2) without the closing point."""
    out = []
    for p in shape.geoms if isinstance(shape, MultiPolygon) else [shape]:
        out += [np.asarray(r.coords)[:-1] for r in [p.exterior, *p.interiors]]
    return out


def silhouette(slices: tuple[Slice, ...], views: Views, fit: JointFit, plane: LinkPlane) -> np.ndarray:
    """(F, h, w) bool: the shape drawn in every view."""
    import cv2

    out = np.zeros((len(views.frames), views.size[1], views.size[0]), np.uint8)
    q = fit.q[views.frames]
    for s in slices:
        rings = rings_of(s.outline)
        H = {z: views.S @ homography(fit, plane, q, z) for z in (s.low, s.high)}
        for k in range(len(q)):
            flat = {z: [apply_homography(H[z][k], r) for r in rings] for z in H}
            if not all(np.isfinite(r).all() and np.abs(r).max() < 1e4 for rs in flat.values() for r in rs):
                continue
            cap = np.zeros(out[k].shape, np.uint8)
            for z in flat:
                cap[:] = 0
                cv2.fillPoly(cap, [np.round(r * 16).astype(np.int32) for r in flat[z]], 1, shift=4)
                out[k] |= cap
            if s.high > s.low:
                for a, b in zip(flat[s.low], flat[s.high], strict=True):
                    for i in range(len(a)):
                        j = (i + 1) % len(a)
                        quad = np.array([a[i], a[j], b[j], b[i]])
                        cv2.fillConvexPoly(out[k], cv2.convexHull(np.round(quad * 16).astype(np.int32)), 1, shift=4)
    return out > 0


def agreement(drawn: np.ndarray, views: Views) -> float:
    """Weighted mean intersection over union, hand pixels left out."""
    both = (drawn & views.mask & views.known).sum((1, 2))
    either = ((drawn | views.mask) & views.known).sum((1, 2))
    seen = either > 0
    return float(np.average(both[seen] / either[seen], weights=views.weight[seen])) if seen.any() else 0.0


def hold_points(hands: Hands, fit: JointFit, plane: LinkPlane) -> np.ndarray:
    """(k, 2) places on the plane where finger tips stay while the link moves: a driving hand is still there."""
    moving = fit.moving_frames if fit.moving_frames is not None else np.ones(len(fit.q), bool)
    best: tuple[float, np.ndarray] | None = None
    for track in hands.tracks:
        frames = np.flatnonzero(moving & track.valid)
        if len(frames) < 5:
            continue
        H = np.linalg.inv(homography(fit, plane, fit.q[frames]))
        H = H * np.sign(np.einsum("tij,j->ti", homography(fit, plane, fit.q[frames]), [0, 0, 1.0])[:, 2])[:, None, None]
        uv = track.uv[frames][:, list(TIPS)]
        flat = np.einsum("tij,tkj->tki", H, np.concatenate([uv, np.ones((*uv.shape[:-1], 1))], -1))
        flat = flat[..., :2] / flat[..., 2:]
        # Frames that see the plane edge-on say nothing about where on it a pixel lies.
        flat = flat[np.abs(plane.facing[frames]) > 0.25]
        if len(flat) < 5:
            continue
        middle = np.nanmedian(flat, axis=0)
        scatter = np.nanmedian(np.linalg.norm(flat - middle, axis=-1), axis=0)
        still = scatter < 0.08 * plane.extent
        if still.any() and (best is None or scatter[still].mean() < best[0]):
            best = (float(scatter[still].mean()), middle[still])
    return best[1] if best is not None else np.empty((0, 2))


@dataclass(frozen=True)
class Face:
    """The link's outline on its plane, and what it was drawn from.

    Attributes:
        outline: plane coordinates, grown to where the hand holds it by ``reach``, world units.
    """

    outline: Polygon | MultiPolygon
    reach: float
    views: Views
    chart: Chart


def trace_face(video: Video, hands: Hands, fit: JointFit, plane: LinkPlane, masks: LinkMasks, costs: np.ndarray
               ) -> Face:  # fmt: skip
    """The moving link's outline from its silhouettes.

    Args:
        costs: (T,) from :func:`reconstruct.geometry.layers.frame_costs`.
    """
    views = make_views(video, fit, plane, masks, costs)
    seed = seed_polygon(fit, plane)
    chart = make_chart(seed)
    share, total = vote(views, fit, plane, chart)
    cells = fill_unseen((share > 0.5) & (total > 0.05 * total.max()), total <= 0.05 * total.max())
    outline = trace(chart, cells, 0.018 * plane.extent)
    if outline.is_empty:
        outline = Polygon(seed)
    outline, reach = _reach_hand(tidy(outline), hold_points(hands, fit, plane))
    return Face(outline, reach, views, chart)


def build_shape(face: Face, fit: JointFit, plane: LinkPlane) -> Shape:
    """How thick the moving link is, from its silhouettes."""
    views, chart, outline = face.views, face.chart, face.outline
    extent = float(np.hypot(*(np.array(outline.bounds[2:]) - outline.bounds[:2])))
    unseen = 0.03 * extent
    if fit.type != "prismatic" and abs(float(plane.pose[:3, 2] @ fit.axis)) > 0.8:
        # A lever seen along its hinge: as deep as it is high, more or less, not a sheet.
        sides = np.asarray(outline.minimum_rotated_rectangle.exterior.coords)
        unseen = 0.7 * float(np.linalg.norm(np.diff(sides[:3], axis=0), axis=1).min())
    if fit.metric:
        unseen = max(unseen, 0.008)
    # Only where the plane is also seen obliquely do silhouettes show the rim.
    gain = 0.004 if np.abs(plane.facing[views.frames]).min() < 0.6 else 0.02

    def slab_of(low: float, high: float) -> Slice:
        carved = _carve(views, fit, plane, chart, low, high)
        # Not where the hand's reach grew the face, nor where nothing much would be left of it.
        whole = face.reach > 0 or carved.is_empty or carved.area < 0.3 * outline.area
        return Slice(outline if whole else carved, low, high)

    def draw(body: Slice) -> float:
        return agreement(silhouette((body,), views, fit, plane), views)

    # The points were seen on the surface at 0, the body lies behind it; how deep, the silhouettes tell.
    trials = {behind: draw(slab_of(-behind * extent, 0.0)) - 0.02 * behind for behind in RATIOS}
    best = max(trials, key=lambda k: trials[k])
    # Less than half of what is assumed is the end of the scale: silhouettes whose rims are a pixel wide say nothing.
    told = best * extent >= 0.5 * unseen
    body, origin = slab_of(-unseen, 0.0), "assumed"
    if told and trials[best] > draw(body) - 0.02 * unseen / extent + gain:
        body, origin = slab_of(-best * extent, 0.0), "fitted"
    slab = Shape((body,), draw(body), origin, "slab", face.reach)
    deep = _deepen(views, fit, plane, chart, slab, extent)
    if deep is not None:
        slab = deep
    # A link seen from one side only gives its silhouettes no say about depth: a hull would be a guess in 16 parts.
    turned = float(np.ptp(np.abs(plane.facing[views.frames]))) > 0.25
    stack = _stack(views, fit, plane, chart, slab, extent) if turned else None
    return stack if stack is not None and stack.iou > slab.iou + 0.03 else slab


def reach_behind(plane: LinkPlane) -> float:
    """How far behind the plane the link's body is known to reach, world units, 0 if nothing is.

    Points there whose tracks the plane misses tell, if they are many and beyond the others' scatter: their upper
    quartile, as they are spread over a rim from the face on, and some are strays. Nothing in front counts: a body there
    would hide the face, so that it is something that stands on it.
    """
    noise = 2 * float(np.quantile(np.abs(plane.spread[~plane.beside]), 0.9)) if not plane.beside.all() else 0.0
    behind = -plane.spread[plane.beside]
    behind = behind[(behind > noise) & (behind < 0.5 * plane.extent)]
    if len(behind) < max(5, 0.08 * len(plane.spread)):
        return 0.0
    return float(np.quantile(behind, 0.75))


def _carve(views: Views, fit: JointFit, plane: LinkPlane, chart: Chart, low: float, high: float
           ) -> Polygon | MultiPolygon:  # fmt: skip
    """The outline of a slab between two heights: where both of its faces project into the silhouettes."""
    cells = None
    for z in (low, (low + high) / 2, high):
        share, total = vote(views, fit, plane, chart, z)
        unseen = total <= 0.05 * total.max()
        here = fill_unseen((share > 0.5) & ~unseen, unseen)
        cells = here if cells is None else cells & here
    return tidy(trace(chart, cells, 0.018 * plane.extent))


def _deepen(views: Views, fit: JointFit, plane: LinkPlane, chart: Chart, slab: Shape, extent: float) -> Shape | None:
    """The slab made as thick as points behind its plane say; its outline then is where both of its faces project
    into the silhouettes. None if no points say so, or the silhouettes fit worse."""
    low, high = -reach_behind(plane), slab.slices[0].high
    # Points tell more than an assumption does; silhouettes that showed more than they do were right.
    if low == 0.0 or (slab.thickness_origin == "fitted" and low >= slab.slices[0].low):
        return None
    outline = _carve(views, fit, plane, chart, low, high)
    if outline.is_empty or outline.area < 0.3 * slab.slices[0].outline.area:
        return None
    body = (Slice(outline, low, high),)
    iou = agreement(silhouette(body, views, fit, plane), views)
    return replace(slab, slices=body, iou=iou, thickness_origin="fitted") if iou > slab.iou - 0.05 else None


def _stack(views: Views, fit: JointFit, plane: LinkPlane, chart: Chart, slab: Shape, extent: float,
           layers: int = 8) -> Shape | None:
    """Slices each carved by all silhouettes: a visual hull. Only as deep as the points say or as the smaller
    side of the outline, since silhouettes from one camera hardly bound the depth of what turns little."""
    width = float(np.min(np.ptp(slab.bounds[:, :2], axis=0)))
    spread = np.quantile(plane.spread, [0.1, 0.9])
    low = min(slab.slices[0].low, max(float(spread[0]), -0.6 * width))
    high = max(slab.slices[0].high, min(float(spread[1]), 0.6 * width))
    if high - low < 0.06 * extent:
        return None
    edges = np.linspace(low, high, layers + 1)
    slices = []
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        share, total = vote(views, fit, plane, chart, (a + b) / 2, frontal=False)
        cells = (share > 0.8) & (total > 0.3 * total.max())
        part = trace(chart, cells, 0.015 * extent)
        if not part.is_empty and part.area > 0.01 * extent**2:
            slices.append(Slice(part, float(a), float(b)))
    if not slices or any(abs(x.high - y.low) > 1e-9 for x, y in zip(slices[:-1], slices[1:], strict=True)):
        return None
    body = tuple(slices)
    return replace(slab, slices=body, kind="stack", iou=agreement(silhouette(body, views, fit, plane), views))


def _reach_hand(outline: Polygon | MultiPolygon, holds: np.ndarray) -> tuple[Polygon | MultiPolygon, float]:
    """Grow the outline to where finger tips stay, if they stay near it: the hand hides the very edge it holds."""
    extent = float(np.hypot(*(np.array(outline.bounds[2:]) - outline.bounds[:2])))
    near = [p for p in holds if 0 < outline.distance(Point(p)) < 0.15 * extent]
    inside = sum(outline.contains(Point(p)) for p in holds)
    if not near or inside + len(near) < 2 or inside >= 2:
        # Two tips on the part already: nothing needs to grow.
        return outline, 0.0
    near.sort(key=lambda p: outline.distance(Point(p)))
    reach = float(outline.distance(Point(near[0])))
    target = Point(near[0]).buffer(0.015 * extent)
    box = outline.minimum_rotated_rectangle
    if outline.area > 0.97 * box.area:
        # A rectangle stays one: move its nearest side.
        corners = np.asarray(box.exterior.coords)[:4]
        u = (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
        frame = np.stack([u, [-u[1], u[0]]])
        pts = np.vstack([corners, np.asarray(target.exterior.coords)]) @ frame.T
        low, high = pts.min(0), pts.max(0)
        c = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]) @ frame
        return Polygon(c), reach
    base = outline.intersection(Point(near[0]).buffer(reach + 0.1 * extent))
    return outline.union(base.union(target).convex_hull), reach



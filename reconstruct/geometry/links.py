"""From masks and a joint to the two links' meshes."""

from __future__ import annotations

import time

import numpy as np

from reconstruct.cues import Hands, LinkMasks, Tracks
from reconstruct.errors import TaaError
from reconstruct.geometry import Geometry, LinkMesh
from reconstruct.geometry.collision import contacts_over_range, convex_parts, mass_properties, trim_parts
from reconstruct.geometry.layers import make_window, spread_frames, to_lab
from reconstruct.geometry.masks import points_on_mask
from reconstruct.geometry.outline import Shape, build_shape
from reconstruct.geometry.plane import LinkPlane, fit_plane, keep_points
from reconstruct.geometry.solids import carve, extrude, hull, static_box, swept_hulls, to_arrays
from reconstruct.geometry.texture import paint, subdivide
from reconstruct.joint.models import JointFit
from reconstruct.video import Video

CLEARANCE = 0.012
"""Gap kept between the links, in parts of the moving link's extent."""


def build_geometry(video: Video, hands: Hands, tracks: Tracks, fit: JointFit, masks: LinkMasks,
                   hand_points: np.ndarray | None = None) -> Geometry:
    """Meshes, collision parts and colours of both links.

    Args:
        video: stabilised, static camera.
        hands: landmarks say where the link is held.
        tracks: all tracks.
        fit: the joint; in metres if ``fit.metric``, otherwise everything is in its unit.
        masks: from :func:`reconstruct.geometry.masks.segment_links`.
        hand_points: optional (F, k, 3) world points of the reference hand; the assumed static body is kept
            out of each frame's convex hull of them.

    Raises:
        TaaError: the link has too few points, or no silhouette.
    """
    if fit.points is None or len(fit.points) < 3:
        raise TaaError("the moving link has fewer than three points; film it closer or with more texture")
    if not masks.moving.any():
        raise TaaError("the moving link's silhouette was found in no frame; film it from where it can be seen")
    started = time.perf_counter()
    notes: list[str] = []
    plane = fit_plane(tracks, fit)
    good = points_on_mask(video, tracks, fit, masks)
    if not good.all():
        notes.append(f"{int((~good).sum())} of {len(good)} fitted points lie off the moving silhouette; left out")
        fit, plane = keep_points(fit, plane, good)
    shape = build_shape(video, hands, fit, plane, masks)
    solid = extrude(shape, plane)
    vertices, faces = to_arrays(solid)
    extent = float(np.linalg.norm(shape.bounds[1] - shape.bounds[0]))
    clearance = CLEARANCE * extent
    parts, convexity = convex_parts(vertices, faces)

    end, likeness, decided = closed_end(video, fit, plane, shape, masks, clearance)
    clouds = swept_hulls(parts, fit, clearance)
    if hand_points is not None:
        clouds = clouds + _hand_clouds(np.asarray(hand_points, float), clearance)
    box, about = static_box(shape, plane, fit, end, clearance)
    body = carve(box, clouds)
    # A block that loses little when cut back by planes alone stays convex: simpler to simulate and to believe.
    plain = trim_parts((to_arrays(box),), clouds)
    if plain and hull(plain[0][0]).volume() > 0.85 * body.volume():
        body = hull(plain[0][0])
    left = body.volume() / max(box.volume(), 1e-30)
    if left < 0.05:
        raise TaaError("no room for the static part beside the moving one's path; check the joint's range")
    if left < 0.5:
        notes.append(f"the assumed static body lost {1 - left:.0%} of its volume to the moving part's path")
    s_vertices, s_faces = to_arrays(body)
    s_parts, s_convexity = convex_parts(s_vertices, s_faces)
    s_parts = trim_parts(s_parts, clouds)
    verdict = contacts_over_range(parts, s_parts, fit)
    if verdict["contacts"]:
        notes.append(f"the links touch in {verdict['contacts']} contacts over the joint's range")

    moving = _finish(video, fit, masks, vertices, faces, parts, True, [])
    static = _finish(video, fit, masks, s_vertices, s_faces, s_parts, False,
                     [(moving.vertices, moving.faces, True)])
    inertia = mass_properties(vertices, faces)
    notes.append("the static link's size and sides were not seen: it is a block behind the moving part's closed pose")
    if not decided:
        notes.append("which end of the motion is closed is not clear from the pixels; the likelier was taken")
    if shape.thickness_origin == "assumed":
        notes.append("the moving link's thickness is assumed")

    def entry(value: object, origin: str, **more: object) -> dict:
        return {"value": value, "origin": origin, **more}

    thickness = float(shape.bounds[1][2] - shape.bounds[0][2])
    unit = "m" if fit.metric else "scene unit"
    provenance = {
        "moving_shape": entry(shape.kind, "fitted"),
        "moving_plane": entry(plane.kind, "fitted", residual_px=plane.residual_px),
        "moving_extent": entry((shape.bounds[1] - shape.bounds[0]).tolist(), "fitted", unit=unit),
        "moving_thickness": entry(thickness, shape.thickness_origin, unit=unit),
        "moving_silhouette_iou": entry(shape.iou, "observed"),
        "moving_reach_to_hand": entry(shape.reach, "fitted" if shape.reach else "assumed", unit=unit),
        "moving_seen_faces": entry(float(1 - moving.assumed.mean()), "observed"),
        "moving_density": entry(inertia["density"], "assumed", unit="kg/m3"),
        "moving_mass": entry(inertia["mass"], "assumed", unit="kg"),
        "moving_com": entry(inertia["com"].tolist(), "assumed", unit=unit),
        "moving_inertia": entry(inertia["inertia"].tolist(), "assumed", unit="kg m2"),
        "moving_parts": entry(convexity["parts"], "fitted", **{k: v for k, v in convexity.items() if k != "parts"}),
        "static_depth": entry(about["depth"], "assumed", unit=unit),
        "static_closed_at": entry(end, "fitted" if decided else "assumed", unit=fit.unit, likeness=likeness),
        "static_volume_kept": entry(left, "assumed"),
        "static_parts": entry(len(s_parts), "fitted", **{k: v for k, v in s_convexity.items() if k != "parts"}),
        "clearance": entry(clearance, "assumed", unit=unit),
        "contacts_over_range": entry(verdict["contacts"], "observed", states=verdict["states"],
                                     penetration=verdict["penetration"]),
        "seconds": entry(round(time.perf_counter() - started, 2), "observed"),
    }
    return Geometry(static, moving, provenance, tuple(notes))


def _hand_clouds(points: np.ndarray, clearance: float, count: int = 16) -> list[np.ndarray]:
    """One fattened cloud for each of up to ``count`` frames of hand points."""
    good = points[np.isfinite(points).all((1, 2))]
    if not len(good):
        return []
    pick = good[np.unique(np.linspace(0, len(good) - 1, count).astype(int))]
    around = np.vstack([np.eye(3), -np.eye(3)]) * np.sqrt(3) * clearance
    return [(p[:, None] + around).reshape(-1, 3) for p in pick]


def closed_end(video: Video, fit: JointFit, plane: LinkPlane, shape: Shape, masks: LinkMasks,
               clearance: float) -> tuple[float, dict, bool]:
    """Which end of the range is the closed one: there the body lies right behind the link.

    A body and its door, lid or arm are mostly of one make, while floors and walls are not, and a hand does
    not reach through a body: the block assumed at each end is drawn into the image, its colours are compared
    with the link's, and the share of it that hands cover counts against it.

    Returns:
        The state, {"start", "other"} likenesses in [0, 1], and whether they differ enough to decide.
    """
    import cv2

    ends = [float(fit.q.min()), float(fit.q.max())]
    frames = spread_frames(fit, masks.hand, 12)
    window = make_window(video, fit, plane)
    size, S = window.size, window.matrix(video)
    images = np.stack([to_lab(window.crop(video.frames[t])) for t in frames])
    kernel = np.ones((5, 5), np.uint8)
    link = np.stack([window.crop(masks.moving[t]) for t in frames])
    hand = np.stack([window.crop(masks.hand[t]) for t in frames])
    free = ~np.stack([cv2.dilate(window.crop(masks.moving[t] | masks.hand[t]).astype(np.uint8), kernel) > 0
                      for t in frames])
    mean = _histogram(images[link])
    path = shape_silhouette(shape, plane, fit, ends, S, size)
    scores = []
    for end in ends:
        box, _ = static_box(shape, plane, fit, end, clearance)
        corners, _ = to_arrays(box)
        uv = fit.project(corners)
        uv = np.concatenate([uv, np.ones((len(uv), 1))], 1) @ S.T
        region = np.zeros((size[1], size[0]), np.uint8)
        cv2.fillConvexPoly(region, cv2.convexHull(np.round(uv[:, :2]).clip(-9999, 9999).astype(np.int32)), 1)
        # Leave out the hollow behind the closed link: only it and the moving part were ever there.
        here = (region > 0) & ~path
        pixels = np.concatenate([images[k][here & free[k]] for k in range(len(frames))])
        likeness = float(np.minimum(_histogram(pixels), mean).sum()) if len(pixels) > 50 else 0.0
        reached = float(hand[:, here].mean()) if here.any() else 0.0
        scores.append(likeness * (1 - min(1.0, 2 * reached)))
    first = int(np.argmin(np.abs(np.array(ends) - fit.q[0])))
    likeness = {"start": scores[first], "other": scores[1 - first]}
    chosen = first if scores[first] >= scores[1 - first] else 1 - first
    return ends[chosen], likeness, scores[chosen] > 1.3 * scores[1 - chosen] + 0.02


def shape_silhouette(shape: Shape, plane: LinkPlane, fit: JointFit, states: list[float], S: np.ndarray,
                     size: tuple[int, int]) -> np.ndarray:
    """(h, w) bool: pixels that the link's bounding block covers at any of the states."""
    import cv2

    low, high = shape.bounds
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    world = plane.to_world(corners)
    out = np.zeros((size[1], size[0]), np.uint8)
    for q in states:
        T = fit.link_pose(q)
        uv = fit.project(world @ T[:3, :3].T + T[:3, 3])
        uv = np.concatenate([uv, np.ones((len(uv), 1))], 1) @ S.T
        cv2.fillConvexPoly(out, cv2.convexHull(np.round(uv[:, :2]).clip(-9999, 9999).astype(np.int32)), 1)
    return out > 0


def _histogram(lab: np.ndarray) -> np.ndarray:
    """Normalised colour histogram of (n, 3) pixels, blurred over neighbouring bins."""
    from scipy.ndimage import gaussian_filter

    count, _ = np.histogramdd(lab, bins=(10, 16, 16), range=((0, 160), (64, 192), (64, 192)))
    count = gaussian_filter(count, 0.7)
    return count / max(count.sum(), 1e-12)


def _finish(video: Video, fit: JointFit, masks: LinkMasks, vertices: np.ndarray, faces: np.ndarray,
            parts: tuple, moves: bool, others: list) -> LinkMesh:
    """Subdivide and colour one link."""
    import cv2

    fine_v, fine_f = subdivide(vertices, faces)
    frames = spread_frames(fit, masks.hand, 14)
    if moves:
        allowed = np.stack([cv2.erode(masks.moving[t].astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
                            for t in frames])
    else:
        covered = np.stack([masks.moving[t] | masks.hand[t] for t in frames])
        allowed = ~np.stack([cv2.dilate(c.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0 for c in covered])
    colors, seen = paint(video, fit, fine_v, fine_f, frames, allowed, moves, [(vertices, faces, moves), *others])
    # Colours on the static block are a projection of what stands there; its surface itself stays assumed.
    assumed = ~seen[fine_f].all(1) if moves else np.ones(len(fine_f), bool)
    return LinkMesh(fine_v, fine_f, colors, assumed, parts)



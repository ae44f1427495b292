"""From masks and a joint to the two links' meshes."""

from __future__ import annotations

import numpy as np

from reconstruct.cues import Hands, LinkMasks, Tracks
from reconstruct.errors import TaaError
from reconstruct.geometry import Geometry, LinkMesh
from reconstruct.geometry.atlas import make_atlas
from reconstruct.geometry.block import place_block
from reconstruct.geometry.collision import contacts_over_range, convex_parts, trim_parts
from reconstruct.geometry.layers import frame_costs, spread_frames
from reconstruct.geometry.masks import points_on_mask
from reconstruct.geometry.outline import build_shape, trace_face
from reconstruct.geometry.plane import fit_plane, keep_points
from reconstruct.geometry.relief import find_raised
from reconstruct.geometry.solids import carve, extrude, hull, swept_hulls, to_arrays, united
from reconstruct.geometry.texture import paint, subdivide, vertex_normals
from reconstruct.geometry.tray import assume_tray, with_tray
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
    notes: list[str] = []
    plane = fit_plane(tracks, fit)
    good = points_on_mask(video, tracks, fit, masks)
    if not good.all():
        notes.append(f"{int((~good).sum())} of {len(good)} fitted points lie off the moving silhouette; left out")
        fit, plane = keep_points(fit, plane, good)
    costs = frame_costs(video, tracks, fit, masks.hand)
    face = trace_face(video, hands, fit, plane, masks, costs)
    raised = find_raised(video, fit, plane, face.outline, masks, costs)
    shape = build_shape(face, fit, plane)
    slab = extrude(shape, plane)
    solid = united([slab, *(piece for r in raised for piece in r.solids(plane))])
    vertices, faces = to_arrays(solid)
    extent = float(np.linalg.norm(shape.bounds[1] - shape.bounds[0]))
    clearance = CLEARANCE * extent
    parts, convexity = convex_parts(*to_arrays(slab))
    parts = (*parts, *(part for r in raised for part in r.parts(plane)))
    if any(r.bar for r in raised):
        notes.append("a long thin thing on the face is taken for a bar on two posts; the gap behind it was not seen")

    surface, _ = subdivide(vertices, faces, 800)
    block = place_block(video, fit, plane, shape, masks, costs, surface, clearance)
    tray = assume_tray(fit, plane, shape, block.end, block.depth)
    clouds = swept_hulls(parts if tray is None else (*parts, tray.room), fit, clearance)
    if tray is not None:
        vertices, faces = to_arrays(with_tray(solid, tray))
        parts = (*parts, *tray.plates)
        notes.append("the drawer's tray was not seen: a bottom, sides and a back are assumed behind its front")
    if hand_points is not None:
        clouds = clouds + _hand_clouds(np.asarray(hand_points, float), clearance)
    box = block.solid
    body = carve(box, clouds)
    # A block that loses little when cut back by planes alone stays convex: simpler to simulate and to believe.
    plain = trim_parts((to_arrays(box),), clouds)
    if plain and hull(plain[0][0]).volume() > 0.85 * body.volume():
        body = hull(plain[0][0])
    hollow = hull(tray.room[0]).volume() if tray is not None else 0.0  # meant to be empty
    left = body.volume() / max(box.volume() - hollow, 1e-30)
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

    moving = _finish(video, fit, masks, costs, vertices, faces, parts, True, [])
    static = _finish(video, fit, masks, costs, s_vertices, s_faces, s_parts, False,
                     [(moving.vertices, moving.faces, True)], block.seen)
    words = "a block behind the moving part's closed pose"
    words += ", cut to the body's outline in the picture" if block.seen is not None else ""
    notes.append(f"the static link's depth and sides were not seen: it is {words}")
    if not block.decided:
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
        "moving_parts": entry(len(parts), "fitted", **{k: v for k, v in convexity.items() if k != "parts"}),
        "moving_raised": entry([r.height for r in raised], "fitted", unit=unit, bars=[r.bar for r in raised],
                               tracked_points=[r.points for r in raised]),
        "moving_tray_depth": entry(0.0 if tray is None else tray.depth, "assumed", unit=unit),
        "static_depth": entry(block.depth, "assumed", unit=unit),
        "static_closed_at": entry(block.end, "fitted" if block.decided else "assumed", unit=fit.unit,
                                  likeness=block.scores),
        "static_outline": entry(block.seen is not None, "fitted" if block.seen is not None else "assumed"),
        "static_volume_kept": entry(left, "assumed"),
        "static_parts": entry(len(s_parts), "fitted", **{k: v for k, v in s_convexity.items() if k != "parts"}),
        "clearance": entry(clearance, "assumed", unit=unit),
        "contacts_over_range": entry(verdict["contacts"], "observed", states=verdict["states"],
                                     penetration=verdict["penetration"]),
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


def _finish(video: Video, fit: JointFit, masks: LinkMasks, costs: np.ndarray, vertices: np.ndarray,
            faces: np.ndarray, parts: tuple, moves: bool, others: list, within: np.ndarray | None = None) -> LinkMesh:
    """Colour one link and draw its picture; ``within`` (any size) bounds the pixels that may colour it."""
    import cv2

    fine_v, fine_f = subdivide(vertices, faces)
    frames = spread_frames(fit, costs, 14)
    if moves:
        allowed = np.stack([cv2.erode(masks.moving[t].astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
                            for t in frames])
    else:
        covered = np.stack([masks.moving[t] | masks.hand[t] for t in frames])
        allowed = ~np.stack([cv2.dilate(c.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0 for c in covered])
        if within is not None:
            h, w = masks.moving.shape[1:]
            allowed &= cv2.resize(within.astype(np.uint8), (w, h), interpolation=cv2.INTER_NEAREST)[None] > 0
    hidden_by = [(vertices, faces, moves), *others]
    colors, seen = paint(video, fit, fine_v, vertex_normals(fine_v, fine_f)[1], frames, allowed, moves, hidden_by)
    depth = vertices @ fit.T_camera_world[2, :3] + fit.T_camera_world[2, 3]
    pixels = fit.K[0, 0] * video.frames.shape[2] / video.size[0] / max(float(np.median(depth)), 1e-9)
    atlas = make_atlas(vertices, faces, pixels)
    texels, _ = paint(video, fit, atlas.points, atlas.directions, frames, allowed, moves, hidden_by)
    # Colours on the static block are a projection of what stands there; its surface itself stays assumed.
    assumed = ~seen[fine_f].all(1) if moves else np.ones(len(fine_f), bool)
    return LinkMesh(fine_v, fine_f, colors, assumed, parts, atlas.skin(texels[:, :3]))



"""Objects with several moving links: a second joint without depth, and the links' meshes side by side.

A further link is treated like the first by every stage; what is here is what only several links have: a common scale
where depth is not given, and room for each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from reconstruct.cues import Hands, Tracks
from reconstruct.errors import TaaError
from reconstruct.geometry import Geometry, LinkMesh
from reconstruct.joint.models import JointFit, placed
from reconstruct.others import OtherPart
from reconstruct.video import Video

CLEARANCE = 0.004
"""Gap kept between two moving links, in parts of the first's extent."""
SWEEPS = 5
"""States of each of two moving links between which room is made."""
FLAT = 0.15
"""Least second over first extent of a link's points for them to span a front."""


def joint_beside(video: Video, tracks: Tracks, fit: JointFit, other: OtherPart, seed: int = 0) -> JointFit:
    """The joint of a part that moves while the first one rests, without depth.

    Its tracks are fitted like the first link's, by themselves. That leaves their distance open: at rest both parts are
    taken to lie in one front, the plane of the first link's points at q = 0 (where these span none, at their depth).

    Returns:
        The joint in the world and the scale of the first, its ``point_track`` in all tracks; or one that is refused.
    """
    from reconstruct.joint.fit import fit_joint

    rows = np.asarray(other.tracks, int)
    some = replace(tracks, uv=tracks.uv[rows], visible=tracks.visible[rows], reference=tracks.reference[rows],
                   slip=None if tracks.slip is None else tracks.slip[rows], shade=None, cast=None)  # fmt: skip
    made = fit_joint(video, some, float(fit.K[0, 0]), seed, camera_moving=False)
    if made.verdict == "refused":
        return made
    factor = _front_depth(fit, made)
    T = np.array(made.T_camera_world, float)
    T[:3, 3] *= factor
    made = placed(made, np.linalg.inv(fit.T_camera_world) @ T, factor)
    words = f"{made.reason}; its distance is that of the first link's front"
    members = None if made.members is None else rows[made.members]
    return replace(made, reason=words, point_track=rows[made.point_track], members=members, tracks=len(tracks.uv))


def _front_depth(fit: JointFit, made: JointFit) -> float:
    """Factor that puts a joint's points at q = 0 on the first link's front."""
    camera = fit.points @ fit.T_camera_world[:3, :3].T + fit.T_camera_world[:3, 3]
    theirs = made.points @ made.T_camera_world[:3, :3].T + made.T_camera_world[:3, 3]
    ray = np.median(theirs, axis=0)
    middle = np.median(camera, axis=0)
    _, extent, axes = np.linalg.svd(camera - middle, full_matrices=False)
    facing = abs(axes[2] @ ray) / np.linalg.norm(ray)
    if extent[1] > FLAT * extent[0] and facing > 0.2:
        factor = float(axes[2] @ middle / (axes[2] @ ray))
        if 0.5 < factor * ray[2] / middle[2] < 2.0:
            return factor
    return float(middle[2] / ray[2])


def alongside(fit: JointFit, plain: JointFit) -> JointFit:
    """The fit with the further joints of what it was made from, in its world and scale.

    Args:
        fit: in metres and in the final world.  plain: the same joint before that, with its ``further``.
    """
    if not plain.further:
        return fit
    factor = float(np.median(np.linalg.norm(_seen(fit), axis=1)) / np.median(np.linalg.norm(_seen(plain), axis=1)))
    T = np.array(plain.T_camera_world, float)
    T[:3, 3] *= factor
    T_new_old = np.linalg.inv(fit.T_camera_world) @ T
    scale = {"scale": fit.std["scale"]} if "scale" in fit.std else {}
    moved = [placed(other, T_new_old, factor) for other in plain.further]
    return replace(fit, further=tuple(replace(other, metric=fit.metric, scale_source=fit.scale_source,
                                              std={**other.std, **scale}) for other in moved))


def _seen(fit: JointFit) -> np.ndarray:
    return fit.points @ fit.T_camera_world[:3, :3].T + fit.T_camera_world[:3, 3]


def further_geometry(video: Video, hands: Hands, tracks: Tracks, fit: JointFit, geometry: Geometry
                     ) -> tuple[JointFit, Geometry]:  # fmt: skip
    """Meshes of the further links, clear of each other and of the static link over all ranges.

    A link of which no mesh can be made, or for which there is no room beside the others, is left out of both and named
    in the notes.

    Returns:
        The fit with the joints that are kept, and the geometry with their links in ``further``.
    """
    from reconstruct.geometry.collision import keep_clear
    from reconstruct.geometry.links import build_geometry
    from reconstruct.geometry.masks import segment_links

    kept: list[tuple[JointFit, LinkMesh]] = []
    notes: list[str] = []
    static = geometry.static
    for k, other in enumerate(fit.further, 2):
        try:
            masks = segment_links(video, hands, tracks, other)
            link = build_geometry(video, hands, tracks, other, masks).moving
            link = _beside(link, other, [(geometry.moving, fit), *((mesh, joint) for joint, mesh in kept)])
        except TaaError as error:
            notes.append(f"joint_{k} is known, its link is not in the asset: {error}")
            continue
        pair = keep_clear(Geometry(static, link), other)
        if static.parts and not pair.static.parts:
            notes.append(f"joint_{k} is known, its link is not in the asset: the static link leaves it no room")
            continue
        static = pair.static
        notes += [note for note in pair.notes if note not in notes]
        kept.append((other, link))
    if kept:
        notes.append("the static link's surface is made for the first link; further links may cut through it")
    return replace(fit, further=tuple(joint for joint, _ in kept)), replace(
        geometry, static=static, further=tuple(link for _, link in kept), notes=(*geometry.notes, *notes))


def _beside(link: LinkMesh, fit: JointFit, others: Sequence[tuple[LinkMesh, JointFit]]) -> LinkMesh:
    """The link with its collision parts cut back wherever another moving link can be while it is anywhere.

    Raises:
        TaaError: nothing is left of them.
    """
    from reconstruct.geometry.collision import trim_parts
    from reconstruct.geometry.solids import sweep_range, swept_hulls

    clouds = []
    back = np.linalg.inv(fit.link_pose(np.linspace(*sweep_range(fit), SWEEPS)))
    for mesh, joint in others:
        extent = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
        for cloud in swept_hulls(mesh.parts, joint, CLEARANCE * extent, SWEEPS):
            clouds += [cloud @ T[:3, :3].T + T[:3, 3] for T in back]
    parts = trim_parts(link.parts, clouds)
    if not parts:
        raise TaaError("it would overlap another moving link; trim the video to one of them")
    return replace(link, parts=parts)

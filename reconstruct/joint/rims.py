"""A part whose points show no joint, or leave it in doubt, asked again with its straight edges.

Parts of even paint, and small ones, have few points, which are lost within a few frames, and shadows have many: what is
left when those are taken away follows nothing, and the joint is refused. The straight edges that move and are no
shadow's are nearly all the part's, and are seen throughout. They say little by themselves, as each is held across
itself only, but with the few points enough.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from reconstruct.cues import Tracks
from reconstruct.joint.answers import alone_deg, apart_deg, doubtful, is_open
from reconstruct.joint.flat_fit import NEAR_DEG, FlatFit
from reconstruct.joint.models import VAGUE_DEG, JointFit
from reconstruct.joint.result import FREELY, MIN_INLIERS
from reconstruct.joint.shadows import maybe_shadows, without
from reconstruct.video import Video

PLATE_DEG, PROBABLE = 2 * VAGUE_DEG, 0.8
"""What a plate's axis has to be known to where points show no joint, and how probable one plate has to be beside all
others, to count though its axis is known no better."""
NEARLY_ALL = 0.8
"""Of the motion of all edges what a plate has to explain to count against a doubtful joint whose axis is known: of 49
films of other parts one does, a blade of three edges, of small scissors about half."""
DOUBTFUL = "its points alone leave the joint in doubt, with its straight edges"
SHOW_NONE = "its points alone show no joint, with its straight edges"
LEAVE_OPEN = "its points alone leave the axis open, with its straight edges"


def unless_rims_tell(fit: JointFit, video: Video, tracks: Tracks, rims: Callable[[], Tracks],
                     ask: Callable[[Tracks], JointFit], flat: Callable[[Tracks, Tracks], FlatFit | None]
                     ) -> JointFit:  # fmt: skip
    """The joint, or where it is refused or doubtful what points and straight edges together follow, doubtful in any
    case.

    Not where a body that is carried freely refutes it: a few edges of that follow some hinge. Where it is refused they
    are asked without all that may be a shadow, and a sure answer counts; else, and where the axis is open, known to
    VAGUE_DEG or worse by points alone, without the edges of shadows: a sure answer counts that knows it better; either
    unless a probable plate contradicts it that more points follow. Else
    the part is asked as a plate that turns in its plane, by its edges first. That counts if it knows the axis better or
    is probable by itself. Else what was found counts, unless the most probable plate contradicts it. Where a joint is
    doubtful though its axis is known, a plate counts that contradicts it, is probable, and explains nearly all edges.

    Args:
        fit: the joint of the points, or a refusal.
        rims: for the moving straight edges that are no shadow's and on no arm, as tracks of the same video.
        ask: for the joint of some tracks.
        flat: for the joint of a plate, of points and of straight edges; None if they are none's.
    """
    if FREELY in fit.reason or video.warp is not None or tracks.cast is None:
        return fit
    refused = fit.verdict == "refused"
    if fit.verdict == "ok":
        return fit
    edges = rims()
    if not len(edges.uv):
        return fit
    points, uncast = len(tracks.uv), without(tracks, tracks.cast)
    if not refused and not is_open(fit):
        return _unless_plainly_a_plate(fit, flat(uncast, edges), points)
    words = SHOW_NONE if refused else LEAVE_OPEN

    @functools.cache
    def plate_and_joint() -> tuple[FlatFit | None, JointFit | None]:
        plate = flat(uncast, edges)
        return plate, None if plate is None else _answer(plate.fit, points)

    def sure(found: JointFit) -> JointFit:
        plate, turned = plate_and_joint()
        if plate is not None and turned is not None and _rather_a_plate(found, plate, turned):
            return doubtful(turned, words)
        return doubtful(found, words)

    first = _answer(ask(_joined(without(tracks, maybe_shadows(video, tracks)), edges)), points) if refused else None
    if first is not None and first.verdict == "ok":
        return sure(first)
    found = _answer(ask(_joined(uncast, edges)), points) or first
    if found is not None and found.verdict == "ok" and (refused or alone_deg(found) < alone_deg(fit)):
        return sure(found)
    plate, turned = plate_and_joint()
    better = found is not None and (refused or alone_deg(found) < alone_deg(fit))
    if plate is not None and turned is not None:
        known = alone_deg(turned) < (PLATE_DEG if refused else alone_deg(fit))
        if known or plate.probability > PROBABLE:
            return doubtful(turned, words)
        better = better and found is not None and apart_deg(found, turned) < NEAR_DEG
    return doubtful(found, words) if found is not None and better else fit


def _rather_a_plate(found: JointFit, plate: FlatFit, turned: JointFit) -> bool:
    """Whether a probable plate contradicts what points and edges are sure of, and more of the points follow it."""
    apart = found.type != turned.type or apart_deg(found, turned) >= NEAR_DEG
    return apart and plate.probability > PROBABLE and _count(turned) > _count(found)


def _count(fit: JointFit) -> int:
    return 0 if fit.point_track is None else len(fit.point_track)


def _unless_plainly_a_plate(fit: JointFit, plate: FlatFit | None, points: int) -> JointFit:
    """A doubtful joint, or the plate that contradicts it and explains nearly all edges."""
    turned = None if plate is None else _answer(plate.fit, points)
    if plate is None or turned is None or plate.probability <= PROBABLE or plate.share < NEARLY_ALL:
        return fit
    if fit.axis is not None and fit.type == turned.type and apart_deg(fit, turned) < NEAR_DEG:
        return fit
    return doubtful(turned, DOUBTFUL)


def _joined(points: Tracks, edges: Tracks) -> Tracks:
    """Tracks of points and of edges, in this order."""
    known = [k for k in ("uv", "visible", "reference", "slip", "shade", "cast") if getattr(points, k) is not None]
    return replace(points, **{k: np.concatenate([getattr(points, k), getattr(edges, k)]) for k in known})


def _answer(fit: JointFit, points: int) -> JointFit | None:
    """A joint as one of so many points, without what it knows of edges; None if none was found, or one without either.

    What points follow alone has been refused for a reason: the shadow of a waving hand is a slide.
    """
    if fit.verdict == "refused" or fit.points is None or fit.point_track is None or fit.members is None:
        return None
    own, members = fit.point_track < points, fit.members[fit.members < points]
    if own.sum() < MIN_INLIERS or len(fit.members) - len(members) < MIN_INLIERS:
        return None
    return replace(fit, points=fit.points[own], point_track=fit.point_track[own], members=members, tracks=points)

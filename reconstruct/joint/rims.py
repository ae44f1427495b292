"""A part whose points show no joint, or leave its axis open, asked again with its straight edges.

Parts of even paint, and small ones, have few points, which are lost within a few frames, and shadows have many: what is
left when those are taken away follows nothing, and the joint is refused. The straight edges that move and are no
shadow's are nearly all the part's, and are seen throughout. They say little by themselves, as each is held across
itself only, but with the few points enough.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from reconstruct.cues import Tracks
from reconstruct.joint.answers import alone_deg
from reconstruct.joint.kinds import or_by_prior
from reconstruct.joint.models import VAGUE_DEG, JointFit
from reconstruct.joint.result import FREELY, MIN_INLIERS
from reconstruct.joint.shadows import maybe_shadows, without
from reconstruct.video import Video

FACTOR = 2.0
"""How many times what is stated such joints are off (the root of the mean square of nine rendered ones, 0.1 to 3.6)."""
SHOW_NONE = "its points alone show no joint, with its straight edges"
LEAVE_OPEN = "its points alone leave the axis open, with its straight edges"


def unless_rims_tell(fit: JointFit, video: Video, tracks: Tracks, rims: Callable[[], Tracks],
                     ask: Callable[[Tracks], JointFit]) -> JointFit:  # fmt: skip
    """The joint, or where it is refused or its axis is open what points and straight edges together follow, doubtful
    in any case.

    Not where a body that is carried freely refutes it: a few edges of that follow some hinge. Where it is refused they
    are asked without all that may be a shadow, and a sure answer counts; else without the edges of shadows, and what is
    found counts; else what was found first. Where the axis is open, known to VAGUE_DEG or worse by points alone, they
    are asked without the edges of shadows, and what is found counts if it is known better.

    Args:
        fit: the joint of the points, or a refusal.
        rims: for the moving straight edges that are no shadow's and on no arm, as tracks of the same video.
        ask: for the joint of some tracks.
    """
    if FREELY in fit.reason or video.warp is not None or tracks.cast is None:
        return fit
    refused = fit.verdict == "refused"
    if not refused and not _open(fit):
        return fit
    edges = rims()
    if not len(edges.uv):
        return fit
    if not refused:
        found = _answer(ask(_joined(without(tracks, tracks.cast), edges)), len(tracks.uv))
        return fit if found is None or alone_deg(found) >= alone_deg(fit) else _doubtful(found, LEAVE_OPEN)
    lit = _answer(ask(_joined(without(tracks, maybe_shadows(video, tracks)), edges)), len(tracks.uv))
    if lit is not None and lit.verdict == "ok":
        return _doubtful(lit, SHOW_NONE)
    found = _answer(ask(_joined(without(tracks, tracks.cast), edges)), len(tracks.uv)) or lit
    return fit if found is None else _doubtful(found, SHOW_NONE)


def _open(fit: JointFit) -> bool:
    """Whether a joint is doubtful and its axis known to VAGUE_DEG or worse by its tracks alone."""
    return fit.verdict == "ambiguous" and "axis_deg" in fit.std and alone_deg(fit) > VAGUE_DEG


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


def _doubtful(fit: JointFit, words: str) -> JointFit:
    """The joint as `ambiguous`: its type half by the prior, its axis and place FACTOR times less sure."""
    p, std = or_by_prior(fit.type_probability), dict(fit.std)
    for k in ("axis_deg", "point_m"):
        if k in std:
            std[k] = FACTOR * std[k]
    return replace(fit, verdict="ambiguous", reason=f"{words}, {fit.reason}", type_probability=p, std=std)

"""A part that hands cover, asked again with points that are followed up to the hands' rims.

Points are followed a few pixels off a hand, since along its rim they slide. Of a stapler under a hand that leaves
nothing but strips between the fingers. Followed up to the rims the part has several times as many points, and the rims
as well: where the first show a joint these do harm, and are not asked.
"""

from __future__ import annotations

from collections.abc import Callable

from reconstruct.cues import Hands, Tracks
from reconstruct.joint.answers import AS_WELL, FACTOR, alone_deg, contradicts, doubtful, is_open, types_of_both
from reconstruct.joint.models import JointFit
from reconstruct.joint.result import FREELY
from reconstruct.video import Video

MANY = 3.0
"""Times as many tracks: of a plain oven's door 194 follow a joint to 0.06 px, where off the hand 48 had to 0.12."""
SHOW_NONE = "points off the hands show no joint, up to the hands' rims"
LEAVE_OPEN = "points off the hands leave the axis open, up to the hands' rims"


def unless_hands_hide_it(fit: JointFit, video: Video, tracks: Tracks, hands: Hands, follow: Callable[[], Tracks],
                         ask: Callable[[Tracks], JointFit]) -> tuple[Tracks, JointFit]:  # fmt: skip
    """The tracks and their joint, or where it is refused or its axis open the tracks up to the hands' rims and theirs,
    if that is sure or, of an open one, knows the axis better; doubtful in any case.

    One that contradicts an open one, which may rest on more than points, has to know the axis AS_WELL times better than
    that as it is stated: what slides along rims agrees as well. Of the same type it counts too, however well it knows
    the axis, if MANY times as many tracks follow it more exactly. Of another type it counts only if that is the more
    probable one by both in the mean. Not where a body that is carried freely refutes the joint, nor before a camera
    that moves.

    Args:
        fit: the joint of these tracks, or a refusal.
        follow: for the tracks up to the hands' rims.
        ask: for the joint of such.
    """
    refused = fit.verdict == "refused"
    if not (refused or is_open(fit)) or FREELY in fit.reason or video.warp is not None:
        return tracks, fit
    if hands.mask is None or not hands.mask.any():
        return tracks, fit
    closer = follow()
    found = ask(closer)
    if refused:
        return (closer, doubtful(found, SHOW_NONE)) if found.verdict == "ok" else (tracks, fit)
    if found.verdict == "refused" or "axis_deg" not in found.std:
        return tracks, fit
    p = types_of_both(found, fit)
    if p[found.type] < p[fit.type]:
        return tracks, fit
    least = AS_WELL * FACTOR if contradicts(fit, found) else 1.0
    better = least * alone_deg(found) < alone_deg(fit) or (
        found.type == fit.type and found.inliers > MANY * fit.inliers and found.residual_px < fit.residual_px
    )
    return (closer, doubtful(found, LEAVE_OPEN)) if better else (tracks, fit)

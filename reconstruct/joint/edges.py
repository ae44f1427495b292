"""A joint that tracks on one straight edge follow, and nothing else.

How such an edge goes is seen across itself only, two numbers a frame, and many joints make it go so: a drawer's rim and
a lid's, or the shadow that the rest of a laptop throws on its lid, which no joint moves at all. That it has hundreds of
tracks says nothing: they all say the same. Where grain, or the steps of a shadow that is rendered, hold points along it
too, how the edge turns about itself stays unseen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from reconstruct.cues import Tracks
from reconstruct.joint.answers import contradicts
from reconstruct.joint.models import JointFit
from reconstruct.joint.shadows import without
from reconstruct.video import Video

NEAR_PX = 2.0
"""Working px from a line up to which a track is on it."""
SHARE = 0.9
"""Of the tracks that follow a joint, the share on one line from which on nothing else holds the joint."""
LOOKS = 5
"""Frames that are looked at."""
ROUNDS = 3
"""Fits of a line, as strays beside it turn it."""
ONE_EDGE = "all tracks that agree lie on one straight edge, of which only the way across is seen"


def unless_one_edge(fit: JointFit, video: Video, tracks: Tracks, ask: Callable[[Tracks], JointFit]) -> JointFit:
    """The joint, or where all of its tracks are on one straight edge, what the others follow.

    What is found so is doubtful where it contradicts the first, and that one where nothing is found.

    Args:
        fit: the joint of these tracks, or a refusal.
        ask: for the joint of some.
    """
    if fit.verdict == "refused" or not on_one_edge(video, tracks, fit.point_track):
        return fit
    out = np.zeros(len(tracks.uv), bool)
    out[fit.point_track] = True
    rest = without(tracks, out)
    again = ask(rest)
    if again.verdict == "refused" or on_one_edge(video, rest, again.point_track):
        return replace(fit, verdict="ambiguous", reason=f"{ONE_EDGE}; {fit.reason}")
    words = f"without the tracks on one straight edge, {again.reason}"
    verdict = "ambiguous" if contradicts(again, fit) else again.verdict
    return replace(again, verdict=verdict, reason=words)


def on_one_edge(video: Video, tracks: Tracks, ids: np.ndarray) -> bool:
    """Whether tracks lie on one straight line of the picture in every frame that is looked at.

    Args:
        ids: (n,) indices of the tracks.
    """
    if not len(ids):
        return False
    uv, seen = video.to_work(tracks.uv[ids]), tracks.visible[ids]
    enough = np.flatnonzero(seen.sum(0) >= max(3, 0.5 * seen.sum(0).max()))
    looks = np.unique(enough[np.linspace(0, len(enough) - 1, LOOKS).round().astype(int)])
    return all(_share_on_a_line(uv[seen[:, t], t]) >= SHARE for t in looks)


def _share_on_a_line(p: np.ndarray) -> float:
    """Share of points (n, 2) px on the line through most of them."""
    on = np.ones(len(p), bool)
    for _ in range(ROUNDS):
        middle = np.median(p[on], axis=0)
        along = np.linalg.svd(p[on] - middle)[2][0]
        off = np.abs((p - middle) @ [-along[1], along[0]])
        on = off <= max(NEAR_PX, float(np.median(off)))
    return float(np.mean(off < NEAR_PX))

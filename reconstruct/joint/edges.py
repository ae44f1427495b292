"""A joint that tracks on one straight edge, or on parallel ones, follow, and nothing else.

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
from reconstruct.joint.answers import contradicts, doubtful
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
ALONG, ASIDE_DEG = 0.9, 10.0
"""Length of a sighting's slip from which on it slides along an edge as it will (it is five times worse held along than
across), and how far off the others' an edge's direction may be to be the same. Of 43 sure joints of rendered films one
has SHARE of such, 37 deg off, the others 0.71 at most; nearly all are right."""
ONE_EDGE = "all tracks that agree lie on one straight edge, of which only the way across is seen"
PARALLELS = "all tracks that agree slide along parallel edges, of which only the way across is seen"


def unless_one_edge(fit: JointFit, video: Video, tracks: Tracks, ask: Callable[[Tracks], JointFit]) -> JointFit:
    """The joint, or where all of its tracks are on one straight edge or slide along parallel ones, what the others
    follow.

    What is found so is doubtful where it contradicts the first, and that one where nothing is found.

    Args:
        fit: the joint of these tracks, or a refusal.
        ask: for the joint of some.
    """
    if fit.verdict == "refused" or not (words := _edges_alone(video, tracks, fit.point_track)):
        return fit
    out = np.zeros(len(tracks.uv), bool)
    out[fit.point_track] = True
    rest = without(tracks, out)
    again = ask(rest)
    if again.verdict == "refused" or _edges_alone(video, rest, again.point_track):
        return doubtful(fit, words)
    edge = "one straight edge" if words == ONE_EDGE else "parallel edges"
    verdict = "ambiguous" if contradicts(again, fit) else again.verdict
    return replace(again, verdict=verdict, reason=f"without the tracks on {edge}, {again.reason}")


def _edges_alone(video: Video, tracks: Tracks, ids: np.ndarray) -> str:
    """What is wrong with tracks (n,) that only edges hold, or ""."""
    if on_one_edge(video, tracks, ids):
        return ONE_EDGE
    return PARALLELS if on_parallels(tracks, ids) else ""


def on_parallels(tracks: Tracks, ids: np.ndarray) -> bool:
    """Whether tracks slide along edges that go one way in each picture.

    Args:
        ids: (n,) indices of the tracks.
    """
    if tracks.slip is None or not tracks.visible[ids].any():
        return False
    slip, seen = tracks.slip[ids], tracks.visible[ids]
    length = np.linalg.norm(slip, axis=-1)
    slides = seen & (length > ALONG)
    # A direction and its opposite are the same edge's: angles count twice.
    way = np.where(slides, (slip[..., 0] + 1j * slip[..., 1]) ** 2 / np.maximum(length, 1e-9) ** 2, 0)
    usual = way.sum(0) / np.maximum(np.abs(way.sum(0)), 1e-9)
    same = slides & (np.real(way * usual.conj()) > np.cos(np.radians(2 * ASIDE_DEG)))
    return bool(same.sum() >= SHARE * seen.sum())


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

"""Whether something else moves by itself while the joint rests: a second drawer after the first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reconstruct.cues import Tracks
from reconstruct.joint.models import JointFit
from reconstruct.video import Video

MIN_TRACKS = 12
MOVES = 0.02
"""Net motion that counts, as a share of the image diagonal."""
RESTS = 0.004
"""How much a resting track may wander, as a share of the image diagonal."""


@dataclass(frozen=True)
class OtherPart:
    """A part that moves by itself. tracks: (M,) its tracks.  start, end: frames between which it moves."""

    tracks: np.ndarray
    start: int
    end: int


def second_part(video: Video, tracks: Tracks, fit: JointFit) -> OtherPart | None:
    """The part that moves while the fitted joint rests, or None.

    A part's track rests, moves once, and rests again; a track on an arm or its shadow is hardly ever at
    rest. Counted are tracks outside the joint's consensus that are seen in most frames, rest for at least
    a third of these, and move on the whole while the joint does not.

    Args:
        video: for times and size.  tracks: all tracks.
        fit: with q, moving_frames and point_track.
    """
    if fit.q is None or fit.moving_frames is None or fit.point_track is None:
        return None
    resting = ~np.asarray(fit.moving_frames, bool)
    free = np.ones(len(tracks.uv), bool)
    free[np.asarray(fit.point_track, int)] = False
    free &= tracks.visible.mean(1) >= 0.6
    when: list[tuple[int, int, int]] = []
    for n in np.flatnonzero(free):
        seen = np.flatnonzero(tracks.visible[n])
        uv = np.asarray(tracks.uv[n, seen], float)
        first, last = uv[: max(3, len(uv) // 10)], uv[-max(3, len(uv) // 10) :]
        a, b = np.median(first, axis=0), np.median(last, axis=0)
        if np.linalg.norm(b - a) < MOVES * video.diagonal:
            continue
        at_a = np.linalg.norm(uv - a, axis=1) < RESTS * video.diagonal
        at_b = np.linalg.norm(uv - b, axis=1) < RESTS * video.diagonal
        if (at_a | at_b).mean() < 1 / 3 or not at_a.any() or not at_b.any():
            continue
        start, end = seen[np.flatnonzero(at_a)[-1]], seen[np.flatnonzero(at_b)[0]]
        if start < end and resting[start : end + 1].mean() > 0.7:
            when.append((int(n), int(start), int(end)))
    if len(when) < MIN_TRACKS:
        return None
    rows, start, end = (np.array(column) for column in zip(*when, strict=True))
    return OtherPart(rows, int(np.median(start)), int(np.median(end)))


def words_of(video: Video, other: OtherPart) -> str:
    """A sentence for who has to know that only the dominant part was taken."""
    return (
        f"another part moves from {video.time[other.start]:.1f} to {video.time[min(other.end, len(video) - 1)]:.1f} s "
        "while this joint rests; the dominant one was taken, trim the video to the other one to get it too"
    )

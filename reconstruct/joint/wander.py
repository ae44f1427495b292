"""Tracks that wander: a window on paint so faint that noise moves it goes a little this way and that, for ever.

Such a track goes several pixels from its place, as a part does that moves slightly, and there can be more of them than
of the part's. What tells them is that they get no further than their own unrest takes them: of a random walk the
distance grows with the root of the number of steps, of a motion with the number itself.
"""

from __future__ import annotations

import warnings

import numpy as np

from reconstruct.cues import Tracks
from reconstruct.joint.paths import Paths
from reconstruct.video import Video

LEAVES_SHARE = 0.0025
"""Of the picture's diagonal, what a track has to go to leave its place: 2 px of 800."""
FEWEST = 8
"""Frames that have to show a track for its unrest to be known."""
AS_FAR = 2.0
"""Over its step times the root of the number of steps, how far a track has to get to go somewhere. Of random walks half
to two thirds get less far (5 % as far as 3), of tracks on the links of 27 rendered films 1.4 %, of those of seven real
joints none, of the other points beside rendered links that leave their place and are on no shadow's edge half."""


def wandering(video: Video, tracks: Tracks) -> np.ndarray:
    """(N,) bool, which of the tracks that leave their place get no further than a random walk of their own unrest.

    The step's standard deviation is read off second differences, which even motion does not change, by their median,
    which a sudden start does not. What lies along an edge counts for as little as the picture holds it.

    Args:
        tracks: of a camera that rests, whose slip is known; of others nothing is said.
    """
    out = np.zeros(len(tracks.uv), bool)
    if tracks.slip is None or video.warp is not None:
        return out
    ids = np.flatnonzero(tracks.visible.sum(1) >= FEWEST)
    uv = np.where(tracks.visible[ids][..., None], tracks.uv[ids], np.nan)
    went = Paths(uv, tracks.slip[ids]).moved()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # tracks without three frames in a row: no unrest is known
        unrest = np.nanmedian(np.linalg.norm(np.diff(went, 2, axis=1), axis=-1), axis=1)
    # Of two directions of standard deviation 1 the length's median is the root of 2 log 2; each second difference
    # holds two steps.
    step = unrest / np.sqrt(2 * np.log(2)) / np.sqrt(2)
    reach = np.linalg.norm(np.nanmax(went, axis=1) - np.nanmin(went, axis=1), axis=-1)
    leaves = reach > LEAVES_SHARE * float(np.hypot(*video.size))
    out[ids] = leaves & (reach < AS_FAR * step * np.sqrt(tracks.visible[ids].sum(1)))
    return out

"""Which tracks go with a hand: a tool, a lid that is lifted off, whatever is held and follows no joint of the scene."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d

from reconstruct.cues import Hands, HandTrack, Tracks
from reconstruct.hand.forearm import KNUCKLE, WRIST
from reconstruct.joint.paths import beside

FRAMES = 6
"""Frames that have to show both the track and the hand."""
SMOOTH = 5
"""Frames over whose mean landmarks are taken: single ones shake by some px, and a tool's end by more."""
GOES = 0.05
"""RMS distance from its middle, in palm lengths, from which on a track goes anywhere."""
STAYS = 0.6
"""Over it, the same as seen from the hand, up to which a track goes with it (a hook in a hand that opens a door: 0.16
to 0.7, 0.37 in the middle; all else there 0.25 to 3.2, 0.93 in the middle)."""
BESIDE = 1 / 6
"""Palm lengths from a track that goes with the hand within which others do too: their windows see it."""


def carried(tracks: Tracks, hands: Hands) -> np.ndarray:
    """(M, N) bool for each of M hands: tracks that keep their place as seen from the hand far better than in the
    picture, and those that are beside such for more than half of their time.

    What a hand pulls along a joint goes with it too while it is held, not before and not after: a track that is seen
    for long is told so.

    Args:
        tracks: (N, T) points, full px.
        hands: of the same T frames; their landmarks in full px.
    """
    out = np.zeros((len(hands.tracks), len(tracks.uv)), bool)
    for row, hand in zip(out, hands.tracks, strict=True):
        pose, palm = _poses(hand)
        seen = tracks.visible & np.isfinite(pose[:, 0].real)
        shown = seen.sum(1) >= FRAMES
        uv = np.where(seen, tracks.uv[..., 0] + 1j * tracks.uv[..., 1], complex(np.nan, np.nan))[shown]
        goes = _scatter(uv)
        a, b = np.where(np.isfinite(pose), pose, 1.0).T
        stays = _scatter((uv - b) / a)
        row[shown] = (goes > GOES * palm) & (stays < STAYS * goes)
        row |= beside(tracks.uv, tracks.visible, row, BESIDE * palm)
    return out


def path_px(hand: HandTrack) -> np.ndarray:
    """(T - 1,) way of the hand's middle from each frame to the next, full px; 0 where one does not show it."""
    step = np.abs(np.diff(_smooth(hand).mean(1)))
    return np.where(np.isfinite(step), step, 0.0)


def _smooth(hand: HandTrack) -> np.ndarray:
    """(T, 21) landmarks as complex numbers, means over SMOOTH frames of those that are valid; NaN where none is."""
    z = np.where(hand.valid[:, None], hand.uv[..., 0] + 1j * hand.uv[..., 1], 0)
    count = uniform_filter1d(hand.valid.astype(float), SMOOTH, mode="constant")[:, None]
    mean = [uniform_filter1d(x, SMOOTH, axis=0, mode="constant") for x in (z.real, z.imag)]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(hand.valid[:, None], (mean[0] + 1j * mean[1]) / count, complex(np.nan, np.nan))


def _poses(hand: HandTrack) -> tuple[np.ndarray, float]:
    """(T, 2) complex similarity (a, b) of each frame, a w + b from the hand's frame to full px, and the palm's length
    in full px; the size of the hand is the middle one of the video (generalised Procrustes analysis, Gower 1975)."""
    z = _smooth(hand)
    shown = np.flatnonzero(np.isfinite(z[:, 0].real))
    pose = np.full((len(z), 2), complex(np.nan, np.nan))
    if not len(shown):
        return pose, np.nan
    middle = z[shown].mean(1)
    form = z[shown] - middle[:, None]
    mean = form[len(form) // 2]
    for _ in range(3):
        turn = form @ np.conj(mean) / np.vdot(mean, mean)
        mean = np.mean(form / turn[:, None], axis=0)
    turn = form @ np.conj(mean) / np.vdot(mean, mean)
    size = float(np.median(np.abs(turn)))
    pose[shown, 0], pose[shown, 1] = turn / size, middle
    return pose, size * float(np.abs(mean[WRIST] - mean[KNUCKLE]))


def _scatter(z: np.ndarray) -> np.ndarray:
    """(N,) RMS distance of each path (N, T) of complex numbers from its middle."""
    middle = np.nanmedian(z.real, axis=1) + 1j * np.nanmedian(z.imag, axis=1)
    return np.sqrt(np.nanmean(np.abs(z - middle[:, None]) ** 2, axis=1))

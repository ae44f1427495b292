"""Which tracks lie on an arm: sleeves have texture and move like a link, and no skin tells them."""

from __future__ import annotations

import numpy as np

from reconstruct.cues import Hands, Tracks

WRIST, KNUCKLE = 0, 9
WIDTH, WIDENS, REACH = 0.75, 0.36, 7.0
"""Half the forearm's width at the wrist over the palm's length, what it may bend or widen by a unit of length, and how
far it reaches in palm lengths. A forearm is some three palms long, and what is seen of the upper arm prolongs it."""
SHARE, FRAMES = 0.8, 5
"""A track is on the arm if it is inside for this share of the frames that show both, and for so many frames."""
ALONG = 0.2
"""And if it goes at least such a share of the way that the wrist goes meanwhile: what is behind an arm does not."""


def on_forearm(tracks: Tracks, hands: Hands) -> np.ndarray:
    """(N,) bool: tracks that stay where a forearm is, which prolongs a hand beyond its wrist.

    What lies behind an arm is seen only while the arm is elsewhere; what stays in the moving wedge is the arm itself.

    Args:
        tracks: (N, T) points, full px.
        hands: of the same T frames; their landmarks in full px.
    """
    out = np.zeros(len(tracks.uv), bool)
    for hand in hands.tracks:
        wrist = hand.uv[:, WRIST]
        palm = wrist - hand.uv[:, KNUCKLE]
        length = np.linalg.norm(palm, axis=-1)
        along = palm / np.maximum(length, 1e-6)[:, None]
        d = np.where(tracks.visible[..., None], tracks.uv, np.nan) - wrist
        a = np.einsum("ntk,tk->nt", d, along) / length
        b = np.abs(d[..., 0] * along[:, 1] - d[..., 1] * along[:, 0]) / length
        both = tracks.visible & hand.valid & np.isfinite(a)
        inside = both & (a > 0) & (a < REACH) & (b < WIDTH + WIDENS * a)
        goes = _extent(np.where(inside[..., None], d + wrist, np.nan))
        wrist_goes = _extent(np.where(inside[..., None], wrist, np.nan))
        out |= (inside.sum(1) >= FRAMES) & (inside.sum(1) > SHARE * both.sum(1)) & (goes >= ALONG * wrist_goes)
    return out


def _extent(uv: np.ndarray) -> np.ndarray:
    """(N,) px, diagonal of the box around each path (N, T, 2); 0 where nothing is seen."""
    lo, hi = np.where(np.isnan(uv), np.inf, uv).min(1), np.where(np.isnan(uv), -np.inf, uv).max(1)
    return np.linalg.norm(np.where(np.isfinite(lo), hi - lo, 0.0), axis=-1)

"""Point prompts for a promptable segmenter, out of the track clusters: what a person would click.

The tracks that follow the joint lie on the moving part, those that rest beside it on the static one, and the hand
detector's landmarks on the hand. A few well-spread ones in a few frames that show different states are the prompts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reconstruct.cues import Hands, Tracks
from reconstruct.joint.models import JointFit
from reconstruct.video import Video

POINTS = 8
"""SAM keeps at most sixteen points an object: eight on it, eight off it."""
RESTS = 0.004
MOVES = 0.02
NEAR = 0.15
"""Shares of the image diagonal: what a resting track may wander, what counts as motion, how near "beside" is."""


@dataclass(frozen=True)
class Prompt:
    """Points in one frame, full px; each (n, 2), possibly empty.

    Attributes:
        frame: working frame.  moving, static, hand: points on these.
    """

    frame: int
    moving: np.ndarray
    static: np.ndarray
    hand: np.ndarray


def point_prompts(video: Video, tracks: Tracks, fit: JointFit | None = None, hands: Hands | None = None,
                  count: int = 3) -> list[Prompt]:  # fmt: skip
    """Prompts in up to ``count`` frames: near the start, the middle and the end of the motion.

    Args:
        video: for the size.  tracks: all tracks.
        fit: a joint, whose consensus tracks are the moving cluster; without one the tracks that move are.
        hands: detected hands; points under them are not used for the links.

    Returns:
        At least one frame with three or more points on the moving part, or [].
    """
    diagonal = video.diagonal
    moving = _moving(tracks, fit, diagonal)
    resting = _extent(tracks) < RESTS * diagonal
    resting[moving] = False
    free = tracks.visible & ~_under_hands(video, tracks, hands)
    seen = free[moving].sum(0)
    if not len(moving) or seen.max(initial=0) < 3:
        return []
    prompts = []
    for frame in _frames(seen, fit, count):
        on = tracks.uv[moving[free[moving, frame]], frame]
        # Two parts meet at the border of the cluster; what is well inside is a safer click.
        centre = np.median(on, axis=0)
        away = np.linalg.norm(on - centre, axis=1)
        on = spread(on[away <= np.quantile(away, 0.9)], POINTS)
        off = tracks.uv[resting & free[:, frame], frame]
        near = np.min(np.linalg.norm(off[:, None] - on[None], axis=-1), axis=1) if len(off) else np.zeros(0)
        beside = off[(near < NEAR * diagonal) & (near > 0.01 * diagonal)]
        prompts.append(Prompt(int(frame), on, spread(beside, POINTS), _hand_points(hands, frame)))
    return prompts


def spread(points: np.ndarray, count: int) -> np.ndarray:
    """(m, 2) up to ``count`` of the points, far from one another: farthest-point sampling from the middle one."""
    points = np.asarray(points, float).reshape(-1, 2)
    if len(points) <= count:
        return points
    chosen = [int(np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1)))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]


def _extent(tracks: Tracks) -> np.ndarray:
    """(N,) px, the larger side of each track's box."""
    uv = np.where(tracks.visible[..., None], tracks.uv, np.nan)
    out = np.full(len(uv), np.inf)
    some = tracks.visible.sum(1) > 1
    if some.any():
        out[some] = np.max(np.nanmax(uv[some], axis=1) - np.nanmin(uv[some], axis=1), axis=-1)
    return out


def _moving(tracks: Tracks, fit: JointFit | None, diagonal: float) -> np.ndarray:
    if fit is not None and fit.point_track is not None:
        return np.unique(np.asarray(fit.point_track, int))
    extent = _extent(tracks)
    return np.flatnonzero(np.isfinite(extent) & (extent > MOVES * diagonal))


def _under_hands(video: Video, tracks: Tracks, hands: Hands | None) -> np.ndarray:
    """(N, T) bool."""
    under = np.zeros(tracks.visible.shape, bool)
    if hands is None:
        return under
    h, w = hands.mask.shape[1:]
    for t in range(min(under.shape[1], len(hands.mask))):
        seen = np.flatnonzero(tracks.visible[:, t])
        at = np.round((tracks.uv[seen, t] + 0.5) * (w / video.size[0], h / video.size[1]) - 0.5).astype(int)
        x, y = np.clip(at[:, 0], 0, w - 1), np.clip(at[:, 1], 0, h - 1)
        under[seen, t] = hands.mask[t, y, x]
    return under


def _frames(seen: np.ndarray, fit: JointFit | None, count: int) -> list[int]:
    """The best-covered frame of each part of the joint's range (of the time, without a joint)."""
    state = np.arange(len(seen), dtype=float) if fit is None or fit.q is None else np.asarray(fit.q, float)
    edges = np.quantile(state, np.linspace(0, 1, count + 1))
    frames = []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        inside = np.flatnonzero((state >= low) & (state <= high))
        best = inside[int(np.argmax(seen[inside]))]
        if seen[best] >= 3 and best not in frames:
            frames.append(int(best))
    return sorted(frames)


def _hand_points(hands: Hands | None, frame: int) -> np.ndarray:
    """Wrist and finger middles of every hand that is seen in the frame."""
    if hands is None:
        return np.zeros((0, 2))
    points = [t.uv[frame, [0, 5, 9, 17, 7, 11]] for t in hands.tracks if t.valid[frame]]
    return np.concatenate(points)[:POINTS] if points else np.zeros((0, 2))

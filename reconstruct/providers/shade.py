"""Edges of shadows, among the tracks.

A shadow of the arm or of the part moves nearly as the part does, and its edge is followed like any other. Two things
tell it. Its two sides have one colour: what paints, labels and what lies behind a rim leave there differs in colour, a
fold of a part of even paint does not. And what it falls on stays: over another time's picture of the same place, one
side is as it was and the other darker by one factor, whatever the grain of what is seen through it.
"""

from __future__ import annotations

import numpy as np

HALF, SPREAD = 9, 5.0
"""Half the window's side and the standard deviation of its weight, px, as the tracks are registered with."""
LOOKS = 24
"""Frames that are looked at for its colours."""
CONTRAST, COLOUR = 0.2, 0.25
"""Logarithm of the brighter side over the darker one from which on a shadow may be the reason (fainter edges are mostly
grain), and the share of it by which a single channel may differ."""
SIDE, TIP, CLEAN = 0.1, 0.03, 0.25
"""Share of a window's pixels that make a side at least; the same for the tip of a finger's shadow, and over the step
between the two the most by which pixels may scatter about their sides' for it: of grain a few are always darkest."""
DARKEST = 4.0
"""Values below which a channel says nothing."""
STAYS_LOOKS, TIMES = 8, 16
"""Frames of a track that are held against other times, and so many of these."""
DARKENED, UNCHANGED = 0.1, 0.06
"""Logarithm of the factor between the two sides over another time, and how far the unchanged one's may be from 0."""
HUE, ROUGH, NOISE = 0.3, 0.25, 0.03
"""Share of the factor by which a single channel's may differ, and by which pixels may scatter about their side's;
least scatter that is asked for."""
BY_THEN = 0.5
"""Share of the frames of a track that some other time has to explain so."""


def one_colour(frames: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Points on an edge whose sides differ in brightness only, by the median over the frames that see them.

    Args:
        frames: (T, h, w, 3) uint8.  uv: (N, T, 2) px of these, NaN where not seen.

    Returns:
        (N,) bool.
    """
    N, T = uv.shape[:2]
    some = np.unique(np.linspace(0, T - 1, min(T, LOOKS)).round().astype(int))
    contrast, colour = np.full((2, N, len(some)), np.nan)
    bell = _bell()
    for k, t in enumerate(some):
        seen = np.flatnonzero(np.isfinite(uv[:, t, 0]))
        if not len(seen):
            continue
        patch = _light(frames[t])[_around(uv[seen, t], frames.shape[1:3])].reshape(len(seen), -1, 3)
        gap = _step(patch, bell)
        contrast[seen, k] = gap.mean(1)
        colour[seen, k] = np.abs(gap - gap.mean(1, keepdims=True)).max(1)
    out = np.zeros(N, bool)
    told = np.isfinite(contrast).any(1)
    middle, off = np.nanmedian(contrast[told], axis=1), np.nanmedian(colour[told], axis=1)
    out[told] = (middle > CONTRAST) & (off < COLOUR * middle)
    return out


def rest_beneath(frames: np.ndarray, uv: np.ndarray, hidden: np.ndarray | None = None) -> np.ndarray:
    """Share of a track's frames in which the picture about it is another time's, one side of an edge darkened.

    Args:
        frames: (T, h, w, 3) uint8.  uv: (N, T, 2) px of these, NaN where not seen.
        hidden: (T, h, w) bool, under a hand.

    Returns:
        (N,) in [0, 1].
    """
    N, T = uv.shape[:2]
    times = np.unique(np.linspace(0, T - 1, min(T, TIMES)).round().astype(int))
    light = {int(t): _light(frames[t]) for t in times}
    bell = _bell()
    looks = np.zeros((N, T), bool)
    for i, seen in enumerate(np.isfinite(uv[..., 0])):
        f = np.flatnonzero(seen)
        looks[i, f[np.linspace(0, len(f) - 1, min(len(f), STAYS_LOOKS)).round().astype(int)]] = True
    explained = np.zeros(N)
    for t in np.flatnonzero(looks.any(0)):
        ids = np.flatnonzero(looks[:, t])
        around = _around(uv[ids, t], frames.shape[1:3])
        here = light.get(int(t), _light(frames[t]))[around].reshape(len(ids), -1, 3)
        any_time = np.zeros(len(ids), bool)
        for s in times[times != t]:
            left = np.flatnonzero(~any_time)
            if not len(left):
                break
            change = here[left] - light[int(s)][around[0][left], around[1][left]].reshape(len(left), -1, 3)
            good = _one_side_darkened(change, bell)
            if hidden is not None:
                good &= ~hidden[s][around[0][left], around[1][left]].reshape(len(left), -1).any(1)
            any_time[left[good]] = True
        explained[ids] += any_time
    return explained / np.maximum(looks.sum(1), 1)


def _one_side_darkened(change: np.ndarray, bell: np.ndarray) -> np.ndarray:
    """(n,) bool of logarithms of ratios (n, m, 3) between two times."""
    high, low, above = _two_sides(change, bell, TIP)
    factor = high.mean(1) - low.mean(1)
    rises, falls = np.abs(high.mean(1)), np.abs(low.mean(1))
    hue = np.where((rises > falls)[:, None], high, low)
    hue = np.abs(hue - hue.mean(1, keepdims=True)).max(1)
    off = np.sum((change - np.where(above[..., None], high[:, None], low[:, None])) ** 2, axis=-1)
    scatter = [np.sqrt(np.sum(w * off, axis=1) / np.maximum(3 * w.sum(1), 1e-6)) for w in (above * bell, ~above * bell)]
    good = (factor > DARKENED) & (np.minimum(rises, falls) < UNCHANGED)
    return good & (hue < HUE * factor) & (np.maximum(*scatter) < np.maximum(ROUGH * factor, NOISE))


def _step(patch: np.ndarray, bell: np.ndarray) -> np.ndarray:
    """(n, 3) brighter less darker side of the pixels (n, m, 3)."""
    high, low, _ = _two_sides(patch, bell)
    more, less, above = _two_sides(patch, bell, TIP)
    off = np.sum((patch - np.where(above[..., None], more[:, None], less[:, None])) ** 2, axis=-1)
    scatter = np.sqrt(np.sum(bell * off, axis=1) / (3 * bell.sum()))
    tip = scatter < CLEAN * (more - less).mean(1)
    return np.where(tip[:, None], more - less, high - low)


def _two_sides(patch: np.ndarray, bell: np.ndarray, least: float = SIDE) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean colours (n, 3) of the brighter and the darker part of the pixels (n, m, 3), and (n, m) bool which."""
    grey = patch.mean(-1)
    low, high = np.quantile(grey, [least, 1 - least], axis=1)
    above = grey > ((low + high) / 2)[:, None]
    return _mean(patch, above * bell), _mean(patch, ~above * bell), above


def _light(frame: np.ndarray) -> np.ndarray:
    return np.log(np.maximum(frame, DARKEST, dtype=np.float32))


def _bell() -> np.ndarray:
    side = np.arange(-HALF, HALF + 1)
    return np.exp(-(side[:, None] ** 2 + side**2) / (2 * SPREAD**2)).astype(np.float32).ravel()


def _around(uv: np.ndarray, size: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Rows (n, k, 1) and columns (n, 1, k) of the windows about places (n, 2) in a picture of (height, width)."""
    x, y = np.round(uv).astype(int).T
    x, y = x.clip(HALF, size[1] - 1 - HALF), y.clip(HALF, size[0] - 1 - HALF)
    side = np.arange(-HALF, HALF + 1)
    return y[:, None, None] + side[:, None], x[:, None, None] + side


def _mean(patch: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(n, 3) of the pixels (n, m, 3), weighted by (n, m)."""
    return (weight[..., None] * patch).sum(1) / np.maximum(weight.sum(1), 1e-6)[:, None]

"""Edges of brightness alone: where a shadow begins, its two sides have one colour.

A shadow of the arm or of the part moves nearly as the part does, and its edge is followed like any other. What
paints, labels and what lies behind a rim leave there differs in colour; a shadow, and a fold of a part of even paint,
does not.
"""

from __future__ import annotations

import numpy as np

HALF, SPREAD = 9, 5.0
"""Half the window's side and the standard deviation of its weight, px, as the tracks are registered with."""
LOOKS = 24
"""Frames that are looked at."""
CONTRAST, COLOUR = 0.2, 0.25
"""Logarithm of the brighter side over the darker one from which on a shadow may be the reason (fainter edges are mostly
grain), and the share of it by which a single channel may differ."""
DARKEST = 4.0
"""Values below which a channel says nothing."""


def one_colour(frames: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Which points lie on an edge whose sides differ in brightness only.

    Args:
        frames: (T, h, w, 3) uint8.  uv: (N, T, 2) px of these, NaN where not seen.

    Returns:
        (N,) bool, by the median over the frames that see the point.
    """
    N, T = uv.shape[:2]
    h, w = frames.shape[1:3]
    some = np.unique(np.linspace(0, T - 1, min(T, LOOKS)).round().astype(int))
    contrast, colour = np.full((2, N, len(some)), np.nan)
    side = np.arange(-HALF, HALF + 1)
    bell = np.exp(-(side[:, None] ** 2 + side**2) / (2 * SPREAD**2)).astype(np.float32).ravel()
    for k, t in enumerate(some):
        seen = np.flatnonzero(np.isfinite(uv[:, t, 0]))
        if not len(seen):
            continue
        light = np.log(np.maximum(frames[t], DARKEST, dtype=np.float32))
        x, y = np.round(uv[seen, t]).astype(int).T
        x, y = x.clip(HALF, w - 1 - HALF), y.clip(HALF, h - 1 - HALF)
        rows, columns = y[:, None, None] + side[:, None], x[:, None, None] + side
        patch = light[rows, columns].reshape(len(seen), -1, 3)
        grey = patch.mean(-1)
        low, high = np.quantile(grey, [0.1, 0.9], axis=1)
        above = grey > ((low + high) / 2)[:, None]
        gap = _mean(patch, above * bell) - _mean(patch, ~above * bell)
        contrast[seen, k] = gap.mean(1)
        colour[seen, k] = np.abs(gap - gap.mean(1, keepdims=True)).max(1)
    out = np.zeros(N, bool)
    told = np.isfinite(contrast).any(1)
    middle, off = np.nanmedian(contrast[told], axis=1), np.nanmedian(colour[told], axis=1)
    out[told] = (middle > CONTRAST) & (off < COLOUR * middle)
    return out


def _mean(patch: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(n, 3) of the pixels (n, m, 3), weighted by (n, m)."""
    return (weight[..., None] * patch).sum(1) / np.maximum(weight.sum(1), 1e-6)[:, None]

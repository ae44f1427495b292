"""Motions of a few pixels, which the search does not see.

It looks at tracks that leave their place by more than what tracks that go wrong do anyway, and judges in pixels. A
stove's burner that is lifted by half a centimetre goes less far; but three hundred points that go four pixels together
hold an axis to half a degree. What tells them from tracks that wander is that they go together.
"""

from __future__ import annotations

import numpy as np

from reconstruct.joint.flow import candidates, flow_of
from reconstruct.joint.paths import Paths
from reconstruct.joint.polish import Bundle
from reconstruct.joint.sweep import FEWEST, start_of
from reconstruct.joint.view import View

SMOOTH = 5
"""Frames over which a track's place is averaged."""
LEAST_PX, LEAST_SIGMAS = 2.0, 6.0
"""Extent of the averaged path from which on a track may move, working px, and over its own noise."""
TOGETHER = 0.5
"""Share of these that has to follow the joint, to be sure of it: resting texture that wanders follows none."""
HINGES, SLIDES = 2, 1
"""Different ways to move that are handed on."""


def slight_motion(paths: Paths, view: View, least: int | None = None
                  ) -> tuple[dict[str, list[Bundle]], np.ndarray, bool] | None:  # fmt: skip
    """The joints that most of the tracks follow which leave their place at all, as their velocities show them.

    Args:
        paths: N tracks, px from the principal point.  view: focal length; the camera rests.
        least: how many have to follow, where another joint is known; TOGETHER of them when None.

    Returns:
        Starts of each type in all frames, (n,) the tracks that follow the best of them, and whether these are TOGETHER
        of all that leave their place; None if there are too few of these, or too few follow any joint.
    """
    pool = np.flatnonzero(_leaves(paths))
    if len(pool) < FEWEST or (flow := flow_of(paths[pool], view.focal)) is None:
        return None
    ways = candidates(flow, HINGES, SLIDES)
    most = TOGETHER * len(pool)
    if not ways or (good := ways[0].good).sum() < max(FEWEST, most if least is None else least):
        return None
    starts: dict[str, list[Bundle]] = {}
    for way in ways:
        starts.setdefault(way.kind, []).append(start_of(way, flow, np.flatnonzero(good), np.arange(paths.uv.shape[1])))
    return starts, pool[flow.ids[good]], bool(good.sum() >= most)


def _leaves(paths: Paths) -> np.ndarray:
    """(N,) bool: whose averaged path is longer than noise makes it."""
    moved = paths.moved()
    seen = paths.seen
    second = np.diff(moved, n=2, axis=1)
    told = np.isfinite(second[..., 0]).any(1)
    sigma = np.full(len(paths), np.inf)
    # The second difference of white noise has six times its variance; the median of |.| is 0.6745 of its deviation.
    sigma[told] = np.nanmedian(np.abs(second[told]), axis=(1, 2)) / 0.6745 / np.sqrt(6)
    kernel = np.ones(SMOOTH)
    total = np.apply_along_axis(np.convolve, 1, np.where(seen[..., None], moved, 0.0), kernel, "valid")
    count = np.apply_along_axis(np.convolve, 1, seen.astype(float), kernel, "valid")
    mean = np.where(count[..., None] == SMOOTH, total / SMOOTH, np.nan)
    some = (count == SMOOTH).any(1)
    extent = np.zeros(len(paths))
    extent[some] = np.linalg.norm(np.nanmax(mean[some], axis=1) - np.nanmin(mean[some], axis=1), axis=-1)
    return extent > np.maximum(LEAST_PX, LEAST_SIGMAS * sigma / np.sqrt(SMOOTH))

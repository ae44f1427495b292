"""Regions of the picture, asked by themselves: what moves beside a part, its shadow say, may be most of what moves."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from scipy.cluster.vq import kmeans2

from reconstruct.joint.bundle import Observations
from reconstruct.joint.finish import View
from reconstruct.joint.paths import Paths
from reconstruct.joint.polish import Bundle, residuals
from reconstruct.joint.sweep import Swept, placed_on, sweep

REGIONS = 4
"""Whose tracks are swept by themselves."""
MISSED_PX = 0.3
"""What a track costs at most by which joints of two sweeps are compared."""


def region_of(place: np.ndarray, count: int) -> np.ndarray:
    """(N,) region of the picture, of so many, that each of the places (N, 2) lies in: k-means from a row along the
    direction that they extend in."""
    off = place - place.mean(0)
    order = np.argsort(off @ np.linalg.svd(off, full_matrices=False)[2][0])
    first = place[order[((np.arange(count) + 0.5) / count * len(place)).astype(int)]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a region may lose all its tracks
        return kmeans2(place, first, minit="matrix")[1]


def swept_by_regions(paths: Paths, moving: np.ndarray, obs: Observations, view: View, rivals: Sequence[Bundle] = (),
                     depths: Sequence[float] | np.ndarray = (1.0,)) -> list[Swept]:  # fmt: skip
    """Joints of the tracks that leave their place in REGIONS of the picture; arguments as of :func:`sweep`."""
    where = region_of(np.nanmedian(paths.uv[moving], axis=1), REGIONS)
    several = [sweep(paths, moving, obs, moving[where == k], rivals, view, depths) for k in range(REGIONS)]
    return [swept for swept in several if swept is not None]


def least_missed(tries: Sequence[Swept], paths: Paths, moving: np.ndarray, view: View) -> Swept | None:
    """That whose joint the tracks ``moving`` miss least, MISSED_PX each at most; None of none."""
    every = view.sightings(paths[moving], np.arange(paths.uv.shape[1]))

    def missed(swept: Swept) -> float:
        off = np.linalg.norm(residuals(placed_on(swept.lead, every), every), axis=-1)
        off = np.nanmedian(np.where(every.seen, off, np.nan)[every.seen.any(1)], axis=1)
        return float(np.sum(np.minimum(off, MISSED_PX)))

    return min(tries, key=missed, default=None)

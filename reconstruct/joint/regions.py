"""Regions of the picture, asked by themselves: what moves beside a part, its shadow say, may be most of what moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reconstruct.joint.bundle import Observations
from reconstruct.joint.paths import Paths
from reconstruct.joint.polish import Bundle, residuals
from reconstruct.joint.select import region_of
from reconstruct.joint.sweep import Swept, placed_on, sweep
from reconstruct.joint.view import View

REGIONS = 4
"""Whose tracks are swept by themselves."""
MISSED_PX = 0.3
"""What a track costs at most by which joints of two sweeps are compared."""


def swept_by_regions(paths: Paths, moving: np.ndarray, obs: Observations, view: View, rivals: Sequence[Bundle] = (),
                     depths: Sequence[float] | np.ndarray = (1.0,)) -> list[Swept]:  # fmt: skip
    """A sweep's joint of each of REGIONS of the picture where tracks follow one; arguments as of :func:`sweep`.

    Args:
        paths: N tracks, px from the principal point.  moving: (m,) those of them that leave their place.
    """
    where = region_of(np.nanmedian(paths.uv[moving], axis=1), REGIONS)
    several = [sweep(paths, moving, obs, moving[where == k], rivals, view, depths) for k in range(REGIONS)]
    return [swept for swept in several if swept is not None]


def least_missed(tries: Sequence[Swept], paths: Paths, moving: np.ndarray, view: View) -> Swept | None:
    """That whose joint the tracks ``moving`` (m,) miss least, MISSED_PX each at most; None of none.

    Args:
        paths: N tracks, px from the principal point.
    """
    every = view.sightings(paths[moving], np.arange(paths.uv.shape[1]))

    def missed(swept: Swept) -> float:
        off = np.linalg.norm(residuals(placed_on(swept.lead, every), every), axis=-1)
        off = np.nanmedian(np.where(every.seen, off, np.nan)[every.seen.any(1)], axis=1)
        return float(np.sum(np.minimum(off, MISSED_PX)))

    return min(tries, key=missed, default=None)

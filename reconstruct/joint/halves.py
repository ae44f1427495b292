"""What half of the link would have said: the joint again from random halves of the link's regions.

The covariance at the optimum (uncertainty.py) knows the noise of the tracks that are there, and one local minimum.
It does not know that the tracks along one rim, of one face or of a shadow's edge err together, nor that another minimum
lies next to it. Halves of the regions, drawn without replacement, scatter about the answer as much as answers do (the
delete-d jackknife; Shao and Wu, "A general theory for jackknife variance estimation", Annals of Statistics 1989), and
each half's joint is one more start for all tracks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from reconstruct.joint.polish import (
    ROBUST_SIGMAS,
    Bundle,
    Sightings,
    place_points,
    polish,
    radius_cost,
    residuals,
    robust_loss,
)
from reconstruct.joint.states import held_frames
from reconstruct.joint.uncertainty import Spread, clusters

REGION = 0.3
"""Edge of a region over the link's diagonal."""
HALVES, LEAST_REGIONS, LEAST_TRACKS = 8, 4, 8
"""Halves drawn, and the regions and tracks below which none can be."""
STUDENT = 1.18
"""Standard deviation that gives the 95 % interval of so many halves, over their own (Student's t over the normal's)."""
WIDE, STEPS, LAST_STEPS = 2.0, 10, 12
"""The first loss of a half over the last one's scale; steps of either, and of the last ones on all tracks."""


@dataclass(frozen=True)
class Half:
    """A joint from some of the tracks.

    Attributes:
        tracks: (N,) bool, those it is fitted to.  bundle: the joint, with their points.
        held: (T,) bool, the frames whose state enough of them agree on.
    """

    tracks: np.ndarray
    bundle: Bundle
    held: np.ndarray


def halves(b: Bundle, s: Sightings, seed: int = 0) -> tuple[Bundle, list[Half]]:
    """The best joint that halves of the link lead to, and these halves' own.

    Args:
        b: the polished joint before a camera whose path is not fitted with it.  s: its observations.
        seed: of the draws.

    Returns:
        ``b``, or what costs less on all tracks; and the halves, none where the link has too few regions or tracks.
    """
    region = clusters(b, None, REGION)
    count = int(region.max()) + 1
    if s.free or count < LEAST_REGIONS:
        return b, []
    rng = np.random.default_rng(seed)
    limit = ROBUST_SIGMAS * max(b.sigma, 0.05)
    best, out = polish(b, s, LAST_STEPS, limit, sharpen=False), []
    for _ in range(HALVES):
        tracks = np.isin(region, rng.permutation(count)[: count // 2])
        if tracks.sum() < LEAST_TRACKS:
            continue
        half, few = replace(b, X=b.X[tracks]), s.of(tracks)
        for scale in (WIDE, 1.0):
            half = polish(half, few, STEPS, scale * limit, sharpen=False)
        out.append(Half(tracks, half, _held(half, few)))
        # The points of the whole are where the old joint wanted them: they are placed anew.
        whole = polish(place_points(replace(half, X=b.X * _scale(half, b, tracks)), s), s, LAST_STEPS, limit, False)
        best = min(best, whole, key=lambda x: _cost(x, s, limit))
    return best, out


def widened(sure: Spread, b: Bundle, several: list[Half]) -> Spread:
    """The uncertainty, where halves of the link scatter by more than it says.

    Args:
        sure: of the joint.  b: the joint, as :func:`halves` returned it.
        several: of :func:`halves`; with fewer than half of them nothing is known.

    Returns:
        Axis (deg), point and states (T,) (rad, units of the link's mean depth) with the larger standard deviation of
        both; the rest is left. Of a state only those halves speak that hold it: elsewhere theirs run off for nothing.
    """
    if len(several) < HALVES / 2:
        return sure
    off = [_off(half, b) for half in several]
    axis, point = (STUDENT * float(np.sqrt(np.mean([o[k] ** 2 for o in off]))) for k in (0, 1))
    held = np.array([half.held for half in several])
    q = STUDENT * np.sqrt(np.sum([o[2] ** 2 for o in off], axis=0, where=held) / np.maximum(held.sum(0), 1))
    return replace(sure, axis_deg=max(sure.axis_deg, axis), point=max(sure.point, point), q=np.maximum(sure.q, q))


def _held(b: Bundle, s: Sightings) -> np.ndarray:
    """(T,) bool: frames whose state tracks agree on, three of the five around among them; single ones are chance."""
    held = held_frames(b, s)
    return held & (np.convolve(held, np.ones(5), "same") >= 3)


def _cost(b: Bundle, s: Sightings, limit: float) -> float:
    return robust_loss(residuals(b, s), s, limit)[0] + radius_cost(b, s)


def _scale(half: Bundle, b: Bundle, tracks: np.ndarray) -> float:
    """Lengths of the half over those of the whole: nothing in a resting camera's picture holds either."""
    ratio = half.X[:, 2] / b.X[tracks, 2]
    ratio = ratio[np.isfinite(ratio) & (ratio > 0)]
    return float(np.median(ratio)) if len(ratio) else 1.0


def _off(half: Half, b: Bundle) -> tuple[float, float, np.ndarray]:
    """By how much a half differs: axis, deg; its line across itself, link depths; (T,) states, rad or link depths.

    States are relative to the first frame; of a half that does not see it they are taken relative to its own middle.
    """
    one, two, unit = b.twist, half.bundle.twist, float(np.median(b.X[:, 2]))
    scale = _scale(half.bundle, b, half.tracks)
    axis, other = one.axis, two.axis
    along = float(axis @ other)
    turned = float(np.degrees(np.arctan2(np.linalg.norm(np.cross(axis, other)), abs(along))))
    if b.kind == "prismatic":
        return turned, 0.0, _moved(half, np.sign(along) * half.bundle.q / scale / unit - b.q / unit)
    middle = np.median(b.X, axis=0)
    foot = one.point + axis * (axis @ (middle - one.point))
    gap = two.point / scale - foot
    gap = gap + other * (other @ (middle - two.point / scale))
    gap = gap - axis * (axis @ gap)
    rate = [float(np.linalg.norm(t.curvature)) for t in (one, two)]
    q = _moved(half, np.sign(along) * rate[1] * half.bundle.q - rate[0] * b.q)
    return turned, float(np.linalg.norm(gap)) / unit, q


def _moved(half: Half, q: np.ndarray) -> np.ndarray:
    """(T,) by how much a half's states are off, relative to the first, or to their middle where that is not held."""
    return q if half.held[0] or not half.held.any() else q - np.median(q[half.held])

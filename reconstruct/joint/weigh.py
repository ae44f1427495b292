"""Which of finished joints it is: types weighed against each other, and axes of one type."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from reconstruct.joint.kinds import log_odds_hinge, log_odds_screw, majority, probabilities, tempered, votes
from reconstruct.joint.polish import ROBUST_SIGMAS, Bundle, Sightings, residuals, track_costs
from reconstruct.joint.shape import extent
from reconstruct.joint.uncertainty import clusters, compact, spread

SCREW_TURN_DEG, FREE_BODY = 120.0, 0.95
"""Between two poses every rigid motion is a screw (Chasles): only a long one is evidence for a thread. A shorter one is
no type among the others; it stands for a body that moves freely, if it is clearly more probable than they are."""
VOTERS = 0.15
"""Edge of a neighbourhood that has a vote on the type, over the link's diagonal."""
FEW_SPEAK, BENT_DEG = (3.0, 2.0), 10.0
"""Votes for a hinge, and neighbourhoods whose middle track is for it, in standard deviations: below both it is a few
tracks that speak for it, however much each of them gains; and the turn up to which strays bend a slide."""
SHAPELY = 0.95
"""Share of a link's points that are near each other: of 11 right joints of small motions all of them, of a wrong slide
0.86."""
UNDECIDED = 1.0
"""Log odds that are left where points out of all proportion to the link would turn the answer round, or the votes."""
SPANS, NOISY_PX = 4, 0.2
"""Spans of a camera's path that are independent of each other, and px, of a point at the link's depth, up to which a
step is none."""
APART_DEG = 8.0
"""Axes so far from each other are two optima, not one."""
LIKELY = 0.1
"""Probability of another axis, or type, from which on the answer is not called certain."""


@dataclass(frozen=True)
class Rival:
    """Another joint of the same type that explains the motion too, with states in all frames, how far off its axis is,
    and how probable it is."""

    apart_deg: float
    probability: float
    joint: Bundle


def type_probabilities(best: dict[str, Bundle], sight: Sightings, near: Sequence[Bundle] = ()) -> dict[str, float]:
    """Posterior of the types, from the curvature of the hinge and the advance of the screw.

    Args:
        best: of every type.  sight: its observations.
        near: hinges as near as hinges are. The best hinge of all may be a slide that strays have bent, so that a slide
            which wins has to win the votes against these.
    """
    hinge, slide = best["revolute"], best["prismatic"]
    X = hinge.X if sight.link is None else hinge.X[sight.link]
    size = extent(X)
    curvature = spread(hinge, sight).curvature
    if "screw" in best:
        # A body that is carried freely refutes both types together: no vote between them is asked for, but that every
        # neighbourhood is carried so, not strays alone.
        screw = best["screw"]
        gain = _cost_gain(hinge, slide, sight) + calmer(hinge, slide, sight)
        odds = log_odds_hinge(hinge.twist, curvature, size, gain)
        gain = _cost_gain(screw, hinge, sight) + calmer(screw, hinge, sight)
        more = log_odds_screw(screw.twist, spread(screw, sight).curvature, gain)
        if more > 0:
            more = tempered(more, _votes(screw, hinge, sight))
        p = probabilities({"prismatic": 0.0, "revolute": odds, "screw": odds + more})
        if turn_deg(screw) >= SCREW_TURN_DEG or p["screw"] >= FREE_BODY:
            return p
    path = calmer(hinge, slide, sight)
    odds, by_costs, alone = (
        log_odds_hinge(hinge.twist, curvature, size, gain)
        for gain in (_gain(hinge, slide, sight) + path, _cost_gain(hinge, slide, sight) + path, 0.0)
    )
    costs, near_each_other = costs_of_both(hinge, slide, sight), clusters(hinge, sight.link, VOTERS)
    z, most = votes(*costs, near_each_other), majority(*costs, near_each_other)
    few = z < FEW_SPEAK[0] and most < FEW_SPEAK[1]
    if odds > 0 > alone and few and turn_deg(hinge) < BENT_DEG:
        # A few strays have bent a slide: what they gain by it is no evidence, where hinges are is. But a slide whose
        # points are no link of any shape is as likely a hinge that no start has reached.
        odds = alone if _shapely(slide, sight) else -UNDECIDED
    elif odds * by_costs < 0:
        # Points that are no part of a link of any shape would turn the answer round: they are as likely to know.
        return probabilities({"prismatic": 0.0, "revolute": float(np.clip(odds, -UNDECIDED, UNDECIDED))})
    if odds > 0:
        odds = tempered(odds, z)
    elif near:
        odds = tempered(odds, -min(_votes(slide, b, sight) for b in near))
    if odds == 0:
        # The votes are against what they should confirm: where most neighbourhoods are, whatever the few gain, leads.
        odds = float(np.copysign(UNDECIDED, most))
    return probabilities({"prismatic": 0.0, "revolute": odds})


def _shapely(b: Bundle, sight: Sightings) -> bool:
    """Whether nearly all points of the link are near each other."""
    own = b.X if sight.link is None else b.X[sight.link]
    return bool(np.mean(compact(own) & (own[:, 2] > 0)) > SHAPELY)


def _cost_gain(one: Bundle, other: Bundle, sight: Sightings) -> float:
    """Log-likelihood ratio at the costs of the adjustment, where the noise's size is unknown."""
    return one.cost / (2 * one.sigma**2 * sight.lasting) * float(np.log(max(other.cost, 1e-9) / max(one.cost, 1e-9)))


def calmer(one: Bundle, other: Bundle, sight: Sightings) -> float:
    """Log-likelihood ratio of the paths that two joints need of a camera whose path is fitted with them; 0 of one that
    is not.

    A joint of the wrong type has the camera go along with what it cannot explain. Of SPANS steps of the camera's
    centre, each of three normal numbers of one unknown size, the likelihood with the size integrated over its logarithm
    goes with the power of their sum of squares. What noise does to a path that is held to its px is no step.

    Args:
        one, other: of the same tracks, with poses R (T, 3, 3), t (T, 3), lengths in any unit: the link's depth is 1.

    Returns:
        Of ``one`` over ``other``: positive where its camera goes less.
    """
    if not sight.free:
        return 0.0
    sums = []
    for b in (one, other):
        assert b.R is not None and b.t is not None and sight.link is not None
        unit = float(np.median(b.X[sight.link, 2]))
        centre = -np.einsum("tji,tj->ti", b.R, b.t) / unit
        cuts = np.linspace(0, len(centre) - 1, SPANS + 1).round().astype(int)
        sums.append(float(np.sum(np.diff(centre[cuts], axis=0) ** 2)))
    floor = 3 * SPANS * (NOISY_PX / sight.focal) ** 2
    return 1.5 * SPANS * float(np.log((sums[1] + floor) / (sums[0] + floor)))


def costs_of_both(one: Bundle, other: Bundle, sight: Sightings) -> tuple[np.ndarray, np.ndarray]:
    """(N,) robust cost of every track under either, by one scale. A point out of all proportion explains nothing."""
    limit = ROBUST_SIGMAS * max(min(one.sigma, other.sigma), 0.05)
    out = []
    for b in (one, other):
        cost = track_costs(residuals(b, sight), sight, limit)
        link = np.ones(len(b.X), bool) if sight.link is None else sight.link
        lost = np.flatnonzero(link)[~(compact(b.X[link]) & (b.X[link, 2] > 0))]
        cost[lost] = limit**2 * sight.weight[lost] * sight.seen[lost].sum(1)
        out.append(cost)
    return out[0], out[1]


def _votes(one: Bundle, other: Bundle, sight: Sightings) -> float:
    return votes(*costs_of_both(one, other, sight), clusters(one, sight.link, VOTERS))


def _gain(one: Bundle, other: Bundle, sight: Sightings) -> float:
    """Log-likelihood ratio where the noise's size is unknown: so many observations times half the logarithm."""
    a, b = (float(c.sum()) for c in costs_of_both(one, other, sight))
    return a / (2 * one.sigma**2 * sight.lasting) * float(np.log(max(b, 1e-9) / max(a, 1e-9)))


def log_odds_of_same_type(one: Bundle, other: Bundle, sight: Sightings) -> float:
    """Of two joints of one type with the points of the same tracks."""
    return tempered(_gain(one, other, sight), _votes(one, other, sight))


def strongest_rival(last: Bundle, others: Sequence[Bundle], sight: Sightings) -> Rival | None:
    """The most probable other axis, of joints that are fitted to the answer's own tracks.

    A small motion is seen nearly as from afar, and from there a body and its mirror image that turns the other way look
    the same (Necker's reversal): what is stated of one optimum knows nothing of the next.
    """
    found: list[Rival] = []
    for b in others:
        if (apart := apart_deg(b, last)) > APART_DEG:
            odds = log_odds_of_same_type(last, b, sight)
            found.append(Rival(apart, float(expit(-odds)), b))
    return max(found, key=lambda r: r.probability, default=None)


def apart_deg(one: Bundle, other: Bundle) -> float:
    """Angle between the axes of two joints, 0 to 90 deg."""
    return float(np.degrees(np.arccos(np.clip(abs(one.twist.axis @ other.twist.axis), 0, 1))))


def turn_deg(b: Bundle) -> float:
    """By how much the link turns."""
    return float(np.degrees(np.ptp(b.q) * np.linalg.norm(b.twist.curvature)))

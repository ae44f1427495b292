"""What is sure although something is left.

Where slow residual remains, intervals and likelihoods no longer mean what they say: both take the residual for noise. A
cause can be sure all the same. It is called dominant if the whole set cuts the held-out error to a tenth, the error
without the cause is at least three times that with it, and its strength is the same wherever one looks: in every
episode, early and late, on either side of the range, in either direction of motion. A wrong cause that stands in for
something unknown (friction that grows, a force in one quadrant) fits on average and not everywhere. That a cause's
effect stays the same where all else differs is the invariance of Peters, Buehlmann and Meinshausen (2016).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diagnose.causes import CAUSES
from diagnose.fit import Problem
from diagnose.kernel import INDEX
from diagnose.simulate import needed, row_of

CUT = 0.1  # of the nominal held-out error, that the whole set must leave at most
WITHOUT = 3.0  # times the held-out error, if the cause is left out
SAME = 0.1  # relative deviation of its strength anywhere; friction that doubles over a log deviates by 0.33
SEEN = 0.05  # share of the cause's effect that a part of the data must hold to be asked
REST = 0.02  # of the largest speed, below which the part may be at rest
RIVAL = 1.15  # times the held-out error within which another cause in its place does as well


@dataclass(frozen=True)
class Steady:
    """How steady a cause is. deviation: largest relative one of its strength; where: the part of the data it is in."""

    deviation: float
    where: str


def steadiness(causes: tuple[str, ...], terms: dict[str, float], fitted: Problem, held: Problem) -> dict[str, Steady]:
    """Of every cause: the strength that each part of the data asks for, against the fitted one."""
    episodes = fitted.episodes + held.episodes
    plant, frame = fitted.plant, fitted.motion.frame
    row = row_of(terms)
    q, v, share = (np.concatenate(x) for x in zip(*[(e.q, e.v, e.t / e.t[-1]) for e in episodes], strict=True))
    number = np.concatenate([np.full(len(e.t), i) for i, e in enumerate(episodes)])
    lacking = np.concatenate([e.u - needed(plant, frame, e, row) for e in episodes])
    # What sticks says nothing of a torque's size.
    moving = np.abs(v) > REST * np.abs(v).max() if not fitted.driven else np.ones(len(v), bool)
    half = 0.5 * (q.min() + q.max())
    sides = {"low positions": q < half, "high positions": q >= half}
    ways = {"opening": v > 0, "closing": v < 0}
    parts = {f"episode {i + 1}": number == i for i in range(len(episodes))} | sides | ways
    # Not by side and way at once: in a quadrant friction and a weight push one way, and one's error is the other's.
    parts |= {"early": share < 0.5, "late": share >= 0.5}
    out = {}
    for name in causes:
        without = row.copy()
        for p in CAUSES[name].parameters:
            if p.term in CAUSES[name].decisive or p.term == "spring_torque":
                without[INDEX[p.term]] = 0.0
        # What the cause adds to the torque that the motion takes: a unit of it is its fitted strength.
        mine = np.concatenate([needed(plant, frame, e, row) - needed(plant, frame, e, without) for e in episodes])
        total = float(mine[moving] @ mine[moving])
        worst = Steady(0.0, "")
        for where, mask in parts.items():
            mask = mask & moving
            energy = float(mine[mask] @ mine[mask])
            if energy >= SEEN * total > 0:
                deviation = abs(float(mine[mask] @ lacking[mask])) / energy
                if deviation > worst.deviation:
                    worst = Steady(deviation, where)
        out[name] = worst if total > 0 else Steady(np.inf, "everywhere")
    return out

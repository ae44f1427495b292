"""Two answers to one question, found in different tracks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reconstruct.joint.kinds import or_by_prior
from reconstruct.joint.models import VAGUE_DEG, JointFit

APART_STDS = 2.0
"""Standard deviations of their axes by which two joints contradict each other."""
AS_WELL = 1.5
"""Ratio of what two joints state of their axes up to which these are known alike."""
WHOLE = 0.99
"""A state that is stated to such a share of the stroke is not known at all."""
OPEN_DEG = 20.0
"""An axis known to a third of a radian or worse: a hinge's curvature is within three standard deviations of none."""
FACTOR = 2.0
"""How many times what is stated joints are off that are taken for want of a better one (the root of the mean square of
nine rendered ones by straight edges, 0.1 to 3.6; 1.2 of fourteen by points up to hands' rims, 0.02 to 3.1)."""


def contradicts(one: JointFit, other: JointFit) -> bool:
    """Whether two joints are of different types, or their axes further apart than both say they may be."""
    if "refused" in (one.verdict, other.verdict):
        return False
    if one.type != other.type:
        return True
    if one.axis is None or other.axis is None or one.std is None or other.std is None:
        return False
    return bool(apart_deg(one, other) > APART_STDS * np.hypot(alone_deg(one), alone_deg(other)))


def apart_deg(one: JointFit, other: JointFit) -> float:
    """Angle between the axes of two joints before one camera, 0 to 90 deg."""
    a, b = (np.asarray(x.T_camera_world)[:3, :3] @ x.axis for x in (one, other))
    return float(np.degrees(np.arccos(min(1.0, abs(float(a @ b))))))


def better_known(joint: JointFit, than: JointFit) -> JointFit | None:
    """A joint of more tracks if its axis is known no worse than another's of few, else None.

    It is doubtful where the two contradict each other. Where their types do, its type is as likely as the two say in
    the mean, and None is returned where they say that it is the other one.
    """
    if alone_deg(joint) > AS_WELL * alone_deg(than):
        return None
    if not contradicts(joint, than):
        return joint
    if joint.type == than.type:
        return replace(joint, verdict="ambiguous")
    p = types_of_both(joint, than)
    if p.get(joint.type, 0.0) < max(p.values()):
        return None
    return replace(joint, verdict="ambiguous", type_probability=p)


def types_of_both(one: JointFit, other: JointFit) -> dict[str, float]:
    """Probabilities of the types by two joints, in the mean."""
    types = {**other.type_probability, **one.type_probability}
    return {k: (one.type_probability.get(k, 0.0) + other.type_probability.get(k, 0.0)) / 2 for k in types}


def alone_deg(fit: JointFit) -> float:
    """Standard deviation of an axis by its own tracks: that some direction of the picture's edges fits a joint does not
    make it the right one of two."""
    return fit.std["axis_deg"] if fit.alone_deg is None else fit.alone_deg


def is_open(fit: JointFit) -> bool:
    """Whether a joint is doubtful and its axis known to VAGUE_DEG or worse by its tracks alone."""
    return fit.verdict == "ambiguous" and "axis_deg" in fit.std and alone_deg(fit) > VAGUE_DEG


def open_states_told(fit: JointFit) -> JointFit:
    """The joint, its reason saying in how many frames nothing holds the state: it is stated to the whole stroke there,
    and the range may be another."""
    if fit.verdict == "refused" or fit.q is None or "q" not in fit.std:
        return fit
    count = int(np.sum(np.asarray(fit.std["q"]) >= WHOLE * np.ptp(fit.q)))
    if not count:
        return fit
    words = f"in {count} of {len(fit.q)} frames nothing holds the state to the first one's: the range may be another"
    return replace(fit, reason=f"{fit.reason}; {words}")


def type_no_surer(fit: JointFit) -> JointFit:
    """The joint; where its axis is stated to OPEN_DEG or worse, its type no surer than one half and half of the prior:
    what holds the axis no better tells the types apart no better."""
    if fit.verdict != "ambiguous" or fit.std.get("axis_deg", 0.0) <= OPEN_DEG:
        return fit
    most = or_by_prior({kind: float(kind == fit.type) for kind in fit.type_probability})
    if fit.type_probability.get(fit.type, 0.0) <= most.get(fit.type, 1.0):
        return fit
    return replace(fit, type_probability=most)


def doubtful(fit: JointFit, words: str) -> JointFit:
    """The joint as `ambiguous`: its type half by the prior, its axis and place FACTOR times less sure."""
    p, std = or_by_prior(fit.type_probability), dict(fit.std)
    for k in ("axis_deg", "point_m"):
        if k in std:
            std[k] = FACTOR * std[k]
    return replace(fit, verdict="ambiguous", reason=f"{words}, {fit.reason}", type_probability=p, std=std)

"""Named reward terms. Each step's reward is their sum; ``info["reward_terms"]`` holds them scaled.

=============  ========================================================================================
progress       part of the stroke made in this step while the hand's contact did work on the joint;
               motion against the demonstration counts negative whatever caused it
reach          ``-tanh(d / 0.1 m)`` of the finger tips' distance d to the moving link, 0 in contact
action_rate    minus the mean squared change of the action
penetration    minus the overlap of hand and link beyond 5 mm, in units of 5 mm, at most 1
success        1 in the step in which the episode succeeds
=============  ========================================================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

TERMS = ("progress", "reach", "action_rate", "penetration", "success")
SCALES: dict[str, dict[str, float]] = {
    "dense": {"progress": 10.0, "reach": 0.02, "action_rate": 0.01, "penetration": 0.02, "success": 5.0},
    "sparse": {"success": 1.0},
}
REACH_SCALE = 0.1  # m
FREE_PENETRATION = 0.005  # m


@dataclass(frozen=True)
class RewardInputs:
    """What a step did: fractions of the stroke, metres, the action before and now, and whether it succeeded."""

    driven: float
    moved: float
    contact: bool
    distance: float
    penetration: float
    action: np.ndarray
    previous_action: np.ndarray
    success: bool


def reward_scales(reward: str | Mapping[str, float]) -> dict[str, float]:
    """Scales of a named reward, or those given.

    Raises:
        ValueError: unknown name; the message lists the names.
    """
    if isinstance(reward, str):
        if reward not in SCALES:
            raise ValueError(f"no reward is named {reward!r}; known: {', '.join(SCALES)}, or a dict of scales")
        return dict(SCALES[reward])
    unknown = set(reward) - set(TERMS)
    if unknown:
        raise ValueError(f"no reward term is named {', '.join(sorted(unknown))}; known: {', '.join(TERMS)}")
    return {name: float(value) for name, value in reward.items()}


def reward_terms(step: RewardInputs, scales: Mapping[str, float]) -> dict[str, float]:
    """Term name -> scaled value, of the terms that have a scale."""
    raw = {
        "progress": step.driven + min(step.moved, 0.0),
        "reach": 0.0 if step.contact else -float(np.tanh(step.distance / REACH_SCALE)),
        "action_rate": -float(np.mean((step.action - step.previous_action) ** 2)),
        "penetration": -float(np.clip((step.penetration - FREE_PENETRATION) / FREE_PENETRATION, 0.0, 1.0)),
        "success": float(step.success),
    }
    return {name: scale * raw[name] for name, scale in scales.items()}

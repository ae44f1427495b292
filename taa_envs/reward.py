"""Named reward terms. Each step's reward is their sum; ``info["reward_terms"]`` holds them scaled.

=============  ========================================================================================
progress       part of the stroke made in this step while the hand's contact did work on the joint;
               motion against the demonstration counts negative whatever caused it
reach          ``-tanh(d / 0.1 m)`` of the finger tips' distance d to the moving link, 0 in contact
action_rate    minus the mean squared change of the action
penetration    minus the overlap of hand and link beyond 5 mm, in units of 5 mm, at most 1
success        1 in a step in which the episode's state is a success
=============  ========================================================================================

:func:`taa_envs.kernels.raw_terms` computes them. ``"sparse_goal"`` has no terms: its reward is :func:`goal_reward`, 0
where the goal is reached and -1 elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

TERMS = ("progress", "reach", "action_rate", "penetration", "success")
SCALES: dict[str, dict[str, float]] = {
    "dense": {"progress": 10.0, "reach": 0.02, "action_rate": 0.01, "penetration": 0.02, "success": 5.0},
    "sparse": {"success": 1.0},
    "sparse_goal": {},
}
REACH_SCALE = 0.1  # m
FREE_PENETRATION = 0.005  # m
SUCCESS_PROGRESS = 0.95
DRIVEN_SHARE = 0.8  # of the progress made, what contact must have driven for a success
GOAL = (1.0, DRIVEN_SHARE)


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


def goal_reward(achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
    """0 where the goal is reached, else -1.

    Args:
        achieved: (..., 2): fraction of the stroke, and the share of the progress made that contact drove, in [0, 1].
        desired: (..., 2): the same; reached within 5 % of the stroke, and with that share or :data:`DRIVEN_SHARE`.
    """
    achieved, desired = np.asarray(achieved, float), np.asarray(desired, float)
    tolerance = 1e-6  # goals are float32
    reached = ((achieved[..., 0] >= desired[..., 0] - (1 - SUCCESS_PROGRESS) - tolerance)
               & (achieved[..., 1] >= np.minimum(desired[..., 1], DRIVEN_SHARE) - tolerance))
    return reached.astype(float) - 1.0

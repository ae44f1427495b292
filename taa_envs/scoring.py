"""Scores of a replay that somebody else made."""

from __future__ import annotations

import numpy as np

from taa_envs.asset import Asset


def score_joint_log(asset: Asset, time: np.ndarray, q: np.ndarray) -> dict[str, float]:
    """Scores of a joint log against the asset's demonstration, the contract's definitions, at the log's last row.

    Args:
        asset: the asset the log is about.
        time: (N,) s, increasing, may be unevenly spaced.
        q: (N,) joint state in the asset's convention, rad or m.

    Returns:
        joint_progress, final_q_error, max_progress, wrong_way, and duration (s).

    Raises:
        ValueError: shapes differ, numbers are not finite, or time does not increase.
    """
    time, q = np.asarray(time, float), np.asarray(q, float)
    if time.ndim != 1 or time.shape != q.shape or not len(time):
        raise ValueError(f"time and q must be columns of equal length, have shapes {time.shape} and {q.shape}")
    if not (np.isfinite(time).all() and np.isfinite(q).all()):
        raise ValueError("the log holds numbers that are not finite; remove those rows")
    if not (np.diff(time) > 0).all():
        raise ValueError("the log's time does not increase; sort its rows and drop doubles")
    fraction = asset.stroke_fraction(q)
    return {"joint_progress": float(asset.progress(q[-1])), "final_q_error": asset.final_q_error(q[-1]),
            "max_progress": float(np.clip(fraction.max(), 0, 1)), "wrong_way": float(max(0.0, -fraction.min())),
            "duration": float(time[-1] - time[0])}


def score_actions(asset: Asset, actions: np.ndarray, hand: str = "points") -> dict[str, float]:
    """Scores of an open-loop action sequence, played in ``TAA/<id>`` from its unperturbed start.

    Args:
        actions: (N, 7), one row an environment step, see :class:`taa_envs.env.ArticulationEnv`.

    Returns:
        joint_progress, final_q_error, max_progress, contact_fraction, wrong_way, duration (s), is_success.

    Raises:
        ValueError: actions are not (N, 7) finite numbers.
    """
    from taa_envs.env import ACTIONS, ArticulationEnv

    env = ArticulationEnv(asset, hand=hand)
    actions = np.asarray(actions, np.float32)
    if actions.ndim != 2 or actions.shape[1] != ACTIONS or not np.isfinite(actions).all():
        raise ValueError(f"actions must be (N, {ACTIONS}) finite numbers, have shape {actions.shape}")
    _, info = env.reset(seed=0)
    q = [env.q]
    for action in np.clip(actions, -1, 1):
        _, _, terminated, _, info = env.step(action)
        q.append(env.q)
        if terminated:
            break
    scores = score_joint_log(asset, env.dt * np.arange(len(q)), np.array(q))
    return {**scores, "contact_fraction": info["contact_fraction"], "is_success": info["is_success"]}

"""Scores of a replay that somebody else made."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

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


def score_actions(asset: Asset, actions: np.ndarray, hand: str = "points", *, seed: int = 0,
                  options: Mapping[str, Any] | None = None) -> dict[str, float]:
    """Scores of an open-loop action sequence, played in ``TAA/<id>``.

    Args:
        actions: (N, 8) residual or (N, 63) absolute actions, one row an environment step, see
            :class:`taa_envs.env.ArticulationEnv`; (N, 7) are residual ones at the demonstration's own pace.
        seed, options: of the reset; the default is the unperturbed start.

    Returns:
        joint_progress, final_q_error, max_progress, contact_fraction, wrong_way, duration (s), is_success.

    Raises:
        ValueError: actions are not such finite numbers.
    """
    from taa_envs.env import ArticulationEnv
    from taa_envs.motion import CORRECTIONS, RESIDUALS
    from taa_envs.task import ABSOLUTES

    actions = np.asarray(actions, np.float32)
    if actions.ndim != 2 or actions.shape[1] not in (CORRECTIONS, RESIDUALS, ABSOLUTES) \
            or not np.isfinite(actions).all():
        raise ValueError(f"actions must be (N, {RESIDUALS}) or (N, {ABSOLUTES}) finite numbers, have shape "
                         f"{actions.shape}")
    if actions.shape[1] == CORRECTIONS:
        actions = np.pad(actions, ((0, 0), (0, 1)))
    env = ArticulationEnv(asset, hand=hand, action="absolute" if actions.shape[1] == ABSOLUTES else "residual")
    _, info = env.reset(seed=seed, options=dict(options or {}))
    q = [env.q]
    for action in actions:
        _, _, terminated, _, info = env.step(action)
        q.append(env.q)
        if terminated:
            break
    scores = score_joint_log(asset, env.dt * np.arange(len(q)), np.array(q))
    return {**scores, "contact_fraction": info["contact_fraction"], "is_success": info["is_success"]}

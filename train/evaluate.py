"""How often a policy succeeds under the asset's own randomisation, beside the open-loop replay in the same episodes."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from scipy.stats import binomtest

from taa_envs.asset import Asset
from taa_envs.env import ArticulationEnv
from taa_envs.errors import TaaEnvsError
from taa_envs.vector import BatchedArticulationEnv
from train.policy import Policy, load_policy

BATCH = 32  # episodes at once


def act(policy: Policy | None, env: BatchedArticulationEnv | ArticulationEnv, observation: np.ndarray) -> np.ndarray:
    return env.reference_action() if policy is None else policy.act(observation)


def make_env(asset: Asset, count: int, *, action: str = "residual", randomize: Any = True, hold: int = 1
             ) -> BatchedArticulationEnv:
    """An environment in which :func:`episodes` can run count episodes."""
    return BatchedArticulationEnv(asset, min(BATCH, count), action=action, randomize=randomize, hold=hold,
                                  autoreset_mode="disabled")


def episodes(asset: Asset, policy: Policy | None, count: int, *, seed: int = 0, action: str = "residual",
             randomize: Any = True, env: BatchedArticulationEnv | None = None) -> dict[str, np.ndarray]:
    """Run episodes 0 to count - 1, episode i under the seed ``seed + i``, whichever simulation it runs in.

    Args:
        policy: as :func:`train.policy.load_policy` gives; None for the open-loop replay.
        env: of :func:`make_env`, with the policy's ``hold``, to use it again; it then says action and randomize.

    Returns:
        success (count,) bool, progress (count,), steps (count,).
    """
    out = {"success": np.zeros(count, bool), "progress": np.zeros(count), "steps": np.zeros(count, int)}
    made = env if env is not None else make_env(asset, count, action=action, randomize=randomize,
                                                hold=1 if policy is None else policy.hold)
    n = made.num_envs
    running = np.arange(n)  # episode in each simulation; from count on it is one that nobody asked for
    observation, _ = made.reset(seed=[seed + int(i) for i in running])
    following = n
    while (running < count).any():
        observation, _, terminated, truncated, info = made.step(act(policy, made, observation))
        over = terminated | truncated
        if not over.any():
            continue
        ended = np.flatnonzero(over & (running < count))
        rows = running[ended]
        out["steps"][rows] = made.steps[ended]
        out["success"][rows], out["progress"][rows] = info["is_success"][ended], info["joint_progress"][ended]
        starts = np.flatnonzero(over)
        running[starts] = np.arange(following, following + len(starts))
        following += len(starts)
        if (running < count).any():
            observation, _ = made.reset(seed=[seed + int(i) for i in running], options={"reset_mask": over})
    if env is None:
        made.close()
    return out


def _summary(run: dict[str, np.ndarray]) -> dict[str, Any]:
    count = len(run["success"])
    interval = binomtest(int(run["success"].sum()), count).proportion_ci(0.95, method="wilson")
    return {"success": float(run["success"].mean()), "success_ci95": [float(interval.low), float(interval.high)],
            "joint_progress": float(run["progress"].mean())}


def evaluate(asset: Asset, policy_file: str | os.PathLike, count: int = 100, *, seed: int = 1_000_000,
             randomize: Any = True, replay: dict[str, Any] | None = None) -> dict[str, Any]:
    """Compare a policy with the open-loop replay in the same randomised episodes.

    Args:
        policy_file: ``policy.pt`` or the run's folder.
        seed: of the first episode; the default is far from the seeds that training uses.
        replay: what this function said of the replay in the same episodes, where that is known.

    Returns:
        id, policy (algo, action), episodes, and for policy and replay success, its 95 % Wilson interval and mean
        joint_progress; gain: the difference of the successes.

    Raises:
        TaaEnvsError: the policy cannot be read, or its sizes are not this environment's.
    """
    if count < 1:
        raise TaaEnvsError("at least one episode is needed")
    policy, described = load_policy(policy_file)
    check(asset, policy, described)
    own = _summary(episodes(asset, policy, count, seed=seed, action=described["action"], randomize=randomize))
    if replay is None:
        replay = _summary(episodes(asset, None, count, seed=seed, action=described["action"], randomize=randomize))
    return {"id": asset.id, "trained_on": described["asset"], "algo": described["algo"], "action": described["action"],
            "episodes": count, "seed": seed, "policy": own, "replay": replay,
            "gain": own["success"] - replay["success"]}


def check(asset: Asset, policy: Policy, described: dict[str, Any]) -> None:
    env = ArticulationEnv(asset, action=described["action"])
    if policy.sizes != (env.observation_space.shape, env.action_space.shape):
        raise TaaEnvsError(f"the policy was made for observations {policy.sizes[0]} and actions {policy.sizes[1]}; "
                           f"TAA/{asset.id} has {env.observation_space.shape} and "
                           f"{env.action_space.shape}: train it again")


def record_dataset(asset: Asset, policy_file: str | os.PathLike, name: str, count: int = 20, *, seed: int = 1_000_000,
                   overwrite: bool = False) -> str:
    """Write a policy's episodes as a Minari dataset, see :func:`taa_envs.datasets.record`; its name."""
    from taa_envs import datasets

    policy, described = load_policy(policy_file)
    check(asset, policy, described)
    if described["action"] != "residual":
        raise TaaEnvsError("datasets hold residual actions; this policy's are " + described["action"])
    return datasets.record(asset, name, count, seed=seed, act=policy.act, hold=policy.hold,
                           algorithm=f"{described['algo']} policy", overwrite=overwrite)

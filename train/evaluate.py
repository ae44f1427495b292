"""How often a policy succeeds under the asset's own randomisation, beside the open-loop replay in the same episodes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from taa_envs.asset import Asset
from taa_envs.env import ArticulationEnv
from taa_envs.errors import TaaEnvsError
from taa_envs.files import written_whole
from taa_envs.registry import max_episode_steps
from taa_envs.vector import BatchedArticulationEnv
from train.policy import Policy, load_policy

BATCH = 32  # episodes at once


def _act(policy: Policy | None, env: BatchedArticulationEnv | ArticulationEnv, observation: np.ndarray) -> np.ndarray:
    return env.reference_action() if policy is None else policy.act(observation)


def episodes(asset: Asset, policy: Policy | None, count: int, *, seed: int = 0, action: str = "residual",
             randomize: Any = True) -> dict[str, np.ndarray]:
    """Run episodes 0 to count - 1, episode i under the seed ``seed + i``.

    Args:
        policy: as :func:`train.policy.load_policy` gives; None for the open-loop replay.

    Returns:
        success (count,) bool, progress (count,), steps (count,).
    """
    out = {"success": np.zeros(count, bool), "progress": np.zeros(count), "steps": np.zeros(count, int)}
    for first in range(0, count, BATCH):
        n = min(BATCH, count - first)
        env = BatchedArticulationEnv(asset, n, action=action, randomize=randomize,
                                     hold=1 if policy is None else policy.hold)
        observation, _ = env.reset(seed=seed + first)
        running = np.ones(n, bool)
        while running.any():
            observation, _, terminated, truncated, info = env.step(_act(policy, env, observation))
            ended = running & (terminated | truncated)
            rows = first + np.flatnonzero(ended)
            out["steps"][rows] = env.steps[ended]
            out["success"][rows], out["progress"][rows] = info["is_success"][ended], info["joint_progress"][ended]
            running &= ~ended
        env.close()
    return out


def _summary(run: dict[str, np.ndarray]) -> dict[str, Any]:
    count = len(run["success"])
    interval = binomtest(int(run["success"].sum()), count).proportion_ci(0.95, method="wilson")
    return {"success": float(run["success"].mean()), "success_ci95": [float(interval.low), float(interval.high)],
            "joint_progress": float(run["progress"].mean())}


def evaluate(asset: Asset, policy_file: str | os.PathLike, count: int = 100, *, seed: int = 1_000_000,
             randomize: Any = True) -> dict[str, Any]:
    """Compare a policy with the open-loop replay in the same randomised episodes.

    Args:
        policy_file: ``policy.pt`` or the run's folder.
        seed: of the first episode; the default is far from the seeds that training uses.

    Returns:
        id, policy (algo, action), episodes, and for policy and replay success, its 95 % Wilson interval and mean
        joint_progress; gain: the difference of the successes.

    Raises:
        TaaEnvsError: the policy cannot be read, or its sizes are not this environment's.
    """
    if count < 1:
        raise TaaEnvsError("at least one episode is needed")
    policy, described = load_policy(policy_file)
    _check(asset, policy, described)
    own = _summary(episodes(asset, policy, count, seed=seed, action=described["action"], randomize=randomize))
    replay = _summary(episodes(asset, None, count, seed=seed, action=described["action"], randomize=randomize))
    return {"id": asset.id, "trained_on": described["asset"], "algo": described["algo"], "action": described["action"],
            "episodes": count, "seed": seed, "policy": own, "replay": replay,
            "gain": own["success"] - replay["success"]}


def _check(asset: Asset, policy: Policy, described: dict[str, Any]) -> None:
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
    _check(asset, policy, described)
    if described["action"] != "residual":
        raise TaaEnvsError("datasets hold residual actions; this policy's are " + described["action"])
    return datasets.record(asset, name, count, seed=seed, act=policy.act, hold=policy.hold,
                           algorithm=f"{described['algo']} policy", overwrite=overwrite)


def record(asset: Asset, policy_file: str | os.PathLike, file: Path, *, seed: int = 1_000_000, count: int = 3,
           height: int = 360) -> None:
    """Write an MP4: the policy (left) beside the open-loop replay (right) in the same randomised episodes."""
    import imageio_ffmpeg

    policy, described = load_policy(policy_file)
    _check(asset, policy, described)
    envs = [ArticulationEnv(asset, action=described["action"], randomize=True, render_mode="rgb_array",
                            height=height - height % 2) for _ in range(2)]
    with written_whole(Path(file)) as partial:
        writer = None
        for episode in range(count):
            seen = [env.reset(seed=seed + episode)[0] for env in envs]
            pictures = [env.render() for env in envs]
            over, actions = [False, False], [np.zeros(0, np.float32)] * 2
            for step in range(max_episode_steps(asset.demo["duration"])):
                for i, (env, acting) in enumerate(zip(envs, (policy, None), strict=True)):
                    if not over[i]:
                        if acting is None or step % acting.hold == 0:
                            actions[i] = _act(acting, env, seen[i])
                        seen[i], _, over[i], _, _ = env.step(actions[i])
                        if step % 2 == 0 or over[i]:
                            pictures[i] = env.render()
                if step % 2 and not all(over):
                    continue
                frame = np.hstack(pictures)
                frame = np.ascontiguousarray(frame[:, :frame.shape[1] - frame.shape[1] % 2])
                if writer is None:
                    writer = imageio_ffmpeg.write_frames(str(partial), (frame.shape[1], frame.shape[0]), fps=25,
                                                         macro_block_size=1, quality=6)
                    writer.send(None)
                writer.send(frame)
                if all(over):
                    break
        if writer is not None:
            writer.close()
    for env in envs:
        env.close()

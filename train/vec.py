"""The batched environment as a Stable-Baselines3 ``VecEnv``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from taa_envs.vector import BatchedArticulationEnv

CLIP = 5.0  # standard deviations
LEAST_STD = 0.6  # of an observation's own unit: what hardly changes in a replay, corrections do change


@dataclass(frozen=True)
class Normal:
    """What observations of an asset's replays look like, (size,) each: a policy sees ``(x - mean) / std``, clipped.

    Fixed before training begins, so that a policy's input means the same from the first step to its last use.
    """

    mean: np.ndarray
    std: np.ndarray

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        return np.clip((observation - self.mean) / self.std, -CLIP, CLIP).astype(np.float32)


def replay_normal(env: BatchedArticulationEnv, seed: int) -> Normal:
    """Mean and standard deviation over one open-loop replay in each of the batch's simulations; leaves them running."""
    seen = [env.reset(seed=seed)[0]]
    for _ in range(env.max_episode_steps // env.hold):
        seen.append(env.step(env.reference_action())[0])
    values = np.concatenate(seen).astype(float)
    return Normal(values.mean(0), np.maximum(values.std(0), LEAST_STD))


class BatchedVecEnv(VecEnv):
    """A :class:`taa_envs.vector.BatchedArticulationEnv` in "same_step" mode, with the infos SB3 looks for.

    normal: how observations are normalised, None for not at all.

    An ended episode's info has ``terminal_observation``, ``TimeLimit.truncated``, ``is_success``, ``joint_progress``
    and ``episode`` (r: return, l: steps).

    Raises:
        ValueError: the environment resets itself in another way.
    """

    def __init__(self, env: BatchedArticulationEnv, normal: Normal | None = None) -> None:
        if env.metadata["autoreset_mode"].name != "SAME_STEP":
            raise ValueError("Stable-Baselines3 resets within a step; make the environment with "
                             "autoreset_mode='same_step'")
        self.env, self._normal = env, normal
        self._returns, self._lengths = np.zeros(env.num_envs), np.zeros(env.num_envs, int)
        self._actions: np.ndarray | None = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Any:
        seeds = self._seeds if any(seed is not None for seed in self._seeds) else None
        observation, _ = self.env.reset(seed=seeds)
        self._returns[:], self._lengths[:] = 0.0, 0
        self._reset_seeds()
        self._reset_options()
        return self._seen(observation)

    def _seen(self, observation: Any) -> Any:
        return observation if self._normal is None else self._normal(observation)

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        observation, rewards, terminated, truncated, info = self.env.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(done):
            last, final = self._seen(info["final_obs"]), info["final_info"]
            infos[row] = {
                "terminal_observation": {k: v[row] for k, v in last.items()} if isinstance(last, dict) else last[row],
                "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
                "is_success": bool(final["is_success"][row]), "joint_progress": float(final["joint_progress"][row]),
                "episode": {"r": float(self._returns[row]), "l": int(self._lengths[row]), "t": 0.0}}
        self._returns[done], self._lengths[done] = 0.0, 0
        return self._seen(observation), rewards.astype(np.float32), done, infos

    def get_state(self) -> dict[str, Any]:
        """Snapshot of every episode, for a checkpoint."""
        return {"envs": self.env.get_state(), "returns": self._returns.copy(), "lengths": self._lengths.copy()}

    def set_state(self, state: dict[str, Any]) -> None:
        self.env.set_state(state["envs"])
        self._returns[:], self._lengths[:] = state["returns"], state["lengths"]

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise AttributeError(f"the batch's {attr_name} is one for all its environments; give it to the constructor")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise AttributeError(f"the batch has no {method_name} for one of its environments")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))


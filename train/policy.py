"""Policies on disk: weights and plain settings, no pickles.

``policy.pt`` is read with ``torch.load(weights_only=True)``: a policy from a stranger can be wrong, but runs no code.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.policies import BasePolicy

from taa_envs.errors import TaaEnvsError
from taa_envs.files import written_whole
from train.config import Config
from train.vec import CLIP, Normal

FORMAT = "taa-policy/2"
CLASSES: dict[str, Any] = {"ppo": PPO, "sac": SAC}
ACTIVATIONS = {"relu": torch.nn.ReLU, "tanh": torch.nn.Tanh}


def policy_arguments(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings' table [policy] as Stable-Baselines3 takes it: ``activation_fn`` is a name there.

    Raises:
        ValueError: no activation has that name.
    """
    name = settings.get("activation_fn")
    if name is None:
        return dict(settings)
    if name not in ACTIVATIONS:
        raise ValueError(f"no activation_fn is named {str(name)[:40]!r}, known are {' and '.join(ACTIVATIONS)}")
    return {**settings, "activation_fn": ACTIVATIONS[name]}


def tensors(value: Any) -> Any:
    """The same with arrays as tensors and numpy numbers as plain ones, which ``weights_only`` loading accepts."""
    if isinstance(value, np.ndarray):
        return torch.from_numpy(np.array(value))
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        return {k: tensors(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [tensors(v) for v in value]
    return value


def arrays(value: Any) -> Any:
    """The same with tensors as arrays; undoes :func:`tensors`."""
    if isinstance(value, torch.Tensor):
        return value.numpy()
    if isinstance(value, dict):
        return {k: arrays(v) for k, v in value.items()}
    if isinstance(value, list):
        return [arrays(v) for v in value]
    return value


def save_torch(file: Path, content: dict[str, Any]) -> None:
    """Write whole or not at all."""
    with written_whole(file) as partial:
        torch.save(content, partial)


def load_torch(file: str | os.PathLike, kind: str) -> dict[str, Any]:
    """Read a file of :func:`save_torch` whose "format" is kind.

    Raises:
        TaaEnvsError: it is not one.
    """
    if not Path(file).is_file():
        raise TaaEnvsError(f"no such file: {file}; give the policy.pt that `taa train` wrote")
    try:
        content = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # zip, pickle and tensor errors of many kinds
        raise TaaEnvsError(f"{file} cannot be read ({type(error).__name__}); give the policy.pt that `taa train` wrote"
                           ) from None
    if not isinstance(content, dict) or content.get("format") != kind:
        raise TaaEnvsError(f"{file} is not a {kind} file; give the policy.pt that `taa train` wrote")
    return content


@dataclass(frozen=True)
class Policy:
    """A trained policy. hold: environment steps for which its action is to be held."""

    network: BasePolicy
    normal: Normal
    hold: int

    @property
    def sizes(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Shapes of its observations and actions."""
        return self.network.observation_space.shape, self.network.action_space.shape

    def act(self, observation: np.ndarray) -> np.ndarray:
        """(..., A) float32 action of flat observations (..., size), without noise."""
        return self.network.predict(self.normal(observation), deterministic=True)[0]


def save_policy(file: Path, policy: BasePolicy, normal: Normal, config: Config, asset_id: str,
                weights: dict[str, torch.Tensor] | None = None) -> None:
    """Write a trained policy; weights: in place of its present ones."""
    save_torch(file, {"format": FORMAT, "algo": config.algo, "asset": asset_id, "action": config.action,
                      "hold": config.hold, "mean": torch.from_numpy(normal.mean), "std": torch.from_numpy(normal.std),
                      "use_sde": bool(config.algorithm.get("use_sde", False)), "policy": dict(config.policy),
                      "observation_size": policy.observation_space.shape[0],
                      "action_size": policy.action_space.shape[0],
                      "weights": policy.state_dict() if weights is None else weights})


def load_policy(file: str | os.PathLike) -> tuple[Policy, dict[str, Any]]:
    """A policy and its settings: algo, asset, action.

    Args:
        file: ``policy.pt``, or the folder that holds it.

    Raises:
        TaaEnvsError: there is none, or it is not one.
    """
    if Path(file).is_dir():
        file = Path(file) / "policy.pt"
    content = load_torch(file, FORMAT)
    try:
        made = CLASSES[content["algo"]].policy_aliases["MlpPolicy"](
            spaces.Box(-CLIP, CLIP, (content["observation_size"],), np.float32),
            spaces.Box(-1.0, 1.0, (content["action_size"],), np.float32), lambda _: 0.0,
            use_sde=content["use_sde"], **policy_arguments(content["policy"]))
        made.load_state_dict(content["weights"])
        made.set_training_mode(False)
        policy = Policy(made, Normal(content["mean"].numpy(), content["std"].numpy()), int(content["hold"]))
    except (KeyError, TypeError, RuntimeError, ValueError, AttributeError, MemoryError) as error:
        raise TaaEnvsError(f"{file} does not hold a whole policy ({str(error)[:100]}); train it again") from None
    return policy, {name: content[name] for name in ("algo", "asset", "action")}

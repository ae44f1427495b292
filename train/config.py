"""Training settings: plain TOML files, one an algorithm, in ``train/configs``."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from taa_envs.errors import TaaEnvsError

ALGORITHMS = ("ppo", "sac")


@dataclass(frozen=True)
class Config:
    """How a policy is trained; see the files for what each number is.

    Attributes:
        algo: "ppo" or "sac".  seed: of everything that draws.
        envs, steps, checkpoint_every: simulations at once, environment steps in all, and between checkpoints.
        reward, action, randomize: of the environment.
        algorithm, policy: arguments of the Stable-Baselines3 class and of its policy.
    """

    algo: str
    envs: int
    steps: int
    checkpoint_every: int
    reward: str = "dense"
    action: str = "residual"
    randomize: bool = True
    seed: int = 0
    algorithm: Mapping[str, Any] = field(default_factory=dict)
    policy: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def load_config(algo: str = "ppo", file: Path | None = None, **changes: Any) -> Config:
    """The shipped settings of an algorithm, or a file's, with changes (None: as the file has it).

    Raises:
        TaaEnvsError: unknown algorithm, or a file that does not hold settings.
    """
    if algo not in ALGORITHMS:
        raise TaaEnvsError(f"no algorithm is named {algo!r}; known: {', '.join(ALGORITHMS)}")
    file = Path(file) if file is not None else Path(__file__).with_name("configs") / f"{algo}.toml"
    try:
        made = Config(algo=algo, **{**tomllib.loads(file.read_text(encoding="utf-8")),
                                    **{k: v for k, v in changes.items() if v is not None}})
    except (tomllib.TOMLDecodeError, TypeError, UnicodeDecodeError) as error:
        raise TaaEnvsError(f"{file} does not hold training settings ({error}); copy one of train/configs") from None
    for name in ("envs", "steps", "checkpoint_every"):
        if not isinstance(getattr(made, name), int) or getattr(made, name) < 1:
            raise TaaEnvsError(f"{name} must be a whole number of at least 1, is {getattr(made, name)!r}")
    return made

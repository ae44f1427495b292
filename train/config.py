"""Training settings: plain TOML files, one an algorithm, in ``train/configs``."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from taa_envs.errors import TaaEnvsError

ALGORITHMS = ("ppo", "sac")
MAX_BYTES = 64 << 10


@dataclass(frozen=True)
class Config:
    """How a policy is trained; see the files for what each number is.

    Attributes:
        algo: "ppo" or "sac".  seed: of everything that draws.
        envs, steps, checkpoint_every: simulations at once, environment steps in all, and between checkpoints.
        reward, action, randomize: of the environment.
        hold: environment steps for which the policy's action is held.
        evaluate_every, evaluate_episodes, enough: environment steps between evaluations without exploration (0: none),
            episodes of one (of a middling policy's, 32), and the success at which training ends.
        anneal_to, anneal_steps: PPO's log standard deviation is held below a line to this value at so many steps.
        guide_episodes: draws in which PPO on residual actions first imitates a guide, see :mod:`train.guide`; 0: none,
            nor where ``steps`` has no room for it.
        algorithm, policy: arguments of the Stable-Baselines3 class and of its policy.
    """

    algo: str
    envs: int
    steps: int
    checkpoint_every: int
    reward: str = "dense"
    action: str = "residual"
    randomize: bool = True
    hold: int = 5
    evaluate_every: int = 0
    evaluate_episodes: int = 100
    enough: float = 1.0
    anneal_to: float | None = None
    anneal_steps: int = 100_000
    guide_episodes: int = 0
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
        if file.stat().st_size > MAX_BYTES:
            raise TaaEnvsError(f"{file} is larger than {MAX_BYTES >> 10} KiB; training settings take a few lines")
        made = Config(algo=algo, **{**tomllib.loads(file.read_text(encoding="utf-8")),
                                    **{k: v for k, v in changes.items() if v is not None}})
    except (ValueError, TypeError, RecursionError) as error:  # tomllib goes down by recursion, and knows bad dates
        reason = " ".join(str(error).split())[:120]
        raise TaaEnvsError(f"{file} does not hold training settings ({reason}); copy one of train/configs") from None
    for name, least, most in (("envs", 1, 65_536), ("steps", 1, 10**12), ("checkpoint_every", 1, 10**12),
                              ("evaluate_every", 0, 10**12), ("evaluate_episodes", 1, 10**6),
                              ("anneal_steps", 1, 10**12), ("guide_episodes", 0, 65_536)):  # fmt: skip
        value = getattr(made, name)
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
            raise TaaEnvsError(f"{name} must be a whole number from {least} to {most}, is {str(value)[:40]}; "
                               f"mend {file}")
    for name, kinds in (("reward", (str, dict)), ("action", (str,)), ("randomize", (bool, list, dict)),
                        ("seed", (int,)), ("enough", (int, float)), ("anneal_to", (int, float, type(None))),
                        ("algorithm", (dict,)), ("policy", (dict,))):  # fmt: skip
        if not isinstance(getattr(made, name), kinds):
            words = " or ".join(k.__name__ for k in kinds)
            raise TaaEnvsError(f"{name} must be {words}, is {str(getattr(made, name))[:40]!r}; mend {file}")
    if made.guide_episodes and (made.algo, made.action) != ("ppo", "residual"):
        raise TaaEnvsError("a guide teaches PPO on residual actions only, not "
                           f"{made.algo.upper()} on {made.action} ones; set guide_episodes = 0 in {file}")
    return made

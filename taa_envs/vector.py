"""Many environments ``TAA/<id>`` at once on ``mujoco.batch``."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from taa_envs.asset import Asset
from taa_envs.env import ArticulationEnv, observe, spaces_of
from taa_envs.refined import with_reference
from taa_envs.registry import get_asset
from taa_envs.registry import max_episode_steps as default_steps
from taa_envs.rows import BatchRows
from taa_envs.scene import build_scene
from taa_envs.task import Task


class BatchedArticulationEnv(VectorEnv):
    """``num_envs`` of :class:`taa_envs.env.ArticulationEnv`, stepped together on a thread pool.

    What ``gymnasium.make_vec("TAA/<id>", num_envs, vectorization_mode="vector_entry_point")`` makes. Spaces, actions,
    rewards, options and info are those of the single environment, and so is every number: under the same seeds and
    actions an episode here is the one there. Each simulation has a model of its own as soon as one is randomised.

    Arguments beyond the single environment's:
        num_envs: how many.
        max_episode_steps: after which an episode is truncated; default the registered limit.
        autoreset_mode: "next_step" (default: the step after an episode's last ignores its action and starts the next
            one, as ``SyncVectorEnv`` does), "same_step" (the last observation and info are then in
            ``info["final_obs"]`` and ``info["final_info"]``) or "disabled"
            (``reset(options={"reset_mask": mask})`` starts those of the (n,) bool mask).
        threads: of the pool; 0 for one a CPU.
        hold: steps for which an action is held; rewards are summed over them. Observations, infos and the next episode
            come after the last; an episode that ends before waits for it.

    Rendering is left to the single environment.
    """

    metadata = {"render_modes": [], "render_fps": ArticulationEnv.metadata["render_fps"],
                "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(self, asset: str | os.PathLike | Asset, num_envs: int = 1, max_episode_steps: int | None = None,
                 autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP, threads: int = 0, hold: int = 1,
                 hand: str = "points", reward: str | Mapping[str, float] = "dense", action: str = "residual",
                 observation: str = "flat", randomize: Any = False, touch_static: bool = False,
                 reference: str = "demonstration") -> None:
        self.asset = with_reference(get_asset(asset), reference, hand)
        self.num_envs = num_envs
        if isinstance(autoreset_mode, str) and not isinstance(autoreset_mode, AutoresetMode):
            try:
                autoreset_mode = AutoresetMode[autoreset_mode.upper()]
            except KeyError:
                raise ValueError(f"no autoreset mode is named {autoreset_mode!r}; known: next_step, same_step, disabled"
                                 ) from None
        self._mode = autoreset_mode
        self.metadata = {**self.metadata, "autoreset_mode": autoreset_mode}
        self.render_mode = None
        scene = build_scene(self.asset, hand, touch_static=touch_static)
        self.task = Task(scene, BatchRows(scene, num_envs, threads), action=action, reward=reward)
        self.single_observation_space, self.single_action_space = spaces_of(self.task, observation)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._observed, self._randomize = observation, randomize
        self.max_episode_steps = max_episode_steps or default_steps(self.asset.demo["duration"])
        if hold < 1:
            raise ValueError(f"hold must be at least 1, is {hold}")
        self.hold = hold
        self._steps = np.zeros(num_envs, int)
        self._over = np.zeros(num_envs, bool)
        self._generators: list[np.random.Generator] = [seeding.np_random(None)[0] for _ in range(num_envs)]
        for row in range(num_envs):
            self.task.begin(row, self._generators[row])

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
              ) -> tuple[Any, dict[str, Any]]:
        """Start all episodes, or those of ``options["reset_mask"]``; the other options are the single environment's.

        seed: one for each, or a number s for s, s + 1, ...

        Raises:
            ValueError: an option is unknown or out of range, or there are not num_envs seeds.
        """
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise ValueError(f"reset_mask must be ({self.num_envs},) bool with one True at least")
        seeds = [None if seed is None else seed + i for i in range(self.num_envs)] \
            if seed is None or isinstance(seed, (int, np.integer)) else list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"{self.num_envs} seeds are needed, {len(seeds)} are given")
        for row in np.flatnonzero(mask):
            if seeds[row] is not None:
                self._generators[row] = seeding.np_random(int(seeds[row]))[0]
        drawn = self._begin(np.flatnonzero(mask), options)
        return self._observation(), self._info({}, drawn, mask)

    def _begin(self, ids: np.ndarray, options: Mapping[str, Any] | None = None) -> dict[int, dict]:
        drawn = {int(row): self.task.begin(row, self._generators[row], options, self._randomize) for row in ids}
        self._steps[ids], self._over[ids] = 0, False
        return drawn

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """See the class.

        Raises:
            ValueError: actions are not (num_envs, A), or an episode is over and autoreset is disabled.
        """
        actions = np.asarray(actions, np.float32)
        if actions.shape != self.action_space.shape:
            raise ValueError(f"actions must have shape {self.action_space.shape}, have {actions.shape}")
        starting = np.flatnonzero(self._over)
        if len(starting) and self._mode == AutoresetMode.DISABLED:
            raise ValueError(f"episodes {starting.tolist()} are over; reset them with the option reset_mask")
        live = ~self._over
        rewards, terms = np.zeros(self.num_envs), dict.fromkeys(self.task.scales, 0.0)
        terminated, truncated = np.zeros(self.num_envs, bool), np.zeros(self.num_envs, bool)
        for _ in range(self.hold):
            if not live.any():
                break
            reward, some = self.task.step(actions, None if live.all() else np.flatnonzero(live))
            rewards += np.where(live, reward, 0.0)
            terms = {name: terms[name] + np.where(live, value, 0.0) for name, value in some.items()}
            self._steps[live] += 1
            terminated |= live & (self.task.success() | self.task.diverged)
            truncated |= live & (self._steps >= self.max_episode_steps)
            live = live & ~(terminated | truncated)
        drawn = self._begin(starting)
        self._over = terminated | truncated
        info = self._info(terms, drawn, np.ones(self.num_envs, bool))
        if self._mode == AutoresetMode.SAME_STEP and self._over.any():
            over = self._over.copy()
            final = self._observation()
            drawn = self._begin(np.flatnonzero(over))
            info = {**self._info(terms, drawn, np.ones(self.num_envs, bool)), "final_info": info, "final_obs": final,
                    "_final_info": over, "_final_obs": over.copy()}
        return self._observation(), rewards, terminated, truncated, info

    def _observation(self) -> Any:
        return observe(self.task, self._observed)

    def _info(self, terms: Mapping[str, np.ndarray], drawn: Mapping[int, dict], mask: np.ndarray) -> dict[str, Any]:
        info: dict[str, Any] = {}
        for name, value in self.task.info().items():
            info[name], info[f"_{name}"] = value, mask.copy()
        info["reward_terms"] = {name: np.array(np.broadcast_to(value, self.num_envs)) for name, value in terms.items()}
        drawn = {row: made for row, made in drawn.items() if made}
        if drawn:
            names = next(iter(drawn.values()))
            flags = np.zeros(self.num_envs, bool)
            flags[list(drawn)] = True
            arrays = {name: np.zeros((self.num_envs, *np.shape(value))) for name, value in names.items()}
            for row, made in drawn.items():
                for name, value in made.items():
                    arrays[name][row] = value
            info["randomized"], info["_randomized"] = arrays, flags
        return info

    @property
    def steps(self) -> np.ndarray:
        """(num_envs,) steps made in the running episodes; of one that has ended, its length until the next begins."""
        return self._steps.copy()

    def reference_action(self) -> np.ndarray:
        """(num_envs, A): the actions that follow the demonstrated hand in the next step."""
        return self.task.reference_action()

    def get_state(self) -> list[dict[str, Any]]:
        """Snapshot of every episode and generator; plain arrays and numbers, copies."""
        return [{**self.task.snapshot(row), "generator": self._generators[row].bit_generator.state,
                 "steps": int(self._steps[row]), "over": bool(self._over[row])} for row in range(self.num_envs)]

    def set_state(self, states: Sequence[Mapping[str, Any]]) -> None:
        """Take a snapshot of :meth:`get_state`; what follows is what followed there."""
        for row, state in enumerate(states):
            self.task.restore(row, state)
            self._generators[row].bit_generator.state = state["generator"]
            self._steps[row], self._over[row] = state["steps"], state["over"]

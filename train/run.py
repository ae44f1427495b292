"""Training with Stable-Baselines3, in a folder that survives a kill.

::

    RUN/config.json      settings, the asset's id and digest
    RUN/checkpoint.pt    all that training goes on from: weights, optimisers, generators, every simulation's state
    RUN/curve.csv        one row an iteration
    RUN/policy.pt        the policy that did best in an evaluation, or the last one where none is made

A run that was killed goes on from its last checkpoint as if nothing had happened: the curve is the same, row by row.
"""

from __future__ import annotations

import csv
import hashlib
import importlib.util
import json
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, configure

from taa_envs.asset import Asset
from taa_envs.errors import TaaEnvsError
from taa_envs.files import written_whole
from taa_envs.randomize import uncertainties
from taa_envs.vector import BatchedArticulationEnv
from train.config import Config
from train.evaluate import episodes as run_episodes
from train.evaluate import make_env
from train.guide import most_steps, teach
from train.policy import CLASSES, Policy, arrays, load_torch, policy_arguments, save_policy, save_torch, tensors
from train.vec import BatchedVecEnv, Normal, replay_normal

FORMAT = "taa-checkpoint/2"
FREE = ("steps", "checkpoint_every", "evaluate_every", "evaluate_episodes", "enough")  # may differ when a run goes on
COLUMNS = ("steps", "episodes", "success", "return", "progress", "evaluated", "seconds", "processor")
EVALUATED = COLUMNS.index("evaluated")
WINDOW = 100  # episodes that a row of the curve averages over
EVALUATION_SEED = 500_000  # of an evaluation's first episode: not the training's, nor those of `taa evaluate`
FIRST = 32  # episodes of an evaluation after which a policy is known well enough
GOOD = 0.9  # unless it succeeds in so many
CHUNK = 2048  # environment steps between rows of SAC's curve; PPO has one a rollout


class _Episodes(BaseCallback):
    """Collects how episodes ended, of those that began so long ago that none of them can be running any more.

    A success ends early, a failure at the time limit: the first to end are successes, and an average over what has
    ended would begin far too high.

    Args:
        longest: decisions in the longest episode.
    """

    def __init__(self, longest: int) -> None:
        super().__init__()
        self.longest = longest
        self.now = self.count = 0
        self.waiting: list[list[float]] = []  # when it began, success, return, progress
        self.last: deque[list[float]] = deque(maxlen=WINDOW)

    def _on_step(self) -> bool:
        self.now += 1
        for info in self.locals["infos"]:
            if "episode" in info:
                self.waiting.append([self.now - info["episode"]["l"], float(info["is_success"]), info["episode"]["r"],
                                     info["joint_progress"]])
        return True

    def means(self) -> list[float]:
        """Of success, return and progress."""
        known = [e for e in self.waiting if e[0] <= self.now - self.longest]
        self.waiting = [e for e in self.waiting if e[0] > self.now - self.longest]
        self.count += len(known)
        self.last.extend(e[1:] for e in sorted(known, key=lambda e: e[0]))
        return np.mean(self.last, axis=0).tolist() if self.last else [float("nan")] * 3


def train(asset: Asset, config: Config, folder: Path, *, minutes: float | None = None,
          progress: Callable[[float, dict], None] | None = None) -> dict:
    """Train a policy, or go on with a run that was begun with the same settings.

    Args:
        asset: what to train on.
        config: settings.  ``steps`` may be larger than the run's was: it then goes on. With ``evaluate_every`` the
            policy is evaluated without exploration now and then, before the first step too; the best one is kept, and
            training ends where one does well ``enough``.
        folder: the run's, made if missing.
        minutes: stop after so many by the clock, those before a kill counted in, but not amid the guide's lessons; the
            run can go on later.
        progress: called after every iteration with the share done and the curve's row.

    Returns:
        run (path), policy (path), resumed_at (steps), steps, guided (whether a guide was imitated first), and the
        curve's last success, return, progress, evaluated (success without exploration), seconds by the clock and of the
        processor.

    Raises:
        TaaEnvsError: the folder holds a run with other settings, or something else.
    """
    folder = Path(folder)
    described = {"asset": asset.id, "asset_sha256": digest(asset),
                 **{k: v for k, v in config.as_dict().items() if k not in FREE}}
    _claim(folder, described)
    batch = BatchedArticulationEnv(asset, config.envs, autoreset_mode="same_step", reward=config.reward,
                                   action=config.action, randomize=config.randomize, hold=config.hold)
    checkpoint = folder / "checkpoint.pt"
    content = arrays_of(checkpoint) if checkpoint.exists() else None
    normal = replay_normal(batch, config.seed) if content is None else Normal(*content["normal"])
    env = BatchedVecEnv(batch, normal)
    torch.set_num_threads(1)  # small networks: threads cost more than they bring, and results depend on them
    kind = CLASSES[config.algo]
    try:
        model = kind("MlpPolicy", env, policy_kwargs=policy_arguments(config.policy), seed=config.seed, device="cpu",
                     verbose=0, **config.algorithm)
    except (TypeError, ValueError) as error:
        raise TaaEnvsError(f"the settings do not fit Stable-Baselines3's {kind.__name__} ({error}); mend them"
                           ) from None
    model.set_logger(_logger(folder))
    if config.algo == "ppo":  # begin as the replay: the mean action of a fresh policy is then zero
        with torch.no_grad():
            model.policy.action_net.weight.zero_()
    episodes, rows = _Episodes(-(-batch.max_episode_steps // config.hold)), []
    chunk = config.envs * model.n_steps if config.algo == "ppo" else max(CHUNK // config.hold, config.envs)
    resumed, seconds, used, best = 0, 0.0, 0.0, None
    if content is not None:
        rows, best = _restore(model, env, episodes, content), content["best"]
        resumed, (seconds, used) = model.num_timesteps * config.hold, rows[-1][-2:] if rows else (0.0, 0.0)
        # The kill may have come before they were written.
        _write_results(folder, model, best, normal, config, asset, rows)
    begin, begin_used, saved, made = time.monotonic() - seconds, time.process_time() - used, resumed, resumed
    judge = _Judge(asset, config, normal)
    guided = content is not None and content["guided"]
    # Where so few steps are asked for that the guide would take them all, there is none.
    to_guide = config.guide_episodes > 0 and most_steps(config, batch.max_episode_steps) <= config.steps
    over = made >= config.steps or (guided >= to_guide and bool(rows) and rows[-1][EVALUATED] >= config.enough)
    while not over:
        if len(rows) < (config.evaluate_every > 0):
            pass  # the untrained policy is evaluated first: PPO's is the replay
        elif to_guide and made == 0:
            guided = True
            model.num_timesteps = teach(model, asset, config, normal) // config.hold
        else:
            _quieten(model, config, made)
            # The first call resets the environments, the others go on.
            model.learn(chunk, callback=episodes, reset_num_timesteps=model.num_timesteps == 0, log_interval=None)
        made = model.num_timesteps * config.hold  # Stable-Baselines3 counts decisions
        evaluated = float("nan")
        if config.evaluate_every and made - _evaluated_at(rows) >= config.evaluate_every:
            evaluated = judge.success(model)
            if best is None or evaluated >= best["evaluated"]:
                best = {"evaluated": evaluated, "weights": {k: v.clone() for k, v in model.policy.state_dict().items()}}
        rows.append([made, episodes.count, *episodes.means(), evaluated, time.monotonic() - begin,
                     time.process_time() - begin_used])
        for name, value in zip(COLUMNS[1:], rows[-1][1:], strict=True):
            model.logger.record(f"taa/{name}", value)
        model.logger.dump(made)
        if progress is not None:
            progress(min(made / config.steps, 1.0), dict(zip(COLUMNS, rows[-1], strict=True)))
        # A replay that never failed in the evaluation may fail in others: the guide's lessons are not left out.
        over = (made >= config.steps or (evaluated >= config.enough and guided >= to_guide)
                or (minutes is not None and time.monotonic() - begin >= 60 * minutes))
        if made - saved >= config.checkpoint_every or over:
            save_torch(checkpoint, {**_checkpoint(model, env, normal, episodes, rows), "best": best, "guided": guided})
            _write_results(folder, model, best, normal, config, asset, rows)
            saved = made
    env.close()
    judge.close()
    last = dict(zip(COLUMNS, rows[-1], strict=True)) if rows else {}
    return {"run": str(folder), "policy": str(folder / "policy.pt"), "resumed_at": resumed,
            "steps": made, "guided": guided,
            **{k: None if np.isnan(last[k]) else last[k] for k in COLUMNS[2:] if k in last}}


def digest(asset: Asset) -> str:
    """SHA-256 of what a policy is trained on: the model, the demonstration, and what randomisation draws from."""
    out = hashlib.sha256(asset.model_path.read_bytes())
    for _, array in sorted(asset.reference.arrays().items()):
        out.update(np.ascontiguousarray(array).tobytes())
    out.update(json.dumps([uncertainties(asset), asset.joint.get("std")], sort_keys=True).encode())
    return out.hexdigest()


class _Judge:
    """Evaluates policies without exploration, in episodes of its own and always the same.

    Only a policy that is :data:`GOOD` in the first :data:`FIRST` goes through all of them: most evaluations ask no
    more than how far a policy is, and which of several good ones is best shows in many.
    """

    def __init__(self, asset: Asset, config: Config, normal: Normal) -> None:
        self._asset, self._config, self._normal = asset, config, normal
        self._env: BatchedArticulationEnv | None = None

    def success(self, model: BaseAlgorithm) -> float:
        config, count = self._config, self._config.evaluate_episodes
        if self._env is None:
            self._env = make_env(self._asset, min(count, FIRST), action=config.action, randomize=config.randomize,
                                 hold=config.hold)
        policy = Policy(model.policy, self._normal, config.hold)

        def run(first: int, number: int) -> np.ndarray:
            return run_episodes(self._asset, policy, number, seed=EVALUATION_SEED + first, env=self._env)["success"]

        won = run(0, min(count, FIRST))
        if won.mean() >= GOOD and count > FIRST:
            won = np.concatenate([won, run(FIRST, count - FIRST)])
        return float(won.mean())

    def close(self) -> None:
        if self._env is not None:
            self._env.close()


def _quieten(model: BaseAlgorithm, config: Config, made: int) -> None:
    """Hold PPO's exploration below a line that falls from where it began to ``anneal_to`` in ``anneal_steps``."""
    if config.anneal_to is not None and config.algo == "ppo":
        first = float(config.policy.get("log_std_init", 0.0))
        share = min(made / config.anneal_steps, 1.0)
        with torch.no_grad():
            model.policy.log_std.clamp_(max=first + share * (config.anneal_to - first))


def _evaluated_at(rows: list[list[float]]) -> float:
    """Steps at which the policy was evaluated last."""
    return max((row[0] for row in rows if np.isfinite(row[EVALUATED])), default=-np.inf)


def _claim(folder: Path, described: dict) -> None:
    file = folder / "config.json"
    text = json.dumps(described, indent=1, sort_keys=True)
    if file.is_file():
        if json.loads(file.read_text(encoding="utf-8")) != json.loads(text):
            raise TaaEnvsError(f"{folder} holds a run with other settings or of another asset; choose another --out")
        return
    # What a killed write of this very file left does not make the folder somebody else's.
    if folder.exists() and any(not f.name.startswith(f".{file.name}.") for f in folder.iterdir()):
        raise TaaEnvsError(f"{folder} is not a training run and not empty; choose another --out")
    folder.mkdir(parents=True, exist_ok=True)
    with written_whole(file) as partial:
        partial.write_text(text, encoding="utf-8")


def _logger(folder: Path) -> Logger:
    """Event files for TensorBoard where it is installed; the curve is written in any case."""
    found = importlib.util.find_spec("tensorboard") is not None
    return configure(str(folder / "tensorboard"), ["tensorboard"]) if found else Logger(None, [])


def _write_results(folder: Path, model: BaseAlgorithm, best: dict[str, Any] | None, normal: Normal, config: Config,
                   asset: Asset, rows: list[list[float]]) -> None:
    save_policy(folder / "policy.pt", model.policy, normal, config, asset.id, None if best is None else best["weights"])
    _write_curve(folder / "curve.csv", rows)


def _write_curve(file: Path, rows: list[list[float]]) -> None:
    with written_whole(file) as partial, partial.open("w", newline="", encoding="utf-8") as f:
        writer = csv.writer(f)
        writer.writerow(COLUMNS)
        writer.writerows(rows)


def _checkpoint(model: BaseAlgorithm, env: BatchedVecEnv, normal: Normal, episodes: _Episodes, rows: list
                ) -> dict[str, Any]:
    _, variables = model._get_torch_save_params()
    state = np.random.get_state()  # noqa: NPY002 - the generator that Stable-Baselines3 draws from
    content = {
        "format": FORMAT, "parameters": model.get_parameters(),
        "variables": {name: getattr(model, name).detach().clone() for name in variables},
        "model": {"num_timesteps": model.num_timesteps, "_n_updates": model._n_updates,
                  "_episode_num": model._episode_num},
        "last_obs": model._last_obs, "last_episode_starts": model._last_episode_starts, "env": env.get_state(),
        "normal": [normal.mean, normal.std],
        "torch": torch.get_rng_state(), "numpy": [state[1], state[2], state[3], state[4]],
        "actions": model.action_space.np_random.bit_generator.state,
        "episodes": {"now": episodes.now, "count": episodes.count, "waiting": [list(e) for e in episodes.waiting],
                     "last": [list(e) for e in episodes.last]}, "rows": rows,
    }
    buffer = getattr(model, "replay_buffer", None)
    if buffer is not None:
        filled = buffer.buffer_size if buffer.full else buffer.pos
        content["buffer"] = {"pos": buffer.pos, "full": buffer.full,
                             **{name: getattr(buffer, name)[:filled] for name in _BUFFER}}
    return tensors(content)


_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def arrays_of(file: Path) -> dict[str, Any]:
    """A checkpoint; its parameters and generator stay tensors."""
    content = load_torch(file, FORMAT)
    kept = {name: content.pop(name) for name in ("parameters", "variables", "torch", "best")}
    return {**arrays(content), **kept}


def _restore(model: BaseAlgorithm, env: BatchedVecEnv, episodes: _Episodes, content: dict[str, Any]) -> list:
    model.set_parameters(content["parameters"], exact_match=True, device="cpu")
    for name, value in content["variables"].items():
        getattr(model, name).data = value
    for name, value in content["model"].items():
        setattr(model, name, value)
    model._last_obs, model._last_episode_starts = content["last_obs"], content["last_episode_starts"]
    env.reset()  # as a fresh run does, before the states are put in place of what it made
    env.set_state(content["env"])
    if "buffer" in content:
        buffer = getattr(model, "replay_buffer")  # noqa: B009 - SAC's alone
        buffer.pos, buffer.full = content["buffer"]["pos"], content["buffer"]["full"]
        for name in _BUFFER:
            getattr(buffer, name)[:len(content["buffer"][name])] = content["buffer"][name]
    episodes.now, episodes.count = content["episodes"]["now"], content["episodes"]["count"]
    episodes.waiting = content["episodes"]["waiting"]
    episodes.last.extend(content["episodes"]["last"])
    model.action_space.np_random.bit_generator.state = content["actions"]
    np.random.set_state(("MT19937", *content["numpy"]))  # noqa: NPY002
    torch.set_rng_state(content["torch"])
    return content["rows"]

"""What an environment step costs beside the physics in it.

    python -m benchmarks.environment                 # the door of the tests
    python -m benchmarks.environment --asset ID --envs 16 64

One episode of the demonstration is played; its controls are recorded, so that the bare loops (``mj_step``, and
``mujoco.batch`` with the contact sensors read) pass through the same states and contacts. Everything is timed in turn,
round after round, and ratios are medians over the rounds: another load on the machine hits both sides of a ratio.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
from mujoco.batch import Batch

from taa_envs.asset import Asset, save_asset
from taa_envs.env import ArticulationEnv
from taa_envs.registry import get_asset
from taa_envs.task import SUBSTEPS
from taa_envs.vector import BatchedArticulationEnv

NO_END = 10**9  # steps: no episode ends by time while it is timed


def recorded(asset: Asset, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Full state at the start of an episode, and the controls (steps * SUBSTEPS, nu) of its substeps."""
    env = ArticulationEnv(asset)
    env.reset(seed=0)
    start, controls, step = env.get_state()["simulation"], [], env._rows.step

    def recording(ids: np.ndarray | None) -> None:
        controls.append(env.data.ctrl.copy())
        step(ids)

    env._rows.step = recording  # type: ignore[method-assign]
    for _ in range(steps):
        env.step(env.reference_action())
    return start, np.array(controls)


def single(asset: Asset, steps: int) -> dict[str, Callable[[], float]]:
    """Name -> function that plays the episode once and returns its seconds."""
    start, controls = recorded(asset, steps)
    plain = ArticulationEnv(asset)
    wrapped = gymnasium.make("TAA/" + asset.id) if "TAA/" + asset.id in gymnasium.registry else None
    model, data = plain.model, mujoco.MjData(plain.model)
    spec = mujoco.mjtState.mjSTATE_INTEGRATION

    def raw() -> float:
        mujoco.mj_setState(model, data, start, spec)
        begin = time.perf_counter()
        for control in controls:
            data.ctrl[:] = control
            mujoco.mj_step(model, data)
        return time.perf_counter() - begin

    def play(env: gymnasium.Env) -> float:
        env.reset(seed=0)
        zero = np.zeros(7, np.float32)
        begin = time.perf_counter()
        for _ in range(steps):
            env.step(zero)
        return time.perf_counter() - begin

    out = {"raw": raw, "environment": lambda: play(plain)}
    if wrapped is not None:
        out["gym.make"] = lambda: play(wrapped)
    return out


def many(asset: Asset, n: int, steps: int) -> dict[str, Callable[[], float]]:
    """The same for n simulations."""
    start, controls = recorded(asset, steps)
    batch_env = BatchedArticulationEnv(asset, n, max_episode_steps=NO_END)
    sync = gymnasium.vector.SyncVectorEnv([lambda: ArticulationEnv(asset)] * n)
    bare = Batch(ArticulationEnv(asset).model, n)
    control, touch = bare.bind("ctrl"), bare.bind("sensordata")
    zero = np.zeros((n, 7), np.float32)

    def loop() -> float:
        bare.state[:] = start
        log = np.empty((SUBSTEPS, *touch.shape))
        begin = time.perf_counter()
        for k, row in enumerate(controls):
            control[:] = row
            bare.step()
            log[k % SUBSTEPS] = touch
        return time.perf_counter() - begin

    def play(env: gymnasium.vector.VectorEnv) -> float:
        env.reset(seed=0)
        begin = time.perf_counter()
        for _ in range(steps):
            env.step(zero)
        return time.perf_counter() - begin

    return {"bare batch": loop, "batched": lambda: play(batch_env), "SyncVectorEnv": lambda: play(sync)}


def interleaved(runs: dict[str, Callable[[], float]], rounds: int) -> dict[str, np.ndarray]:
    """Name -> (rounds,) s; one round before them is not counted."""
    for run in runs.values():
        run()
    times = [{name: run() for name, run in runs.items()} for _ in range(rounds)]
    return {name: np.array([t[name] for t in times]) for name in runs}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--asset", help="id or folder (default: the door of the tests)")
    parser.add_argument("--envs", type=int, nargs="*", default=[16, 64])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=100, help="environment steps a round")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if arguments.asset is None:
            from tests.taa_envs.made import door_arguments

            asset = save_asset(Path(folder), "door", **door_arguments())
        else:
            asset = get_asset(arguments.asset)
        # The demonstration's own steps only: no episode may end while it is timed.
        steps = min(arguments.steps, int(0.8 * asset.demo["duration"] * ArticulationEnv.metadata["render_fps"]))
        times = interleaved(single(asset, steps), arguments.rounds)
        raw = times["raw"]
        print(f"{asset.id}: {SUBSTEPS} substeps a step, raw mj_step {1e6 * np.median(raw) / steps / SUBSTEPS:.1f} us")
        for name, value in times.items():
            extra = 1e6 * np.median(value - raw) / steps
            print(f"  {name:14s} {1e6 * np.median(value) / steps:8.0f} us a step  {np.median(value / raw):5.2f} x raw  "
                  f"{extra:+6.0f} us a step")
        for n in arguments.envs:
            times = interleaved(many(asset, n, steps), arguments.rounds)
            print(f"{n} simulations, environment steps a second:")
            for name, value in times.items():
                print(f"  {name:14s} {np.median(n * steps / value):8.0f}  "
                      f"{np.median(times['bare batch'] / value):5.2f} x bare batch  "
                      f"{np.median(times['SyncVectorEnv'] / value):5.2f} x SyncVectorEnv")


if __name__ == "__main__":
    main()

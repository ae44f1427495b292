"""What an environment step costs beside the physics in it.

    python -m benchmarks.speed                       # the door of the tests
    python -m benchmarks.speed --asset ID --envs 1 4 16 64 --figure docs/images/speed.png

One episode of small random corrections is played and its controls recorded, so that the bare loops (``mj_step``, and
``mujoco.batch`` with the contact history copied out) pass through the same states and contacts. Everything is timed in
turn, round after round, and ratios are medians over the rounds' pairs: another load on the machine hits both sides of a
pair. Beside the clock the process's own processor time is given, which waiting for a processor does not lengthen.
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
from taa_envs.scene import SUBSTEPS, touch_history
from taa_envs.vector import BatchedArticulationEnv

NO_END = 10**9  # steps: no episode ends by time while it is timed
Times = dict[str, np.ndarray]


def wrapped(asset: Asset) -> gymnasium.Env:
    """The environment in the wrappers that ``gymnasium.make`` puts around it."""
    spec = gymnasium.envs.registration.EnvSpec("TAA/" + asset.id, entry_point="taa_envs.env:ArticulationEnv",
                                               max_episode_steps=NO_END, kwargs={"asset": asset})
    return gymnasium.make(spec)


def recorded(asset: Asset, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Full state at an episode's start, actions (steps, A), and the controls (steps, nu) that they lead to."""
    env = ArticulationEnv(asset)
    env.reset(seed=0)
    start, controls = env.get_state()["simulation"], []
    actions = np.random.default_rng(0).uniform(-0.2, 0.2, (steps, *env.action_space.shape)).astype(np.float32)
    for action in actions:
        env.step(action)
        controls.append(env.data.ctrl.copy())
    return start, actions, np.array(controls)


def timed(step: Callable[[int], object], steps: int) -> np.ndarray:
    """(steps, 2) s by the clock and of the processor, of each step."""
    out = np.empty((steps, 2))
    for k in range(steps):
        clock, processor = time.perf_counter(), time.process_time()
        step(k)
        out[k] = time.perf_counter() - clock, time.process_time() - processor
    return out


def single(asset: Asset, steps: int) -> dict[str, Callable[[], np.ndarray]]:
    """Name -> function that plays the episode once and returns its steps' times."""
    start, actions, controls = recorded(asset, steps)
    plain, made = ArticulationEnv(asset), wrapped(asset)
    model, data = plain.model, mujoco.MjData(plain.model)

    def raw() -> np.ndarray:
        mujoco.mj_setState(model, data, start, mujoco.mjtState.mjSTATE_INTEGRATION)

        def step(k: int) -> None:
            data.ctrl[:] = controls[k]
            mujoco.mj_step(model, data, SUBSTEPS)

        return timed(step, steps)

    def play(env: gymnasium.Env) -> np.ndarray:
        env.reset(seed=0)
        return timed(lambda k: env.step(actions[k]), steps)

    return {"raw mj_step": raw, "environment": lambda: play(plain), "gym.make": lambda: play(made)}


def alone(env: gymnasium.Env, loops: int = 300, steps: int = 50) -> float:
    """Least time of a step with the physics left out, s: the Python around it, its caches warm."""
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, np.float32)
    for _ in range(10):
        env.step(action)
    env.unwrapped.task.rows.step = lambda ids, count=1: None
    best = np.inf
    for _ in range(loops):
        begin = time.perf_counter()
        for _ in range(steps):
            env.step(action)
        best = min(best, (time.perf_counter() - begin) / steps)
    return best


def many(asset: Asset, n: int, steps: int, with_sync: bool) -> dict[str, Callable[[], np.ndarray]]:
    """The same for n simulations."""
    start, actions, controls = recorded(asset, steps)
    batch_env = BatchedArticulationEnv(asset, n, max_episode_steps=NO_END)
    scene = ArticulationEnv(asset).task.scene
    bare = Batch(scene.model, n)
    control, touches = bare.bind("ctrl"), bare.bind("history")[:, touch_history(scene)]
    rows = np.repeat(actions[:, None], n, 1)

    def loop() -> np.ndarray:
        bare.state[:] = start
        log = np.empty(touches.shape)

        def step(k: int) -> None:
            control[:] = controls[k]
            bare.step(nstep=SUBSTEPS)
            log[:] = touches

        return timed(step, steps)

    def play(env: gymnasium.vector.VectorEnv) -> np.ndarray:
        env.reset(seed=0)
        return timed(lambda k: env.step(rows[k]), steps)

    out: dict[str, Callable[[], np.ndarray]] = {"bare batch": loop, "batched": lambda: play(batch_env)}
    if with_sync:
        sync = gymnasium.vector.SyncVectorEnv([lambda: wrapped(asset)] * n)
        out["SyncVectorEnv"] = lambda: play(sync)
    return out


def interleaved(runs: dict[str, Callable[[], np.ndarray]], rounds: int) -> Times:
    """Name -> (rounds, steps, 2) s; one round before them is not counted."""
    for run in runs.values():
        run()
    times = [{name: run() for name, run in runs.items()} for _ in range(rounds)]
    return {name: np.array([t[name] for t in times]) for name in runs}


def ratios(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Median over rounds of a's time over b's, by the clock and of the processor."""
    clock, processor = np.median(a.sum(1) / np.maximum(b.sum(1), 1e-12), axis=0)
    return float(clock), float(processor)


def report_single(times: Times, steps: int) -> None:
    raw = times["raw mj_step"]
    print(f"one simulation, {SUBSTEPS} substeps a step, {steps} steps a round, {len(raw)} rounds")
    print("| what | us a step, median | x raw, clock | x raw, processor | us of Python a step, least times |")
    print("| --- | --- | --- | --- | --- |")
    for name, value in times.items():
        clock, processor = ratios(value, raw)
        # The least time of each step over all rounds: what it costs when nothing else runs meanwhile.
        python = 1e6 * (value[..., 0].min(0) - raw[..., 0].min(0)).mean()
        print(f"| {name} | {1e6 * np.median(value[..., 0].mean(1)):.0f} | {clock:.2f} | {processor:.2f} | "
              f"{python:.0f} |")


def report_many(n: int, times: Times, steps: int) -> dict[str, float]:
    """Prints a table row a name; steps a second by name."""
    rates = {name: float(np.median(n * steps / value[..., 0].sum(1))) for name, value in times.items()}
    for name, value in times.items():
        bare = ratios(times["bare batch"], value)
        sync = ratios(times["SyncVectorEnv"], value) if "SyncVectorEnv" in times else None
        print(f"| {n} | {name} | {rates[name]:.0f} | {bare[0]:.2f} ({bare[1]:.2f}) | "
              + (f"{sync[0]:.2f} ({sync[1]:.2f}) |" if sync else " |"))
    return rates


def draw(file: Path, rates: dict[int, dict[str, float]], asset: str) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.0, 3.8), layout="constrained")
    sizes = sorted(rates)
    for name in ("bare batch", "batched", "SyncVectorEnv"):
        known = [n for n in sizes if name in rates[n]]
        axes.plot(known, [rates[n][name] for n in known], "o-", label=name)
    axes.set_xscale("log", base=2)
    axes.set_xticks(sizes, [str(n) for n in sizes])
    axes.set_ylim(bottom=0)
    axes.set_xlabel("simulations in the batch")
    axes.set_ylabel(f"environment steps a second\n({SUBSTEPS} substeps each)")
    axes.set_title(f"TAA/{asset}", fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(file, dpi=150)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--asset", help="id or folder (default: the door of the tests)")
    parser.add_argument("--envs", type=int, nargs="*", default=[1, 4, 16, 64])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--steps", type=int, default=100, help="environment steps a round")
    parser.add_argument("--batch-steps", type=int, default=40, help="of each simulation of a batch")
    parser.add_argument("--figure", type=Path, help="PNG to draw")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if arguments.asset is None:
            from tests.taa_envs.made import door_arguments

            asset = save_asset(Path(folder), "door", **door_arguments())
        else:
            asset = get_asset(arguments.asset)
        # The demonstration's own steps only: no episode may end while it is timed.
        limit = int(0.6 * asset.demo["duration"] * ArticulationEnv.metadata["render_fps"])
        steps = min(arguments.steps, limit)
        report_single(interleaved(single(asset, steps), arguments.rounds), steps)
        print("\nPython alone, physics left out: "
              + ", ".join(f"{name} {1e6 * alone(env):.1f} us"
                          for name, env in (("environment", ArticulationEnv(asset)), ("gym.make", wrapped(asset)))))
        print("\n| simulations | what | steps a second | x bare batch, clock (processor) | x SyncVectorEnv |")
        print("| --- | --- | --- | --- | --- |")
        steps, rates = min(arguments.batch_steps, limit), {}
        for n in arguments.envs:
            rates[n] = report_many(n, interleaved(many(asset, n, steps, True), max(3, arguments.rounds // 2)), steps)
        if arguments.figure is not None:
            draw(arguments.figure, rates, asset.id)


if __name__ == "__main__":
    main()

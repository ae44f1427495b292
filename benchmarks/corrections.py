"""What simple corrections of the replay would bring, were everything known: where a policy has room to gain.

    python -m benchmarks.corrections ID ... --episodes 24

The same randomised episodes are played as they are, with the drawn offset of the hand taken back, and with that and a
push along the link's motion once it is to move. The offset is read from the draw, which a policy sees only through its
finger tips: these runs tell what fails, they are no controllers.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from taa_envs.asset import Asset
from taa_envs.corrections import along
from taa_envs.registry import get_asset
from taa_envs.vector import BatchedArticulationEnv

STARTED = 0.005  # of the stroke: from here on the demonstrated hand drives


def play(asset: Asset, count: int, undo: bool, press: float, seed: int = 1_000_000) -> tuple[float, np.ndarray]:
    """Success, and the joint progress of the failures, sorted. press: m along the link's motion at the hand."""
    env = BatchedArticulationEnv(asset, count, randomize=True)
    _, info = env.reset(seed=seed)
    offset = info["randomized"]["hand"]
    reference, task = asset.reference, env.task
    stroke = asset.stroke_fraction(reference.q)
    running, success, progress = np.ones(count, bool), np.zeros(count, bool), np.zeros(count)
    while running.any():
        started = np.interp(task.time, reference.time, stroke) > STARTED
        shift = np.zeros((count, 3))
        if press:
            shift += press * started[:, None] * along(asset, task.landmarks().mean(1))
        if undo:
            shift -= offset
        actions = np.zeros(env.action_space.shape, np.float32)
        actions[:, :3] = np.clip(shift / task.translation, -1, 1)
        _, _, terminated, truncated, info = env.step(actions)
        ended = running & (terminated | truncated)
        success[ended], progress[ended] = info["is_success"][ended], info["joint_progress"][ended]
        running &= ~ended
    env.close()
    return float(success.mean()), np.sort(progress[~success])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("assets", nargs="+", help="ids or folders")
    parser.add_argument("--episodes", type=int, default=24)
    arguments = parser.parse_args()
    print("| asset | replay | offset undone | and pushed 1 cm | 2 cm | 3 cm |\n| --- | --- | --- | --- | --- | --- |")
    for name in arguments.assets:
        asset = get_asset(Path(name) if Path(name).is_dir() else name)
        runs = [play(asset, arguments.episodes, undo, press)
                for undo, press in ((False, 0.0), (True, 0.0), (True, 0.01), (True, 0.02), (True, 0.03))]
        print(f"| {asset.id} | " + " | ".join(f"{success:.0%}" for success, _ in runs) + " |", flush=True)


if __name__ == "__main__":
    main()

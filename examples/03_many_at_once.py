"""Sixteen environments stepped together on MuJoCo's thread pool, each with its own draw of the uncertain numbers.

python examples/03_many_at_once.py OUT
"""

import sys
from pathlib import Path

import numpy as np
from made import save_door

from taa_envs.vector import BatchedArticulationEnv

asset = save_door(Path(sys.argv[1] if len(sys.argv) > 1 else "example_out"))
env = BatchedArticulationEnv(asset, 16, randomize=True, autoreset_mode="disabled", max_episode_steps=10_000)
_, info = env.reset(seed=0)
print("friction loss drawn:", np.round(info["randomized"]["frictionloss"], 2) if "randomized" in info else "none")
best = np.zeros(16)
for _ in range(int(asset.end_time / 0.02)):
    _, _, terminated, _, info = env.step(np.zeros(env.action_space.shape, np.float32))
    best = np.maximum(best, info["joint_progress"])
    if terminated.any():
        break
print(f"progress of the replay until the first success: {best.min():.0%} to {best.max():.0%}")

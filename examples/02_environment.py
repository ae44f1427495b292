"""The Gymnasium environment of an asset: the zero action is the open-loop replay, rewards are named terms.

python examples/02_environment.py OUT
"""

import os
import sys
from pathlib import Path

import gymnasium
from made import save_door

import taa_envs  # registers every asset that is found as TAA/<id>

out = Path(sys.argv[1] if len(sys.argv) > 1 else "example_out")
save_door(out)
os.environ["TAA_ASSETS"] = str(out)
taa_envs.register_assets()  # look again

env = gymnasium.make("TAA/door")
observation, info = env.reset(seed=0)
done = False
while not done:
    observation, reward, terminated, truncated, info = env.step(0 * env.action_space.sample())
    done = terminated or truncated
print(f"success {info['is_success']}, progress {info['joint_progress']:.0%}, warnings {info['warnings']}")
print("terms of the last reward:", {name: round(value, 3) for name, value in info["reward_terms"].items()})

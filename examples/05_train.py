"""A few iterations of PPO on an asset, in a folder that a killed run goes on from; then evaluate the policy.

python examples/05_train.py OUT
"""

import sys
from dataclasses import replace
from pathlib import Path

from made import save_door

from train.config import load_config
from train.evaluate import evaluate
from train.run import train

out = Path(sys.argv[1] if len(sys.argv) > 1 else "example_out")
asset = save_door(out)
config = replace(load_config("ppo", steps=1024, envs=4), checkpoint_every=512)
config = replace(config, algorithm={**config.algorithm, "n_steps": 64, "batch_size": 128})
made = train(asset, config, out / "run")
print(f"{made['steps']} steps, went on from {made['resumed_at']}")
compared = evaluate(asset, Path(made["policy"]), 4)
print(f"policy {compared['policy']['success']:.0%}, open-loop replay {compared['replay']['success']:.0%}")

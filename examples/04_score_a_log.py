"""Score a joint log that another program made against an asset's demonstration.

python examples/04_score_a_log.py OUT
"""

import sys
from pathlib import Path

import numpy as np
from made import save_door

from taa_envs.scoring import score_joint_log

asset = save_door(Path(sys.argv[1] if len(sys.argv) > 1 else "example_out"))
time = np.linspace(0, 2, 50)
for name, q in (
    ("opens all the way", 0.5 * time),
    ("stops half-way", np.minimum(0.5 * time, 0.5)),
    ("wrong way", -0.1 * time),
):
    scores = score_joint_log(asset, time, q)
    print(
        f"{name}: progress {scores['joint_progress']:.0%}, final error {scores['final_q_error']:.0%}, "
        f"wrong way {scores['wrong_way']:.0%}"
    )

"""Fit a joint from point tracks alone, as any tracker may have made them: a scene folder with one cue.

python examples/06_joint_from_cues.py OUT
"""

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruct.pipeline import fit_scene

scene = Path(sys.argv[1] if len(sys.argv) > 1 else "example_out") / "scene"
(scene / "cues").mkdir(parents=True, exist_ok=True)

rng = np.random.default_rng(0)
focal, frames, axis = 600.0, 30, np.array([0.1, 0.99, 0.05]) / np.linalg.norm([0.1, 0.99, 0.05])
lid = np.c_[rng.uniform(0.05, 0.5, 40), rng.uniform(-0.3, 0.3, 40), np.zeros(40)]
still = np.c_[rng.uniform(-0.8, 0.8, (30, 2)), rng.uniform(1.5, 2.5, 30)]
uv = np.zeros((70, frames, 2))
for t, angle in enumerate(np.linspace(0, 1.2, frames)):
    points = np.r_[Rotation.from_rotvec(angle * axis).apply(lid) + [0, 0, 2], still]
    uv[:, t] = focal * points[:, :2] / points[:, 2:] + [320, 240]
np.savez(scene / "cues" / "tracks.npz", uv=uv + rng.normal(0, 0.2, uv.shape), visible=np.ones((70, frames), bool))
np.savez(scene / "cues" / "camera.npz", K=np.array([[focal, 0, 320], [0, focal, 240], [0, 0, 1]]))

joint = fit_scene(scene, focal=focal)
R = np.array(joint["T_camera_world"])[:3, :3]
found = R @ np.array(joint["axis"])
error = np.degrees(np.arccos(min(1.0, abs(found @ axis))))
print(
    f"{joint['verdict']}: {joint['type']}, axis off by {error:.1f} deg, range {np.degrees(np.ptp(joint['q'])):.0f} deg"
)

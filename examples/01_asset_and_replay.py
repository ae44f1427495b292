"""Make an asset from meshes and a joint, load it as anybody's, and replay its demonstration through contact.

python examples/01_asset_and_replay.py OUT
"""

import sys
from pathlib import Path

from made import save_door

from taa_envs.asset import load_asset
from taa_envs.replay import replay

out = Path(sys.argv[1] if len(sys.argv) > 1 else "example_out")
folder = save_door(out).path

asset = load_asset(folder)  # checks everything: an asset may come from a stranger
print(
    f"{asset.id}: {asset.joint_type} joint, mass {asset.provenance['moving.mass']['value']:.2f} kg "
    f"({asset.provenance['moving.mass']['origin']})"
)

result = replay(asset)  # the joint is passive: only the hand's contact moves it
print(f"joint progress {result.joint_progress:.0%}, contact {result.contact_fraction:.0%}")
for name, progress in result.controls.items():  # the same without a hand, with a mirrored and a late one: must fail
    print(f"  control {name}: {progress:.0%}")

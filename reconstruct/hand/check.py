"""A grip is tried where it has to work: against the passive joint, through contact."""

from __future__ import annotations

import tempfile

from reconstruct.cues import HandReference
from reconstruct.geometry import Geometry
from reconstruct.joint.models import JointFit


def replay_progress(fit: JointFit, geometry: Geometry, reference: HandReference) -> float:
    """Joint progress in [0, 1] of the open-loop replay; 0 where the simulation becomes unstable."""
    from taa_envs.authoring import save_asset
    from taa_envs.replay import Diverged, replay

    joint = {"type": fit.type, "axis": fit.axis, "point": fit.point}
    with tempfile.TemporaryDirectory(prefix="taa-grip-") as folder:
        asset = save_asset(folder, "trial", joint=joint, static=geometry.static, moving=geometry.moving,
                           reference=reference)
        try:
            return replay(asset, controls=False).joint_progress
        except Diverged:
            return 0.0

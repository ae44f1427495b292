"""A grip is tried where it has to work: against the passive joint, through contact."""

from __future__ import annotations

import tempfile

from reconstruct.cues import HandReference
from reconstruct.geometry import Geometry
from reconstruct.joint.models import JointFit


def replay_progress(fit: JointFit, geometry: Geometry, reference: HandReference) -> tuple[float, float]:
    """Open-loop replay of a reference.

    Returns:
        Joint progress in [0, 1] and the largest progress of a control (1 where the replay is too poor to run them).
        An unstable simulation counts as no progress.
    """
    from taa_envs.authoring import save_asset
    from taa_envs.replay import Diverged, replay

    joint = {"type": fit.type, "axis": fit.axis, "point": fit.point}
    with tempfile.TemporaryDirectory(prefix="taa-grip-") as folder:
        asset = save_asset(folder, "trial", joint=joint, static=geometry.static, moving=geometry.moving,
                           reference=reference)
        try:
            progress = replay(asset, controls=False).joint_progress
            if progress < 0.7:
                return progress, 1.0
            return progress, max(replay(asset).controls.values())
        except Diverged:
            return 0.0, 1.0

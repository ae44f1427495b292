"""An asset's own video as measured data: the joint's state over the frames in which no hand touches the part.

A door that coasts, swings back or springs open by itself moves under its own forces alone. A video carries no force, so
only their ratios to the inertia show; the asset's own (assumed) inertia is the measure.
"""

from __future__ import annotations

import numpy as np

from diagnose.log import MIN_SAMPLES, JointLog, LogError
from taa_envs.asset import Asset

MARGIN = 2  # frames beside a touch that count as touched: the hand's last push is seen late
STILL = 0.01  # of the demonstrated range: what moves less stands still


def video_logs(asset: Asset) -> list[JointLog]:
    """Joint logs, without torque, of the stretches in which the part moves and no hand touches it.

    A stretch begins with the last frame of standing still (or the first after the hand's touch) and ends half a second
    after the last motion.

    Raises:
        LogError: no such stretch is long enough.
    """
    r = asset.reference
    touched = np.convolve(r.contact.astype(float), np.ones(2 * MARGIN + 1), mode="same") > 0
    edges = np.flatnonzero(np.diff(np.concatenate([[True], touched, [True]]).astype(int)))
    span = asset.demo["q_max"] - asset.demo["q_min"]
    logs = []
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        q, t = r.q[a:b], r.time[a:b]
        if len(q) < MIN_SAMPLES:
            continue
        moving = np.flatnonzero(np.abs(np.diff(q)) > STILL * span * np.diff(t))
        fast = np.flatnonzero(np.abs(np.diff(q)) > STILL * span)
        if not len(fast):
            continue
        # Slow drift of a part that stands is the tracks', not the part's: the stretch starts with fast motion.
        first = max(int(fast[0]) - 1, 0)
        last = min(int(np.searchsorted(t, t[moving[-1] + 1] + 0.5)), len(q))
        if last - first >= MIN_SAMPLES:
            logs.append(JointLog(f"{asset.id}: video, {t[first]:.2f} to {t[last - 1]:.2f} s", t[first:last],
                                 q[first:last]))  # fmt: skip
    if not logs:
        raise LogError(f"the video of {asset.id} shows no part that moves for {MIN_SAMPLES} frames without a hand on "
                       "it; record one in which it coasts, or log the joint")  # fmt: skip
    return logs


def assumptions(asset: Asset) -> list[str]:
    """What such logs take for granted, in words."""
    out = ["the joint's state is the video's, over the frames in which no hand touches the part; a video shows no "
           "force, so every torque here is a ratio to the inertia times the asset's own inertia"]  # fmt: skip
    if not asset.reference.hand_valid.any():
        out.append("no hand was recognised anywhere in the video: that none touches the part in these frames is taken "
                   "from that, and a finger that was not recognised would break it")  # fmt: skip
    if not asset.joint.get("metric", True) and asset.joint_type == "prismatic":
        out.append("the video has no metric scale: lengths are in the asset's unit")
    return out

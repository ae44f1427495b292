"""Metres from the hand: its depth against the part's where they touch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reconstruct.cues import Hands
from reconstruct.hand.drive import find_drive
from reconstruct.hand.pnp import hand_positions
from reconstruct.hand.skeleton import CONTACT, HAND_SIZE_STD
from reconstruct.joint.models import JointFit, placed_std

MIN_FRAMES = 3
TOUCH_STD = 0.03  # relative, depth of what a hand touches over that of the tracked points beside it


def rescale(fit: JointFit, factor: float, factor_std: float, source: str) -> JointFit:
    """The same joint with all lengths multiplied by factor (relative standard deviation factor_std), in metres.

    The image of everything stays the same: points, pivot and camera move together about the world's origin.
    """
    T = fit.T_camera_world.copy()
    T[:3, 3] *= factor
    slide = fit.type == "prismatic"
    std = placed_std(fit.std, np.eye(3), factor, slide)
    if slide and std.get("q") is not None and fit.q is not None:
        std["q"] = np.hypot(std["q"], np.abs(fit.q) * factor * factor_std)
    std["scale"] = factor_std
    return replace(
        fit, q=fit.q * factor if slide else fit.q, point=None if fit.point is None else fit.point * factor,
        points=None if fit.points is None else fit.points * factor, T_camera_world=T,
        pitch=None if fit.pitch is None else fit.pitch * factor, metric=True, scale_source=source, std=std)  # fmt: skip


def hand_scale(fit: JointFit, hands: Hands, time: np.ndarray | None = None) -> JointFit:
    """Make a joint metric by the hand that drives it.

    In the frames in which the hand drives the part, finger tips and part are at the same depth: hand depth (m) over
    the depth of the part's nearest points (units) is the unit's length. The median over these frames is taken; its
    standard deviation joins the scatter with the 12 % spread of hand sizes.

    Args:
        fit: a joint up to scale.
        hands: the hands of the same frames.
        time: (T,) s; default 30 frames a second.

    Returns:
        A metric joint with ``scale_source`` "hand" and ``std["scale"]`` (relative), or the joint unchanged with
        ``scale_source`` "none" where no hand drives the part long enough.
    """
    if fit.metric or fit.q is None or fit.points is None:
        return fit
    unchanged = replace(fit, metric=False, scale_source="none")
    time = np.arange(len(fit.q)) / 30.0 if time is None else time
    drive = find_drive(hands, fit, time)
    if drive.index is None:
        return unchanged
    hand = hands.tracks[drive.index]
    camera, _ = hand_positions(hand, fit.K)
    pose = fit.link_pose(fit.q)
    ratios, weights = [], []
    for t in np.flatnonzero(drive.drives & np.isfinite(camera[:, 0, 0])):
        world = fit.points @ pose[t, :3, :3].T + pose[t, :3, 3]
        depth = (world @ fit.T_camera_world[:3, :3].T + fit.T_camera_world[:3, 3])[:, 2]
        apart = np.linalg.norm(hand.uv[t, CONTACT][:, None] - fit.project(world)[None], axis=-1)
        # The joints nearest to the part touch it; the part's depth there is that of its nearest points.
        touch = np.argsort(apart.min(1))[:4]
        beside = np.argsort(apart[touch].min(0))[: max(3, min(8, len(depth) // 4))]
        ratio = np.median(camera[t, CONTACT[touch], 2]) / np.median(depth[beside])
        if np.isfinite(ratio) and ratio > 0:
            ratios.append(np.log(ratio))
            weights.append(hand.score[t])
    if len(ratios) < MIN_FRAMES:
        return unchanged
    ratios, weights = np.array(ratios), np.array(weights)
    sure = ratios[weights >= 0.7 * weights.max()]
    middle = float(np.median(sure))
    scatter = 1.4826 * float(np.median(np.abs(sure - middle)))
    # Neighbouring frames err alike: a handful of independent looks at most, and never below a third of the scatter.
    error = scatter / np.sqrt(min(len(sure) / 8.0 + 1.0, 9.0))
    # A hand measured in space knows its size; what is left is that it may touch something before or behind the points.
    size = HAND_SIZE_STD if hand.placed is None else TOUCH_STD
    return rescale(fit, float(np.exp(middle)), float(np.hypot(size, error)), "hand")

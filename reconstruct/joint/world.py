"""From the camera frame to a z-up world: an assumption, made from how mechanisms are usually mounted."""

from __future__ import annotations

import numpy as np

TYPICAL_PITCH = np.radians(20.0)
"""People look down on what they film; used only to choose between candidates."""


def assumed_up(kind: str, axis: np.ndarray, points_start: np.ndarray, points_end: np.ndarray) -> tuple[np.ndarray, str]:
    """Up direction in the camera frame (right, down, forward).

    A joint axis close to the image's vertical is taken as vertical, any other as horizontal. About a
    horizontal axis the remaining angle comes from the link's plane if it has one (a closed door stands, a
    closed lid lies), else from a typical camera pitch.

    Args:
        kind: joint type.
        axis: (3,) unit.
        points_start, points_end: (M, 3) the link's points at both ends of the motion.

    Returns:
        (3,) unit vector and a sentence that says which assumption was made.
    """
    prior = np.array([0.0, -np.cos(TYPICAL_PITCH), -np.sin(TYPICAL_PITCH)])
    vertical = np.degrees(np.arccos(np.clip(abs(axis @ prior), 0, 1)))
    if vertical < 35.0:
        return axis * np.sign(axis @ prior), "the joint axis is taken as vertical"
    level = prior - (prior @ axis) * axis
    level /= np.linalg.norm(level)
    best, how = (
        level,
        f"the joint axis is taken as horizontal, the camera as looking down by {np.degrees(TYPICAL_PITCH):.0f} deg",
    )
    nearest = np.cos(np.radians(25.0))
    if kind != "prismatic":
        for points, when in ((points_start, "first"), (points_end, "last")):
            if len(points) < 8:
                continue
            _, sv, vt = np.linalg.svd(points - np.median(points, axis=0), full_matrices=False)
            if sv[2] > 0.25 * sv[1]:
                continue
            for up, name in ((vt[2], "lying"), (np.cross(axis, vt[2]), "standing")):
                up = up - (up @ axis) * axis
                up = up / max(np.linalg.norm(up), 1e-9) * np.sign(up @ level)
                if up @ level > nearest:
                    nearest, best = up @ level, up
                    how = f"the joint axis is taken as horizontal, the link as {name} in the {when} frame"
    return best, how


def world_from_camera(up: np.ndarray, axis: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """T_world_camera (4, 4): z along `up`, y away from the camera, origin at `origin` (camera frame)."""
    forward = np.array([0.0, 0.0, 1.0])
    y = forward - (forward @ up) * up
    if np.linalg.norm(y) < 1e-6:
        y = np.cross(up, axis)
    y /= np.linalg.norm(y)
    R = np.stack([np.cross(y, up), y, up])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ origin
    return T

"""World frames of models that know no gravity: turned so that z is up, by how people hold a camera."""

from __future__ import annotations

import numpy as np

from reconstruct.joint.world import TYPICAL_PITCH, world_from_camera


def upright(T_any_camera: np.ndarray) -> np.ndarray:
    """T_world_any (4, 4): from a model's arbitrary world to one with z up.

    Assumed: the first camera is held without roll and looks down by :data:`reconstruct.joint.world.TYPICAL_PITCH`.
    The origin is the first camera's place; lengths stay as they are.

    Args:
        T_any_camera: (T, 4, 4) poses in the model's world.
    """
    up = np.array([0.0, -np.cos(TYPICAL_PITCH), -np.sin(TYPICAL_PITCH)])
    T_world_camera = world_from_camera(up, np.array([1.0, 0, 0]), np.zeros(3))
    return T_world_camera @ np.linalg.inv(np.asarray(T_any_camera, float)[0])


def inverse_poses(extrinsics: np.ndarray) -> np.ndarray:
    """World-to-camera (T, 3, 4) or (T, 4, 4) -> camera-to-world (T, 4, 4)."""
    extrinsics = np.asarray(extrinsics, float)
    full = np.tile(np.eye(4), (len(extrinsics), 1, 1))
    full[:, :3] = extrinsics[:, :3]
    return np.linalg.inv(full)

"""A camera that moves: found from the static scene."""

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruct.joint.cameras import camera_moves
from reconstruct.joint.groups import rigid_group
from reconstruct.joint.models import joint_transform
from tests.reconstruct.joint_scenes import FOCAL, H, W, project

AXIS, POINT = np.array([0.0, 1.0, 0.0]), np.array([-0.3, 0.0, 1.8])


def scene(frames=40, orbit_deg=25.0, seed=0):
    """(N, T, 2) px from the centre: 120 points of a box that stands, 60 of a door that opens; and the cameras."""
    rng = np.random.default_rng(seed)
    still = rng.uniform([-0.5, -0.4, 1.5], [0.5, 0.4, 2.3], (120, 3))
    door = POINT + rng.uniform([0.02, -0.3, -0.1], [0.5, 0.3, 0.0], (60, 3))
    s = np.clip((np.arange(frames) - 5) / (frames - 10), 0, 1)
    T = joint_transform("revolute", AXIS, POINT, -1.0 * (3 * s**2 - 2 * s**3))
    moving = np.einsum("tij,nj->nti", T[:, :3, :3], door) + T[:, :3, 3]
    world = np.concatenate([np.repeat(still[:, None], frames, axis=1), moving])
    turn = Rotation.from_rotvec(np.outer(np.linspace(0, np.radians(orbit_deg), frames), [0, 1, 0])).as_matrix()
    centre = np.array([0, 0, 1.9])
    cam = np.einsum("tij,ntj->nti", turn, world - centre) + centre
    uv = project(cam) + rng.normal(scale=0.5, size=(*world.shape[:2], 2))
    return uv, turn


def test_cameras_are_recovered_from_the_static_points():
    uv, turn = scene()
    assert camera_moves(uv, float(np.hypot(W, H)))
    group = rigid_group(uv - [(W - 1) / 2, (H - 1) / 2], FOCAL, np.ones(len(uv), bool))
    assert group.members[:120].mean() > 0.95
    assert group.members[120:].mean() < 0.05
    assert group.sigma < 0.7
    errors = Rotation.from_matrix(group.R @ np.swapaxes(turn, 1, 2)).magnitude()
    assert np.degrees(errors).max() < 0.3


def test_a_static_camera_is_not_taken_for_a_moving_one():
    rng = np.random.default_rng(1)
    uv = np.repeat(rng.uniform(50, 500, (80, 1, 2)), 30, axis=1) + rng.normal(scale=0.3, size=(80, 30, 2))
    uv[:40] += np.linspace(0, 60, 30)[:, None]
    assert not camera_moves(uv, float(np.hypot(W, H)))

"""A camera in a hand: its path from what rests, and the joint before it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reconstruct.cues import ProviderInfo, Tracks
from reconstruct.joint.fit import fit_joint
from reconstruct.joint.handheld import filmed, path_from_rest
from reconstruct.joint.models import joint_transform
from tests.reconstruct.joint_scenes import FOCAL, H, W, make_video, project

CENTRE = np.array([(W - 1) / 2, (H - 1) / 2])
AXIS, POINT = np.array([0.1, 0.98, 0.15]) / np.linalg.norm([0.1, 0.98, 0.15]), np.array([-0.15, 0.0, 0.95])
FRAMES = 36


def camera_path(frames, rng):
    """A hand that sways by about a centimetre and a degree: world to camera."""
    t = np.linspace(0, 1, frames)
    sway = sum(rng.normal(size=6) * np.sin(2 * np.pi * k * t[:, None] + rng.uniform(0, 6, 6)) / k
               for k in (0.7, 1.6, 3))  # fmt: skip
    sway = (sway - sway[0]) * np.repeat([0.006, 0.008], 3)
    R = Rotation.from_rotvec(sway[:, 3:]).as_matrix()
    return R, -np.einsum("tij,tj->ti", R, sway[:, :3])


def scene(noise=0.1, rest=160, link=45, body="hinge", link_noise=None, seed=0):
    """Tracks of a door before a desk and a wall, in the picture that the wall's homographies take to its first view."""
    rng = np.random.default_rng(seed)
    R, t = camera_path(FRAMES, rng)
    half = rest // 2
    wall = np.column_stack([rng.uniform(-1.2, 1.2, half), rng.uniform(-0.7, 0.5, half), np.full(half, 2.2)])
    desk = np.column_stack([rng.uniform(-0.5, 0.5, half), np.full(half, 0.25), rng.uniform(0.9, 1.8, half)])
    still = np.concatenate([wall, desk])
    door = POINT + rng.uniform([0.02, -0.2, -0.02], [0.3, 0.2, 0.0], (link, 3))
    s = np.clip((np.arange(FRAMES) - 6) / (FRAMES - 12), 0, 1)
    q = 0.9 * (3 * s**2 - 2 * s**3)
    if body == "hinge":
        pose = joint_transform("revolute", AXIS, POINT, -q)
    else:  # carried away on a curve
        pose = joint_transform("revolute", AXIS, POINT, -0.5 * q)
        pose[:, :3, 3] += np.column_stack([0.1 * q, -0.15 * np.sin(2.5 * q), 0.1 * q**2])
    moving = np.einsum("tij,nj->nti", pose[:, :3, :3], door) + pose[:, :3, 3]
    world = np.concatenate([np.repeat(still[:, None], FRAMES, axis=1), moving])
    uv = project(np.einsum("tij,ntj->nti", R, world) + t)
    scale = np.r_[np.full(rest, noise), np.full(link, noise if link_noise is None else link_noise)]
    uv += rng.normal(size=uv.shape) * scale[:, None, None]
    warp = np.stack([cv2.findHomography(uv[:half, k], uv[:half, 0])[0] for k in range(FRAMES)])
    flat = np.stack([cv2.perspectiveTransform(uv[None, :, k].copy(), warp[k])[0] for k in range(FRAMES)], axis=1)
    visible = ((uv > 0) & (uv < [W, H])).all(-1)
    tracks = Tracks(flat.astype(np.float32), visible, np.zeros(len(uv), int), ProviderInfo("made", "0", "Apache-2.0"))
    return tracks, warp, (R, t), q


def angle(fit):
    a = fit.T_camera_world[:3, :3] @ fit.axis
    return np.degrees(np.arccos(min(1.0, abs(a @ AXIS))))


def test_the_path_is_known_from_what_rests():
    tracks, warp, (R, t), _ = scene()
    flat = np.where(tracks.visible[..., None], tracks.uv, np.nan).astype(float)
    path = path_from_rest(filmed(flat, warp) - CENTRE, flat - CENTRE, np.arange(160), FOCAL)
    assert path is not None and len(path.ids) > 140
    assert path.sigma == pytest.approx(0.1, rel=0.15)
    centre = lambda R, t: -np.einsum("tji,tj->ti", R, t)  # noqa: E731
    found, true = centre(path.R, path.t), centre(R, t)
    found *= np.sum(found * true) / np.sum(found**2)  # the scale is free
    assert np.linalg.norm(found - true, axis=1).max() < 0.1 * np.linalg.norm(true, axis=1).max()
    assert np.degrees(Rotation.from_matrix(path.R @ np.swapaxes(R, 1, 2)).magnitude()).max() < 0.1


def test_tracks_go_back_to_the_picture_as_filmed():
    tracks, warp, _, _ = scene(rest=60, link=10)
    back = filmed(tracks.uv.astype(float), warp)
    again = np.stack([cv2.perspectiveTransform(back[None, :, k], warp[k])[0] for k in range(FRAMES)], axis=1)
    np.testing.assert_allclose(again, tracks.uv, atol=1e-3)
    assert np.isnan(filmed(np.full((2, FRAMES, 2), np.nan), warp)).all()


def test_a_door_before_a_hand_held_camera_is_as_exact_as_its_tracks():
    tracks, warp, _, q = scene()
    fit = fit_joint(replace(make_video(FRAMES), warp=warp), tracks, FOCAL, camera_moving=False)
    assert fit.type == "revolute" and fit.verdict == "ok", fit.reason
    assert "its path is fitted" in fit.reason
    assert angle(fit) < min(0.3, 3 * fit.std["axis_deg"])
    assert np.abs(fit.q - q).max() < 0.01


def test_a_link_that_errs_does_not_bend_the_path():
    """The link's tracks are ten times as noisy as the scene's, which hold the camera."""
    tracks, warp, _, q = scene(noise=0.07, link_noise=0.7)
    fit = fit_joint(replace(make_video(FRAMES), warp=warp), tracks, FOCAL, camera_moving=False)
    assert fit.type == "revolute", fit.reason
    assert angle(fit) < 3 * fit.std["axis_deg"] < 6
    assert np.abs(fit.q - q).max() < 0.05


def test_where_too_little_rests_the_result_says_what_was_done():
    tracks, warp, _, _ = scene(rest=30)
    fit = fit_joint(replace(make_video(FRAMES), warp=warp), tracks, FOCAL, camera_moving=False)
    assert fit.verdict == "refused" or "taken to its first view" in fit.reason


def test_what_is_carried_before_a_hand_held_camera_is_refused():
    tracks, warp, _, _ = scene(body="carried")
    fit = fit_joint(replace(make_video(FRAMES), warp=warp), tracks, FOCAL, camera_moving=False)
    assert fit.verdict == "refused", fit.type_probability

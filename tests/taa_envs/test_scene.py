"""Scenes: who touches whom, and a camera that sees what the video's saw."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from taa_envs.asset import Asset, save_asset
from taa_envs.errors import UnknownHand
from taa_envs.hands.points import BONES, PointsHand, sphere_weights
from taa_envs.scene import build_scene
from tests.taa_envs.made import camera_of, door_arguments


def test_actuators_act_on_the_hand_only(door: Asset) -> None:
    scene = build_scene(door)
    model = scene.model
    joint = model.joint("joint").id
    assert model.nu == model.nv - 1 and model.neq == 0 and model.ntendon == 0
    assert joint not in model.actuator_trnid[:, 0]
    assert (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)).all()


def test_hand_touches_the_moving_link_only(door: Asset) -> None:
    for touch_static in (False, True):
        model = build_scene(door, touch_static=touch_static).model
        kind = np.full(model.ngeom, "none", dtype=object)
        touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        for i in np.flatnonzero(touching):
            body = model.body(model.geom_bodyid[i]).name
            kind[i] = "hand" if body.startswith("hand") else body
        meets = set()
        for a in np.flatnonzero(touching):
            for b in np.flatnonzero(touching):
                if model.geom_contype[a] & model.geom_conaffinity[b]:
                    meets.add(frozenset((kind[a], kind[b])))
        expected = {frozenset(("hand", "moving"))} | ({frozenset(("hand", "static"))} if touch_static else set())
        assert meets == expected


def test_floor_is_below_the_links_everywhere_in_the_range(drawer: Asset) -> None:
    scene = build_scene(drawer)
    floor = scene.model.geom("floor").pos[2]
    assert floor < 0.0
    assert scene.model.geom("floor").contype == 0


def test_unknown_hand_lists_the_hands(door: Asset) -> None:
    with pytest.raises(UnknownHand, match="'claw'; known: points"):
        build_scene(door, "claw")


def test_weights_interpolate_landmarks() -> None:
    weights = sphere_weights()
    np.testing.assert_allclose(weights.sum(1), 1)
    np.testing.assert_array_equal(weights[:21], np.eye(21))
    assert (weights >= 0).all() and len(BONES) == 20
    assert {frozenset((a, b)) for a, b, _ in BONES} >= {frozenset((0, k)) for k in (1, 5, 9, 13, 17)}


def test_spheres_follow_a_moving_target_closely(door: Asset) -> None:
    scene = build_scene(door, PointsHand())
    data = mujoco.MjData(scene.model)
    start = door.reference.hand_joints[0] + [0, 0.5, 0]
    scene.hand.place(data, start)
    velocity = np.array([0.0, 0.3, 0.1])
    for i in range(300):
        scene.hand.control(data, start + velocity * (0.002 * i + scene.hand.lead))
        mujoco.mj_step(scene.model, data)
    np.testing.assert_allclose(scene.hand.landmarks(data), start + velocity * 0.002 * 300, atol=1e-3)


def test_total_force_is_limited(door: Asset) -> None:
    scene = build_scene(door)
    data = mujoco.MjData(scene.model)
    joints = door.reference.hand_joints[0]
    scene.hand.place(data, joints)
    scene.hand.control(data, joints + 1.0)
    mujoco.mj_forward(scene.model, data)
    force = np.linalg.norm(data.actuator_force[scene.hand.act], axis=1).sum()
    assert 0.9 * 60 < force <= 60.001


def test_landmarks_are_a_copy(door: Asset) -> None:
    scene = build_scene(door)
    data = mujoco.MjData(scene.model)
    scene.hand.landmarks(data)[:] = 9
    assert not data.qpos.any()


def test_video_camera_projects_as_the_videos_did(tmp_path) -> None:
    arguments = door_arguments()
    camera = camera_of((0.9, 1.3, 0.9), (0.2, 0, 0.3), focal=430.0, width=640, height=360)
    camera["K"][0][2] += 55.0
    camera["K"][1][2] -= 35.0
    arguments["camera"] = camera
    scene = build_scene(save_asset(tmp_path, "door", **arguments), None)
    data = mujoco.MjData(scene.model)
    mujoco.mj_forward(scene.model, data)
    option = mujoco.MjvOption()
    option.geomgroup[:] = [0, 0, 0, 1, 0, 0]
    with mujoco.Renderer(scene.model, 360, 640) as renderer:
        renderer.enable_segmentation_rendering()
        renderer.update_scene(data, camera="video", scene_option=option)
        seen = renderer.render()[..., 0] == scene.model.geom("moving_part1").id
    v, u = np.nonzero(seen)
    corners = arguments["moving"].parts[1][0]
    T = camera["T_camera_world"]
    x = (corners @ T[:3, :3].T + T[:3, 3]) @ np.array(camera["K"]).T
    uv = x[:, :2] / x[:, 2:]
    np.testing.assert_allclose([u.min(), v.min()], uv.min(0), atol=1.5)
    np.testing.assert_allclose([u.max(), v.max()], uv.max(0), atol=1.5)


def test_link_is_rendered_in_its_colours(door: Asset) -> None:
    scene = build_scene(door, None)
    data = mujoco.MjData(scene.model)
    mujoco.mj_forward(scene.model, data)
    with mujoco.Renderer(scene.model, 240, 320) as renderer:
        renderer.update_scene(data, camera="video")
        picture = renderer.render().astype(float)
        renderer.enable_segmentation_rendering()
        renderer.update_scene(data, camera="video")
        wood = renderer.render()[..., 0] == scene.model.geom("moving_visual").id
    mean = np.median(picture[wood], axis=0)
    np.testing.assert_allclose(mean / mean.sum(), np.array([176, 124, 78]) / 378, atol=0.04)
    assert mean[0] > 80

"""Hands measured in space are used as they are, and what they hold that the geometry lacks is assumed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from reconstruct.cues import Hands
from reconstruct.geometry import Geometry
from reconstruct.hand.align import align_hand
from reconstruct.hand.grip import RADII, SPHERES, Grip, Sighting, pushing_spheres
from reconstruct.hand.holds import assumed_handle, holding
from reconstruct.hand.pnp import hand_positions
from reconstruct.hand.scale import hand_scale, rescale
from reconstruct.hand.shape import LinkShape, drive_direction
from taa_envs.authoring import save_asset
from taa_envs.replay import replay
from tests.reconstruct.hand_scenes import Scene, make_scene


def measured(scene: Scene, std: float = 0.01, noise: float = 0.0, offset: float = 0.0) -> Hands:
    """The scene's hand as somebody measured it in space: true but for a common offset along x and noise, m."""
    T = scene.fit.T_camera_world
    rng = np.random.default_rng(5)
    camera = scene.joints @ T[:3, :3].T + T[:3, 3] + [offset, 0.0, 0.0]
    camera = camera + gaussian_filter1d(rng.normal(0, 2 * noise, camera.shape), 1.5, axis=0)
    track = scene.hands.tracks[0]
    placed = np.where(track.valid[:, None, None], camera, np.nan)
    return replace(scene.hands, tracks=(replace(track, placed=placed, placed_std=std),))


def bare(geometry: Geometry) -> Geometry:
    """A drawer whose handle nobody recovered: the parts in front of its front board are gone."""
    front = min(v[:, 1].min() for v, _ in geometry.moving.parts if np.ptp(v[:, 0]) > 0.3)
    parts = tuple(p for p in geometry.moving.parts if p[0][:, 1].min() >= front - 1e-6)
    vertices = np.concatenate([v for v, _ in parts])
    starts = np.cumsum([0, *[len(v) for v, _ in parts[:-1]]])
    faces = np.concatenate([f + a for (_, f), a in zip(parts, starts, strict=True)])
    moving = replace(geometry.moving, vertices=vertices, faces=faces, parts=parts,
                     colors=np.full((len(vertices), 4), 200, np.uint8), assumed=np.zeros(len(faces), bool))  # fmt: skip
    return replace(geometry, moving=moving)


def test_measured_landmarks_are_returned_as_they_are() -> None:
    scene = make_scene("drawer")
    hand = measured(scene, 0.004).tracks[0]
    camera, std = hand_positions(hand, scene.fit.K)
    np.testing.assert_array_equal(camera, hand.placed)
    assert (std[hand.valid] == 0.004).all() and np.isnan(std[~hand.valid]).all()


def test_measured_hand_gives_the_scale_with_less_doubt() -> None:
    scene = make_scene("drawer")
    unit = replace(rescale(scene.fit, 1 / 0.7, 0.0, "none"), metric=False)
    metric = hand_scale(unit, measured(scene), scene.video.time)
    factor = np.linalg.norm(metric.T_camera_world[:3, 3]) / np.linalg.norm(unit.T_camera_world[:3, 3])
    assert abs(np.log(factor / 0.7)) < 0.08 and metric.std["scale"] < 0.05


@pytest.mark.parametrize("name", ["laptop", "oven"])
def test_measured_hand_stays_where_it_was_measured(name: str) -> None:
    scene = make_scene(name)
    reference = align_hand(scene.video, measured(scene, noise=0.003), scene.fit, scene.geometry)
    off = np.linalg.norm(reference.hand_joints - scene.joints, axis=-1)
    assert reference.contact.sum() > 20 and np.median(off[reference.contact]) < 0.02
    assert "measured in space" in reference.notes[0] and not reference.holds
    assert 0.01 <= reference.std["across"] <= 0.025 and 0.01 <= reference.std["offset"] <= 0.03


def test_a_handle_that_geometry_lacks_is_assumed_where_the_hand_pulls(tmp_path) -> None:
    scene = make_scene("drawer", 1)
    geometry = bare(scene.geometry)
    hands = measured(scene, noise=0.002)
    reference = align_hand(scene.video, hands, scene.fit, geometry)
    assert reference.holds and any("handle is assumed" in note for note in reference.notes)
    off = np.linalg.norm(reference.hand_joints - scene.joints, axis=-1)
    assert np.median(off[reference.contact]) < 0.025
    whole = holding(geometry, reference.holds)
    assert whole.provenance["moving.handle"]["origin"] == "assumed"
    assert len(whole.moving.parts) == len(geometry.moving.parts) + len(reference.holds)
    added = len(whole.moving.faces) - len(geometry.moving.faces)
    assert added > 0 and whole.moving.assumed[-added:].all() and whole.moving.faces.max() < len(whole.moving.vertices)
    # In front of the board and within a finger's breadth or two of the true handle.
    true = np.concatenate([v for v, _ in scene.geometry.moving.parts])
    bar, handle = reference.holds[0][0].mean(0), true[true[:, 1] < true[:, 1].min() + 0.011].mean(0)
    assert np.linalg.norm(bar - handle) < 0.05
    joint = {"type": scene.fit.type, "axis": scene.fit.axis, "point": scene.fit.point}
    asset = save_asset(tmp_path, "bare", joint=joint, static=whole.static, moving=whole.moving, reference=reference)
    result = replay(asset)
    assert result.joint_progress >= 0.9 and max(result.controls.values()) < 0.05


def gripping(scene: Scene) -> tuple[LinkShape, np.ndarray, np.ndarray]:
    """The drawer without its handle, the true hand in its frame, and the viewing ray."""
    fit = scene.fit
    camera = -fit.T_camera_world[:3, :3].T @ fit.T_camera_world[:3, 3]
    ray = scene.joints[50].mean(0) - camera
    hand = scene.joints[50] - fit.link_pose(fit.q)[50, :3, 3]
    return LinkShape(bare(scene.geometry).moving), hand, ray / np.linalg.norm(ray)


def test_no_handle_is_assumed_far_from_the_part() -> None:
    scene = make_scene("drawer")
    shape, grip, ray = gripping(scene)
    assert assumed_handle(shape, scene.fit, 1.0, grip, ray) is not None
    assert assumed_handle(shape, scene.fit, 1.0, grip + [0.0, -0.2, 0.0], ray) is None
    assert assumed_handle(shape, scene.fit, 1.0, grip + 0.4 * ray, ray) is None  # would have to come 40 cm nearer


def test_an_assumed_handle_holds_a_hand_that_is_a_centimetre_off() -> None:
    """The tips' place is known no better; on a bar as narrow as that the replay was a matter of luck."""
    scene = make_scene("drawer")
    shape, grip, ray = gripping(scene)
    parts, moved = assumed_handle(shape, scene.fit, 1.0, grip, ray)
    bar = shape.with_parts(parts[:1])
    forward = drive_direction(scene.fit, moved[8], 1.0)
    on = pushing_spheres(bar, scene.fit, 1.0, moved)[[8, 12, 16]]
    assert on.any()
    for across in np.linalg.svd(forward[None])[2][1:]:
        for shift in (-0.01, 0.01):
            still = pushing_spheres(bar, scene.fit, 1.0, moved + shift * across)[[8, 12, 16]]
            assert still[on].all(), (across, shift)


def test_a_hand_sunk_into_the_surface_comes_towards_the_camera_before_a_handle_is_put_there() -> None:
    scene = make_scene("drawer")
    shape, grip, ray = gripping(scene)
    sunk = grip + 0.04 * ray
    parts, moved = assumed_handle(shape, scene.fit, 1.0, sunk, ray)
    assert shape.distance(moved[[8, 12, 16]])[0].min() >= RADII[8] > shape.distance(sunk[[8, 12, 16]])[0].min()
    np.testing.assert_allclose(np.cross(moved - sunk, ray), 0.0, atol=1e-12)
    # The tips press on the bar by millimetres.
    bar = shape.with_parts(parts[:1])
    deep = np.maximum(RADII - bar.distance(SPHERES @ moved)[0], 0) - np.maximum(
        RADII - shape.distance(SPHERES @ moved)[0], 0)  # fmt: skip
    assert 0.001 < deep[[8, 12, 16]].max() < 0.006


def test_how_far_a_grip_is_off() -> None:
    grip = Grip(np.zeros((21, 3)), "push", np.array([0.03, 0.04, 0.0]), 0.2, 3, 0, 0.0)
    ray = np.array([1.0, 0.0, 0.0])
    assert Sighting(0.03, 0.04, 0.2).off(grip, ray) == pytest.approx(np.sqrt(3))
    assert Sighting.measured(0.01).off(grip, ray) == pytest.approx(np.sqrt(9 + 16 + 4))

"""Hands in space: position, driving hand, scale, and demonstrations that drive the part through contact."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reconstruct.cues import Hands, HandTrack
from reconstruct.hand.align import align_hand
from reconstruct.hand.drive import _affine as onward
from reconstruct.hand.drive import close_gaps, find_drive, runs
from reconstruct.hand.grip import penetration
from reconstruct.hand.pnp import hand_positions
from reconstruct.hand.scale import hand_scale, rescale
from reconstruct.hand.shape import LinkShape, lever
from reconstruct.hand.skeleton import ADULT, HAND_SIZE_STD, PALM, bone_lengths, one_anatomy, reach
from taa_envs.authoring import save_asset
from taa_envs.replay import replay
from tests.reconstruct.hand_scenes import Scene, make_scene


def replayed(scene: Scene, reference, folder) -> dict:
    joint = {"type": scene.fit.type, "axis": scene.fit.axis, "point": scene.fit.point}
    asset = save_asset(folder, "trial", joint=joint, static=scene.geometry.static, moving=scene.geometry.moving,
                       reference=reference)  # fmt: skip
    return replay(asset).as_dict()


def held_still(track: HandTrack, frame: int) -> HandTrack:
    n = len(track.valid)
    return replace(track, uv=np.repeat(track.uv[frame : frame + 1], n, 0), valid=np.ones(n, bool),
                   metric=np.repeat(track.metric[frame : frame + 1], n, 0))  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seed"), [("demo", 0), ("laptop", 1), ("drawer", 1), ("oven", 0), ("puncher", 0)])
def test_a_monocular_hand_becomes_one_that_drives_the_part(name: str, seed: int, tmp_path) -> None:
    scene = make_scene(name, seed)
    reference = align_hand(scene.video, scene.hands, scene.fit, scene.geometry)
    assert np.isfinite(reference.hand_joints).all()
    result = replayed(scene, reference, tmp_path)
    assert result["joint_progress"] >= 0.9
    # A hand that waits at the part, as on the short stroke of the puncher, touches it and does not press.
    assert max(result["controls"].values()) <= 0.05
    assert result["contact_fraction"] > 0.8
    # Contact is claimed only while the true hand holds on, and in most of the frames in which it moves the part.
    moves = np.abs(np.gradient(scene.fit.q)) > 0.1 * np.abs(np.gradient(scene.fit.q)).max()
    assert not reference.contact[~scene.contact].any()
    assert reference.contact[moves].mean() > 0.8
    assert not reference.hand_valid[40:48].any()
    assert any("not seen" in note for note in reference.notes)
    # Anatomy stays one, and the hand stays near the true one.
    assert np.linalg.norm(reference.hand_joints - scene.joints, axis=-1).mean(1)[moves].max() < 0.09
    # No jumps: a person's hand stays below 3 m/s.
    speed = np.linalg.norm(np.diff(reference.hand_joints, axis=0), axis=-1).max() * 30
    assert speed < 3.0


def test_it_is_told_when_only_fingers_beyond_the_edge_say_who_drives() -> None:
    scene = make_scene("oven")
    points = LinkShape(scene.geometry.moving).points
    arm = lever(scene.fit, points)
    whole = find_drive(scene.hands, scene.fit, scene.video.time, points)
    part = find_drive(scene.hands, scene.fit, scene.video.time, points[arm < 0.5 * arm.max()])
    assert (whole.index, whole.beyond) == (0, False)
    assert (part.index, part.beyond) == (0, True)


@given(st.integers(0, 1000), st.floats(-0.5, 0.5), st.floats(0.8, 1.2))
def test_what_goes_on_beyond_the_edge_moves_on_as_the_part(seed: int, angle: float, zoom: float) -> None:
    rng = np.random.default_rng(seed)
    before, beyond = rng.uniform(0, 100, (40, 2)), rng.uniform(120, 160, (5, 2))
    A = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    assert np.allclose(onward(before, before @ A.T + 7, beyond), beyond @ A.T + 7)
    # Seen edge-on: along its line the motion goes on, beside it nothing is known and it moves as the line does there.
    line = before * [1, 0]
    assert np.allclose(onward(line, line + [0, 5], beyond), beyond + [0, 5])


def test_a_still_part_has_no_driving_hand() -> None:
    scene = make_scene("demo")
    # The part springs open by itself: same joint motion, but the hand never leaves its first place.
    track = scene.hands.tracks[0]
    there = held_still(track, 22)
    hands = Hands((there,), scene.hands.mask, scene.hands.provider)
    drive = find_drive(hands, scene.fit, scene.video.time)
    assert drive.index is None
    reference = align_hand(scene.video, hands, scene.fit, scene.geometry)
    assert not reference.contact.any() and not reference.hand_valid.any()
    assert "no hand moves with the part" in reference.notes[0]
    assert penetration(LinkShape(scene.geometry.moving), reference.hand_joints[0]).max() == 0


def test_no_hand_at_all_is_said() -> None:
    scene = make_scene("demo")
    reference = align_hand(scene.video, Hands((), scene.hands.mask, scene.hands.provider), scene.fit, scene.geometry)
    assert not reference.contact.any()
    assert "no hand was seen" in reference.notes[0]


def test_the_hand_that_moves_with_the_part_is_chosen() -> None:
    scene = make_scene("drawer")
    right = scene.hands.tracks[0]
    still = replace(held_still(right, 20), side="left")
    drive = find_drive(Hands((still, right), scene.hands.mask, scene.hands.provider), scene.fit, scene.video.time)
    assert drive.index == 1


def test_scale_comes_from_the_hand_within_its_stated_error() -> None:
    errors = []
    for name, seed in (("demo", 0), ("laptop", 0), ("drawer", 0), ("oven", 1)):
        scene = make_scene(name, seed, hand_size=1.0, drift=0.05)
        unit = replace(rescale(scene.fit, 1 / 0.7, 0.0, "none"), metric=False)
        metric = hand_scale(unit, scene.hands, scene.video.time)
        assert metric.metric and metric.scale_source == "hand"
        factor = np.linalg.norm(metric.T_camera_world[:3, 3]) / np.linalg.norm(unit.T_camera_world[:3, 3])
        errors.append(np.log(factor / 0.7) / metric.std["scale"])
        # The picture is the same.
        np.testing.assert_allclose(metric.project(metric.points), unit.project(unit.points), atol=1e-6)
    assert np.abs(errors).max() < 2.0
    nobody = hand_scale(unit, Hands((), scene.hands.mask, scene.hands.provider), scene.video.time)
    assert not nobody.metric and nobody.scale_source == "none"
    np.testing.assert_array_equal(nobody.points, unit.points)


def test_position_from_one_view() -> None:
    scene = make_scene("laptop", hand_size=1.0, drift=0.0, pixel_noise=0.5)
    camera, std = hand_positions(scene.hands.tracks[0], scene.fit.K)
    T = scene.fit.T_camera_world
    true = scene.joints @ T[:3, :3].T + T[:3, 3]
    valid = scene.hands.tracks[0].valid
    assert np.isnan(camera[~valid]).all() and np.isnan(std[~valid]).all()
    depth, wanted = camera[valid][..., 2].mean(1), true[valid][..., 2].mean(1)
    assert np.median(np.abs(depth / wanted - 1)) < 0.06
    assert (std[valid] >= 0.999 * HAND_SIZE_STD * depth).all()


def test_fingers_lie_on_their_rays_one_bone_apart() -> None:
    """Where a bone can reach its landmark's ray it does; its length is the mean adult's either way."""
    scene = make_scene("laptop", hand_size=1.0, drift=0.0, pixel_noise=0.0)
    track = scene.hands.tracks[0]
    camera, _ = hand_positions(track, scene.fit.K)
    frames = np.flatnonzero(track.valid)[::10]
    fingers = [j for j in range(1, 21) if j not in PALM]
    lengths = bone_lengths(camera[frames])
    np.testing.assert_allclose(lengths[:, fingers], np.broadcast_to(ADULT[fingers], (len(frames), len(fingers))),
                               atol=1e-9)  # fmt: skip
    image = camera[frames] @ scene.fit.K.T
    off = np.linalg.norm(image[..., :2] / image[..., 2:] - track.uv[frames], axis=-1)[:, fingers]
    assert np.mean(off < 1e-3) > 0.6


def test_wrong_bone_directions_do_not_move_the_hand() -> None:
    """The network's fingers may be foreshortened as they like: depth comes from the palm in the picture."""
    scene = make_scene("laptop", hand_size=1.0, drift=0.0, pixel_noise=0.5)
    track = scene.hands.tracks[0]
    squeezed = replace(track, metric=track.metric * [1.0, 1.0, 0.5])
    plain, other = (hand_positions(t, scene.fit.K)[0][..., 2].mean(1) for t in (track, squeezed))
    assert np.nanmedian(np.abs(other / plain - 1)) < 0.05


def test_one_anatomy_keeps_directions() -> None:
    rng = np.random.default_rng(0)
    joints = rng.normal(0, 0.05, (6, 21, 3))
    joints[2] = np.nan
    out = one_anatomy(joints)
    assert np.isnan(out[2]).all()
    seen = np.delete(out, 2, axis=0)
    np.testing.assert_allclose(bone_lengths(seen), np.broadcast_to(bone_lengths(seen)[0], (5, 21)), atol=1e-9)


@pytest.mark.parametrize("target", [(0.03, 0.02, 0.0), (0.5, 0.0, 0.0)])
def test_reach_keeps_bones(target: tuple[float, ...]) -> None:
    chain = np.array([[0, 0, 0], [0.04, 0, 0], [0.065, 0.005, 0], [0.08, 0.012, 0]])
    bent = reach(chain, np.array(target))
    np.testing.assert_allclose(np.linalg.norm(np.diff(bent, axis=0), axis=1),
                               np.linalg.norm(np.diff(chain, axis=0), axis=1), atol=1e-6)  # fmt: skip
    np.testing.assert_array_equal(bent[0], chain[0])
    if np.linalg.norm(target) < 0.08:
        np.testing.assert_allclose(bent[-1], target, atol=1e-3)


def test_distance_to_a_box() -> None:
    shape = LinkShape(make_scene("drawer").geometry.moving)
    assert (shape.distance(shape.points + 0.01 * shape.normals)[0] <= 0.0101).all()
    np.testing.assert_allclose(shape.distance(shape.points)[0], 0.0, atol=1e-6)
    assert shape.distance(shape.centre + [0.0, 0.0, 5.0])[0] > 4.0


def test_thickness_along_a_ray() -> None:
    """A ray square to the drawer's front meets its 17 mm; beside it, or looking away, nothing."""
    shape = LinkShape(make_scene("drawer").geometry.moving)
    x = np.array([[0.15, -0.5, 0.20], [0.15, -0.5, 0.9], [0.15, -0.01, 0.20], [0.15, 2.0, 0.20]])
    along = shape.thickness(x, np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(along[[1, 3]], 0.0)
    assert along[0] > 0.015 and along[2] > 0.005
    np.testing.assert_allclose(shape.thickness(x[:1], np.array([0.0, -1.0, 0.0])), 0.0)


def test_runs_and_gaps() -> None:
    flags = np.array([0, 1, 1, 0, 1, 0, 0, 0, 1], bool)
    assert runs(flags) == [(1, 3), (4, 5), (8, 9)]
    assert runs(close_gaps(flags, 1)) == [(1, 5), (8, 9)]


def test_a_hand_that_is_missed_for_a_moment_drove_the_part_before_too() -> None:
    scene = make_scene("drawer", gap=None)
    track, lost = scene.hands.tracks[0], 50
    uv, valid = track.uv.copy(), track.valid.copy()
    # Before, the landmarks shake by more than the part moves in the picture: that the hand drives cannot be seen there.
    shake = np.random.default_rng(0).choice([-1.0, 1.0], lost) * np.linalg.norm(uv[lost, 0] - uv[lost, 9]) * 0.4
    uv[:lost] += shake[:, None, None]
    valid[lost] = False
    hands = Hands((replace(track, uv=uv, valid=valid),), scene.hands.mask, scene.hands.provider)
    drive = find_drive(hands, scene.fit, scene.video.time)
    assert drive.index == 0 and not drive.drives[:lost - 10].any()
    begins, ends = np.flatnonzero(scene.contact)[[0, -1]]
    first, last = np.flatnonzero(drive.attached)[[0, -1]]
    assert abs(first - begins) < 12 and abs(last - ends) < 12

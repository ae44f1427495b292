"""Masks, meshes and their clearance on a drawn slab whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from reconstruct.errors import TaaError
from reconstruct.geometry import Geometry, LinkMesh
from reconstruct.geometry.collision import contacts_over_range, convex_parts, keep_clear, trim_parts
from reconstruct.geometry.layers import (
    fill,
    frame_costs,
    gather,
    make_chart,
    resting_cells,
    seed_polygon,
    warp_to_image,
)
from reconstruct.geometry.links import build_geometry
from reconstruct.geometry.masks import segment_links
from reconstruct.geometry.outline import reach_behind
from reconstruct.geometry.plane import LinkPlane, fit_plane, homography, working_matrix
from reconstruct.geometry.solids import hull, swept_hulls, to_arrays
from reconstruct.joint.models import JointFit
from tests.reconstruct.geometry_scenes import make_scene


@pytest.fixture(scope="module")
def door():
    scene = make_scene("revolute")
    return scene, segment_links(scene.video, scene.hands, scene.tracks, scene.fit)


@pytest.fixture(scope="module")
def door_geometry(door):
    scene, masks = door
    return build_geometry(scene.video, scene.hands, scene.tracks, scene.fit, masks)


def _iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def _box(low, high):
    v = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])], float)
    return to_arrays(hull(v))


def test_the_plane_is_the_doors_and_holds_the_axis(door):
    scene, _ = door
    plane = fit_plane(scene.tracks, scene.fit)
    assert plane.kind == "holds the axis"
    assert abs(plane.pose[1, 2]) > np.cos(np.radians(4))
    assert plane.inlier.mean() > 0.8


def test_masks_follow_the_link_and_leave_out_the_hand(door):
    scene, masks = door
    ious = [_iou(masks.moving[t], scene.masks[t]) for t in range(len(scene.video))]
    # Edge-on, the slab's rim is most of it, and a few pixels decide.
    frontal = np.abs(fit_plane(scene.tracks, scene.fit).facing) > 0.35
    assert np.mean(ious) > 0.9 and np.min(np.array(ious)[frontal]) > 0.85
    assert not (masks.moving & masks.hand).any()
    assert not (masks.moving & masks.static).any()
    assert masks.confidence.shape == (len(scene.video),) and (masks.confidence <= 1).all()


def test_the_outline_of_an_even_link_grows_beyond_its_points():
    """It goes less than its own height: above its points it is its own background until the outline has grown."""
    scene = make_scene("revolute", hand=False, plain=True)
    low = np.asarray(scene.fit.points)[:, 2] < 0.2
    fit = replace(scene.fit, points=scene.fit.points[low], point_track=scene.fit.point_track[low])
    plane = fit_plane(scene.tracks, fit)
    costs = frame_costs(scene.video, scene.tracks, fit, scene.hands.mask)
    face = np.array([[0.0, -0.01, 0.0], [0.4, -0.01, 0.0], [0.4, -0.01, 0.3], [0.0, -0.01, 0.3]])

    def right(rounds: int) -> float:
        evidence = gather(scene.video, scene.hands, scene.tracks, fit, plane, costs, rounds=rounds)
        return _iou(evidence.occupied, fill(evidence.chart, plane.to_plane(face)[:, :2]))

    few, many = right(2), right(20)
    assert few < 0.4 and many > 0.7


@pytest.mark.parametrize("strays", [0, 3])
@pytest.mark.parametrize(("rim", "told"), [(30, True), (4, False)])
def test_points_on_a_rim_tell_how_far_back_it_goes(rim, told, strays):
    """Of 100 on the face and so many spread over a rim 30 mm deep, with some far behind it."""
    rng = np.random.default_rng(0)
    spread = np.concatenate([rng.normal(0, 3e-4, 100), -rng.uniform(0, 0.03, rim), -rng.uniform(0.05, 0.15, strays)])
    beside = np.arange(len(spread)) >= 100
    plane = LinkPlane(np.eye(4), "free", 0.2, spread, np.ones(len(spread), bool), beside, 0.4, np.ones(5))
    found = reach_behind(plane)
    assert 0.018 < found < 0.031 if told else found == 0.0


def test_points_seen_at_rest_lie_beside_the_link(door):
    scene, _ = door
    video, fit = scene.video, scene.fit
    plane = fit_plane(scene.tracks, fit)
    chart = make_chart(seed_polygon(fit, plane))
    frames = np.arange(0, len(video), 4)
    h, w = video.frames.shape[1:3]
    y, x = np.mgrid[6 : h - 6 : 8, 6 : w - 6 : 8].reshape(2, -1)
    # A grid of points at rest, seen where the link and the hand are not.
    clear = ~np.stack([cv2.dilate((m | a).astype(np.uint8), np.ones((7, 7))) > 0
                       for m, a in zip(scene.masks, scene.hands.mask, strict=True)])  # fmt: skip
    visible = clear[:, y, x].T
    uv = np.repeat(video.to_full(np.stack([x, y], -1).astype(float))[:, None], len(video), axis=1)
    room = replace(scene.tracks, uv=np.where(visible[..., None], uv, np.nan), visible=visible)
    cells = resting_cells(video, room, fit, plane, chart, frames)
    H = working_matrix(video) @ homography(fit, plane, fit.q[frames])
    drawn = np.stack([warp_to_image(chart, c, m, (w, h)) for c, m in zip(cells, H, strict=True)])
    assert drawn.any((1, 2)).mean() > 0.8
    assert (drawn & scene.masks[frames]).sum() < 0.03 * drawn.sum()
    own = replace(scene.tracks, visible=scene.tracks.visible & np.isin(np.arange(len(scene.tracks.uv)),
                                                                      fit.point_track)[:, None])  # fmt: skip
    assert resting_cells(video, own, fit, plane, chart, frames).mean() < 0.001


def test_the_moving_mesh_is_the_slab(door, door_geometry):
    scene, _ = door
    mesh = trimesh.Trimesh(door_geometry.moving.vertices, door_geometry.moving.faces, process=False)
    assert mesh.is_watertight and mesh.volume > 0
    size = np.linalg.norm(scene.high - scene.low)
    low, high = mesh.bounds
    assert np.abs(low - scene.low).max() < 0.06 * size
    assert np.abs(high - scene.high).max() < 0.06 * size


def test_both_links_are_closed_and_coloured(door_geometry):
    for link in (door_geometry.moving, door_geometry.static):
        mesh = trimesh.Trimesh(link.vertices, link.faces, process=False)
        assert mesh.is_watertight
        assert link.colors.shape == (len(link.vertices), 4) and link.colors.dtype == np.uint8
        assert link.assumed.shape == (len(link.faces),)
        assert 1 <= len(link.parts) <= 16
    assert door_geometry.static.assumed.all()
    assert not door_geometry.moving.assumed.all()


def test_the_front_has_the_videos_colour(door_geometry):
    seen = ~door_geometry.moving.assumed
    rgb = door_geometry.moving.colors[door_geometry.moving.faces[seen]][..., :3].mean((0, 1))
    assert rgb[0] > rgb[1] > rgb[2]


def test_links_stay_clear_over_the_range(door, door_geometry):
    assert door_geometry.provenance["contacts_over_range"]["value"] == 0
    scene, _ = door
    again = contacts_over_range(door_geometry.moving.parts, door_geometry.static.parts, scene.fit, states=60)
    assert again["contacts"] == 0


def test_every_number_says_where_it_comes_from(door_geometry):
    for entry in door_geometry.provenance.values():
        assert entry["origin"] in ("observed", "fitted", "assumed", "given")


def test_an_overlap_is_seen_and_trimmed_away(door):
    scene, _ = door
    moving = (_box(scene.low, scene.high),)
    blocked = (_box([0.1, -0.2, 0.05], [0.2, -0.1, 0.2]), _box([-0.3, 0.05, 0.0], [0.3, 0.1, 0.2]))
    bad = contacts_over_range(moving, blocked, scene.fit)
    assert bad["contacts"] > 0 and bad["penetration"] > 0
    kept = trim_parts(blocked, swept_hulls(moving, scene.fit, 0.004))
    assert contacts_over_range(moving, kept, scene.fit)["contacts"] == 0
    assert len(kept) >= 1


def test_static_keeps_out_of_the_hands_way(door, door_geometry):
    scene, masks = door
    middle = door_geometry.static.vertices.mean(0)
    cloud = middle + np.random.default_rng(0).normal(size=(6, 21, 3)) * 0.02
    made = build_geometry(scene.video, scene.hands, scene.tracks, scene.fit, masks, hand_points=cloud)
    for vertices, faces in made.static.parts:
        # The parts are convex: a point is inside if it is behind every face.
        part = trimesh.Trimesh(vertices, faces, process=False)
        above = (cloud.reshape(-1, 1, 3) - part.triangles_center) * part.face_normals
        assert (above.sum(-1).max(axis=1) > -1e-6).all()


def test_a_slide_in_another_unit():
    scene = make_scene("prismatic", unit=37.0)
    masks = segment_links(scene.video, scene.hands, scene.tracks, scene.fit)
    made = build_geometry(scene.video, scene.hands, scene.tracks, scene.fit, masks)
    size = np.linalg.norm(scene.high - scene.low)
    span = np.ptp(made.moving.vertices, axis=0)
    assert abs(span[0] - 0.4 * 37) < 0.1 * size and abs(span[2] - 0.3 * 37) < 0.1 * size
    assert made.provenance["contacts_over_range"]["value"] == 0


def test_same_input_same_mesh(door, door_geometry):
    scene, masks = door
    again = build_geometry(scene.video, scene.hands, scene.tracks, scene.fit, masks)
    assert np.array_equal(again.moving.vertices, door_geometry.moving.vertices)
    assert np.array_equal(again.static.vertices, door_geometry.static.vertices)


def test_no_silhouette_is_refused(door):
    scene, masks = door
    with pytest.raises(TaaError, match="silhouette"):
        build_geometry(scene.video, scene.hands, scene.tracks, scene.fit,
                       replace(masks, moving=np.zeros_like(masks.moving)))


def test_convex_parts_of_an_angle_iron():
    a, b = _box([0, 0, 0], [1, 0.1, 0.1]), _box([0, 0, 0], [0.1, 1, 0.1])
    solid = hull(a[0]) + hull(b[0])
    parts, report = convex_parts(*to_arrays(solid))
    assert 2 <= len(parts) <= 4
    assert abs(report["volume_error"]) < 0.1
    whole, report = convex_parts(*a)
    assert len(whole) == 1 and abs(report["volume_error"]) < 1e-6


def test_a_given_body_in_the_links_way_is_cut_back_and_says_so():
    fit = JointFit("ok", "", "revolute", {"revolute": 1.0}, np.array([0.0, 0, 1]), np.array([-0.2, -0.02, 0.2]), None,
                   np.linspace(-1.2, 0.0, 5), np.arange(5), np.eye(3), np.eye(4), np.zeros((3, 3)), np.arange(3), True,
                   "given", {}, None, 0.5, 3, 3, None)  # fmt: skip
    # The body reaches 1 cm into the door.
    door, body = _box([-0.2, -0.05, 0.0], [0.2, -0.02, 0.4]), _box([-0.2, -0.03, 0.0], [0.2, 0.25, 0.4])
    link = lambda p: LinkMesh(p[0], p[1], np.full((8, 4), 200, np.uint8), np.zeros(12, bool), (p,))  # noqa: E731
    mended = keep_clear(Geometry(link(body), link(door)), fit)
    assert contacts_over_range(mended.moving.parts, mended.static.parts, fit)["contacts"] == 0
    assert mended.notes and "cut back" in mended.notes[0]
    assert mended.provenance["contacts_over_range"]["before_cutting"] > 0
    low, high = mended.static.parts[0][0].min(0), mended.static.parts[0][0].max(0)
    assert (high - low)[1] > 0.2  # most of the body is left
    assert keep_clear(mended, fit) is mended

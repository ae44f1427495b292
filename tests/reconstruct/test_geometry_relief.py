"""What stands on the moving link's face, and shadows that move as it does, on drawn slabs whose truth is known."""

from __future__ import annotations

import numpy as np

from reconstruct.geometry.layers import frame_costs, gather
from reconstruct.geometry.links import build_geometry
from reconstruct.geometry.masks import segment_links
from reconstruct.geometry.outline import trace_face
from reconstruct.geometry.plane import fit_plane
from reconstruct.geometry.relief import find_raised
from tests.reconstruct.geometry_scenes import BAR, make_scene


def _raised(scene):
    masks = segment_links(scene.video, scene.hands, scene.tracks, scene.fit)
    plane = fit_plane(scene.tracks, scene.fit)
    costs = frame_costs(scene.video, scene.tracks, scene.fit, scene.hands.mask)
    face = trace_face(scene.video, scene.hands, scene.fit, plane, masks, costs)
    return find_raised(scene.video, scene.fit, plane, face.outline, masks, costs), plane, masks


def test_a_bar_before_the_face_is_found_where_it_is():
    scene = make_scene("revolute", bar=True)
    (bar,), plane, masks = _raised(scene)
    assert bar.bar and bar.points >= 3
    depth = -0.01 - BAR[0, 1]  # from the face to the bar's front
    assert abs(bar.height - depth) < 0.25 * depth
    corners = np.concatenate([v for v, _ in bar.parts(plane)])
    found = np.stack([corners.min(0), corners.max(0)])
    assert np.abs(found[:, [0, 2]] - BAR[:, [0, 2]]).max() < 0.025
    geometry = build_geometry(scene.video, scene.hands, scene.tracks, scene.fit, masks)
    assert geometry.provenance["moving_raised"]["bars"] == [True]
    assert geometry.provenance["contacts_over_range"]["value"] == 0
    # A finger can reach behind the bar: nothing fills the middle between it and the face.
    middle = np.array([BAR[:, 0].mean(), -0.025, BAR[:, 2].mean()])
    for vertices, _ in geometry.moving.parts:
        assert not ((vertices.min(0) < middle) & (middle < vertices.max(0))).all()


def test_a_bar_on_a_slide_shifts_by_three_pixels_only_and_is_found_still():
    (bar,), plane, _ = _raised(make_scene("prismatic", bar=True))
    depth = -0.01 - BAR[0, 1]
    assert abs(bar.height - depth) < 0.3 * depth
    corners = np.concatenate([v for v, _ in bar.parts(plane)])
    off = corners.mean(0) - BAR.mean(0)
    assert np.abs(off[[0, 2]]).max() < 0.03


def test_nothing_is_raised_on_a_bare_face():
    raised, _, _ = _raised(make_scene("revolute"))
    assert raised == ()


def test_points_on_a_shadow_are_told_from_the_links_own():
    scene = make_scene("prismatic", shadow=True)
    plane = fit_plane(scene.tracks, scene.fit)
    costs = frame_costs(scene.video, scene.tracks, scene.fit, scene.hands.mask)
    shaded = gather(scene.video, scene.hands, scene.tracks, scene.fit, plane, costs).shaded
    own, cast = shaded[:60], shaded[60:]
    assert np.nanmedian(cast) > 0.7 and np.isfinite(cast).sum() >= 6
    assert (own[np.isfinite(own)] > 0.7).mean() < 0.05


def test_a_moving_shadow_is_not_taken_into_the_silhouette():
    scene = make_scene("prismatic", shadow=True)
    masks = segment_links(scene.video, scene.hands, scene.tracks, scene.fit)
    both = (masks.moving & scene.masks).sum((1, 2))
    either = (masks.moving | scene.masks).sum((1, 2))
    assert (both / either).mean() > 0.85

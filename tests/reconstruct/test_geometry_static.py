"""Hidden pixels are unknown, not absent; what stands still is told from its surroundings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reconstruct.geometry.layers import frame_costs, spread_frames
from reconstruct.geometry.outline import fill_unseen
from reconstruct.geometry.standing import Plate, cone, separate
from tests.reconstruct.geometry_scenes import make_scene


def test_unseen_cells_between_link_cells_are_link():
    cells = np.zeros((40, 60), bool)
    cells[5:35, 5:55] = True
    unseen = np.zeros_like(cells)
    unseen[12:25, 40:58] = True
    filled = fill_unseen(cells & ~unseen, unseen)
    assert filled[13:24, 41:54].all()
    assert not filled[:, 56:].any()
    # A hole that frames do show stays one.
    assert not fill_unseen(cells & ~unseen, np.zeros_like(unseen))[13:24, 41:54].any()


def test_of_frames_at_one_state_the_one_without_a_hand_on_the_link_is_taken():
    scene = make_scene("revolute")
    fit = replace(scene.fit, q=np.where(np.arange(len(scene.video)) < 20, 0.0, scene.fit.q))
    nothing = np.zeros_like(scene.hands.mask)
    hand = nothing.copy()
    hand[:20] = True
    hand[7] = False
    # A hand elsewhere in the picture does no harm.
    hand[7, :6, :6] = True
    costs = frame_costs(scene.video, scene.tracks, fit, hand)
    assert costs[7] < costs[:7].min() and costs[7] < costs[8:20].min()
    assert 7 in spread_frames(fit, costs, 12)
    assert (frame_costs(scene.video, scene.tracks, scene.fit, nothing) < 1).mean() > 0.8


def test_a_body_is_told_from_the_table_it_stands_on():
    rng = np.random.default_rng(0)
    image = np.full((120, 160, 3), (90, 140, 190), np.uint8)
    image[40:80, 50:110] = (60, 60, 40)
    image = np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8)
    body = np.zeros(image.shape[:2], bool)
    body[40:80, 50:110] = True
    region = np.zeros_like(body)
    region[30:95, 40:130] = True
    plate = Plate(image, np.ones_like(body), np.eye(3))
    found, contrast = separate(plate, region)
    assert (found & body).sum() / (found | body).sum() > 0.9
    assert contrast > 0.9
    empty = np.zeros_like(body)
    empty[5:35, 5:45] = True
    found, contrast = separate(plate, empty)
    assert found.sum() < 0.5 * empty.sum() or contrast < 0.4


def test_a_cone_projects_to_its_region():
    scene = make_scene("revolute")
    region = np.zeros((120, 160), bool)
    region[40:80, 50:110] = True
    S = np.diag([0.25, 0.25, 1.0])
    plate = Plate(np.zeros((120, 160, 3), np.uint8), np.ones_like(region), S)
    solid = cone(plate, scene.fit, region, 0.5, 2.0)
    corners = np.asarray(solid.to_mesh64().vert_properties)[:, :3]
    uv = scene.fit.project(corners) * 0.25
    assert np.allclose(uv.min(0), [50, 40], atol=1.1) and np.allclose(uv.max(0), [109, 79], atol=1.1)
    z = corners @ scene.fit.T_camera_world[2, :3] + scene.fit.T_camera_world[2, 3]
    assert np.isclose(z.min(), 0.5) and np.isclose(z.max(), 2.0)

"""What slides: a tray is assumed behind a drawer's front, a body beneath what lies flat."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import Polygon, box

from reconstruct.geometry.outline import Shape, Slice
from reconstruct.geometry.plane import LinkPlane
from reconstruct.geometry.solids import carve, extrude, from_arrays, posed, static_box, swept_hulls, to_arrays
from reconstruct.geometry.tray import assume_tray, best_rectangle, with_tray
from reconstruct.joint.models import JointFit

TRAVEL, DEPTH = 0.18, 0.30
OUT = np.array([0.0, -1, 0])
"""A front's normal: towards the camera."""


def slide(axis: np.ndarray, kind: str = "prismatic") -> JointFit:
    q = np.linspace(0.0, TRAVEL, 7)
    return JointFit("ok", "", kind, {kind: 1.0}, axis, None if kind == "prismatic" else np.zeros(3), None, q,
                    np.arange(7), np.eye(3), np.eye(4), np.zeros((3, 3)), np.arange(3), True, "given", {}, None, 0.5, 3,
                    3, None)  # fmt: skip


def face(normal: np.ndarray, u: np.ndarray) -> LinkPlane:
    pose = np.eye(4)
    pose[:3, :3] = np.stack([u, np.cross(normal, u), normal], axis=1)
    return LinkPlane(pose, "free", 0.5, np.zeros(3), np.ones(3, bool), np.zeros(3, bool), 0.5, np.ones(7))


def slab(outline: Polygon, thickness: float = 0.018) -> Shape:
    return Shape((Slice(outline, -thickness, 0.0),), 0.9, "fitted", "slab")


FRONT = slab(box(-0.20, -0.08, 0.20, 0.08))
UPRIGHT = face(OUT, np.array([1.0, 0, 0]))


def test_a_drawers_front_gets_a_tray_as_deep_as_it_opens():
    fit = slide(OUT)
    tray = assume_tray(fit, UPRIGHT, FRONT, 0.0, DEPTH)
    assert tray.depth == pytest.approx(TRAVEL / 0.75) and len(tray.plates) == 4
    corners = np.concatenate([v for v, _ in tray.plates])
    assert corners[:, 1].max() == pytest.approx(0.018 + tray.depth) and 0 < corners[:, 1].min() < 0.018
    assert np.abs(corners[:, 0]).max() < 0.20 and np.abs(corners[:, 2]).max() < 0.08
    whole = trimesh.Trimesh(*to_arrays(with_tray(extrude(FRONT, UPRIGHT), tray)))
    assert whole.is_watertight and whole.body_count == 1
    inside, above = [0.0, 0.1, 0.0], [0.0, 0.1, 0.079]
    assert not whole.contains([inside, above]).any(), "the tray is open"
    # With little room behind the front it is as deep as that, but never less than the drawer came out.
    assert assume_tray(fit, UPRIGHT, FRONT, 0.0, 0.20).depth < 0.20
    assert assume_tray(fit, UPRIGHT, FRONT, 0.0, 0.05).depth == pytest.approx(TRAVEL)


def test_up_is_the_worlds_whatever_the_plane_calls_its_sides():
    """A plane whose first side points down: the tray's bottom is still below."""
    turned = face(OUT, np.array([0.0, 0, -1]))
    tray = assume_tray(slide(OUT), turned, slab(box(-0.08, -0.20, 0.08, 0.20)), 0.0, DEPTH)
    bottom = tray.plates[0][0]
    assert bottom[:, 2].max() < -0.06 and np.ptp(bottom[:, 0]) > 0.35


@pytest.mark.parametrize("why, fit, plane, shape, end", [
    ("a hinge", slide(OUT, "revolute"), UPRIGHT, FRONT, 0.0),
    ("a sliding door", slide(np.array([1.0, 0, 0])), UPRIGHT, FRONT, 0.0),
    ("it closes towards the camera", slide(OUT), UPRIGHT, FRONT, TRAVEL),
    ("a lid that is lifted", slide(np.array([0, 0, 1.0])), face(np.array([0, 0, 1.0]), np.array([1.0, 0, 0])), FRONT,
     0.0),
    ("a triangle", slide(OUT), UPRIGHT, slab(Polygon([(-0.2, -0.08), (0.2, -0.08), (-0.2, 0.08)])), 0.0),
])  # fmt: skip
def test_what_is_no_drawer_gets_no_tray(why, fit, plane, shape, end):
    assert assume_tray(fit, plane, shape, end, DEPTH) is None, why


def test_the_body_leaves_room_for_the_tray():
    fit = slide(OUT)
    tray = assume_tray(fit, UPRIGHT, FRONT, 0.0, DEPTH)
    clearance = 0.005
    front = to_arrays(extrude(FRONT, UPRIGHT))
    block, _ = static_box(FRONT, UPRIGHT, fit, 0.0, clearance)
    body = carve(block, swept_hulls((front, tray.room), fit, clearance))
    room = from_arrays(*tray.room)
    states = np.linspace(0.0, TRAVEL, 9)
    assert 0.2 < body.volume() / block.volume() < 0.9
    assert max((posed(room, fit.link_pose(q)) ^ body).volume() for q in states) < 1e-9
    assert min((posed(room, fit.link_pose(q)) ^ block).volume() for q in states) > 1e-4


@given(st.floats(0.3, 3.0), st.floats(0.3, 3.0), st.floats(0.02, 0.35))
@settings(max_examples=15, deadline=None)
def test_the_best_rectangle_leaves_out_a_rag(width, height, drop):
    """A rectangle with a tongue at its lower side over a quarter of its width."""
    rag = box(0.1 * width, -drop * height, 0.35 * width, 0.0)
    ring = np.asarray(box(0, 0, width, height).union(rag).exterior.coords)[:-1]
    low, high, share = best_rectangle(ring)
    assert share > 0.85
    assert np.abs(low - 0.0).max() < 0.06 * max(width, height) and np.allclose(high, [width, height],
                                                                               atol=0.06 * max(width, height))


def test_what_lies_flat_rests_on_its_body():
    """A lid that slides away along itself: the block under its closed place, not where it slides to."""
    up, away = np.array([0.0, 0, 1]), np.array([0.0, 1, 0])
    fit, lid = slide(away), face(up, np.array([1.0, 0, 0]))
    shape = slab(box(-0.15, -0.14, 0.15, 0.14), 0.012)
    beneath, about = static_box(shape, lid, fit, 0.0, 0.004, beneath=True)
    low, high = np.asarray(beneath.bounding_box()).reshape(2, 3)
    assert high[2] == pytest.approx(-0.012 - 0.004) and low[2] < -0.15 and about["direction"][2] == pytest.approx(-1)
    assert np.allclose([low[0], high[0]], [-high[0], high[0]]) and abs(low[1] + high[1]) < 1e-9
    beside = np.asarray(static_box(shape, lid, fit, TRAVEL, 0.004)[0].bounding_box()).reshape(2, 3)
    assert beside[0, 1] > 0.14 + TRAVEL, "without it: where it slides to"

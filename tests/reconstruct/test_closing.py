"""Any mesh becomes one closed surface: united exactly where its pieces are solids, wrapped where they are not."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruct.geometry.closing import unite, wrap
from reconstruct.geometry.given import make_solid


def heap(*boxes: tuple) -> trimesh.Trimesh:
    """Boxes (centre, extents) put together without a union."""
    made = []
    for centre, extents in boxes:
        box = trimesh.creation.box(extents)
        box.apply_translation(centre)
        made.append(box)
    return trimesh.util.concatenate(made)


def arrays(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


CASE = (((0, 0, 0), (1.0, 1.0, 0.1)), ((0.5, 0, 0.4), (0.1, 1.0, 0.9)), ((-0.5, 0, 0.4), (0.1, 1.0, 0.9)))
CASE_VOLUME = 1.0 * 1.0 * 0.1 + 2 * (0.1 * 1.0 * 0.9 - 0.05 * 1.0 * 0.1)


def test_overlapping_boxes_become_one_surface_and_stay_the_parts():
    vertices, faces = arrays(heap(*CASE))
    assert trimesh.Trimesh(vertices, faces).volume > CASE_VOLUME + 0.005, "the overlap counts twice before"
    solid = make_solid(vertices, faces, wrapped=False)
    surface = trimesh.Trimesh(solid.vertices, solid.faces)
    assert surface.is_watertight and surface.body_count == 1 and not solid.wrapped
    assert surface.volume == pytest.approx(CASE_VOLUME, rel=1e-6)
    assert solid.pieces == len(solid.parts) == 3, "convex pieces are the convex parts"


def test_a_piece_inside_out_is_turned():
    vertices, faces = arrays(heap(*CASE))
    faces = faces.copy()
    faces[:12] = faces[:12, ::-1]
    union = unite(vertices, faces)
    assert trimesh.Trimesh(union.vertices, union.faces).volume == pytest.approx(CASE_VOLUME, rel=1e-6)


@given(st.lists(st.tuples(*[st.floats(-1, 1) for _ in range(3)], *[st.floats(0.2, 1.0) for _ in range(3)]),
                min_size=1, max_size=6))  # fmt: skip
@settings(max_examples=40, deadline=None)
def test_the_union_of_boxes_holds_what_any_box_holds(boxes):
    """By counting random points: inside the union is inside one of the boxes."""
    centres, extents = np.array(boxes)[:, :3], np.array(boxes)[:, 3:]
    union = unite(*arrays(heap(*zip(centres, extents, strict=True))))
    low, high = (centres - extents / 2).min(0), (centres + extents / 2).max(0)
    points = np.random.default_rng(0).uniform(low, high, (20_000, 3))
    share = (np.abs(points[:, None] - centres) < extents / 2).all(2).any(1).mean()
    volume = trimesh.Trimesh(union.vertices, union.faces).volume / np.prod(high - low)
    assert volume == pytest.approx(share, abs=0.02)


def test_a_concave_piece_beside_others_is_decomposed():
    ring = trimesh.creation.annulus(0.3, 0.5, 0.2, sections=24)
    box = trimesh.creation.box((0.3, 0.3, 0.2))
    box.apply_translation((0.5, 0, 0))
    solid = make_solid(*arrays(trimesh.util.concatenate([ring, box])), wrapped=False)
    assert 3 <= len(solid.parts) <= 16 and solid.pieces == 2
    # The hole of the ring stays free.
    for vertices, _ in solid.parts:
        assert not trimesh.Trimesh(*arrays(trimesh.convex.convex_hull(vertices))).contains([[0.0, 0.0, 0.0]]).any()


def test_an_open_box_and_a_sheet_are_wrapped():
    box = trimesh.creation.box((1.0, 0.8, 0.6))
    lid = np.asarray(box.faces)[np.asarray(box.triangles_center)[:, 2] < 0.29]
    assert unite(np.asarray(box.vertices), lid) is None
    vertices, faces = wrap(np.asarray(box.vertices), lid, cells=40)
    made = trimesh.Trimesh(vertices, faces)
    assert made.is_watertight
    # The hole is as wide as the box: a flood enters, and what is left are the walls.
    assert made.volume < 0.35 * box.volume and made.contains([[0.0, 0.0, -0.3]])[0]
    assert not made.contains([[0.0, 0.0, 0.0]])[0]
    assert np.abs(np.ptp(vertices, axis=0) - (1.0, 0.8, 0.6)).max() < 2.5 * 1.0 / 40


def test_a_closed_surface_with_a_slit_is_wrapped_whole():
    box = trimesh.creation.box((1.0, 0.8, 0.6)).subdivide().subdivide().subdivide()
    keep = np.ones(len(box.faces), bool)
    keep[np.argmax(np.asarray(box.triangles_center)[:, 2])] = False
    small = trimesh.Trimesh(box.vertices, np.asarray(box.faces)[keep]).subdivide().subdivide()
    assert not small.is_watertight
    vertices, faces = wrap(*arrays(small), cells=24)
    made = trimesh.Trimesh(vertices, faces)
    assert made.is_watertight and made.volume > 0.9 * box.volume and made.contains([[0.0, 0.0, 0.0]])[0]

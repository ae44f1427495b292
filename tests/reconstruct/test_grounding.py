"""Rays against meshes: depths, a mesh's distance, tracks on surfaces."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruct.providers.grounding import first_hits, ground_tracks, scale_to

K = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])


def ball(centre, radius=0.4):
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces)


def test_a_ball_is_first_met_in_front():
    centre = np.array([0.1, -0.05, 2.0])
    vertices, faces = ball(centre)
    uv = np.stack(np.meshgrid(np.linspace(100, 230, 12), np.linspace(60, 180, 12)), -1).reshape(-1, 2)
    z = first_hits(vertices, faces, K, uv)
    rays = np.c_[uv, np.ones(len(uv))] @ np.linalg.inv(K).T
    # |z ray - centre| = radius, the nearer root.
    a, b, c = (rays**2).sum(1), rays @ centre, centre @ centre - 0.4**2
    root = b**2 - a * c
    expected = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.nan)
    sure = np.abs(root) > 0.02
    assert (np.isfinite(z) == np.isfinite(expected))[sure].all() and np.isfinite(z).sum() > 30
    both = np.isfinite(z) & np.isfinite(expected)
    assert np.nanmax(np.abs(z[both] - expected[both])) < 0.01
    assert np.allclose(first_hits(vertices, faces[:, ::-1], K, uv), z, equal_nan=True), "whatever way faces turn"


def test_nothing_to_meet():
    vertices, faces = ball([0, 0, -2.0])
    assert np.isnan(first_hits(vertices, faces, K, np.array([[160.0, 120.0]]))).all()
    assert np.isnan(first_hits(*ball([0, 0, 2.0]), K, np.array([[np.nan, 3.0]]))).all()
    assert first_hits(*ball([0, 0, 2.0]), K, np.zeros((0, 2))).shape == (0,)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.05, 20.0))
def test_the_factor_about_the_camera_is_found(s):
    vertices, faces = ball([0.0, 0.1, 3.0])
    uv = np.random.default_rng(0).uniform([130, 100], [190, 160], (40, 2))
    z = first_hits(vertices, faces, K, uv)
    assert scale_to(vertices / s, faces, K, uv, z) == pytest.approx(s, rel=1e-9)
    assert scale_to(vertices / s, faces, K, uv + 1000, z) is None


def test_tracks_come_onto_the_surface_and_stay_off_others():
    """Depths wrong by 5 % are put right at the key frame; a point far behind the mesh keeps its own."""
    rng = np.random.default_rng(2)
    vertices, faces = ball([0.0, 0.0, 2.0])
    uv = rng.uniform([130, 90], [190, 150], (30, 2))
    z = first_hits(vertices, faces, K, uv)
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, 3] = [0.3, 0.2, 0.1]
    rays = np.c_[uv, np.ones(30)] @ np.linalg.inv(K).T
    true = rays * z[:, None] + T[0, :3, 3]
    lifted = rays * (z * rng.uniform(0.95, 1.05, 30))[:, None] + T[0, :3, 3]
    lifted[0] = rays[0] * 4.0 + T[0, :3, 3]
    xyz = np.repeat(lifted[:, None], 3, axis=1)
    seen = np.ones((30, 3), bool)
    out, count = ground_tracks(xyz, np.repeat(uv[:, None], 3, axis=1), seen, {1: (vertices, faces)},
                               np.tile(K, (3, 1, 1)), T)  # fmt: skip
    assert count == 29 and np.allclose(out[1:, 1], true[1:], atol=1e-9)
    assert np.allclose(out[:, [0, 2]], xyz[:, [0, 2]]) and np.allclose(out[0], xyz[0])

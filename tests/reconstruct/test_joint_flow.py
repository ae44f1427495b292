"""Joints from velocities alone: exact where they are, and among the first where a third of the tracks stray."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruct.joint.flow import CUT, Flow, candidates, flow_of, turning
from reconstruct.joint.paths import Paths
from reconstruct.joint.polish import Bundle, Sightings, residuals
from reconstruct.joint.twist import twist_of_joint

FOCAL = 700.0


def tracks(kind, axis, stroke, points=120, frames=30, noise=0.0, seed=0):
    """(N, T, 2) px of a link at depth 1, which goes and comes back a little; axis, point and the true path."""
    rng = np.random.default_rng(seed)
    axis = np.array(axis, float) / np.linalg.norm(axis)
    X = rng.uniform([-0.25, -0.2, 0.9], [0.25, 0.2, 1.1], (points, 3))
    point = np.array([0.1, 0.35, 1.0])
    twist, speed = twist_of_joint(kind, axis, point, X.mean(0))
    path = np.sin(np.linspace(0, 0.7 * np.pi, frames))
    blank = Sightings(np.zeros((points, frames, 2)), np.ones((points, frames), bool), np.ones(points), FOCAL)
    uv = residuals(Bundle(kind, twist, stroke * speed * path, X), blank)
    return uv + rng.normal(scale=noise, size=uv.shape), axis, point, (path - path.min()) / np.ptp(path)


def apart(one, other):
    return np.degrees(np.arccos(min(1.0, abs(one @ other) / np.linalg.norm(one) / np.linalg.norm(other))))


@settings(max_examples=30, deadline=None)
@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.5, 3.0), st.integers(0, 1000))
def test_the_velocity_of_a_ray_is_that_of_its_point(x, y, z, seed):
    v, w = np.random.default_rng(seed).normal(size=(2, 3))
    X = z * np.array([x, y, 1.0])
    h = 1e-6
    there = X + h * (v + np.cross(w, X))
    u = (there[:2] / there[2] - X[:2] / X[2]) / h
    told = (v[:2] - np.array([x, y]) * v[2]) / z + turning(np.array([[x, y]]))[0] @ w
    np.testing.assert_allclose(told, u, rtol=1e-3, atol=1e-4)


def test_the_common_path_is_found_where_it_turns_back_and_tracks_come_and_go():
    uv, _, _, path = tracks("revolute", [1, 0.1, 0.15], 0.17, noise=0.1)
    rng = np.random.default_rng(1)
    for track in uv:
        begin = rng.integers(0, 10)
        track[:begin], track[begin + 20 :] = np.nan, np.nan
    flow = flow_of(Paths(uv), FOCAL)
    assert flow is not None
    told = flow.path if np.corrcoef(flow.path, path)[0, 1] > 0 else 1 - flow.path
    assert np.abs(told - path).max() < 0.05


@pytest.mark.parametrize(
    "kind, axis, stroke",
    [("revolute", [1, 0.1, 0.15], 0.17), ("revolute", [0.2, 1, -0.6], 0.1), ("prismatic", [0.3, 0.2, -1], 0.05)],
)
def test_the_joint_is_among_the_first(kind, axis, stroke):
    uv, axis, point, _ = tracks(kind, axis, stroke, noise=0.1)
    rng = np.random.default_rng(2)
    stray = rng.choice(len(uv), 40, replace=False)
    uv[stray] = uv[stray, :1] + (uv[stray] - uv[stray, :1]) * rng.uniform(-0.5, 1.5, (40, 1, 2))
    flow = flow_of(Paths(uv), FOCAL)
    assert flow is not None
    found = candidates(flow, 10, 5)
    assert [c.cost for c in found] == sorted(c.cost for c in found)
    v = np.cross(point, axis) if kind == "revolute" else axis
    near = [c for c in found if c.kind == kind and apart(c.v, v) < 4]
    assert near
    best = near[0]
    assert apart(best.w if kind == "revolute" else best.v, axis) < 4
    right = np.setdiff1d(np.arange(len(uv)), stray)
    assert best.good[np.isin(flow.ids, right)].mean() > 0.9
    # A stray may lie on its own line through the epipole; most do not.
    assert best.good[np.isin(flow.ids, stray)].mean() < 0.5
    assert best.cost <= CUT**2 * len(flow.ids)
    if kind == "revolute":
        assert abs(best.v @ best.w) < 1e-9 * np.linalg.norm(best.v)


def test_nothing_that_moves_is_no_flow():
    still = np.tile(np.random.default_rng(0).uniform(-200, 200, (40, 1, 2)), (1, 20, 1))
    assert flow_of(Paths(still), FOCAL) is None
    assert flow_of(Paths(still[:4]), FOCAL) is None


def test_a_track_of_few_frames_has_no_velocity():
    uv, *_ = tracks("prismatic", [1, 0, 0], 0.05, noise=0.05)
    uv[7, 4:] = np.nan
    flow = flow_of(Paths(uv), FOCAL)
    assert isinstance(flow, Flow) and 7 not in flow.ids and len(flow.ids) == len(uv) - 1

"""Links that are plates and turn in their own plane: what they gain by it, and what other links keep."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reconstruct.joint.finish import Finished
from reconstruct.joint.normal import normal_equations
from reconstruct.joint.plates import FEWEST, FLAT, WORTH_DEG, _starts, as_plate
from reconstruct.joint.polish import Bundle, Sightings, polish, positions, residuals, robust_loss
from reconstruct.joint.shape import Flat
from reconstruct.joint.twist import twist_of_joint
from reconstruct.joint.uncertainty import spread
from reconstruct.joint.view import View
from reconstruct.joint.weigh import turn_deg

FOCAL, T, N = 600.0, 24, 80
AXIS = Rotation.from_euler("xy", [40, 15], degrees=True).apply([0, 0, 1.0])
PIVOT = np.array([0.1, 0.05, 2.0])


def basis(axis: np.ndarray) -> np.ndarray:
    """Rows: two directions at right angles to an axis."""
    e = np.cross(axis, [0, 1.0, 0])
    e /= np.linalg.norm(e)
    return np.stack([e, np.cross(axis, e)])


def blade(rng: np.random.Generator, thick: float = 0.004) -> np.ndarray:
    """(N, 3) points of a plate of 0.8 by 0.15, at right angles to the axis."""
    across = rng.uniform([-0.3, -0.05], [0.5, 0.1], (N, 2)) @ basis(AXIS)
    return PIVOT + across + rng.choice([-thick, thick], (N, 1)) * AXIS


def joint(X: np.ndarray, turn_deg: float, noise: float, seed: int, strays: int = 0) -> Finished:
    """The hinge that tracks hold on points (N, 3) that turn about the axis; the last ones wander off."""
    rng = np.random.default_rng(100 + seed)
    twist, speed = twist_of_joint("revolute", AXIS, PIVOT, X.mean(0))
    q = speed * np.radians(turn_deg) * np.sin(np.linspace(0, np.pi / 2, T)) ** 2
    blank = Sightings(np.zeros((N, T, 2)), np.ones((N, T), bool), np.ones(N), FOCAL)
    truth = Bundle("revolute", twist, q, X)
    cam = positions(truth, blank)[1]
    uv = FOCAL * cam[..., :2] / cam[..., 2:] + rng.normal(scale=noise, size=(N, T, 2))
    if strays:
        uv[-strays:] += np.cumsum(rng.normal(scale=2.0, size=(strays, T, 2)), axis=1)
    sight = replace(blank, uv=uv)
    b = polish(truth, sight, iterations=40)
    return Finished(b, sight, np.arange(N), spread(b, sight), {"revolute": 1.0}, View(FOCAL))


def off_deg(found: Finished) -> float:
    return float(np.degrees(np.arccos(min(1.0, abs(found.bundle.twist.axis @ AXIS)))))


def test_a_plane_through_a_few_points_is_no_evidence():
    free = joint(blade(np.random.default_rng(0)), 10.0, 0.5, 0)
    few = np.arange(FEWEST - 1)
    sight = free.sight.of(few)
    b = polish(replace(free.bundle, X=free.bundle.X[few]), sight, iterations=40)
    some = replace(free, bundle=b, sight=sight, members=few, spread=spread(b, sight))
    assert some.axis_deg > WORTH_DEG
    assert as_plate(some) is some


@pytest.mark.parametrize("seed", range(4))
def test_a_blade_that_turns_by_ten_degrees_shows_its_axis(seed):
    free = joint(blade(np.random.default_rng(seed)), 10.0, 0.5, seed)
    assert free.axis_deg > 2 * WORTH_DEG
    out = as_plate(free)
    assert out is not free
    assert off_deg(out) < 2.5
    assert out.spread.axis_deg < free.axis_deg and off_deg(out) < 2 * out.axis_deg
    assert turn_deg(out.bundle) == pytest.approx(10, abs=1.5)


def test_tracks_that_wander_off_a_plate_are_left_out():
    free = joint(blade(np.random.default_rng(0)), 12.0, 0.5, 0, strays=20)
    assert free.axis_deg > WORTH_DEG
    out = as_plate(free)
    assert out is not free and off_deg(out) < 2.0
    assert len(out.members) == len(out.bundle.X) == len(out.sight.uv) >= 55
    assert np.mean(out.members >= N - 20) < 0.1


@pytest.mark.parametrize("seed", range(4))
def test_links_of_other_shapes_keep_their_joint(seed):
    rng = np.random.default_rng(seed)
    # A door: its plane holds the axis.
    e = basis(AXIS)[0]
    door = PIVOT + rng.uniform(0.1, 0.6, (N, 1)) * e + rng.uniform(-0.4, 0.4, (N, 1)) * AXIS
    box = PIVOT + rng.uniform(-0.3, 0.3, (N, 3)) + [0.3, 0, 0]
    for X in (door, box):
        free = joint(X, 8.0, 1.0, seed)
        assert free.axis_deg > WORTH_DEG
        assert as_plate(free) is free


def test_what_tracks_hold_slides_and_moving_cameras_are_not_asked():
    X = blade(np.random.default_rng(0))
    sure = joint(X, 80.0, 0.02, 0)
    assert sure.axis_deg < WORTH_DEG and as_plate(sure) is sure
    vague = joint(X, 10.0, 0.5, 0)
    slide = replace(vague, bundle=replace(vague.bundle, kind="prismatic"))
    assert as_plate(slide) is slide
    moving = replace(vague, sight=replace(vague.sight, R=np.tile(np.eye(3), (T, 1, 1)), t=np.zeros((T, 3))))
    assert as_plate(moving) is moving


def test_the_plane_is_in_the_normal_equations_as_its_cost_is():
    free = joint(blade(np.random.default_rng(1)), 15.0, 0.2, 1)
    b, s = free.bundle, replace(free.sight, flat=FLAT)
    flat = Flat.of(b, s, 0.2)

    def blocks(bound: bool):
        world, cam = positions(b, s)
        r = residuals(b, s, cam)
        n = normal_equations(b, s, world, cam, r, robust_loss(r, s, 1.0)[1])
        if bound:
            flat.add(n, b)
        return n

    with_it, without = blocks(True), blocks(False)
    g, gp = with_it.g - without.g, with_it.gp - without.gp
    h = 1e-6
    for k in range(with_it.Z.shape[1]):
        there, back = (replace(b, twist=b.twist.moved(d * with_it.Z[:, k], b.kind)) for d in (h, -h))
        assert g[k] == pytest.approx((flat.cost(there) - flat.cost(back)) / (4 * h), rel=1e-4, abs=1e-6)
    for i, j in ((0, 0), (5, 1), (9, 2)):
        step = np.zeros_like(b.X)
        step[i, j] = h
        slope = (flat.cost(replace(b, X=b.X + step)) - flat.cost(replace(b, X=b.X - step))) / (4 * h)
        assert gp[i, j] == pytest.approx(slope, rel=1e-4, abs=1e-6)
    np.testing.assert_allclose(with_it.scores.sum(0), with_it.g, atol=1e-6)


def test_planes_whose_horizon_cuts_the_link_are_not_tried():
    """Of one that has most points behind its horizon these were nowhere, and its turn had no radius."""
    rng = np.random.default_rng(0)
    done = joint(blade(rng), 10.0, 0.3, 0)
    corners = np.repeat([[-1.0, -1.0], [-1.0, 1.0], [1.0, -0.7], [1.0, 1.0]], [20, 24, 24, 12], axis=0)
    uv = FOCAL * (corners + rng.normal(scale=0.1, size=(N, 2)))[:, None] + np.zeros((N, T, 2))
    # The few in one corner turn about a point of it exactly; the others, by far the most, go nowhere together.
    turn = np.exp(0.2j * np.linspace(0, 1, T))
    own = (uv[:20, :, 0] + FOCAL) + 1j * (uv[:20, :, 1] + FOCAL)
    uv[:20] = np.stack([(own * turn).real, (own * turn).imag], axis=-1) - FOCAL
    uv[20:] += np.cumsum(rng.normal(scale=4.0, size=(N - 20, T, 2)), axis=1)
    starts = _starts(done.bundle, replace(done.sight, uv=uv))
    assert all(np.isfinite(s.twist.curvature).all() and np.isfinite(s.X).all() for s in starts)

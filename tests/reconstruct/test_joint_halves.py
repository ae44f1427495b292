"""Halves of the link: what they scatter by under white noise, and where regions err together."""

from dataclasses import replace

import numpy as np
import pytest

from reconstruct.joint.halves import HALVES, Half, _off, halves, widened
from reconstruct.joint.polish import polish, residuals, robust_loss
from reconstruct.joint.twist import Twist
from reconstruct.joint.uncertainty import spread
from tests.reconstruct.test_joint_polish import SIGMA, scene


def off_deg(b, truth):
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(b.twist.axis, truth.twist.axis)),
                                       abs(b.twist.axis @ truth.twist.axis))))  # fmt: skip


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_white_noise_is_stated_nearly_as_without(kind):
    wider = []
    for seed in range(6):
        truth, s = scene(kind, seed)
        b, several = halves(polish(truth, s, iterations=30), s)
        assert len(several) == HALVES
        plain = spread(b, s)
        sure = widened(plain, b, several)
        assert sure.axis_deg >= plain.axis_deg
        assert (sure.q >= plain.q).all()
        wider += [sure.axis_deg / plain.axis_deg, np.median(sure.q[1:] / plain.q[1:])]
        if kind == "revolute":
            wider.append(sure.point / plain.point)
    assert 1 <= np.mean(wider) < 1.6


def test_regions_that_err_together_are_stated():
    """All tracks of one end of the link go a tenth farther than they should."""
    plain, stated = [], []
    for seed in range(10):
        truth, s = scene("revolute", seed, points=80)
        along = truth.X @ np.random.default_rng(seed).normal(size=3)
        end = along > np.quantile(along, 0.75)
        uv = s.uv.copy()
        uv[end] += 0.1 * (uv[end] - uv[end, :1])
        s = replace(s, uv=uv)
        b, several = halves(polish(truth, s, iterations=30), s)
        error, sure = off_deg(b, truth), spread(b, s)
        plain.append(error < 1.96 * sure.axis_deg)
        stated.append(error < 1.96 * widened(sure, b, several).axis_deg)
    assert np.mean(plain) <= 0.6
    assert np.mean(stated) >= 0.8


def test_halves_never_lead_to_a_worse_joint():
    truth, s = scene("revolute", 1, noise=SIGMA)
    rng = np.random.default_rng(0)
    uv = s.uv + (rng.uniform(size=s.seen.shape) < 0.2)[..., None] * rng.normal(scale=20, size=s.uv.shape)
    s = replace(s, uv=uv)
    b = polish(truth, s, iterations=3)
    better, _ = halves(b, s)
    cost = lambda x: robust_loss(residuals(x, s), s, 4 * b.sigma)[0]  # noqa: E731
    assert cost(better) <= cost(b) + 1e-6


def test_where_there_are_no_halves_nothing_changes():
    truth, s = scene("revolute", 2, points=7)
    b = polish(truth, s)
    same, several = halves(b, s)
    assert several == []
    sure = spread(same, s)
    assert widened(sure, same, several) is sure
    moving = replace(s, free=True)
    assert halves(b, moving) == (b, [])


def test_a_half_says_nothing_of_states_that_it_does_not_hold():
    """In the last frames one end of the link is all that is seen, and what is left of the rest has strayed."""
    truth, s = scene("revolute", 0, points=80)
    end = truth.X[:, 1] > np.quantile(truth.X[:, 1], 0.75)
    few, late = np.flatnonzero(~end)[::12], np.arange(25, 40)
    seen, uv = s.seen.copy(), s.uv.copy()
    seen[np.ix_(~end, late)] = False
    seen[np.ix_(few, late)] = True
    uv[np.ix_(few, late)] += 5 * (late - 24)[:, None] * np.array([0.6, 0.8])
    s = replace(s, seen=seen, uv=uv)
    b, several = halves(polish(truth, s, iterations=30), s)
    lost = [half for half in several if not half.held[late].any()]
    assert len(lost) == 1
    # Nothing keeps the states of that half from running off.
    off = replace(lost[0].bundle, q=np.where(np.arange(40) < 25, lost[0].bundle.q, 100.0))
    ran_off = [replace(half, bundle=off) if half is lost[0] else half for half in several]
    sure = spread(b, s)
    np.testing.assert_allclose(widened(sure, b, ran_off).q[late], widened(sure, b, several).q[late], atol=1e-9)


def test_lengths_do_not_matter():
    """Nothing in the pictures holds the scale: a half may come out larger than the whole."""
    for kind in ("revolute", "prismatic"):
        truth, _ = scene(kind)
        t = truth.twist
        all_tracks, all_frames = np.ones(len(truth.X), bool), np.ones(len(truth.q), bool)
        grown = replace(truth, X=3 * truth.X, q=3 * truth.q, twist=Twist(3 * t.anchor, t.direction, t.curvature / 3))
        axis, point, q = _off(Half(all_tracks, grown, all_frames), truth)
        assert axis == pytest.approx(0, abs=1e-6)
        assert point == pytest.approx(0, abs=1e-9)
        np.testing.assert_allclose(q, 0, atol=1e-9)
        # The same motion told backwards.
        other = replace(truth, q=-truth.q, twist=Twist(t.anchor, -t.direction, -t.curvature))
        np.testing.assert_allclose(_off(Half(all_tracks, other, all_frames), truth)[2], 0, atol=1e-9)

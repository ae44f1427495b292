"""States in frames where a tracker has lost the link and goes on saying where it is."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reconstruct.joint.finish import finish
from reconstruct.joint.paths import Paths
from reconstruct.joint.polish import Bundle, frames_held, polish, positions, residuals
from reconstruct.joint.states import found_again, held_frames, held_only, in_sight_only, unlinked, with_states
from reconstruct.joint.view import View
from tests.reconstruct.test_joint_polish import FOCAL, scene

KINDS = ("revolute", "prismatic")


def off_deg(b: Bundle, truth: Bundle) -> float:
    return float(np.degrees(np.arccos(np.clip(abs(b.twist.axis @ truth.twist.axis), 0, 1))))


def left_behind(uv: np.ndarray, since: int, seed: int) -> np.ndarray:
    """All tracks let go of the link in one frame, and each wanders by itself, as far as the link went and farther."""
    rng = np.random.default_rng(seed)
    out = uv.copy()
    steps = rng.normal(scale=6.0, size=out[:, since:].shape)
    out[:, since:] = out[:, since - 1 : since] + np.cumsum(steps, axis=1)
    return out


@pytest.mark.parametrize("kind", KINDS)
def test_states_that_have_run_off_are_found_again(kind):
    truth, s = scene(kind, 0)
    away = truth.q.copy()
    away[[5, 6, 7, len(away) - 1]] = [3.0, -2.0, 40.0, 1e4]
    b = with_states(replace(truth, sigma=0.5), away)
    assert not held_frames(b, s)[[5, 6, 7, -1]].any() and held_frames(b, s).sum() == len(away) - 4
    found = found_again(b, s)
    assert np.abs(found.q - truth.q).max() < 0.05 * np.ptp(truth.q)
    assert found_again(truth, s) is truth


def test_the_first_state_may_be_the_lost_one():
    truth, s = scene("revolute", 0)
    away = truth.q.copy()
    away[0] = 9.0
    b = with_states(replace(truth, sigma=0.5), away)
    assert np.allclose(positions(b, s)[0][:, 1:], positions(truth, s)[0][:, 1:])
    found = found_again(b, s)
    assert found.q[0] == 0
    assert np.abs(found.q - truth.q).max() < 0.05 * np.ptp(truth.q)


@pytest.mark.parametrize("kind", KINDS)
def test_frames_that_agree_on_no_state_have_no_say(kind):
    truth, s = scene(kind, 1)
    T = len(truth.q)
    since = T - 12
    few = s.seen.copy()
    few[20:, since:] = False
    lost = replace(s, uv=left_behind(s.uv, since, 1), seen=few)
    best, kept = held_only({kind: replace(truth, sigma=0.5)}, lost)
    assert not kept.seen[:, since + 1 :].any() and kept.seen[:, :since].all()
    assert np.allclose(best[kind].q[since + 1 :], best[kind].q[since], atol=0.05 * np.ptp(truth.q))
    assert held_only({kind: replace(truth, sigma=0.5)}, replace(lost, seen=s.seen))[1].seen.all()  # they contradict it
    same, all_of_it = held_only({kind: truth}, s)
    assert all_of_it is s and same[kind] is truth


@pytest.mark.parametrize("kind", KINDS)
def test_where_a_moving_camera_has_lost_the_link_one_stray_does_not_carry_it_on(kind):
    """A burner was refused whose last third a stray made nine tenths of the stroke."""
    truth, s = scene(kind, 2)
    T = len(truth.q)
    since = T - 12
    still = np.arange(60) < 40
    link = ~still
    seen = s.seen.copy()
    seen[link, since:] = False
    seen[59, since:] = True
    off = truth.q.copy()
    off[since:] += np.linspace(1.0, 9.0, T - since) * np.ptp(truth.q)
    R, t = np.tile(np.eye(3), (T, 1, 1)), np.zeros((T, 3))
    both = replace(s, seen=seen, link=link, free=True)
    uv = residuals(replace(truth, R=R, t=t), replace(both, uv=np.zeros_like(s.uv)))
    uv[59, since:] = residuals(replace(truth, q=off, R=R, t=t), replace(both, uv=np.zeros_like(s.uv)))[59, since:]
    both = replace(both, uv=uv)
    b = replace(truth, q=off, R=R, t=t, sigma=0.5)
    best, kept = in_sight_only({kind: b}, both)
    assert not kept.seen[link, since:].any() and kept.seen[still].all() and kept.seen[link, :since].all()
    assert np.allclose(best[kind].q[since:], truth.q[since - 1])
    assert np.allclose(best[kind].X, truth.X)
    # A state that few tracks hold, but hold, stays.
    seen[link, since:] = True
    same, all_of_it = in_sight_only({kind: replace(b, q=truth.q)}, replace(both, seen=seen))
    assert all_of_it.seen.all() and same[kind].q is truth.q


def in_two(s, seed, bridge, at=20):
    """The sightings with half of the tracks in the frames before, half in those from `at` on, and some in both."""
    order = np.random.default_rng(seed).permutation(len(s.seen))
    half, seen = len(order) // 2, s.seen.copy()
    seen[order[bridge:half], at:] = False
    seen[order[half:], :at] = False
    return replace(s, seen=seen, uv=np.where(seen[..., None], s.uv, 0.0)), order[:bridge]


@given(st.sampled_from(KINDS), st.integers(0, 5), st.integers(0, 6))
def test_three_tracks_hold_frames_together(kind, seed, bridge):
    truth, s = scene(kind, seed)
    s, _ = in_two(s, seed, bridge)
    late = np.arange(40) >= 20
    np.testing.assert_array_equal(unlinked(truth, s), late if bridge < 3 else np.zeros(40, bool))


def test_tracks_that_stray_hold_nothing_together_and_frames_that_show_nothing_do_not_part():
    truth, s = scene("revolute", 1)
    seen = s.seen.copy()
    seen[:, 12:17] = False  # a hand before all of it, the same tracks after
    assert not unlinked(truth, replace(s, seen=seen)).any()
    assert not unlinked(truth, replace(s, seen=np.zeros_like(seen))).any()
    s, bridging = in_two(s, 1, 8)
    uv = s.uv.copy()
    uv[bridging[2:], 20:] += 30.0
    assert unlinked(truth, replace(s, uv=uv)).sum() == 20


def test_a_joint_states_the_stroke_for_what_two_strays_hold():
    """Points before a door is on edge and after: two along a rim made it sure, 30 deg off."""
    truth, s = scene("revolute", 2, points=80)
    s, bridging = in_two(s, 2, 2)
    uv = np.where(s.seen[..., None], s.uv, np.nan)
    uv[bridging] = uv[bridging, :1] + 0.6 * (uv[bridging] - uv[bridging, :1])
    done = finish({"revolute": [truth], "prismatic": [_slide(truth)]}, Paths(uv, None), np.arange(80), View(FOCAL))
    turned = done.bundle.q * np.linalg.norm(done.bundle.twist.curvature)
    right = truth.q * np.linalg.norm(truth.twist.curvature)
    late = np.arange(40) >= 20
    assert (done.spread.q[late] >= 0.9 * np.ptp(turned)).all()
    assert (np.abs(turned - right)[late] <= 1.96 * done.spread.q[late]).all()
    assert done.spread.q[~late].max() < 0.1


def test_a_state_before_a_lost_camera_is_no_part_of_the_stroke():
    """The first frame of one was 62 deg off and an end of the stroke, which nothing was known of then."""
    _, s = scene("revolute", 3)
    link = np.arange(60) < 40
    w = s.weight[:, None] * s.seen
    w[link, 7] = 0.0
    w[~link, 0] = 0.0
    assert frames_held(replace(s, link=link), w).tolist() == [t for t in range(s.seen.shape[1]) if t not in (0, 7)]
    w[link, 0] = 0.0
    assert frames_held(s, w).tolist() == list(range(1, s.seen.shape[1]))


def test_an_end_without_tracks_does_not_run_off():
    """It did, by thousands of turns: a state that nothing holds was what made a hinge as near as hinges are."""
    truth, s = scene("revolute", 3, points=40, frames=60, stroke=0.6)
    since = 35
    uv = left_behind(s.uv, since, 3)
    uv[2:, since:], uv[:, since + 10 :] = np.nan, np.nan
    done = finish({"revolute": [truth], "prismatic": [_slide(truth)]}, Paths(uv, None), np.arange(len(uv)), View(FOCAL))
    assert done.bundle.kind == "revolute" and done.probability["revolute"] > 0.9
    assert done.lost == 10
    assert off_deg(done.bundle, truth) < 3 * max(done.spread.axis_deg, 0.3)
    turned = done.bundle.q * np.linalg.norm(done.bundle.twist.curvature)
    right = truth.q * np.linalg.norm(truth.twist.curvature)
    assert np.abs(turned - right)[:since].max() < 0.05
    assert np.ptp(turned[since:]) < 0.15


@pytest.mark.parametrize("own", [False, True])
def test_what_nothing_sees_comes_to_rest(own):
    """Of tracks that measure how far they slide along edges as well."""
    truth, s = scene("revolute", 3)
    seen = s.seen.copy()
    seen[:, -10:] = False
    b = polish(truth, replace(s, seen=seen, slip=np.zeros_like(s.uv) if own else None))
    speed = np.abs(np.diff(b.q))
    assert speed[-3:].max() < 0.1 * speed[:-12].max()


@pytest.mark.parametrize("own", [False, True])
def test_what_has_run_off_out_of_sight_comes_back(own):
    truth, s = scene("revolute", 3, frames=60)
    seen, q = s.seen.copy(), truth.q.copy()
    seen[:, 20:36] = False
    q[20:36] = 1e3 * np.ptp(truth.q) * np.sin(np.linspace(0, np.pi, 16))
    b = polish(replace(truth, q=q), replace(s, seen=seen, slip=np.zeros_like(s.uv) if own else None), iterations=30)
    assert np.abs(b.q - truth.q).max() < 0.5 * np.ptp(truth.q)


def _slide(hinge: Bundle) -> Bundle:
    direction = hinge.twist.direction / np.linalg.norm(hinge.twist.direction)
    return replace(hinge, kind="prismatic", twist=replace(hinge.twist, direction=direction, curvature=np.zeros(3)))

"""Motions of a few pixels: found because many tracks go together, and not where they do not."""

import numpy as np

from reconstruct.joint.finish import View
from reconstruct.joint.flow import flow_of
from reconstruct.joint.paths import Paths
from reconstruct.joint.slight import _leaves, slight_motion
from tests.reconstruct.test_joint_flow import FOCAL, tracks

FRAMES = 60


def wandering(count, seed):
    """(count, FRAMES, 2) px: random walks of 10 to 20 px."""
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(scale=1.0, size=(count, FRAMES, 2)), axis=1)
    return walk + rng.uniform(-200, 200, (count, 1, 2))


def lifted(noise=0.4, strays=40, seed=0):
    """A link of 120 points that goes 4 px among strays and resting points: tracks, and the slide's direction."""
    uv, axis, _, _ = tracks("prismatic", [0.1, 1.0, -0.7], 0.007, frames=FRAMES, noise=noise, seed=seed)
    rng = np.random.default_rng(seed + 1)
    rest = rng.uniform(-200, 200, (50, 1, 2)) + rng.normal(scale=noise, size=(50, FRAMES, 2))
    return np.concatenate([uv, wandering(strays, seed), rest]), axis


def test_what_rests_does_not_leave_its_place_and_what_goes_four_pixels_does():
    uv, _ = lifted()
    assert np.linalg.norm(np.ptp(uv[:120], axis=1), axis=-1).max() < 9.6  # the search takes these for resting
    leaves = _leaves(Paths(uv))
    assert leaves[:120].mean() > 0.9 and leaves[120:160].mean() > 0.9 and not leaves[160:].any()
    uv[0, 3:] = np.nan  # too short to be averaged
    assert not _leaves(Paths(uv))[0]


def test_a_slide_of_four_pixels_is_found_among_strays():
    uv, axis = lifted()
    found = slight_motion(Paths(uv), View(FOCAL))
    assert found is not None
    starts, ids = found
    assert np.mean(ids < 120) > 0.95 and np.sum(ids < 120) > 90
    slide = starts["prismatic"][0]
    assert slide.q.shape == (FRAMES,) and len(slide.X) == len(ids)
    assert np.degrees(np.arccos(min(1.0, abs(slide.twist.axis @ axis)))) < 5


def test_tracks_that_wander_are_no_slight_motion():
    assert slight_motion(Paths(wandering(80, 3)), View(FOCAL)) is None
    assert slight_motion(Paths(lifted(strays=0)[0][120:]), View(FOCAL)) is None  # all rest
    assert slight_motion(Paths(lifted()[0][:8]), View(FOCAL)) is None  # too few


def test_frames_in_which_only_strays_are_seen_have_no_say_in_the_path():
    uv, _ = lifted(strays=60)
    uv[:120, 30:] = np.nan
    flow = flow_of(Paths(uv[:180]), FOCAL)
    assert flow is not None
    assert np.sum(flow.ids < 120) > 100
    path = np.sin(np.linspace(0, 0.7 * np.pi, FRAMES))[:30]
    assert abs(np.corrcoef(flow.path[:30], path)[0, 1]) > 0.97

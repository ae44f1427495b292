"""Motions of a few pixels: found because many tracks go together, and not where they do not."""

from dataclasses import replace

import numpy as np
import pytest

from reconstruct.joint import fit as fitting
from reconstruct.joint.answers import FACTOR, better_known
from reconstruct.joint.flow import flow_of
from reconstruct.joint.paths import Paths
from reconstruct.joint.slight import _leaves, slight_motion
from reconstruct.joint.view import View
from reconstruct.joint.weigh import Rival
from tests.reconstruct import joint_scenes
from tests.reconstruct.joint_scenes import made, make_scene
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
    starts, ids, together = found
    assert together
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


def test_fewer_than_most_are_heard_where_another_joint_is_known():
    uv, _ = lifted(strays=200)
    assert slight_motion(Paths(uv), View(FOCAL)) is None
    found = slight_motion(Paths(uv), View(FOCAL), least=60)
    assert found is not None and np.mean(found[1] < 120) > 0.9 and not found[2]
    assert slight_motion(Paths(uv), View(FOCAL), least=200) is None


@pytest.mark.parametrize(("said", "std", "gives_way"), [
    ("ambiguous", 40.0, True), ("ambiguous", 0.01, False), ("ok", 4.0, True), ("ok", 0.01, False),
])  # fmt: skip
def test_a_joint_of_few_tracks_gives_way_to_one_of_many(monkeypatch, said, std, gives_way):
    """A door of which the search saw 40 tracks: those that leave their place at all know the axis, unless it did."""
    scene = make_scene("revolute", [0, 1, 0.1], [-0.3, 0, 1.5], [[0.02, 0.5], [-0.3, 0.3], [-0.005, 0.005]], 0.3,
                       points=200, impostors=10, noise=0.3)  # fmt: skip
    others = (np.arange(len(scene.tracks.uv)) >= 40) & (np.arange(len(scene.tracks.uv)) < 200)
    draw = fitting._one_draw

    def of_few(video, paths, *rest):
        found = draw(video, replace(paths, uv=np.where(others[:, None, None], np.nan, paths.uv)), *rest)
        assert found.done is not None and found.fit.verdict == "ok"
        return replace(found, fit=replace(found.fit, verdict=said, std={**found.fit.std, "axis_deg": std}))

    monkeypatch.setattr(fitting, "_one_draw", of_few)
    fit = fitting.fit_joint(scene.video, scene.tracks, joint_scenes.FOCAL, 0)
    assert fit.verdict == ("ok" if gives_way else said)
    assert ("the motion is slight" in fit.reason) == (fit.inliers > 100) == gives_way
    away = np.degrees(np.arccos(min(1.0, abs((fit.T_camera_world[:3, :3] @ fit.axis) @ scene.axis))))
    assert away < 2


def test_what_is_as_probable_as_a_joint_of_few_tracks_competes_with_those_of_many(monkeypatch):
    """A small oven: 297 tracks led to an axis 90 deg off, and sure, from one of two that 196 had left."""
    scene = make_scene("revolute", [0, 1, 0.1], [-0.3, 0, 1.5], [[0.02, 0.5], [-0.3, 0.3], [-0.005, 0.005]], 0.3,
                       points=120, impostors=10, noise=0.3)  # fmt: skip
    finished, asked = [], fitting.finish

    def finish(starts, *rest, **more):
        finished.append((starts, asked(starts, *rest, **more)))
        return finished[-1][1]

    draw = fitting._one_draw

    def wrong_one_leads(*args):
        found = draw(*args)
        right, turned = found.done.bundle, found.done.bundle.twist.axis[[1, 0, 2]]
        wrong = replace(right, twist=replace(right.twist, curvature=turned * np.linalg.norm(right.twist.curvature)))
        return replace(found, done=replace(found.done, bundle=wrong, rival=Rival(90.0, 0.4, right)))

    monkeypatch.setattr(fitting, "finish", finish)
    monkeypatch.setattr(fitting, "_one_draw", wrong_one_leads)
    monkeypatch.setattr(fitting, "_more", lambda *_: True)
    fitting.fit_joint(scene.video, scene.tracks, joint_scenes.FOCAL, 0)
    (_, first), (starts, last) = finished[0], finished[-1]
    axes = np.array([b.twist.axis for b in starts["revolute"][-2:]])
    off = np.degrees(np.arccos(np.abs(axes @ first.bundle.twist.axis)))
    assert off[0] > 60 and off[1] < 0.1
    assert all(len(b.X) == len(starts["revolute"][0].X) for b in starts["revolute"])
    assert np.degrees(np.arccos(min(1.0, abs(last.bundle.twist.axis @ scene.axis)))) < 2


def test_a_joint_that_most_of_what_moves_does_not_follow_is_stated_as_doubtful(monkeypatch):
    """A hinge with p = 1.00, stated to 8 deg, was 87 deg off: of what left its place less than half went with it."""
    assert fitting.ANY_DEG == pytest.approx(61.2, abs=0.1)
    scene = make_scene("revolute", [0, 1, 0.1], [-0.3, 0, 1.5], [[0.02, 0.5], [-0.3, 0.3], [-0.005, 0.005]], 0.3,
                       points=120, impostors=10, noise=0.3)  # fmt: skip
    refused = fitting._Draw(fitting.JointFit("refused", "too few tracks"), 0.0, np.nan)
    monkeypatch.setattr(fitting, "_one_draw", lambda *_: refused)
    sure = fitting.fit_joint(scene.video, scene.tracks, joint_scenes.FOCAL, 0)
    assert sure.verdict == "ok" and sure.type_probability["revolute"] > 0.9
    asked = fitting.slight_motion
    monkeypatch.setattr(fitting, "slight_motion", lambda *args: (*asked(*args)[:2], False))
    fit = fitting.fit_joint(scene.video, scene.tracks, joint_scenes.FOCAL, 0)
    assert fit.verdict == "ambiguous" and fit.reason.startswith(fitting.STRAYS)
    assert fit.type_probability["revolute"] < 0.9
    assert fit.std["axis_deg"] == fitting.ANY_DEG
    assert fit.std["point_m"] == pytest.approx(FACTOR * sure.std["point_m"])


def test_more_tracks_count_only_with_most_of_the_others_among_them():
    few = np.arange(20)
    assert fitting._more(np.arange(5, 60), few)
    assert not fitting._more(np.arange(15, 60), few)
    assert not fitting._more(np.arange(18), few)
    assert not fitting._more(np.arange(35), few, 2.0)


def test_of_two_doubtful_joints_the_one_of_more_tracks_counts_if_it_is_known_as_well():
    doubtful = made("ambiguous", 60.0, 0.1, np.arange(20), 20.0)
    assert better_known(made("ok", 50.0, 0.1, np.arange(90), 3.0), doubtful).verdict == "ok"
    assert better_known(made("ok", 0.0, 0.1, np.arange(90), 3.0), doubtful).verdict == "ambiguous"
    assert better_known(made("ambiguous", 50.0, 0.1, np.arange(90), 25.0), doubtful).verdict == "ambiguous"
    assert better_known(made("ok", 50.0, 0.1, np.arange(90), 31.0), doubtful) is None


@pytest.mark.parametrize("p_slide, taken", [(0.63, True), (0.9999, False)])
def test_of_two_joints_of_different_types_none_is_surer_than_both_together(p_slide, taken):
    slide = replace(made("ambiguous", 60.0, 0.1, np.arange(20), 20.0), type="prismatic",
                    type_probability={"prismatic": p_slide, "revolute": 1 - p_slide})  # fmt: skip
    hinge = replace(made("ok", 60.0, 0.1, np.arange(90), 3.0), type_probability={"revolute": 0.999, "prismatic": 0.001})
    answer = better_known(hinge, slide)
    assert (answer is not None) == taken
    if answer is not None:
        assert answer.type == "revolute" and answer.verdict == "ambiguous"
        assert answer.type_probability["revolute"] == pytest.approx((0.999 + 0.37) / 2)

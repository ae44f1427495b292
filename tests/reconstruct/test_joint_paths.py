"""Points on edges: what slides along them counts for nothing, what goes across counts in full."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruct.cues import Hands, ProviderInfo
from reconstruct.joint.fit import moving_tracks
from reconstruct.joint.models import JointFit
from reconstruct.joint.paths import Paths, held
from reconstruct.joint.polish import Reach, normal_equations, place_points, polish, positions, residuals
from reconstruct.joint.result import stay
from reconstruct.joint.shadows import maybe_shadows, unless_a_shadow
from reconstruct.joint.view import View
from reconstruct.pipeline import joint_off_the_arm
from reconstruct.providers.lk_tracks import slip_of
from reconstruct.providers.shade import one_colour, rest_beneath
from tests.reconstruct.joint_scenes import made, make_scene
from tests.reconstruct.test_joint_polish import FOCAL, scene


def on_edges(s, slide_px=6.0, seed=0):
    """The sightings with every point on an edge of its own direction, along which the track wanders off."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, np.pi, len(s.uv))
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None]
    walk = np.cumsum(rng.normal(size=s.seen.shape), axis=1)
    walk *= slide_px / np.abs(walk).max(1, keepdims=True)
    slip = np.sqrt(1 - 0.01) * np.broadcast_to(along, s.uv.shape)
    return replace(s, uv=s.uv + walk[..., None] * along, slip=slip)


@settings(max_examples=50, deadline=None)
@given(st.floats(0, 2 * np.pi), st.floats(0, 1), st.floats(-9, 9), st.floats(-9, 9))
def test_what_lies_along_the_slip_counts_by_what_it_is_worth(angle, worth, a, b):
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    r = (a * along + b * across)[None, None]
    slip = np.sqrt(1 - worth) * along[None, None]
    np.testing.assert_allclose(held(r, slip)[0, 0], worth * a * along + b * across, atol=1e-9)
    # Derivatives are reduced alike, column by column.
    np.testing.assert_allclose(held(np.stack([r, 2 * r], axis=-1), slip)[..., 1], 2 * held(r, slip), atol=1e-9)
    assert held(r, None) is r


def test_what_slides_along_a_resting_edge_does_not_move():
    uv = np.zeros((3, 20, 2)) + 100.0
    uv[:, :, 1] += np.linspace(0, 30, 20)  # all three go 30 px down
    slip = np.zeros_like(uv)
    slip[0, :, 1] = np.sqrt(0.99)  # an upright edge
    slip[1, :, 0] = np.sqrt(0.99)  # a level one
    slip[2, :, 1] = np.sqrt(0.5)  # a corner, worse one way
    uv[1, :4] = np.nan
    way = np.linalg.norm(np.ptp(Paths(uv, slip).moved()[:, 4:], axis=1), axis=1)
    assert way[0] < 2 and way[1] > 20 and way[2] == pytest.approx(way[1] / 2, rel=1e-6)
    assert Paths(uv).moved() is uv


def test_an_axis_from_points_that_slide_along_edges():
    truth, s = scene("revolute", points=120, noise=0.1)
    slid = on_edges(s)
    start = replace(truth, q=truth.q * 0.9)
    off = {}
    for name, seen in (("told", slid), ("not told", replace(slid, slip=None))):
        axis = polish(place_points(start, seen), seen, iterations=30).twist.axis
        off[name] = np.degrees(np.arccos(min(1.0, abs(axis @ truth.twist.axis))))
    assert off["told"] < 0.5
    assert off["not told"] > 5 * off["told"]


def test_derivatives_of_the_bundle_adjustment_on_edges():
    truth, s = scene("revolute", points=20, frames=10)
    s = on_edges(s)
    world, cam = positions(truth, s)
    n = normal_equations(truth, s, world, cam, residuals(truth, s, cam), s.seen.astype(float))
    cost = lambda b: 0.5 * np.sum(residuals(b, s) ** 2)  # noqa: E731
    h = 1e-6
    for k in range(n.Z.shape[1]):
        up, down = (replace(truth, twist=truth.twist.moved(e * h * n.Z[:, k], "revolute")) for e in (1, -1))
        assert (cost(up) - cost(down)) / (2 * h) == pytest.approx(n.g[k], rel=1e-3, abs=0.1)
    X = truth.X.copy()
    X[3, 2] += h
    assert (cost(replace(truth, X=X)) - cost(truth)) / h == pytest.approx(n.gp[3, 2], rel=1e-3, abs=0.1)


def test_sightings_keep_the_slip_of_their_tracks():
    rng = np.random.default_rng(0)
    paths = Paths(rng.uniform(-100, 100, (6, 9, 2)), rng.uniform(-0.5, 0.5, (6, 9, 2)))
    frames, rows = np.array([1, 4, 7]), np.array([5, 2])
    s = View(FOCAL).sightings(paths[rows], frames)
    np.testing.assert_array_equal(s.slip, paths.slip[rows][:, frames])
    np.testing.assert_array_equal(s.of(np.array([False, True])).slip[0], paths.slip[2][frames])


def test_a_point_may_lie_anywhere_in_reach_and_is_called_back_from_beyond():
    truth, s = scene("revolute")
    reach = Reach.of(truth, s, 0.5)
    assert (reach.weight > 0).all() and reach.cost(truth.X) == 0
    X = truth.X.copy()
    X[7] += [0.0, 0.0, 3 * reach.radius]
    H, g = reach.slopes(X)
    assert not g[:7].any() and not H[8:].any()
    h = 1e-6
    for k in range(3):
        step = np.zeros_like(X)
        step[7, k] = h
        assert (reach.cost(X + step) - reach.cost(X - step)) / (4 * h) == pytest.approx(g[7, k], rel=1e-4, abs=1e-6)
    assert np.linalg.eigvalsh(H[7]).min() > -1e-9


def plain_door(count=16):
    """(count, h, w, 3) of an evenly painted quadrilateral that goes 2 px a frame to the right before an even wall."""
    frames = []
    rng = np.random.default_rng(0)
    for t in range(count):
        f = np.full((240, 320, 3), 180.0)
        shape = np.array([[80 + 2 * t, 50], [170 + 2 * t, 50], [170 + 2 * t, 190], [80 + 2 * t, 190]], np.int32)
        cv2.fillConvexPoly(f, shape, (60.0, 110.0, 90.0))
        frames.append(np.clip(cv2.GaussianBlur(f, (0, 0), 1.0) + rng.normal(scale=1.0, size=f.shape), 0, 255))
    return np.stack(frames).astype(np.uint8)


def test_an_edge_slips_along_itself_and_a_corner_does_not():
    grey = np.stack([cv2.cvtColor(f, cv2.COLOR_BGR2GRAY) for f in plain_door(1)])
    slip = slip_of(grey, np.array([[[80.0, 120.0]], [[120.0, 50.0]], [[80.0, 50.0]], [[np.nan, np.nan]]]))[:, 0]
    assert abs(slip[0, 1]) > 0.98 and abs(slip[0, 0]) < 0.1
    assert abs(slip[1, 0]) > 0.98 and abs(slip[1, 1]) < 0.1
    assert np.linalg.norm(slip[2]) < 0.75
    assert not slip[3].any()


def test_a_shadows_edge_has_one_colour_on_both_sides_and_a_rim_has_two():
    frame = np.zeros((200, 300, 3), float) + [180.0, 170.0, 150.0]
    frame[:, 100:] *= 0.6  # in the shade
    frame[100:, 200:] = [60.0, 110.0, 90.0]  # a part in the shade
    frame[:, :50] *= 0.95  # fainter than any shadow
    frame[150:, 74:77] *= 0.6  # the tip of a finger's
    noisy = np.random.default_rng(0).normal(scale=1.5, size=(5, *frame.shape)) + frame
    frames = np.clip(noisy, 0, 255).astype(np.uint8)
    at = np.array([[100.0, 60.0], [200.0, 150.0], [50.0, 60.0], [np.nan, np.nan], [75.0, 150.0]])
    uv = np.repeat(at[:, None], 5, axis=1)
    uv[0, :2] = np.nan
    assert one_colour(frames, uv).tolist() == [True, False, False, False, True]


def passing(dark, count=7):
    """(count, h, w, 3) of a darker half that comes in from the left over grain, and (1, count, 2) px on its edge.

    Args:
        dark: of a picture, what it looks like within.
    """
    rng = np.random.default_rng(0)
    grain = cv2.GaussianBlur(rng.normal(scale=3.5, size=(200, 300)), (0, 0), 2.0)[..., None]
    wall = np.array([110.0, 105.0, 95.0]) * np.exp(np.clip(grain, -0.8, 0.8))
    frames, edge = [], np.array([[[60.0 + 30 * t, 100.0] for t in range(count)]])
    for x in edge[0, :, 0]:
        f = wall.copy()
        f[:, : int(x)] = dark(f)[:, : int(x)]
        frames.append(f + rng.normal(scale=1.0, size=f.shape))
    return np.clip(np.stack(frames), 0, 255).astype(np.uint8), edge


def test_under_a_shadow_the_grain_stays_and_under_a_part_of_that_colour_it_does_not():
    frames, edge = passing(lambda wall: 0.55 * wall)
    assert one_colour(frames, edge).all() and rest_beneath(frames, edge) > 0.9
    # Under a hand at all other times nothing is known of the place.
    assert rest_beneath(frames, edge, np.ones(frames.shape[:3], bool)) == 0
    frames, edge = passing(lambda wall: np.zeros_like(wall) + 0.35 * np.array([110.0, 105.0, 95.0]))
    assert one_colour(frames, edge).all() and rest_beneath(frames, edge) < 0.2


@pytest.mark.parametrize(("agree", "found", "made", "shade", "verdict", "words"), [
    (35, "all", "ok", 30, "refused", "what moves is a shadow: 30 of the 35"),
    (60, "all", "ok", 30, "ambiguous", "part of what moves is a shadow: 30 of the 60"),
    (60, "all", "ambiguous", 30, "refused", "what moves is a shadow: 30 of the 60 tracks that agree lie on the edge"),
    (60, "lit", "ok", 30, "ok", "without what is on a shadow's edge, made"),
    (60, "lit", "ok", 80, "ok", "without what may be on a shadow, made"),
    (60, "off", "ok", 80, "ambiguous", "what moves may be a shadow: without the edges of one, 83% of the tracks"),
    (60, "off", "ok", 70, "ok", "without what is on a shadow's edge, made"),
    (60, "lit", "ambiguous", 70, "ambiguous", "without what is on a shadow's edge, made"),
    (60, "lit", "ambiguous", 80, "ambiguous", "without what is on a shadow's edge, made"),
    (60, "off", "ambiguous", 80, "refused", "what moves is a shadow: without the edges of one, 83% of the tracks"),
    (80, "lit", "ok", 30, "ok", "made"),
    (80, "lit", "ok", 60, "ok", "without what may be on a shadow, made"),
    (80, "off", "ok", 60, "ok", "made"),
    (80, "rough", "ok", 60, "ok", "made"),
    (60, "lit", "ok", 999, "ok", "without what is on a shadow's edge, made"),
    (60, "lit", "ambiguous", 999, "ambiguous", "without what is on a shadow's edge, made"),
    (80, "lit", "ok", 999, "ok", "made"),
    (80, "exact", "ok", 60, "ok", "without what is on a shadow's edge, made"),
    (160, "exact", "ok", 60, "ok", "without what is on a shadow's edge, made"),
    (320, "exact", "ok", 60, "ok", "made"),
    (320, "lit", "ok", 60, "ok", "made"),
])  # fmt: skip
def test_a_joint_that_many_shadows_follow_is_asked_without_them(monkeypatch, agree, found, made, shade, verdict, words):
    """Found of all tracks only, without the edges of shadows (far more exactly), or without all that may be on one; a
    world in which all is shade is grey."""
    scene = make_scene("revolute", [0, 1, 0.1], [-0.3, 0, 1.5], [[0.05, 0.5], [-0.3, 0.3], [-0.05, 0.05]], 0.8,
                       points=300)  # fmt: skip
    number = np.arange(len(scene.tracks.uv))
    cast = number < 30
    # Nothing is left out beforehand, so that all depends on who agrees.
    monkeypatch.setattr("reconstruct.joint.shadows.LIT_SHARE", 2.0)
    monkeypatch.setattr("reconstruct.joint.shadows.BESIDE_PX", 0.0)

    def answer(video, tracks, *_, **__):
        seen = tracks.visible.any(1)
        px = 1.0 if seen[cast].any() else {"exact": 0.4, "rough": 1.1}.get(found, 1.0)
        if seen[cast].any() or found in ("lit", "rough") or (found in ("off", "exact") and seen[30:shade].any()):
            return JointFit(made, "made", "prismatic", point_track=np.flatnonzero(seen)[:agree], residual_px=px,
                            inliers=agree)  # fmt: skip
        return JointFit("refused", "nothing moves")

    monkeypatch.setattr("reconstruct.joint.fit.fit_joint", answer)
    nobody = Hands((), None, ProviderInfo("made", "0", "Apache-2.0"))
    tracks = replace(scene.tracks, cast=cast, shade=number < shade)
    fit = joint_off_the_arm(scene.video, tracks, nobody, None, 0, lambda _: None)
    assert fit.verdict == verdict
    assert fit.reason.startswith(words)


@pytest.mark.parametrize("by_itself", ["ok", "ambiguous"])
@pytest.mark.parametrize(("turn", "std", "misses", "lit_count", "verdict", "words", "px"), [
    (60.0, 5.0, 0.08, 90, "ambiguous", "without what is on a shadow's edge, made", 0.08),
    (60.0, 5.0, 0.12, 90, "ambiguous", "part of what moves may be a shadow, made", 0.10),
    (60.0, 5.0, 0.08, 20, "ambiguous", "part of what moves may be a shadow, made", 0.10),
    (60.0, 40.0, 0.08, 90, "ok", "made", 0.10),
    (6.0, 5.0, 0.08, 90, "ok", "made", 0.10),
])  # fmt: skip
def test_a_joint_that_is_another_without_some_shadows_is_doubtful(
    turn, std, misses, lit_count, verdict, words, px, by_itself
):
    """Of the two the one that its tracks miss less counts, if these are more than a few."""
    scene = make_scene("revolute", [0, 1, 0.1], [-0.3, 0, 1.5], [[0.05, 0.5], [-0.3, 0.3], [-0.05, 0.05]], 0.8)
    cast = np.arange(len(scene.tracks.uv)) < 30

    tracks = replace(scene.tracks, cast=cast, shade=np.zeros(len(cast), bool))
    again = made(by_itself, turn, misses, np.arange(100), std, lit_count)
    fit = unless_a_shadow(made("ok", 0.0, 0.1, np.arange(100), 1.0), scene.video, tracks, lambda _: again)
    assert (fit.verdict, fit.residual_px) == (verdict, px)
    assert fit.reason.startswith(words)


@pytest.mark.parametrize(("turn", "std", "px", "words"), [
    (6.0, 5.0, 0.10, "made"),  # the same joint, known worse: it stays
    (6.0, 0.5, 0.05, "without what may be on a shadow, made"),  # known better
    (60.0, 5.0, 0.05, "without what may be on a shadow, made"),  # another one
])  # fmt: skip
def test_a_joint_that_fewer_tracks_confirm_stays(turn, std, px, words):
    scene = make_scene("revolute", [0, 1, 0.1], [-0.3, 0, 1.5], [[0.05, 0.5], [-0.3, 0.3], [-0.05, 0.05]], 0.8)
    cast = np.arange(len(scene.tracks.uv)) < 30

    tracks = replace(scene.tracks, cast=cast, shade=np.arange(len(cast)) < 60)
    all_tracks = np.arange(100)
    without = {30: made("ok", 0.0, 0.1, all_tracks, 4.0), 60: made("ok", turn, 0.05, all_tracks, std)}
    left_out = lambda tracks: int((~tracks.visible.any(1)).sum())  # noqa: E731
    fit = unless_a_shadow(made("ok", 0.0, 0.1, all_tracks, 4.0), scene.video, tracks, lambda t: without[left_out(t)])
    assert (fit.verdict, fit.residual_px) == ("ok", px)
    assert fit.reason.startswith(words)


@pytest.mark.parametrize(("lit", "turn", "verdict", "px"), [
    ("ok", 70.0, "ambiguous", 0.05),  # another joint: doubtful, and the one that its tracks miss least
    ("ok", 1.0, "ok", 0.1),
    ("ambiguous", 70.0, "ok", 0.1),  # which says nothing
])  # fmt: skip
def test_of_a_joint_that_was_mostly_a_shadow_some_more_that_may_be_one_makes_it_doubtful(
    lit, turn, verdict, px, monkeypatch
):
    """A blade and a hand's shadow were a sure hinge so: a third of its tracks were beside edges that were left out."""
    monkeypatch.setattr("reconstruct.joint.shadows.BESIDE_PX", 0.0)
    scene = make_scene("revolute", [0, 1, 0.1], [-0.3, 0, 1.5], [[0.05, 0.5], [-0.3, 0.3], [-0.05, 0.05]], 0.8)
    number = np.arange(len(scene.tracks.uv))
    shade = (number < 45) | ((125 <= number) & (number < 140))
    tracks = replace(scene.tracks, cast=number < 45, shade=shade)

    def ask(some):
        left_out = int((~some.visible.any(1)).sum())
        return made("ok", 0.0, 0.1, number[60:140]) if left_out == 45 else made(lit, turn, 0.05, number[60:125])

    fit = unless_a_shadow(made("ok", 30.0, 0.3, number[:100]), scene.video, tracks, ask)
    assert (fit.verdict, fit.residual_px) == (verdict, px)


@pytest.mark.parametrize(("by_itself", "turn", "verdict", "px"), [
    ("ambiguous", 40.0, "ambiguous", 0.05),
    ("ambiguous", 1.0, "ok", 0.05),
    ("ok", 40.0, "ok", 0.1),  # which is confirmed
])  # fmt: skip
def test_two_sure_joints_with_and_without_shadows_that_contradict_each_other_are_doubtful(by_itself, turn, verdict, px):
    """An oven's door was a sure hinge 32 deg off by the 35 tracks that were left, and 2 deg off by all."""
    scene = make_scene("revolute", [0, 1, 0.1], [-0.3, 0, 1.5], [[0.05, 0.5], [-0.3, 0.3], [-0.05, 0.05]], 0.8,
                       points=150)  # fmt: skip
    number = np.arange(len(scene.tracks.uv))
    tracks = replace(scene.tracks, cast=number < 45, shade=number < 90)

    def ask(some):
        left_out = int((~some.visible.any(1)).sum())
        return made(by_itself, turn, 0.1, number[45:110]) if left_out == 45 else made("ok", turn, 0.05, number[90:110])

    fit = unless_a_shadow(made("ok", 0.0, 0.08, number[:100]), scene.video, tracks, ask)
    assert (fit.verdict, fit.residual_px) == (verdict, px)


@pytest.mark.parametrize(("count", "expected"), [(20, ("ambiguous", 0.08)), (30, ("ok", 0.05))])
def test_a_few_tracks_off_all_that_may_be_a_shadow_make_no_doubtful_joint_sure(count, expected):
    """An oven's door was a sure slide by 29 tracks, where 193 left the type open."""
    scene = make_scene("revolute", [0, 1, 0.1], [-0.3, 0, 1.5], [[0.05, 0.5], [-0.3, 0.3], [-0.05, 0.05]], 0.8,
                       points=150)  # fmt: skip
    number = np.arange(len(scene.tracks.uv))
    tracks = replace(scene.tracks, cast=number < 45, shade=number < 90)

    def ask(some):
        few = int((~some.visible.any(1)).sum()) > 45
        return made("ok", 0.0, 0.05, number[90 : 90 + count]) if few else made("ambiguous", 0.0, 0.1, number[45:110])

    fit = unless_a_shadow(made("ambiguous", 0.0, 0.08, number[:100]), scene.video, tracks, ask)
    assert (fit.verdict, fit.residual_px) == expected


@pytest.mark.parametrize(("px", "count", "expected"), [
    (0.05, 20, ("ambiguous", 0.03)),  # forty-five of the tracks off the edges follow the first, and more exactly
    (0.02, 20, ("ok", 0.02)),
    (0.05, 60, ("ok", 0.05)),
])  # fmt: skip
def test_a_joint_off_some_shadows_that_fewer_tracks_follow_does_not_take_the_place_of_one(px, count, expected):
    """Half of the tracks on a blade's edges count as a shadow's: without them a hinge 70 deg off was sure of 16."""
    scene = make_scene("revolute", [0, 1, 0.1], [-0.3, 0, 1.5], [[0.05, 0.5], [-0.3, 0.3], [-0.05, 0.05]], 0.8,
                       points=150)  # fmt: skip
    number = np.arange(len(scene.tracks.uv))
    tracks = replace(scene.tracks, cast=number < 40, shade=np.zeros(len(number), bool))
    again = made("ok", 70.0, px, number[100 : 100 + count], 2.0)
    fit = unless_a_shadow(made("ok", 0.0, 0.03, number[:85], 2.0), scene.video, tracks, lambda _: again)
    assert (fit.verdict, fit.residual_px) == expected


@pytest.mark.parametrize(("verdict", "px", "expected"), [
    ("ok", 0.05, ("ambiguous", 0.05)),  # sure and more exact: its axis counts
    ("ok", 0.2, ("ambiguous", 0.1)),
    ("ambiguous", 0.05, ("ambiguous", 0.1)),
])  # fmt: skip
def test_of_a_joint_that_is_none_without_shadows_a_sure_one_off_all_that_may_be_one_counts(verdict, px, expected):
    scene = make_scene("revolute", [0, 1, 0.1], [-0.3, 0, 1.5], [[0.05, 0.5], [-0.3, 0.3], [-0.05, 0.05]], 0.8)
    number = np.arange(len(scene.tracks.uv))
    tracks = replace(scene.tracks, cast=number < 60, shade=number < 90)

    def ask(some):
        left_out = int((~some.visible.any(1)).sum())
        return JointFit("refused", "a free body") if left_out == 60 else made(verdict, 30.0, px, number[90:140])

    fit = unless_a_shadow(made("ambiguous", 0.0, 0.1, number[:110]), scene.video, tracks, ask)
    assert (fit.verdict, fit.residual_px) == expected


def test_few_is_by_the_joints_that_were_found():
    """A refusal that four hundred tracks agree with leaves two joints of ninety: one of these counts."""
    scene = make_scene("revolute", [0, 1, 0.1], [-0.3, 0, 1.5], [[0.05, 0.5], [-0.3, 0.3], [-0.05, 0.05]], 0.8)
    number = np.arange(len(scene.tracks.uv))
    tracks = replace(scene.tracks, cast=number < 100, shade=number < 130)

    def ask(some):
        left_out = int((~some.visible.any(1)).sum())
        px = 0.1 if left_out == 100 else 0.05
        return made("ambiguous", 0.0, px, number[100:190], 40.0)

    fit = unless_a_shadow(JointFit("refused", "a free body", inliers=442), scene.video, tracks, ask)
    assert (fit.verdict, fit.residual_px) == ("ambiguous", 0.05)


def test_what_is_beside_a_shadows_edge_may_be_on_it():
    scene = make_scene("revolute", [0, 1, 0.1], [-0.3, 0, 1.5], [[0.05, 0.5], [-0.3, 0.3], [-0.05, 0.05]], 0.8)
    T = len(scene.video)
    # The edge of a shadow is seen in the second half only; four points at most so far from it, one on a grey edge.
    uv = np.zeros((6, T, 2), np.float32)
    uv[1:, :, 0] = np.array([3.0, 3.0, 9.0, 11.0, 40.0])[:, None]
    uv = scene.video.to_full(uv)
    visible = np.ones((6, T), bool)
    visible[0, : T // 2] = visible[2, T // 2 :] = visible[3, : T // 2] = False
    visible[1, T - 2 :] = False
    cast, shade = np.arange(6) == 0, np.arange(6) == 5
    start = np.zeros(6, int)
    tracks = replace(scene.tracks, uv=uv, visible=visible, reference=start, slip=None, cast=cast, shade=shade)
    assert maybe_shadows(scene.video, tracks).tolist() == [True, False, False, True, False, True]


def test_a_hinge_whose_shadow_goes_along_is_found_without_it():
    hinge = make_scene("revolute", [0, 1, 0.1], [-0.3, 0, 1.5], [[0.05, 0.5], [-0.3, 0.3], [-0.05, 0.05]], 0.8,
                       noise=0.15, impostors=0)  # fmt: skip
    # A flat shadow on the table below, as wide as the door, that slides as the door opens.
    slide = make_scene("prismatic", [1, 0, -0.4], [0.1, 0.35, 1.5], [[-0.3, 0.3], [0, 0], [-0.2, 0.2]], 0.3, points=140,
                       noise=0.15, impostors=0, seed=1)  # fmt: skip
    shadow = slice(0, 140)  # its points come first, then what rests
    both = replace(hinge.tracks, uv=np.concatenate([slide.tracks.uv[shadow], hinge.tracks.uv]),
                   visible=np.concatenate([slide.tracks.visible[shadow], hinge.tracks.visible]),
                   reference=np.concatenate([slide.tracks.reference[shadow], hinge.tracks.reference]),
                   cast=np.arange(140 + len(hinge.tracks.uv)) < 140)  # fmt: skip
    nobody = Hands((), None, ProviderInfo("made", "0", "Apache-2.0"))
    fit = joint_off_the_arm(hinge.video, both, nobody, 768.0, 0, lambda _: None)
    assert fit.verdict == "ok" and fit.type == "revolute", fit.reason
    assert fit.reason.startswith("without what is on a shadow's edge")
    assert (fit.point_track >= 140).all()
    assert np.degrees(np.arccos(abs(fit.T_camera_world[:3, :3] @ fit.axis @ hinge.axis))) < 1.0


def test_shadows_edges_are_left_out_where_enough_else_moves(monkeypatch):
    scene = make_scene("revolute", [0, 1, 0.1], [-0.3, 0, 1.5], [[0.05, 0.5], [-0.3, 0.3], [-0.05, 0.05]], 0.8)
    moving = moving_tracks(scene.video, scene.tracks)
    asked = []

    def asked_of(video, tracks, *args, **kwargs):
        asked.append(tracks.visible.any(1))
        return JointFit("refused", "no")

    monkeypatch.setattr("reconstruct.joint.fit.fit_joint", asked_of)
    nobody = Hands((), None, ProviderInfo("made", "0", "Apache-2.0"))
    for many in (20, len(moving) - 10):
        shade = np.zeros(len(scene.tracks.uv), bool)
        shade[moving[:many]] = True
        fit = joint_off_the_arm(scene.video, replace(scene.tracks, shade=shade), nobody, None, 0, lambda _: None)
        assert fit.verdict == "refused"
    # Without them, then with them since that was refused; and all at once where ten would be left.
    assert len(asked) == 3 and not asked[0][moving[:20]].any()
    assert asked[1].sum() == asked[0].sum() + 20 and asked[2][moving].all()


def test_a_point_that_slid_off_is_not_handed_on():
    truth, s = scene("revolute", points=40, noise=0.1)
    slid = on_edges(s)
    some = replace(s, uv=np.where(np.arange(40)[:, None, None] < 25, s.uv, slid.uv), slip=slid.slip)
    assert stay(truth, some)[:25].all() and stay(truth, some)[25:].mean() < 0.5
    far = replace(s, uv=s.uv + 50.0)
    assert stay(truth, far).all()


def test_a_point_far_before_or_behind_the_link_is_not_handed_on():
    truth, s = scene("revolute", points=40, noise=0.1)
    X = truth.X.copy()
    X[:3] *= [[30.0], [1e4], [-1.0]]
    kept = stay(replace(truth, X=X), s)
    assert not kept[:3].any() and kept[3:].all()


def beside_shadows(fit, without):
    """What becomes of a joint of tracks 0 to 99 (0 to 59) of which 30 are on shadows' edges and 30 more may be.

    Args:
        without: the joints that are found without so many tracks.
    """
    scene = make_scene("revolute", [0, 1, 0.1], [-0.3, 0, 1.5], [[0.05, 0.5], [-0.3, 0.3], [-0.05, 0.05]], 0.8)
    cast = np.arange(len(scene.tracks.uv)) < 30
    tracks = replace(scene.tracks, cast=cast, shade=np.arange(len(cast)) < 60)
    return unless_a_shadow(fit, scene.video, tracks, lambda t: without[int((~t.visible.any(1)).sum())])


NOTHING = JointFit("refused", "nothing moves")


@pytest.mark.parametrize(("verdict", "first", "after"), [
    ("ok", 60, "ok"), ("ambiguous", 60, "refused"),
    ("ok", 30, "refused"),  # a shadow's
])  # fmt: skip
def test_what_is_refused_beside_some_shadows_is_asked_without_them(monkeypatch, verdict, first, after):
    monkeypatch.setattr("reconstruct.joint.shadows.moving_tracks", lambda *_: np.arange(100))
    found = made(verdict, 0.0, 0.1, np.arange(first, first + 30), 1.0)
    fit = beside_shadows(NOTHING, {30: found, 60: found if first == 60 else NOTHING})
    assert fit.verdict == after
    assert fit.reason == ("without what is on a shadow's edge, made" if after == "ok" else "nothing moves")


def test_of_joints_that_are_all_doubtful_the_one_that_its_tracks_follow_best_counts():
    doubtful = {px: made("ambiguous", 10.0, px, np.arange(100), 20.0) for px in (0.05, 0.06, 0.1, 0.2)}
    fit = beside_shadows(doubtful[0.1], {30: doubtful[0.06], 60: doubtful[0.05]})
    assert (fit.verdict, fit.residual_px) == ("ambiguous", 0.05)
    fit = beside_shadows(doubtful[0.05], {30: doubtful[0.1], 60: doubtful[0.2]})
    assert (fit.verdict, fit.residual_px) == ("ambiguous", 0.05)


@pytest.mark.parametrize(("kind", "verdict"), [("revolute", "ambiguous"), ("prismatic", "refused")])
def test_a_part_beside_its_own_shadow_is_not_refused_where_the_same_type_is_found_without(kind, verdict):
    fit = made("ambiguous", 0.0, 0.1, np.arange(60), 20.0)
    lit = made("ambiguous", 30.0, 0.05, np.arange(60, 70), 60.0, kind=kind)
    got = beside_shadows(fit, {30: NOTHING, 60: lit})
    assert got.verdict == verdict and "a shadow: 30 of the 60 tracks" in got.reason

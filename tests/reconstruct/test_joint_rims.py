"""When straight edges are asked besides points, and what becomes of what they show."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reconstruct.cues import ProviderInfo, Tracks
from reconstruct.joint.answers import FACTOR
from reconstruct.joint.flat_fit import FlatFit
from reconstruct.joint.models import JointFit
from reconstruct.joint.result import FREELY
from reconstruct.joint.rims import unless_rims_tell
from reconstruct.video import Video

T, POINTS, EDGES = 12, 30, 10
VIDEO = Video(Path("none.mp4"), "0" * 64, (640, 480), np.arange(T) / 30, np.arange(T), T,
              np.broadcast_to(np.zeros((1, 1, 1, 3), np.uint8), (T, 480, 640, 3)), 1.0)  # fmt: skip
REFUSED = JointFit("refused", "too few tracks agree")


def tracks(count: int, x: float, cast: int = 0) -> Tracks:
    """So many, 15 px from each other, the first of them on the edges of shadows."""
    uv = np.zeros((count, T, 2), np.float32)
    uv[..., 0] = x + 15.0 * np.arange(count)[:, None]
    uv[..., 1] = 100 + 2.0 * np.arange(T)
    on = np.arange(count) < cast
    return Tracks(uv, np.ones((count, T), bool), np.zeros(count, int), ProviderInfo("t", "1", "Apache-2.0"),
                  np.zeros((count, T, 2), np.float32), on.copy(), on)  # fmt: skip


def joint(verdict: str, ids: np.ndarray, axis_deg: float = 4.0) -> JointFit:
    """A hinge that these tracks follow."""
    p, std = {"revolute": 0.99, "prismatic": 0.01}, {"axis_deg": axis_deg, "point_m": 0.01}
    return JointFit(verdict, "tracks agree", "revolute", p, axis=np.array([0, 0, 1.0]), T_camera_world=np.eye(4),
                    points=np.zeros((len(ids), 3)), point_track=ids, std=std, inliers=len(ids),
                    members=ids)  # fmt: skip


class Asked:
    """Answers in turn, and what was asked."""

    def __init__(self, *answers: JointFit):
        self.answers, self.of = list(answers), []

    def __call__(self, some: Tracks) -> JointFit:
        self.of.append(some)
        return self.answers[len(self.of) - 1]


def edges() -> Tracks:
    return tracks(EDGES, 30.0)


def no_plate(points: Tracks, edges: Tracks) -> None:
    """What edges say that are no plate's."""


def never() -> Tracks:
    raise AssertionError("edges were followed")


def test_what_is_carried_freely_is_not_asked_for_its_edges():
    fit = JointFit("refused", f"{FREELY}: its points follow one 3.1 times more exactly than the best joint (revolute)")
    assert unless_rims_tell(fit, VIDEO, tracks(POINTS, 20.0), never, Asked(), no_plate) is fit


POINT_IDS, BOTH_IDS = np.arange(10, 20), np.arange(20, POINTS + EDGES)
OTHER_IDS = np.concatenate([POINT_IDS, np.arange(POINTS, POINTS + EDGES)])


def test_a_sure_joint_is_left_alone():
    fit = joint("ok", POINT_IDS, 20.0)
    assert unless_rims_tell(fit, VIDEO, tracks(POINTS, 20.0), never, Asked(), no_plate) is fit


def test_an_open_axis_is_taken_from_edges_that_know_it_better():
    ask = Asked(joint("ok", OTHER_IDS, 6.0))
    fit, some = joint("ambiguous", BOTH_IDS, 20.0), tracks(POINTS, 20.0, cast=5)
    out = unless_rims_tell(fit, VIDEO, some, edges, ask, no_plate)
    assert out.verdict == "ambiguous" and "leave the axis open" in out.reason
    assert out.std["axis_deg"] == FACTOR * 6.0 and np.array_equal(out.members, POINT_IDS)
    assert np.array_equal(ask.of[0].visible.any(1), np.arange(POINTS + EDGES) >= 5)


@pytest.mark.parametrize("found", [
    joint("ok", OTHER_IDS, 21.0),
    joint("ok", POINT_IDS, 6.0),  # by no edge
    REFUSED,
])  # fmt: skip
def test_an_open_axis_stays_where_edges_know_it_no_better(found):
    fit = joint("ambiguous", BOTH_IDS, 20.0)
    assert unless_rims_tell(fit, VIDEO, tracks(POINTS, 20.0), edges, Asked(found), no_plate) is fit


@pytest.mark.parametrize("why", ["a hand holds the camera", "nothing is known of shadows"])
def test_edges_are_not_followed_where_they_say_nothing(why):
    video = replace(VIDEO, warp=np.tile(np.eye(3), (T, 1, 1))) if why.startswith("a hand") else VIDEO
    some = tracks(POINTS, 20.0) if why.startswith("a hand") else replace(tracks(POINTS, 20.0), cast=None)
    assert unless_rims_tell(REFUSED, video, some, never, Asked(), no_plate) is REFUSED


def test_a_sure_answer_without_all_shadows_counts_but_is_doubtful():
    ask = Asked(joint("ok", BOTH_IDS))
    out = unless_rims_tell(REFUSED, VIDEO, tracks(POINTS, 20.0, cast=5), edges, ask, no_plate)
    assert out.verdict == "ambiguous"
    assert "straight edges" in out.reason
    assert out.std["axis_deg"] == FACTOR * 4.0
    assert max(out.type_probability.values()) < 0.9
    seen = ask.of[0].visible.any(1)
    assert len(seen) == POINTS + EDGES
    assert not seen[:5].any()
    assert seen[POINTS:].all()


def test_its_points_are_those_of_points():
    out = unless_rims_tell(REFUSED, VIDEO, tracks(POINTS, 20.0), edges, Asked(joint("ok", BOTH_IDS)), no_plate)
    assert np.array_equal(out.point_track, np.arange(20, POINTS))
    assert len(out.points) == POINTS - 20
    assert out.tracks == POINTS


def test_what_is_only_off_shadows_edges_is_asked_second():
    doubtful, other = joint("ambiguous", BOTH_IDS), joint("ambiguous", OTHER_IDS)
    ask = Asked(doubtful, other)
    out = unless_rims_tell(REFUSED, VIDEO, tracks(POINTS, 20.0, cast=5), edges, ask, no_plate)
    assert np.array_equal(out.point_track, POINT_IDS)
    assert np.array_equal(out.members, POINT_IDS)
    assert np.array_equal(ask.of[1].visible[:POINTS].any(1), np.arange(POINTS) >= 5)
    out = unless_rims_tell(REFUSED, VIDEO, tracks(POINTS, 20.0, cast=5), edges, Asked(doubtful, REFUSED), no_plate)
    assert np.array_equal(out.point_track, np.arange(20, POINTS))


def test_what_edges_alone_follow_is_no_joint_of_a_part():
    alone = joint("ok", np.arange(POINTS - 3, POINTS + EDGES))
    assert unless_rims_tell(REFUSED, VIDEO, tracks(POINTS, 20.0), edges, Asked(alone, alone), no_plate) is REFUSED


def test_what_points_alone_follow_stays_refused():
    alone = joint("ok", np.arange(10, POINTS + 3))
    assert unless_rims_tell(REFUSED, VIDEO, tracks(POINTS, 20.0), edges, Asked(alone, alone), no_plate) is REFUSED


def test_without_edges_nothing_is_asked():
    none = lambda: tracks(0, 0.0)  # noqa: E731
    assert unless_rims_tell(REFUSED, VIDEO, tracks(POINTS, 20.0), none, Asked(), no_plate) is REFUSED


@pytest.mark.parametrize(("fit", "axis_deg", "probability"), [
    (joint("ambiguous", BOTH_IDS, 20.0), 15.0, 0.5),
    (joint("ambiguous", BOTH_IDS, 20.0), 30.0, 0.9),
    (REFUSED, 15.0, 0.5),
])  # fmt: skip
def test_a_plate_counts_that_is_known_better_or_is_probable_by_itself(fit, axis_deg, probability):
    plate = FlatFit(joint("ok", OTHER_IDS, axis_deg), probability, 0.7)
    ask = Asked(*[joint("ambiguous", BOTH_IDS, 12.0)] * 2)
    out = unless_rims_tell(fit, VIDEO, tracks(POINTS, 20.0), edges, ask, lambda points, rims: plate)
    assert out.verdict == "ambiguous"
    assert out.std["axis_deg"] == FACTOR * axis_deg
    assert np.array_equal(out.members, POINT_IDS)


@pytest.mark.parametrize("agrees", [True, False])
def test_what_the_likeliest_plate_contradicts_does_not_count(agrees):
    found, fit = joint("ambiguous", OTHER_IDS, 12.0), joint("ambiguous", BOTH_IDS, 20.0)
    other = joint("ok", OTHER_IDS, 30.0)
    plate = FlatFit(other if agrees else replace(other, axis=np.array([1.0, 0, 0])), 0.5, 0.7)
    out = unless_rims_tell(fit, VIDEO, tracks(POINTS, 20.0), edges, Asked(found), lambda points, rims: plate)
    assert (out is fit) != agrees
    assert not agrees or out.std["axis_deg"] == FACTOR * 12.0


@pytest.mark.parametrize("refused", [True, False])
@pytest.mark.parametrize(("followers", "probability", "agrees", "counts"), [
    (12, 0.9, False, True),
    (12, 0.7, False, False),
    (8, 0.9, False, False),
    (12, 0.9, True, False),
])  # fmt: skip
def test_a_sure_joint_of_edges_gives_way_to_a_probable_plate_that_more_points_follow(
    refused, followers, probability, agrees, counts
):
    turned = joint("ok", np.concatenate([np.arange(followers), np.arange(POINTS, POINTS + EDGES)]), 30.0)
    plate = FlatFit(turned if agrees else replace(turned, axis=np.array([1.0, 0, 0])), probability, 0.7)
    fit = REFUSED if refused else joint("ambiguous", BOTH_IDS, 20.0)
    ask = Asked(joint("ok", OTHER_IDS, 6.0))
    out = unless_rims_tell(fit, VIDEO, tracks(POINTS, 20.0), edges, ask, lambda points, rims: plate)
    assert out.verdict == "ambiguous" and len(ask.of) == 1
    assert out.std["axis_deg"] == FACTOR * (30.0 if counts else 6.0)
    assert len(out.point_track) == (followers if counts else len(POINT_IDS))


@pytest.mark.parametrize(("probability", "share", "agrees", "counts"), [
    (0.9, 0.9, False, True),
    (0.7, 0.9, False, False),
    (0.9, 0.7, False, False),
    (0.9, 0.9, True, False),
])  # fmt: skip
def test_a_doubtful_joint_gives_way_to_a_plate_that_nearly_all_edges_follow(probability, share, agrees, counts):
    fit, other = joint("ambiguous", BOTH_IDS, 4.0), joint("ok", OTHER_IDS, 8.0)
    plate = FlatFit(other if agrees else replace(other, axis=np.array([1.0, 0, 0])), probability, share)
    out = unless_rims_tell(fit, VIDEO, tracks(POINTS, 20.0), edges, Asked(), lambda points, rims: plate)
    assert (out is not fit) == counts
    assert not counts or (out.verdict == "ambiguous" and out.std["axis_deg"] == FACTOR * 8.0)


def test_a_doubtful_joint_stays_where_edges_are_no_plates():
    fit = joint("ambiguous", BOTH_IDS, 4.0)
    assert unless_rims_tell(fit, VIDEO, tracks(POINTS, 20.0), edges, Asked(), no_plate) is fit

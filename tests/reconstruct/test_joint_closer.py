"""When points are followed up to the hands' rims, and what becomes of what they show."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reconstruct.cues import Hands, ProviderInfo, Tracks
from reconstruct.joint.answers import FACTOR
from reconstruct.joint.closer import unless_hands_hide_it
from reconstruct.joint.models import JointFit
from reconstruct.joint.result import FREELY
from reconstruct.video import Video

T = 12
INFO = ProviderInfo("t", "1", "Apache-2.0")
VIDEO = Video(Path("none.mp4"), "0" * 64, (640, 480), np.arange(T) / 30, np.arange(T), T,
              np.broadcast_to(np.zeros((1, 1, 1, 3), np.uint8), (T, 480, 640, 3)), 1.0)  # fmt: skip
SEEN = np.zeros((T, 480, 640), bool)
SEEN[:, 200:300, 200:300] = True
HANDS = Hands((), SEEN, INFO)
REFUSED = JointFit("refused", "too few tracks agree")


def tracks(count: int) -> Tracks:
    return Tracks(np.zeros((count, T, 2), np.float32), np.ones((count, T), bool), np.zeros(count, int), INFO)


FIRST, CLOSER = tracks(10), tracks(30)


def joint(verdict: str, axis_deg: float, type: str = "revolute", axis=(0, 0, 1.0)) -> JointFit:
    p = {"revolute": 0.99, "prismatic": 0.01} if type == "revolute" else {"revolute": 0.01, "prismatic": 0.99}
    return JointFit(verdict, "tracks agree", type, p, axis=np.array(axis), T_camera_world=np.eye(4),
                    std={"axis_deg": axis_deg, "point_m": 0.01})  # fmt: skip


def followed(count: int, residual_px: float, fit: JointFit) -> JointFit:
    return replace(fit, inliers=count, residual_px=residual_px)


def never(*_) -> None:
    raise AssertionError("points were followed again")


def given(fit: JointFit, found: JointFit) -> tuple[Tracks, JointFit]:
    def ask(some: Tracks) -> JointFit:
        assert some is CLOSER
        return found

    return unless_hands_hide_it(fit, VIDEO, FIRST, HANDS, lambda: CLOSER, ask)


FREE = JointFit("refused", f"{FREELY}: its points follow one 3.1 times more exactly than the best joint (revolute)")


@pytest.mark.parametrize("fit", [joint("ok", 20.0), joint("ambiguous", 4.0), FREE])
def test_what_is_known_or_carried_freely_is_left_alone(fit):
    assert unless_hands_hide_it(fit, VIDEO, FIRST, HANDS, never, never) == (FIRST, fit)


def test_nothing_is_asked_where_no_hand_is_or_the_camera_moves():
    nobody = replace(HANDS, mask=np.zeros_like(SEEN))
    assert unless_hands_hide_it(REFUSED, VIDEO, FIRST, nobody, never, never) == (FIRST, REFUSED)
    moving = replace(VIDEO, warp=np.tile(np.eye(3), (T, 1, 1)))
    assert unless_hands_hide_it(REFUSED, moving, FIRST, HANDS, never, never) == (FIRST, REFUSED)


@pytest.mark.parametrize(
    "fit, found",
    [(REFUSED, joint("ok", 6.0)), (joint("ambiguous", 30.0), joint("ok", 6.0)),
     (joint("ambiguous", 30.0), joint("ambiguous", 15.0)),
     (joint("ambiguous", 30.0), joint("ok", 9.0, axis=(1.0, 0, 0))),
     (followed(48, 0.12, joint("ambiguous", 20.0)), followed(194, 0.06, joint("ambiguous", 40.0, axis=(1.0, 0, 0))))],
)  # fmt: skip
def test_what_points_up_to_the_rims_show_counts_and_is_doubtful(fit, found):
    used, answer = given(fit, found)
    assert used is CLOSER
    assert answer.verdict == "ambiguous"
    assert "up to the hands' rims" in answer.reason and found.reason in answer.reason
    assert answer.std["axis_deg"] == FACTOR * found.std["axis_deg"]
    assert max(answer.type_probability.values()) < 0.9


@pytest.mark.parametrize(
    "fit, found",
    [(REFUSED, REFUSED), (REFUSED, joint("ambiguous", 6.0)), (joint("ambiguous", 30.0), REFUSED),
     (joint("ambiguous", 30.0), joint("ambiguous", 40.0)),
     (joint("ambiguous", 20.0), joint("ok", 9.0, axis=(1.0, 0, 0))),
     (joint("ambiguous", 20.0), joint("ok", 9.0, "prismatic")),
     (followed(48, 0.12, joint("ambiguous", 20.0)), followed(194, 0.06, joint("ok", 9.0, "prismatic"))),
     (followed(48, 0.12, joint("ambiguous", 20.0)), followed(140, 0.06, joint("ambiguous", 40.0))),
     (followed(48, 0.12, joint("ambiguous", 20.0)), followed(194, 0.13, joint("ambiguous", 40.0)))],
)  # fmt: skip
def test_what_they_know_no_better_does_not(fit, found):
    assert given(fit, found) == (FIRST, fit)


@pytest.mark.parametrize("slide, counts", [(0.63, False), (0.95, True)])
def test_another_type_counts_only_if_both_make_it_the_more_probable(slide, counts):
    hinge = replace(joint("ambiguous", 40.0), type_probability={"revolute": 0.81, "prismatic": 0.19})
    found = replace(joint("ok", 6.0, "prismatic"), type_probability={"revolute": 1 - slide, "prismatic": slide})
    used, answer = given(hinge, found)
    assert (used is CLOSER) == counts
    assert answer.type == ("prismatic" if counts else "revolute")

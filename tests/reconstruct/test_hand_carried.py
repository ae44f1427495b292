"""A tool in the hand that opens a door: which tracks go with the hand, and the joint beside them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reconstruct.cues import Hands, HandTrack, ProviderInfo, Tracks
from reconstruct.hand.carried import carried, path_px
from reconstruct.joint.fit import fit_joint
from reconstruct.joint.handling import unless_carried
from reconstruct.joint.models import JointFit
from reconstruct.joint.result import FREELY
from tests.reconstruct.joint_scenes import make_video, project

MADE = ProviderInfo("made", "0", "Apache-2.0")
T, DOOR, TOOL, ROOM = 90, 30, 100, 60
AXIS, HINGE = np.array([0.0, 1.0, 0.0]), np.array([-0.3, 0.0, 1.5])
FREE = JointFit("refused", f"{FREELY}, not about one joint")


def scene(seed: int = 0) -> tuple[Tracks, Hands]:
    """A door that turns by 25 deg from frame 30 to 60, by a tool in a hand that comes from 0.2 m and leaves so.

    The first DOOR tracks are the door's, each seen for 30 frames, the next TOOL the tool's, the others the room's. The
    tool sways with the hand.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(T)
    R = Rotation.from_rotvec(np.radians(25) * np.clip((t - 30) / 30, 0, 1)[:, None] * AXIS)
    on_door = rng.uniform([0.02, -0.25, 0], [0.6, 0.25, 0], (DOOR, 3))
    door = HINGE + np.stack([R.apply(p) for p in on_door])
    handle = HINGE + R.apply([0.55, 0.1, -0.05])
    off = 0.2 * np.clip(np.abs(t - 45) / 15 - 1, 0, 2)[:, None] / 2 * [0.6, 0.8, -0.2]
    sway = Rotation.from_euler("xyz", np.radians(4) * np.sin(t[:, None] / [9.0, 14.0, 11.0] + [0, 1, 2]))
    carries = lambda p: handle + off + sway.apply(p)  # noqa: E731
    tool = np.stack([carries(p) for p in rng.uniform([-0.06, -0.16, -0.05], [0.06, -0.02, 0.05], (TOOL, 3))])
    room = np.repeat(rng.uniform([-0.8, -0.4, 1.6], [0.8, 0.4, 2.5], (ROOM, 1, 3)), T, axis=1)
    uv = project(np.concatenate([door, tool, room])) + rng.normal(0, 0.2, (DOOR + TOOL + ROOM, T, 2))
    visible = np.ones(uv.shape[:2], bool)
    first = rng.integers(10, T - 40, (DOOR, 1))
    visible[:DOOR] = (t >= first) & (t < first + 30)
    uv[~visible] = np.nan
    hand = rng.uniform([-0.04, 0, -0.02], [0.04, 0.1, 0.02], (21, 3))
    hand[[0, 9]] = [0, 0.1, 0], [0, 0, 0]
    marks = np.stack([project(carries(p)) for p in hand], axis=1) + rng.normal(0, 1.0, (T, 21, 2))
    valid = t > 2
    marks[~valid] = np.nan
    track = HandTrack("right", marks, np.zeros((T, 21, 3)), valid.astype(float), valid)
    cast = np.zeros(len(uv), bool)
    tracks = Tracks(uv.astype(np.float32), visible, np.zeros(len(uv), int), MADE,
                    np.zeros((*uv.shape[:2], 2), np.float32), cast, cast)  # fmt: skip
    return tracks, Hands((track,), np.zeros((T, 1, 1), bool), MADE)


def share_of(which: np.ndarray) -> list[float]:
    return [float(which[k].mean()) for k in (slice(DOOR), slice(DOOR, DOOR + TOOL), slice(DOOR + TOOL, None))]


@pytest.mark.parametrize("seed", range(3))
def test_the_tool_goes_with_the_hand_and_the_door_does_not(seed):
    tracks, hands = scene(seed)
    door, tool, room = share_of(carried(tracks, hands)[0])
    assert tool > 0.9 and door < 0.2 and room < 0.2
    none = Hands((), hands.mask, MADE)
    assert carried(tracks, none).shape == (0, len(tracks.uv))
    unseen = replace(hands.tracks[0], uv=np.full((T, 21, 2), np.nan), valid=np.zeros(T, bool))
    assert not carried(tracks, Hands((unseen,), hands.mask, MADE)).any()


def test_what_is_seen_for_a_few_frames_is_not_told():
    tracks, hands = scene()
    visible = tracks.visible & (np.arange(T) < 8)
    assert not carried(replace(tracks, visible=visible), hands).any()


def test_what_is_beside_the_tool_goes_with_it():
    """A track that slides to and fro along its edge, a pixel from those of the tool."""
    tracks, hands = scene()
    uv = tracks.uv.copy()
    uv[-1] = uv[DOOR] + [1.0, 0.0]
    assert carried(replace(tracks, uv=uv), hands)[0, -1]


def test_the_way_of_a_hand():
    _, hands = scene()
    way = path_px(hands.tracks[0])
    assert way.shape == (T - 1,) and (way[:3] == 0).all()
    assert way[5:13].mean() > 1 and np.isfinite(way).all()


def test_a_door_is_found_beside_the_tool_that_opens_it():
    """By the real search, where the tool was found to be a free body."""
    tracks, hands = scene()
    video = make_video(T)
    fit = unless_carried(FREE, video, tracks, hands, lambda some: fit_joint(video, some, 768.0, camera_moving=False))
    assert (fit.verdict, fit.type) == ("ambiguous", "revolute"), fit.reason
    assert fit.reason.startswith("without what a hand carries") and fit.type_probability["revolute"] < 0.9
    axis = fit.T_camera_world[:3, :3] @ fit.axis
    assert np.degrees(np.arccos(min(1, abs(axis @ AXIS)))) < 2.0
    assert np.degrees(np.ptp(fit.q)) == pytest.approx(25, abs=5)
    assert (fit.point_track < DOOR).mean() > 0.9


def answer(verdict: str, moves: slice) -> JointFit:
    """A hinge whose part moves in some frames."""
    p = {"revolute": 0.99, "prismatic": 0.01}
    return JointFit(verdict, "tracks agree", "revolute", p, moving_frames=np.isin(np.arange(T), np.arange(T)[moves]))


def asked(fit: JointFit, found: JointFit, hold: bool = True) -> tuple[JointFit, list[np.ndarray]]:
    """What becomes of a fit where so much is found without what a hand carries, and what was asked."""
    tracks, hands = scene()
    seen = []

    def ask(some: Tracks) -> JointFit:
        seen.append(some.visible.any(1))
        return found

    return unless_carried(fit, make_video(T), tracks, hands if hold else Hands((), hands.mask, MADE), ask), seen


@pytest.mark.parametrize("verdict", ["ok", "ambiguous"])
def test_a_joint_whose_part_rests_while_the_hand_goes_on_counts_and_is_doubtful(verdict):
    fit, seen = asked(FREE, answer(verdict, slice(30, 61)))
    assert len(seen) == 1 and share_of(seen[0])[1] < 0.1 < 0.8 < share_of(seen[0])[0]
    assert fit.verdict == "ambiguous" and fit.type_probability["revolute"] < 0.9
    assert fit.reason.startswith("without what a hand carries")


@pytest.mark.parametrize("found", [
    answer("ok", slice(None)),  # goes whenever the hand goes
    answer("ambiguous", slice(None)),
    JointFit("refused", "nothing"),
])  # fmt: skip
def test_what_goes_with_the_hand_does_not(found):
    fit, seen = asked(FREE, found)
    assert fit is FREE and len(seen) == 1


def test_it_is_asked_only_where_a_free_body_refutes_the_joint_and_a_hand_carries_it():
    found = answer("ok", slice(30, 61))
    for fit in (found, JointFit("refused", "too few tracks agree")):
        assert asked(fit, found) == (fit, [])
    assert asked(FREE, found, hold=False) == (FREE, [])


def test_a_held_camera_is_not_asked():
    tracks, hands = scene()
    video = replace(make_video(T), warp=np.tile(np.eye(3), (T, 1, 1)))
    assert unless_carried(FREE, video, tracks, hands, never) is FREE


def never(_: Tracks) -> JointFit:
    raise AssertionError("it was asked")

"""Tracks on a forearm: what stays beyond the wrist of a moving hand."""

import numpy as np
import pytest

from reconstruct.cues import Hands, HandTrack, ProviderInfo, Tracks
from reconstruct.hand.forearm import on_forearm
from reconstruct.joint.models import JointFit
from reconstruct.pipeline import ARM_SHARE, joint_off_the_arm
from tests.reconstruct.joint_scenes import make_video

MADE = ProviderInfo("made", "0", "Apache-2.0")
T = 40


def hand_path(turn: float) -> tuple[Hands, np.ndarray, np.ndarray]:
    """A palm of 80 px whose wrist goes 200 px to the right, and the direction of its forearm."""
    along = np.array([np.cos(turn), np.sin(turn)])
    wrist = np.array([400.0, 300.0]) + np.linspace(0, 200, T)[:, None] * [1, 0]
    uv = np.repeat(wrist[:, None], 21, axis=1) - 80 * along * (np.arange(21) > 0)[:, None]
    valid = np.arange(T) > 3
    uv[~valid] = np.nan
    track = HandTrack("right", uv, np.zeros((T, 21, 3)), valid.astype(float), valid)
    return Hands((track,), np.zeros((T, 1, 1), bool), MADE), wrist, along


@pytest.mark.parametrize("turn", [0.3, 1.6, 4.0])
def test_only_what_stays_beyond_the_wrist(turn):
    hands, wrist, along = hand_path(turn)
    rng = np.random.default_rng(0)
    across = np.array([-along[1], along[0]])
    sleeve = wrist + (rng.uniform(30, 250, (30, 1)) * along + rng.uniform(-50, 50, (30, 1)) * across)[:, None]
    held = wrist - (rng.uniform(90, 250, (30, 1)) * along + rng.uniform(-90, 90, (30, 1)) * across)[:, None]
    room = np.repeat(rng.uniform([0, 0], [960, 540], (60, 1, 2)), T, axis=1)
    uv = np.concatenate([sleeve, held, room])
    visible = np.ones(uv.shape[:2], bool)
    # The room behind the arm is hidden by it.
    d = uv[60:] - wrist
    visible[60:] &= ~((d @ along > 0) & (np.abs(d @ across) < 60))
    tracks = Tracks(uv.astype(np.float32), visible, np.zeros(120, int), MADE)
    found = on_forearm(tracks, hands)
    assert found[:30].all()
    assert not found[30:60].any()
    assert found[60:].mean() < 0.1
    assert not on_forearm(tracks, Hands((), hands.mask, MADE)).any()


@pytest.mark.parametrize("share", [0.0, 0.1, 0.4])
def test_the_joint_is_sought_off_the_arm(share, monkeypatch):
    """Which tracks the search is given, not the search: `benchmarks.articulation --rows 4` has rendered sleeves."""
    fit, asked, arms = _asked(share, monkeypatch, refuses=lambda arms: arms)
    assert fit.verdict == "ok" and len(asked) == 1 and np.array_equal(asked[0], ~arms)
    assert fit.reason == ("without what is on an arm, found" if share >= ARM_SHARE else "found")


@pytest.mark.parametrize("share, on_the_arm", [(0.1, False), (0.4, False), (0.4, True)])
def test_a_part_in_the_wedge_is_found_all_the_same_and_an_arm_is_none(share, on_the_arm, monkeypatch):
    fit, asked, arms = _asked(share, monkeypatch, refuses=lambda arms: not arms, on_the_arm=on_the_arm)
    assert np.array_equal(asked[0], ~arms) and (len(asked) == 2) == (share >= ARM_SHARE)
    if share >= ARM_SHARE:
        assert asked[1].all()
    assert fit.verdict == ("ok" if share >= ARM_SHARE and not on_the_arm else "refused")


def _asked(share, monkeypatch, refuses, on_the_arm=False):
    """The answer of a search that refuses with or without an arm's tracks, what it was given, which are on the arm."""
    hands, wrist, along = hand_path(0.3)
    rng = np.random.default_rng(0)
    sleeve = wrist + (rng.uniform(30, 250, (int(100 * share), 1)) * along)[:, None]
    held = wrist - (rng.uniform(90, 250, (100 - len(sleeve), 1)) * along)[:, None]
    uv = np.concatenate([sleeve, held]).astype(np.float32)
    uv += (rng.uniform(-9, 9, (100, 1)) * [-along[1], along[0]])[:, None]  # what is on one line is asked again
    tracks = Tracks(uv, np.ones(uv.shape[:2], bool), np.zeros(100, int), MADE)
    arms, asked = np.arange(100) < len(sleeve), []

    def search(video, tracks, focal, seed, progress, camera_moving, pictures):
        asked.append(tracks.visible.any(1))
        if refuses(bool(asked[-1][arms].any())):
            return JointFit("refused", "a free body")
        return JointFit("ok", "found", "revolute", point_track=np.flatnonzero(arms if on_the_arm else ~arms))

    monkeypatch.setattr("reconstruct.joint.fit.fit_joint", search)
    return joint_off_the_arm(make_video(T), tracks, hands, None, 0, lambda _: None), asked, arms

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


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_where_an_arm_may_hide_the_joint_it_is_sought_without_it(share, monkeypatch):
    """Which tracks the search is given, not the search: `benchmarks.articulation --rows 4` has rendered sleeves."""
    hands, wrist, along = hand_path(0.3)
    rng = np.random.default_rng(0)
    sleeve = wrist + (rng.uniform(30, 250, (int(100 * share), 1)) * along)[:, None]
    held = wrist - (rng.uniform(90, 250, (100 - len(sleeve), 1)) * along)[:, None]
    uv = np.concatenate([sleeve, held]).astype(np.float32)
    tracks = Tracks(uv, np.ones(uv.shape[:2], bool), np.zeros(100, int), MADE)
    asked = []

    def refusing_arms(video, tracks, focal, seed, progress, camera_moving):
        asked.append(tracks.visible.any(1))
        arms = asked[-1][: len(sleeve)].any()
        return JointFit("refused", "a free body") if arms else JointFit("ok", "found", "revolute")

    monkeypatch.setattr("reconstruct.joint.fit.fit_joint", refusing_arms)
    fit = joint_off_the_arm(make_video(T), tracks, hands, None, 0, lambda _: None)
    if share < ARM_SHARE:
        assert (fit.verdict, fit.reason, len(asked)) == ("refused", "a free body", 1)
    else:
        assert (fit.verdict, fit.reason) == ("ok", "without the arm that moved most, found")
        assert len(asked) == 2 and asked[0].all()
        assert np.array_equal(asked[1], np.arange(100) >= len(sleeve))

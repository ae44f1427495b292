"""Tracks that wander on faint paint, and what may be taken for such."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruct.cues import Hands, ProviderInfo, Tracks
from reconstruct.joint.models import JointFit
from reconstruct.joint.wander import AS_FAR, FEWEST, LEAVES_SHARE, wandering
from reconstruct.pipeline import joint_off_the_arm
from tests.reconstruct.joint_scenes import make_video

MADE = ProviderInfo("made", "0", "Apache-2.0")
FRAMES, COUNT = 40, 200


def tracks_of(video, way, slip=None):
    """Tracks (N, T, 2), working px from their first places, that are held alike in all directions or slip."""
    start = np.random.default_rng(9).uniform(60, 300, (len(way), 1, 2))
    uv = video.to_full(start + way).astype(np.float32)
    slip = np.zeros(uv.shape) if slip is None else slip
    return Tracks(uv, np.ones(uv.shape[:2], bool), np.zeros(len(uv), int), MADE, slip)


def walks(rng, count=COUNT, step=0.7):
    return np.cumsum(rng.normal(scale=step, size=(count, FRAMES, 2)), axis=1)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.5, 3.0), st.integers(0, 99))
def test_most_random_walks_are_told_whatever_their_step(step, seed):
    video = make_video(FRAMES)
    out = wandering(video, tracks_of(video, walks(np.random.default_rng(seed), step=step)))
    assert 0.35 < out.mean() < 0.75


@pytest.mark.parametrize("frames", [6, 20, 40])
def test_what_goes_somewhere_at_rest_or_held_across_an_edge_only_is_none(frames):
    """Motions of six px and more, within some frames or all; points that rest; edges along which tracks slide."""
    video, rng = make_video(FRAMES), np.random.default_rng(1)
    s = np.clip((np.arange(FRAMES) - 1) / (frames - 2), 0, 1)
    goes = (3 * s**2 - 2 * s**3)[:, None] * rng.choice([-1, 1], (COUNT, 1, 2)) * rng.uniform(6, 40, (COUNT, 1, 1))
    noise = rng.normal(scale=0.1, size=goes.shape)
    assert wandering(video, tracks_of(video, goes + noise)).mean() < 0.02
    assert not wandering(video, tracks_of(video, noise)).any()
    along = np.array([0.6, 0.8])
    slides = goes + noise + walks(rng, step=2.0)[..., :1] * along
    edge = np.broadcast_to(0.99 * along, slides.shape)
    across = np.abs(goes[:, -1] @ [-0.8, 0.6]) > 4
    assert wandering(video, tracks_of(video, slides, edge))[across].mean() < 0.05


def test_nothing_is_said_of_short_tracks_of_other_trackers_and_before_a_moving_camera():
    video, rng = make_video(FRAMES), np.random.default_rng(2)
    tracks = tracks_of(video, walks(rng))
    assert wandering(video, tracks).any()
    assert not wandering(video, replace(tracks, slip=None)).any()
    moved = replace(video, warp=np.tile(np.eye(3), (FRAMES, 1, 1)))
    assert not wandering(moved, tracks).any()
    seen = tracks.visible & (np.arange(FRAMES) < FEWEST - 1)
    assert not wandering(video, replace(tracks, visible=seen)).any()
    # Every second frame: no two steps in a row, no unrest.
    seen = tracks.visible & (np.arange(FRAMES) % 2 == 0)
    assert not wandering(video, replace(tracks, visible=seen)).any()
    still = np.zeros((3, FRAMES, 2))
    still[:, -1] = 0.9 * LEAVES_SHARE * np.hypot(*video.size) * video.scale / np.sqrt(2)
    assert not wandering(video, tracks_of(video, still)).any()
    assert AS_FAR > 1


def test_the_pipeline_asks_for_the_joint_without_them(monkeypatch):
    video, rng = make_video(FRAMES), np.random.default_rng(3)
    way = walks(rng)
    way[:50] = np.arange(FRAMES)[:, None] * [0.8, 0.1]
    tracks, asked = tracks_of(video, way), []

    def fit_joint(_, some, *__, **___):
        asked.append(some.visible.any(1))
        return JointFit("refused", "the part moves as a free body")

    monkeypatch.setattr("reconstruct.joint.fit.fit_joint", fit_joint)
    joint_off_the_arm(video, tracks, Hands((), None, MADE), None, 0, lambda _: None)
    assert asked[0][:50].all() and (~asked[0] == wandering(video, tracks)).all() and not asked[0].all()

"""A second part that moves after the first is named; an arm that passes is not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from reconstruct.cues import ProviderInfo, Tracks
from reconstruct.joint.models import JointFit
from reconstruct.others import second_part, words_of
from reconstruct.video import Video

T = 90


@pytest.fixture
def video():
    black = np.broadcast_to(np.uint8(0), (T, 540, 960, 3))
    return Video(Path("x.mp4"), "", (960, 540), np.arange(T) / 30, np.arange(T), T, black, 1.0)


def scene(rng: np.random.Generator, other: np.ndarray) -> tuple[Tracks, JointFit]:
    """30 tracks on a part that slides from frame 10 to 30, and 20 that move by other (T, 2)."""
    ramp = np.clip((np.arange(T) - 10) / 20, 0, 1)
    own = rng.uniform(100, 400, (30, 1, 2)) + ramp[:, None] * [80, 0]
    rest = rng.uniform(400, 500, (20, 1, 2)) + other
    uv = np.concatenate([own, rest]) + rng.normal(0, 0.3, (50, T, 2))
    tracks = Tracks(uv, np.ones((50, T), bool), np.zeros(50, int), ProviderInfo("test", "1", "none"))
    fit = JointFit("ok", "", "prismatic", q=ramp, point_track=np.arange(30), moving_frames=(ramp > 0) & (ramp < 1))
    return tracks, fit


def test_a_second_drawer_is_named_with_its_time(video):
    later = np.clip((np.arange(T) - 50) / 20, 0, 1)[:, None] * [0, 60.0]
    other = second_part(video, *scene(np.random.default_rng(0), later))
    assert other is not None and set(other.tracks) == set(range(30, 50))
    assert "from 1.7 to 2.3 s" in words_of(video, other)


@pytest.mark.parametrize("what", ["still", "arm", "together"])
def test_what_is_no_second_part(video, what):
    t = np.arange(T)[:, None]
    motion = {
        "still": np.zeros((T, 2)),
        "arm": 60 * np.concatenate([np.sin(t / 9), np.cos(t / 7)], axis=1) + t * [1.0, 0.3],
        "together": np.clip((t - 10) / 20, 0, 1) * [0, 60.0],
    }[what]
    assert second_part(video, *scene(np.random.default_rng(1), motion)) is None

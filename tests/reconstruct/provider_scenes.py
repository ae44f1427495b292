"""A small textured clip with known tracks, for providers that only have to run."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reconstruct.cues import Hands, HandTrack, ProviderInfo, Tracks
from reconstruct.cues_io import CueFolder
from reconstruct.providers.make import Request
from reconstruct.providers.settings import Settings
from reconstruct.video import Video

T, W, H = 6, 96, 64
MAKER = ProviderInfo("test", "1", "none")


def small_video(frames: int = T) -> Video:
    """A bright square that slides over noise; full size is twice the working size."""
    rng = np.random.default_rng(5)
    ground = rng.integers(60, 120, (H, W, 3), np.uint8)
    picture = np.stack([ground] * frames)
    for t in range(frames):
        picture[t, 20:44, 20 + 3 * t : 44 + 3 * t] = (40, 200, 220)
    return Video(Path("small.mp4"), "0" * 64, (2 * W, 2 * H), np.arange(frames) / 10, np.arange(frames), frames,
                 picture, 0.5)  # fmt: skip


def small_tracks(video: Video) -> Tracks:
    """A grid of points on the square and one on the ground around it, full px."""
    y, x = (a.ravel() for a in np.mgrid[24:42:4, 24:42:4])
    moving = np.stack([x, y], -1)[:, None] + np.stack([3 * np.arange(len(video)), np.zeros(len(video))], -1)[None]
    y, x = (a.ravel() for a in np.mgrid[4:60:8, 4:92:8])
    rest = np.stack([x, y], -1).astype(float)
    rest = rest[~((rest[:, 1] > 16) & (rest[:, 1] < 48) & (rest[:, 0] > 16) & (rest[:, 0] < 64))]
    uv = video.to_full(np.concatenate([moving, np.repeat(rest[:, None], len(video), axis=1)]))
    return Tracks(uv, np.ones(uv.shape[:2], bool), np.zeros(len(uv), int), MAKER)


def small_hands(video: Video) -> Hands:
    """One hand in the lower right corner."""
    rng = np.random.default_rng(1)
    uv = video.to_full(np.array([80.0, 54.0]) + rng.uniform(-6, 6, (len(video), 21, 2)))
    metric = rng.uniform(-0.05, 0.05, (len(video), 21, 3))
    mask = np.zeros((len(video), H, W), bool)
    mask[:, 48:60, 74:86] = True
    valid = np.ones(len(video), bool)
    return Hands((HandTrack("right", uv, metric, valid.astype(float), valid),), mask, MAKER)


def small_request(folder: Path, sections: dict | None = None, chosen: dict | None = None, video: Video | None = None,
                  **more) -> Request:  # fmt: skip
    video = video or small_video()
    return Request(video, CueFolder(folder, chosen), folder / "providers", Settings(None, sections or {}), chosen or {},
                   **more)  # fmt: skip

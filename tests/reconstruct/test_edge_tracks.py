"""Straight edges that are followed: how exactly, for how long, and which are not."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from reconstruct.cues import Tracks
from reconstruct.joint.photometric import Pictures
from reconstruct.providers.edge_tracks import LIFE, all_segments, edge_tracks, segments
from reconstruct.video import Video

T, W, H = 20, 320, 240
BAR = np.array([[-60.0, -14], [60, -14], [60, 14], [-60, 14]])
TURN = np.radians(1.5)


def ground(seed: int = 0) -> np.ndarray:
    """(H, W, 3) uint8, mottled, so that what lies behind a rim changes as it goes."""
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.normal(size=(H, W)).astype(np.float32), (0, 0), 4)
    return np.repeat((190 + 12 * noise / noise.std()).clip(150, 230).astype(np.uint8)[..., None], 3, axis=2)


def corners(t: int, turns: bool = True) -> np.ndarray:
    """(4, 2) px of the bar in a frame: it turns about a point beside it."""
    a = TURN * t * turns
    R = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    return (BAR + [70, 0]) @ R.T + [90, 90]


def film(turns: bool = True, shadow: bool = False) -> Video:
    """A plain bar that turns over the ground, or what it darkens there."""
    frames = []
    for t in range(T):
        picture = ground().astype(float)
        # Drawn four times as large, for edges that go by parts of a pixel.
        mask = np.zeros((4 * H, 4 * W), np.uint8)
        cv2.fillPoly(mask, [np.round(4 * corners(t, turns) + 1.5).astype(np.int32)], 255)
        share = cv2.resize(mask, (W, H), interpolation=cv2.INTER_AREA)[..., None] / 255
        inside = 0.55 * picture if shadow else np.array([60.0, 40, 170])
        frames.append((share * inside + (1 - share) * picture).round().astype(np.uint8))
    return Video(Path("bar.mp4"), "0" * 64, (W, H), np.arange(T) / 24, np.arange(T), T, np.stack(frames), 1.0)


def pictures(video: Video, covered: np.ndarray | None = None) -> Pictures:
    grey = np.stack([cv2.cvtColor(f, cv2.COLOR_BGR2GRAY) for f in video.frames])
    hidden = np.zeros(grey.shape, bool) if covered is None else covered
    return Pictures(grey, hidden, np.array([(W - 1) / 2, (H - 1) / 2]))


def followed_in(video: Video) -> Tracks:
    p = pictures(video)
    return edge_tracks(video, p, all_segments(video, p))


def long_sides(tracks: Tracks) -> np.ndarray:
    """(N,) bool: seeded on one of the bar's long sides."""
    out = np.zeros(len(tracks.uv), bool)
    for i, f in enumerate(tracks.reference):
        c = corners(int(f))
        for a, b in ((c[0], c[1]), (c[2], c[3])):
            along = (b - a) / np.linalg.norm(b - a)
            d = tracks.uv[i, f] - a
            out[i] |= abs(d[0] * along[1] - d[1] * along[0]) < 1.0 and 0 < d @ along < np.linalg.norm(b - a)
    return out


def off_px(tracks: Tracks, rows: np.ndarray) -> np.ndarray:
    """(n, T) px, how far tracks are from the nearer long side."""
    out = np.full((len(rows), T), np.inf)
    for t in range(T):
        c = corners(t)
        for a, b in ((c[0], c[1]), (c[2], c[3])):
            along = (b - a) / np.linalg.norm(b - a)
            d = tracks.uv[rows, t] - a
            out[:, t] = np.fmin(out[:, t], np.abs(d[:, 0] * along[1] - d[:, 1] * along[0]))
    return np.where(tracks.visible[rows], out, np.nan)


def test_a_plain_bars_sides_are_held_to_a_tenth_of_a_pixel_over_a_mottled_ground():
    video = film()
    tracks = followed_in(video)
    rows = np.flatnonzero(long_sides(tracks))
    assert len(rows) >= 8
    assert np.median(tracks.visible[rows].sum(1)) >= 0.5 * T
    off = off_px(tracks, rows)
    assert np.nanmedian(off) < 0.15
    assert np.nanquantile(off, 0.95) < 0.5


def test_slip_is_all_along_the_edge_and_nothing_where_it_is_not_seen():
    video = film()
    tracks = followed_in(video)
    for i in np.flatnonzero(long_sides(tracks)):
        f = int(tracks.reference[i])
        c = corners(f)
        along = (c[1] - c[0]) / np.linalg.norm(c[1] - c[0])
        assert abs(tracks.slip[i, f] @ along) == pytest.approx(1.0, abs=2e-3)
    assert tracks.visible[np.arange(len(tracks.uv)), tracks.reference].all()
    assert np.all(tracks.slip[~tracks.visible] == 0)
    assert np.all(tracks.visible.sum(1) >= LIFE)


def test_from_frame_to_frame_a_point_goes_across_its_edge_only():
    video = film()
    tracks = followed_in(video)
    rows = np.flatnonzero(long_sides(tracks))
    step, slip = np.diff(tracks.uv[rows], axis=1), tracks.slip[rows]
    both = tracks.visible[rows][:, 1:] & tracks.visible[rows][:, :-1]
    # Followed both ways from where it was set: across the edge of the later frame, seen from there.
    later = np.arange(1, T) > tracks.reference[rows][:, None]
    at = np.where(later[..., None], slip[:, 1:], slip[:, :-1])
    assert np.abs(np.sum(step * at, axis=2))[both].max() < 1e-3


def test_what_rests_gives_no_tracks():
    video = film(turns=False)
    assert len(followed_in(video).uv) == 0


def test_what_a_hand_covers_gives_no_segments():
    video = film()
    seen = pictures(video)
    every = segments(seen.grey[0], video.frames[0], seen.covered[0])
    none = segments(seen.grey[0], video.frames[0], np.ones((H, W), bool))
    assert len(every.length) >= 4
    assert len(none.length) == 0


def test_a_shadows_edges_are_left_out():
    bar, shadow = film(), film(shadow=True)
    on_bar = followed_in(bar)
    on_shadow = followed_in(shadow)
    assert long_sides(on_bar).sum() >= 8
    assert long_sides(on_shadow).sum() <= 0.2 * long_sides(on_bar).sum()


def test_the_brighter_side_is_on_the_right_of_a_segment():
    video = film()
    seen = pictures(video)
    found = segments(seen.grey[0], video.frames[0], seen.covered[0])
    assert np.all(found.sides[:, 0].sum(1) >= found.sides[:, 1].sum(1))
    # A dark bar: of its two long sides the brighter is outside.
    middle = corners(0).mean(0)
    long = found.length > 80
    assert long.sum() >= 2
    assert np.all(np.sum((found.middle[long] - middle) * found.across[long], axis=1) > 0)

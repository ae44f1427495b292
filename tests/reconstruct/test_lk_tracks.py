"""Tracks on a turning textured plate over a textured background."""

import cv2
import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from reconstruct.cues import Hands, ProviderInfo
from reconstruct.providers.lk_tracks import CLOSE_PX, LEAST_PIECE, MARGIN_PX, pictures_of, pieces, track_points
from reconstruct.providers.seeds import (
    GRAIN_APART,
    change_region,
    enclosed,
    even_exposure,
    faint_surface,
    grain,
    pixel_noise,
    reference_frames,
)
from tests.reconstruct.joint_scenes import make_video
from tests.reconstruct.textures import turning_plate


def plate_beneath_a_hand():
    """A video, a hand that covers the same pixels in all of its 24 frames, and the plate's homographies."""
    frames, H = turning_plate(24)
    mask = np.zeros(frames.shape[:3], bool)
    mask[:, 150:190, 200:260] = True
    return make_video(len(frames)).with_frames(frames), Hands((), mask, ProviderInfo("made", "0", "Apache-2.0")), H


def test_tracks_follow_the_plate_and_stay_off_hands():
    video, hands, H = plate_beneath_a_hand()
    mask = hands.mask
    tracks = track_points(video, hands)
    extent = np.linalg.norm(np.nanmax(tracks.uv, axis=1) - np.nanmin(tracks.uv, axis=1), axis=-1)
    moving = np.flatnonzero((extent > 10) & (tracks.visible.sum(1) > 8))
    assert len(moving) > 40
    errors = []
    for i in moving:
        r = tracks.reference[i]
        t = np.flatnonzero(tracks.visible[i])
        base = cv2.perspectiveTransform(tracks.uv[i, r].reshape(1, 1, 2).astype(float), np.linalg.inv(H[r]))
        truth = np.array([cv2.perspectiveTransform(base, H[k])[0, 0] for k in t])
        errors.append(np.median(np.linalg.norm(truth - tracks.uv[i, t], axis=-1)))
    assert np.median(errors) < 1.0
    # No visible observation under the hand.
    n, t = np.nonzero(tracks.visible)
    u, v = np.round(tracks.uv[n, t]).astype(int).T
    assert not mask[t, v, u].any()
    # Seeds come from several frames and are followed both ways.
    assert len(set(tracks.reference)) > 5
    both = [
        (tracks.visible[i, : tracks.reference[i]].any() and tracks.visible[i, tracks.reference[i] + 1 :].any())
        for i in moving
    ]
    assert np.mean(both) > 0.3


def test_points_are_followed_off_hands_by_a_margin_that_may_be_given():
    video, hands, _ = plate_beneath_a_hand()
    for margin, found in ((MARGIN_PX, pictures_of(video, hands)), (CLOSE_PX, pictures_of(video, hands, CLOSE_PX))):
        y, x = np.nonzero(found.covered[0])
        assert (y.min(), y.max(), x.min(), x.max()) == (150 - margin, 189 + margin, 200 - margin, 259 + margin)
    seen = []
    for margin in (MARGIN_PX, CLOSE_PX):
        tracks = track_points(video, hands, margin_px=margin)
        n, t = np.nonzero(tracks.visible)
        u, v = np.round(tracks.uv[n, t]).astype(int).T
        seen.append(int(((u > 190) & (u < 270) & (v > 140) & (v < 200)).sum()))
    assert seen[1] > 1.3 * seen[0]


def test_change_region_covers_the_motion_only():
    frames, _ = turning_plate(10)
    region = change_region(make_video(10).with_frames(frames))
    assert region[150:250, 200:300].mean() > 0.5
    assert region[:60].mean() < 0.05


def test_reference_frames_follow_the_motion():
    frames, _ = turning_plate(20)
    still = np.concatenate([np.repeat(frames[:1], 20, axis=0), frames])
    refs = reference_frames(make_video(40).with_frames(still))
    assert refs[0] == 0 and refs[-1] == 39
    assert (refs > 19).sum() > 2 * (refs <= 19).sum()


def test_exposure_jumps_do_not_drag_points():
    frames, _ = turning_plate(2)
    rng = np.random.default_rng(0)
    bright = [
        np.clip(g * frames[0].astype(float) + o, 0, 255) for g, o in ((1, 0), (1, 0), (0.7, 20), (0.7, 20), (1.2, -10))
    ]
    noisy = np.stack([np.clip(b + rng.normal(scale=1.5, size=b.shape), 0, 255).astype(np.uint8) for b in bright])
    video = make_video(len(noisy)).with_frames(noisy)
    level = np.stack(even_exposure(video)).astype(float)
    assert np.abs(level[:, 40:-40, 40:-40] - np.median(level, axis=0)[40:-40, 40:-40]).mean() < 4
    assert (
        np.array_equal(level[0], cv2.cvtColor(noisy[0], cv2.COLOR_BGR2GRAY)) or np.abs(level[0] - level[1]).mean() < 4
    )
    assert change_region(video).mean() < 0.1


def test_what_the_rim_encloses_is_seeded_too():
    ring = np.zeros((120, 160), bool)
    ring[20:100, 30:36] = ring[20:26, 30:120] = True
    inside = enclosed(ring)
    assert inside[30:50, 40:80].all() and not (inside & ring).any()
    assert not inside[:18].any() and not inside[60:, 100:].any()


def test_faint_texture_in_noise_is_followed_by_its_first_picture(monkeypatch):
    """Noise hides that a faint surface looks like itself; it would be lost in every frame."""
    H = turning_plate(24)[1]
    rng = np.random.default_rng(0)
    grain = cv2.GaussianBlur(rng.standard_normal((360, 480)), (0, 0), 1.5)
    paint = np.zeros_like(grain)
    paint[120:260, 180:330] = 150 + 2.5 * grain[120:260, 180:330] / grain.std()
    seen = np.stack([cv2.warpPerspective(paint, h, paint.shape[::-1]) for h in H])
    frames = np.where(seen > 75, seen, 100) + rng.normal(scale=2.0, size=seen.shape)
    frames = np.repeat(np.clip(frames + 0.5, 0, 255).astype(np.uint8)[..., None], 3, axis=-1)
    video = make_video(len(frames)).with_frames(frames)
    assert 1.7 < pixel_noise(np.stack(even_exposure(video))) < 2.4

    def off() -> np.ndarray:
        """px, of the observations of points well inside the plate that have gone by 5 px or more."""
        tracks, out = track_points(video), []
        for uv, r in zip(tracks.uv.astype(float), tracks.reference, strict=True):
            base = cv2.perspectiveTransform(uv[r].reshape(1, 1, 2), np.linalg.inv(H[r]))
            if not (200 < base[0, 0, 0] < 310 and 140 < base[0, 0, 1] < 240):
                continue
            true = np.array([cv2.perspectiveTransform(base, h)[0, 0] for h in H])
            gone = np.linalg.norm(true - true[r], axis=1) > 5
            out.append(np.linalg.norm(true - uv, axis=-1)[gone & np.isfinite(uv[:, 0])])
        return np.concatenate(out)

    told = off()
    monkeypatch.setattr("reconstruct.providers.lk_tracks.pixel_noise", lambda grey: 0.0)
    untold = off()
    assert np.median(told) < 0.35
    assert (told < 1).sum() > 2 * (untold < 1).sum()


def dark_plate(T: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A turning dark plate of even paint before a bright wall, a sensor whose noise grows with the light; (T, h, w, 3)
    uint8 and homographies from frame 0."""
    H = turning_plate(T)[1]
    texture = cv2.GaussianBlur(rng.standard_normal((360, 480)), (0, 0), 1.5)
    paint = np.zeros_like(texture)
    paint[100:280, 160:350] = 45 + 1.1 * texture[100:280, 160:350] / texture.std()
    seen = np.stack([cv2.warpPerspective(paint, h, paint.shape[::-1]) for h in H])
    light = np.where(seen > 25, seen, 180)
    noisy = light + rng.normal(size=light.shape) * (0.9 + 0.006 * light)
    return np.repeat(np.clip(noisy + 0.5, 0, 255).astype(np.uint8)[..., None], 3, axis=-1), H


def test_grain_of_a_dark_surface_is_followed_by_wide_windows(monkeypatch):
    """Where corners are lost after a few frames."""
    frames, H = dark_plate(16, np.random.default_rng(0))
    video = make_video(len(frames)).with_frames(frames)

    def right() -> tuple[int, float]:
        """Observations well inside the plate, after 4 px or more, that are right to 1 px, and their share."""
        tracks, off = track_points(video), []
        for uv, r in zip(tracks.uv.astype(float), tracks.reference, strict=True):
            base = cv2.perspectiveTransform(uv[r].reshape(1, 1, 2), np.linalg.inv(H[r]))
            if 180 < base[0, 0, 0] < 330 and 120 < base[0, 0, 1] < 260:
                true = np.array([cv2.perspectiveTransform(base, h)[0, 0] for h in H])
                gone = np.linalg.norm(true - true[r], axis=1) > 4
                off.append(np.linalg.norm(true - uv, axis=-1)[gone & np.isfinite(uv[:, 0])])
        err = np.concatenate(off)
        return int((err < 1).sum()), float(np.mean(err < 1))

    number, share = right()
    monkeypatch.setattr("reconstruct.providers.seeds.faint_surface", lambda grey, noise: np.zeros(grey.shape, bool))
    before, _ = right()
    assert number > 2 * before and share > 0.8


def test_faint_is_what_varies_no_more_than_noise_and_seeds_spread_over_it():
    frames, _ = dark_plate(2, np.random.default_rng(1))
    grey = np.stack(even_exposure(make_video(2).with_frames(frames)))
    faint = faint_surface(grey[0], pixel_noise(grey))
    assert faint[140:240, 200:310].mean() > 0.9
    rim = np.zeros_like(faint)
    rim[92:108, 170:340] = True
    assert not faint[rim].any()
    inside = np.zeros_like(faint)
    inside[140:240, 200:310] = True
    p = grain(grey[0], faint & inside)
    x, y = p.round().astype(int).T
    assert len(p) > 30 and inside[y, x].all()
    apart = np.linalg.norm(p[:, None] - p[None], axis=-1)[~np.eye(len(p), dtype=bool)]
    assert apart.min() >= GRAIN_APART
    assert grain(grey[0], np.zeros_like(faint)).shape == (0, 2)


def test_what_was_lost_is_another_track_afterwards():
    T = 40
    uv = np.stack([np.arange(T), np.zeros(T)], axis=-1)[None].repeat(3, axis=0).astype(np.float32)
    uv[1, :5] = uv[1, 30:] = np.nan
    lost = np.zeros((3, T), bool)
    lost[0, [25, 30]] = lost[0, 8] = True  # of what is seen after 25, five frames are too few for a track
    lost[2, 20] = True
    out, start = pieces(uv, np.array([12, 12, 20 - 1]), lost)
    spans = [(int(f[0]), int(f[-1])) for f in (np.flatnonzero(np.isfinite(row[:, 0])) for row in out)]
    assert spans[:3] == [(9, 24), (5, 29), (0, 19)]
    assert sorted(zip(spans[3:], start[3:].tolist(), strict=True)) == [((0, 9), 9), ((19, 39), 19), ((29, 39), 29)]
    for row, frame in zip(out, start, strict=True):
        assert row[frame, 0] == frame and set(np.diff(np.flatnonzero(np.isfinite(row[:, 0])))) == {1}


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6))
@example(20710)  # lost before and after the seed
def test_pieces_keep_every_long_stretch_once(seed):
    rng = np.random.default_rng(seed)
    N, T = 6, 50
    reference = rng.integers(0, T, N)
    low, high = rng.integers(0, reference + 1), rng.integers(reference, T)
    seen = (np.arange(T) >= low[:, None]) & (np.arange(T) <= high[:, None])
    uv = np.where(seen[..., None], rng.uniform(0, 100, (N, T, 2)), np.nan)
    lost = seen & (rng.random((N, T)) < 0.08)
    lost[np.arange(N), reference] = False
    out, start = pieces(uv, reference, lost)
    held = np.isfinite(out[..., 0])
    assert np.isfinite(out[np.arange(len(out)), start, 0]).all()
    assert (held[N:].sum(1) >= LEAST_PIECE).all()
    # An observation is in one piece, or in two where one ends and the next one begins: a seed in three, if its point
    # was lost to either side of it.
    for frame in range(T):
        values = out[held[:, frame], frame, 0]
        assert np.isin(values, uv[:, frame, 0]).all()
        different, count = np.unique(values, return_counts=True)
        seeds = np.isin(different, uv[reference == frame, frame, 0])
        assert (count <= np.where(seeds, 3, 2)).all()

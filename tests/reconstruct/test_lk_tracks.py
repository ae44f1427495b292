"""Tracks on a turning textured plate over a textured background."""

import cv2
import numpy as np

from reconstruct.cues import Hands, ProviderInfo
from reconstruct.providers.lk_tracks import change_region, enclosed, even_exposure, reference_frames, track_points
from tests.reconstruct.joint_scenes import make_video
from tests.reconstruct.textures import turning_plate


def test_tracks_follow_the_plate_and_stay_off_hands():
    frames, H = turning_plate(24)
    video = make_video(len(frames)).with_frames(frames)
    mask = np.zeros(frames.shape[:3], bool)
    mask[:, 150:190, 200:260] = True
    hands = Hands((), mask, ProviderInfo("made", "0", "Apache-2.0"))
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

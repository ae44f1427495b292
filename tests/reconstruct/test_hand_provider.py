"""The hand provider on the shared clips, and its geometry on numbers."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reconstruct.errors import TaaError
from reconstruct.providers import mediapipe_hand as provider
from reconstruct.providers import weights
from reconstruct.video import Video, load_video

VIDEOS = Path(__file__).parents[2].parent / "shared" / "data" / "videos"


def clip(name: str) -> Path:
    path = VIDEOS / name
    if not path.is_file():
        pytest.skip(f"{name} is not in {VIDEOS}")
    return path


def hand_pose() -> np.ndarray:
    """A flat open hand, fingers up, (21, 2) px."""
    uv = np.zeros((21, 2))
    uv[1:5] = [[-20, -10], [-35, -25], [-45, -38], [-52, -50]]
    for i, x in enumerate((-15, -5, 5, 15)):
        uv[5 + 4 * i : 9 + 4 * i] = [[x, -50], [x, -72], [x, -86], [x, -98]]
    return uv + (200.0, 180.0)


def test_there_is_an_anchor_for_every_output() -> None:
    anchors = provider._anchors()
    assert anchors.shape == (2016, 2)
    assert anchors.min() > 0 and anchors.max() < 1


@pytest.mark.parametrize("degrees", [0.0, 35.0, -120.0, 180.0])
def test_region_turns_with_the_hand(degrees: float) -> None:
    a = np.deg2rad(degrees)
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    uv = (hand_pose() - 200.0) @ turn.T + 200.0
    region = provider._region_from_landmarks(uv)
    to_image = region.to_image()
    crop = (uv - to_image[:, 2]) @ np.linalg.inv(to_image[:, :2]).T
    upright = provider._region_from_landmarks(hand_pose())
    expected_map = upright.to_image()
    expected = (hand_pose() - expected_map[:, 2]) @ np.linalg.inv(expected_map[:, :2]).T
    np.testing.assert_allclose(crop, expected, atol=1e-6)
    assert crop[9, 1] < crop[0, 1]  # fingers up
    assert crop.min() > 0 and crop.max() < provider.CROP_SIZE


def test_overlapping_palms_become_one() -> None:
    box = np.array([[50.0, 50, 20, 20], [52, 50, 20, 20], [150, 150, 20, 20]])
    merged = provider._merge(np.array([0.8, 0.8, 0.6]), box, np.zeros((3, 7, 2)))
    assert len(merged) == 2
    assert merged[0][1][0] == pytest.approx(51.0)


def test_two_fingers_on_a_button_are_masked_and_nothing_else() -> None:
    """All that is seen of the person who opens a microwave's door with its button."""
    video = load_video(clip("microwave.mp4"))
    third = replace(video, frames=video.frames[::3], time=video.time[::3], index=video.index[::3])
    hands = provider.detect_hands(third)
    assert hands.tracks == ()
    # The button is at the right edge, somewhat above the middle.
    assert hands.mask[1:, 380:460, 490:].mean() > 0.4
    hands.mask[:, 330:600, 430:] = False
    assert not hands.mask.any()


@pytest.mark.slow
def test_dishwasher_hand_is_followed_until_it_leaves() -> None:
    video = load_video(clip("dishwasher.mp4"))
    seen: list[float] = []
    hands = provider.detect_hands(video, seen.append)
    assert seen[-1] == pytest.approx(1.0, abs=0.05)
    (hand,) = hands.tracks
    assert hand.side == "right"
    assert hand.valid[:90].all()
    assert not hand.valid[125:].any()
    assert np.isnan(hand.uv[~hand.valid]).all()
    # The hand starts at the handle, near (0.7, 0.5) of the picture.
    np.testing.assert_allclose(hand.uv[0].mean(0) / video.size, (0.69, 0.51), atol=0.05)
    length = np.linalg.norm(hand.metric[hand.valid][:, 9] - hand.metric[hand.valid][:, 0], axis=1)
    assert 0.06 < np.median(length) < 0.11
    # The mask covers the landmarks and no more than a hand and a forearm.
    inside = [hands.mask[t][tuple(np.round(video.to_work(hand.uv[t, 9])).astype(int)[::-1])] for t in range(90)]
    assert np.mean(inside) > 0.95
    assert hands.mask.mean() < 0.05


@pytest.mark.slow
def test_two_hands_are_told_apart() -> None:
    hands = provider.detect_hands(load_video(clip("usb_plug_unplug3.mp4")))
    assert sorted(h.side for h in hands.tracks) == ["left", "right"]
    assert all(h.valid.mean() > 0.9 for h in hands.tracks)


def test_offline_is_one_clear_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("TAA_CACHE", str(tmp_path))
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9/simple")
    monkeypatch.setenv("PIP_RETRIES", "0")
    monkeypatch.setenv("PIP_NO_CACHE_DIR", "1")
    with pytest.raises(TaaError, match="connect to the internet") as caught:
        weights.from_wheel("mediapipe==0.10.21", provider.DIGESTS)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.rglob("*.tflite"))


@pytest.mark.parametrize(("width", "height"), [(640, 360), (637, 359), (500, 281), (360, 640), (961, 541)])
def test_palms_are_looked_for_in_pictures_of_any_size(width: int, height: int) -> None:
    """A tile may start between two pixels."""
    try:
        networks = provider._Networks()
    except TaaError as error:
        pytest.skip(str(error))
    image = np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)
    for square in provider._squares(height, width):
        assert isinstance(networks.palms(image, square), list)


def test_fingers_at_the_picture_s_edge_are_masked_though_no_palm_is_seen() -> None:
    """A chair's seat is tilted by a hand of which nothing but the fingers is in the picture."""
    video = rendered("foldchair", "pause", 7)
    hands = provider.detect_hands(video)
    assert hands.tracks == ()
    # The seat is green, the wall nearly grey, stickers are no fingers and stay free.
    assert reddish(video)[:, -60:, 200:440].mean() > 0.05
    assert hands.mask[:, -60:, 200:440][reddish(video)[:, -60:, 200:440]].mean() > 0.9
    assert hands.mask.mean() < 0.1


def test_a_hand_as_large_as_the_picture_is_masked_though_no_palm_is_seen() -> None:
    """A washer's door is held by a hand close before the camera."""
    video = rendered("washer", "half", 9)
    assert provider._beyond_the_edge(provider._Networks(), video, [], 24.0) == []
    hands = provider.detect_hands(video)
    assert hands.tracks == ()
    skin = reddish(video)[:, 240:, 400:]
    assert skin.mean() > 0.4 and hands.mask[:, 240:, 400:][skin].mean() > 0.8
    assert hands.mask[:, :200, :200].mean() < 0.02


def test_nothing_that_changes_is_a_hand_where_there_is_none() -> None:
    """Tiles of all colours that slide past on the left."""
    rng = np.random.default_rng(0)
    tiles = np.kron(rng.integers(0, 255, (12, 30, 3), dtype=np.uint8), np.ones((20, 20, 1), np.uint8))
    frames = np.repeat(tiles[None, :, :320], 16, axis=0)
    frames[:, :, :80] = [tiles[:, 4 * t : 4 * t + 80] for t in range(16)]
    video = Video(Path("made.mp4"), "0" * 64, (320, 240), np.arange(16) / 24, np.arange(16), 16, frames, 1.0)
    assert provider._without_palm(provider._Networks(), video, 24.0) == []


def rendered(name: str, motion: str, seed: int) -> Video:
    """The first half second of a small motion of one of the benchmark's objects with labels on it."""
    from benchmarks.articulation.__main__ import _models
    from benchmarks.articulation.motions import SIZE, shoot
    from benchmarks.articulation.pixels import pictures
    from benchmarks.articulation.scenes import rng_of

    model, rng = _models()[name], rng_of(seed, name, motion, "rich", "small")
    shot = shoot(model, motion, False, True, 48, rng)
    images = pictures(model, replace(shot, q=shot.q[:12], T_world_camera=shot.T_world_camera[:12]), "rich", rng)
    return Video(Path("rendered.mp4"), "0" * 64, SIZE, np.arange(12) / 24, np.arange(12), 12, images[..., ::-1], 1.0)


def reddish(video: Video) -> np.ndarray:
    """(T, h, w) bool, as lit skin is."""
    blue, _, red = np.moveaxis(video.frames.astype(int), -1, 0)
    return (red - blue > 50) & (red > 130)

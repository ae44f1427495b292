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


def test_a_clip_without_a_hand_has_none() -> None:
    video = load_video(clip("microwave.mp4"))
    third = replace(video, frames=video.frames[::3], time=video.time[::3], index=video.index[::3])
    hands = provider.detect_hands(third)
    assert hands.tracks == ()
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
    from benchmarks.articulation.__main__ import _models
    from benchmarks.articulation.motions import SIZE, shoot
    from benchmarks.articulation.pixels import pictures
    from benchmarks.articulation.scenes import rng_of

    model, rng = _models()["foldchair"], rng_of(7, "foldchair", "pause", "rich", "small")
    shot = shoot(model, "pause", False, True, 48, rng)
    images = pictures(model, replace(shot, q=shot.q[:12], T_world_camera=shot.T_world_camera[:12]), "rich", rng)
    video = Video(Path("rendered.mp4"), "0" * 64, SIZE, np.arange(12) / 24, np.arange(12), 12, images[..., ::-1], 1.0)
    hands = provider.detect_hands(video)
    assert hands.tracks == ()
    # Skin is reddish; the seat is green, the wall nearly grey, stickers are no fingers and stay free.
    fingers = images[:, -60:, 200:440].astype(int)
    skin = (fingers[..., 0] - fingers[..., 2] > 50) & (fingers[..., 0] > 130)
    assert skin.mean() > 0.05
    assert hands.mask[:, -60:, 200:440][skin].mean() > 0.9
    assert hands.mask.mean() < 0.1

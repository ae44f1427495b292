"""Affine registration of neighbourhoods: known warps of made pictures."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruct.providers.affine import HALF, register

MIDDLE = np.array([160.0, 120.0])


def picture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 255, (240, 320)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return 20 + 200 * (smooth - smooth.min()) / np.ptp(smooth)


def warped(image: np.ndarray, A: np.ndarray) -> np.ndarray:
    return cv2.warpAffine(image, np.c_[A, MIDDLE - A @ MIDDLE], image.shape[::-1], flags=cv2.INTER_CUBIC)


@settings(max_examples=25, deadline=None)
@given(
    st.floats(0.7, 1.4), st.floats(0.7, 1.4), st.floats(-0.5, 0.5), st.floats(0.6, 1.1), st.floats(-15, 15),
    st.integers(0, 50),
)  # fmt: skip
def test_finds_stretch_turn_gain_and_offset(sx, sy, turn, gain, offset, seed):
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    A = R @ np.diag([sx, sy])
    image = picture(seed)
    frames = np.stack([image, gain * warped(image, A) + offset]).clip(0, 255).round().astype(np.uint8)
    rng = np.random.default_rng(seed)
    at = MIDDLE + rng.uniform(-35, 35, (40, 2))
    true = (at - MIDDLE) @ A.T + MIDDLE
    # Between two frames of a video a neighbourhood turns and stretches little: starts come from the frame before.
    place, shape = true + rng.normal(0, 0.5, true.shape), np.tile(A, (40, 1, 1)) + rng.normal(0, 0.03, (40, 2, 2))
    alike = register(frames, np.zeros(40, int), at, 1, place, shape)
    assert np.quantile(alike, 0.1) > 0.97
    assert np.median(np.linalg.norm(place - true, axis=1)) < 0.05
    assert np.median(np.abs(shape - A)) < 0.02


def test_says_where_it_cannot():
    image = picture(0)
    flat = np.full_like(image, 90.0)
    other = picture(1)
    frames = np.stack([image, flat, other]).round().astype(np.uint8)
    at = np.array([[160.0, 120.0], [HALF - 2.0, 100.0]])
    same = np.tile(np.eye(2), (2, 1, 1))
    onto_itself = register(frames, np.zeros(2, int), at, 0, at.copy(), same.copy())
    assert onto_itself[0] == pytest.approx(1.0) and onto_itself[1] == -2  # the second leaves the picture
    assert register(frames, np.ones(2, int), at, 0, at.copy(), same.copy())[0] == -2  # no structure
    assert register(frames, np.zeros(2, int), at, 2, at.copy(), same.copy())[0] < 0.8  # another picture


@pytest.mark.parametrize("contrast", [1.9, 4.0, 40.0])
def test_noise_does_not_make_a_faint_picture_another_one(contrast):
    """The same surface is told from another one at any contrast, the noise given."""
    rng = np.random.default_rng(0)
    sigma, A = 2.0, np.array([[0.98, 0.05], [-0.05, 0.99]])
    faint = [100 + contrast * (p - p.mean()) / p.std() for p in (picture(3), picture(4))]
    seen = (faint[0], warped(faint[0], A), faint[1])
    frames = np.stack([p + rng.normal(0, sigma, p.shape) for p in seen]).clip(0, 255).round().astype(np.uint8)
    at = MIDDLE + rng.uniform(-35, 35, (60, 2))
    true = (at - MIDDLE) @ A.T + MIDDLE
    turned = np.tile(A, (60, 1, 1))
    same = register(frames, np.zeros(60, int), at, 1, true.copy(), turned.copy(), sigma)
    other = register(frames, np.zeros(60, int), at, 2, at.copy(), turned.copy(), sigma)
    assert np.quantile(same, 0.1) > 0.8 > np.quantile(other, 0.8)
    assert np.all(same <= 1)
    if contrast < sigma:
        assert np.median(register(frames, np.zeros(60, int), at, 1, true.copy(), turned.copy())) < 0.8

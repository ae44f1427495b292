"""Noise with a memory is known from a model's slow errors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from diagnose.noise import Noise, arma, estimate, excess


def series(seed, phi, n=600, episodes=4):
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(episodes):
        r = lfilter([np.sqrt(1 - phi * phi)], [1, -phi], rng.standard_normal(n + 200))[200:] * 1e-3
        t = np.linspace(-1, 1, n)
        line = np.stack([t**0, t], 1)
        out.append(r - line @ np.linalg.lstsq(line, r, rcond=None)[0])
    return out


@pytest.mark.parametrize("phi", [0.0, 0.6, 0.9])
def test_noise_is_found_and_nothing_is_left(phi):
    left = 0
    for seed in range(20):
        residuals = series(seed, phi)
        noise, generous = estimate(residuals)
        assert noise.std == pytest.approx(1e-3, rel=0.6) and abs(noise.phi * (noise.theta != noise.phi) - phi) < 0.2
        left += excess(residuals, generous).there
    assert left == 0


@pytest.mark.parametrize("phi", [0.0, 0.9])
def test_a_slow_error_beside_the_noise_is_left(phi):
    residuals = series(1, phi)
    t = np.linspace(0, 6, 600)
    for k, r in enumerate(residuals):
        r += (2e-3 if phi == 0 else 1e-2) * np.sin(3 * t + k)
    found = excess(residuals, estimate(residuals)[1])
    assert found.there and found.band[0] < 0.02


def test_whitened_noise_is_white_and_of_unit_variance():
    noise = arma(0.9, 0.3, 0.7)
    rng = np.random.default_rng(3)
    slow = lfilter([np.sqrt(0.7 * (1 - 0.81))], [1, -0.9], rng.standard_normal(20000))
    w = noise.whiten(slow + np.sqrt(0.3) * rng.standard_normal(20000))[100:]
    assert np.std(w) == pytest.approx(1.0, rel=0.03)
    assert abs(np.corrcoef(w[1:], w[:-1])[0, 1]) < 0.03
    assert noise.std == pytest.approx(1.0, rel=1e-6)
    assert np.mean(noise.spectrum(np.linspace(0, 1, 4001)[:-1])) == pytest.approx(1.0, rel=1e-3)
    assert Noise(k=2.0).whiten(np.ones(3)) == pytest.approx([0.5] * 3)

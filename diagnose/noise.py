"""The measurement's noise: white noise plus a first-order autoregression, and what is too slow to be either.

    S(w) = s_w^2 + s_a^2 / |1 - phi exp(-i w)|^2 = k^2 |1 - theta exp(-i w)|^2 / |1 - phi exp(-i w)|^2

The two variances and phi come from the residual's spectrum above :data:`SLOW` (Whittle's likelihood), where errors of a
model hardly reach; carried on below, the spectrum says how much slow residual noise can explain. An autoregression
that is free at all frequencies would follow any smooth error of a model and call it noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

SLOW = 0.02  # cycles a sample: where a model's errors live
PHI = (0.0, 0.3, 0.5, 0.6, 0.7, 0.75, 0.8, 0.84, 0.87, 0.9, 0.92, 0.935, 0.95)  # memory of 20 samples at most
SHARE = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.85, 0.95, 1.0)  # of the autoregression in the variance


@dataclass(frozen=True)
class Noise:
    """phi, theta, k of the spectrum above."""

    phi: float = 0.0
    theta: float = 0.0
    k: float = 1.0

    @property
    def std(self) -> float:
        """Of one sample."""
        return self.k * float(np.sqrt(1 + (self.phi - self.theta) ** 2 / (1 - self.phi**2)))

    def spectrum(self, f: np.ndarray) -> np.ndarray:
        """At f cycles a sample; mean over [0, 1) is the variance."""
        z = np.exp(-2j * np.pi * f)
        return self.k**2 * np.abs(1 - self.theta * z) ** 2 / np.abs(1 - self.phi * z) ** 2

    def whiten(self, x: np.ndarray) -> np.ndarray:
        """Innovations of unit variance along the first axis of x (N, ...)."""
        if self.phi == self.theta:
            return x / self.k
        out = lfilter([1.0, -self.phi], [1.0, -self.theta], x, axis=0)
        out[0] *= self.k / self.std  # the first sample knows no past
        return out / self.k


def periodogram(r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (cycles a sample) and power of r (N,) under a Hann window, whose mean over [0, 1) is the variance."""
    n = len(r)
    taper = np.hanning(n + 2)[1:-1]
    power = np.abs(np.fft.rfft(r * taper)) ** 2 / np.sum(taper * taper)
    return np.fft.rfftfreq(n)[1:], power[1:]


def estimate(residuals: list[np.ndarray], smallest: float = 0.0) -> tuple[Noise, Noise]:
    """The noise of residuals, a list of (N,), from what is faster than :data:`SLOW`.

    ``smallest``: standard deviation below which no measurement can be (rounding).

    Returns:
        the likeliest noise, and of those that are nearly as likely (2 nats) the one with most slow power.
    """
    parts = [periodogram(r) for r in residuals]
    f, power = (np.concatenate(x) for x in zip(*parts, strict=True))
    fast = f >= SLOW
    f, power = f[fast], np.maximum(power[fast], 1e-300)
    # Averages over bins of like frequency: the grid search is then cheap however long the logs are.
    order = np.argsort(f)
    cut = np.unique(np.concatenate([np.geomspace(1, len(f), 60).astype(int), [len(f)]]) - 1)
    edges = np.concatenate([[0], cut[1:]]) if len(cut) > 1 else np.array([0])
    count = np.diff(np.concatenate([edges, [len(f)]]))
    keep = count > 0
    fm = np.add.reduceat(f[order], edges)[keep] / count[keep]
    pm = np.add.reduceat(power[order], edges)[keep] / count[keep]
    count = count[keep]
    phi, share = (g.ravel() for g in np.meshgrid(PHI, SHARE, indexing="ij"))
    color = (1 - phi**2)[:, None] / np.abs(1 - phi[:, None] * np.exp(-2j * np.pi * fm)) ** 2
    shape = (1 - share)[:, None] + share[:, None] * color
    scale = (pm / shape * count).sum(axis=1) / count.sum()
    cost = (count * np.log(shape)).sum(axis=1) + count.sum() * np.log(scale)
    # A memory must be seen: a white spectrum is kept unless another is clearly likelier.
    best = int(np.argmin(cost + 10.0 * (share > 0)))
    slow = scale * (1 - share + share * (1 - phi**2) / (1 - phi) ** 2)
    generous = int(np.argmax(np.where(0.5 * (cost - cost[best]) < 2.0, slow, 0.0)))
    out = []
    for i in (best, generous):
        variance = max(float(scale[i]), smallest**2)
        out.append(arma(float(phi[i]), (1 - share[i]) * variance, share[i] * variance))
    return out[0], out[1]


def arma(phi: float, white: float, colored: float) -> Noise:
    """Noise of a white variance and an autoregression's variance."""
    if colored <= 0 or phi == 0:
        return Noise(0.0, 0.0, float(np.sqrt(white + colored)))
    driving = colored * (1 - phi * phi)
    if white <= 0:
        return Noise(phi, 0.0, float(np.sqrt(driving)))
    # k^2 (1 + theta^2) = driving + white (1 + phi^2),  k^2 theta = white phi
    b = (driving + white * (1 + phi * phi)) / (white * phi)
    theta = 0.5 * (b - np.sqrt(max(b * b - 4, 0.0)))
    return Noise(phi, float(theta), float(np.sqrt(white * phi / theta)))


@dataclass(frozen=True)
class Excess:
    """Slow residual beyond the noise.

    Attributes:
        ratio: mean power over what the noise has, in the band where it stands out most.
        sigmas: how far above 1 that is.  share: rms of the slow residual over the noise's standard deviation.
        band: (low, high) cycles a sample.
    """

    ratio: float
    sigmas: float
    share: float
    band: tuple[float, float]

    @property
    def there(self) -> bool:
        """True if noise cannot make it."""
        return self.sigmas > 6.0 and self.ratio > 2.0


def excess(residuals: list[np.ndarray], noise: Noise) -> Excess:
    """Compare slow residuals with the noise, in octaves up to four times :data:`SLOW`."""
    parts = [periodogram(r) for r in residuals]
    f, power = (np.concatenate(x) for x in zip(*parts, strict=True))
    ratio = power / noise.spectrum(f)
    worst = Excess(1.0, 0.0, 0.0, (0.0, SLOW))
    high = 4 * SLOW
    while high > f.min():
        low = 0.5 * high if 0.5 * high > 1.5 * f.min() else 0.0
        mine = (f > low) & (f <= high)
        if mine.any():
            mean = float(ratio[mine].mean())
            # Neighbouring bins of a Hann window share half of what they hold.
            sigmas = (mean - 1.0) * float(np.sqrt(mine.sum() / 1.9))
            if sigmas > worst.sigmas:
                extra = max(float((power[mine] - noise.spectrum(f[mine])).sum()) * 2 / len(f), 0.0)
                worst = Excess(mean, sigmas, float(np.sqrt(extra)) / noise.std, (low, high))
        high = low
    return worst

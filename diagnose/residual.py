"""What the nominal model leaves: whiteness, the noise floor, where the left-over torque lives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from diagnose.plant import Plant
from diagnose.simulate import Episode, prepare

MOST_START = 0.15  # of an episode, that may be left out at its start


def ljung_box(residuals: list[np.ndarray], lags: int = 10) -> tuple[float, float]:
    """Ljung-Box statistic of pooled residuals and its p-value (chi-squared with ``lags`` degrees of freedom)."""
    from scipy.stats import chi2

    n = sum(len(r) for r in residuals)
    centred = [r - r.mean() for r in residuals]
    power = sum(float(r @ r) for r in centred) + 1e-300
    q = 0.0
    for k in range(1, lags + 1):
        rho = sum(float(r[k:] @ r[:-k]) for r in centred) / power
        q += rho * rho / (n - k)
    q *= n * (n + 2)
    return float(q), float(chi2.sf(q, lags))


def where(plant: Plant, episodes: list[Episode], residuals: list[np.ndarray], unit: str) -> str:
    """One sentence: where in position, velocity and time most of the squared residual lives."""
    q, v, t = (np.concatenate([getattr(e, k) for e in episodes]) for k in ("q", "v", "t"))
    weight = np.concatenate(residuals) ** 2
    parts = []
    for name, x, u in (("position", q, plant.unit), ("velocity", v, plant.unit + "/s"), ("time", t, "s")):
        order = np.argsort(x)
        share = np.cumsum(weight[order]) / max(weight.sum(), 1e-300)
        a, b = x[order][np.searchsorted(share, [0.25, 0.75]).clip(0, len(x) - 1)]
        parts.append(f"{name} {a:.3g} to {b:.3g} {u}")
    return (f"half of the squared residual (rms {np.sqrt(weight.mean()):.3g} {unit}) lives at " + ", ".join(parts))


def trim_start(plant: Plant, episode: Episode) -> int:
    """How many first samples of a log that claims to be let go cannot be free motion.

    Only where the log's input says let go at its start and the part moves already there.
    The acceleration that position and
    velocity explain is learned from the rest of the log. While its average over a tenth of a second leaves that by
    more than 6 robust standard deviations from the start on (at most 15 % of the log), the part is still held by
    something that the log does not know.
    """
    e = episode
    n = len(e.t)
    most = let_go(e)
    if most == 0:
        return 0
    shape = [np.sin(e.q), np.cos(e.q)] if plant.hinge else [e.q]
    F = np.stack([*shape, np.ones(n), e.v, e.v * np.abs(e.v), np.sign(e.v)], axis=1)
    F = F / np.abs(F).max(axis=0).clip(1e-12)
    c = np.linalg.lstsq(F[most:], e.a[most:], rcond=1e-9)[0]
    r = e.a - F @ c
    # Averages over a tenth of a second: what a hand or a stop does lasts, what a sensor does to accelerations does not.
    long = max(8, int(round(0.1 / float(np.median(np.diff(e.t))))))
    mean = np.convolve(r, np.ones(long) / long, mode="valid")
    rest = mean[most:]
    spread = 1.4826 * np.median(np.abs(rest - np.median(rest))) + 1e-300
    off = np.abs(mean[: most + 1]) > 6 * spread
    if not off[0]:
        return 0
    return min(int(np.argmin(off)) + long // 2, most) if not off.all() else most


def let_go(episode: Episode, share: float = MOST_START) -> int:
    """How many rows at the start of an episode might not be free although the log says let go; 0 if it does not say so
    or the part does not move there."""
    e = episode
    most = int(share * len(e.t))
    if e.log.torque is None and e.log.force is None:
        return 0
    if e.u[: most + 1].any() or abs(e.v[:5].mean()) < 0.1 * np.abs(e.v).max():
        return 0
    return most


def shortened(plant: Plant, episode: Episode, cut: int) -> Episode:
    """The episode without its first rows."""
    log = episode.log
    keys = [k for k in ("time", "q", "torque", "force", "point", "markers") if getattr(log, k) is not None]
    return prepare(plant, replace(log, **{k: getattr(log, k)[cut:] for k in keys}), episode.step)

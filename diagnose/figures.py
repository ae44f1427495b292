"""The report's pictures; each function returns a matplotlib figure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from diagnose.kernel import KNOTS

if TYPE_CHECKING:
    from diagnose.diagnosis import Diagnosis

NOMINAL, EXTENDED, MEASURED, NOISE = "#d1495b", "#00798c", "#222222", "#dddddd"
OPENING, CLOSING = "#edae49", "#66589b"


def over_time(result: Diagnosis) -> Figure:
    """Measured, nominal and extended over time, and the residuals below: held-out episodes, three at most."""
    curves = list(result.curves.items())[:3]
    figure = Figure(figsize=(max(4.2 * len(curves), 7.0), 5), layout="constrained")
    axes = figure.subplots(2, len(curves), sharex="col", squeeze=False)
    unit = result.plant.torque_unit if result.held.driven else result.plant.unit
    noise = result.found.noise.std
    for k, (name, c) in enumerate(curves):
        top, low = axes[0, k], axes[1, k]
        top.plot(c["time"], c["measured"], color=MEASURED, lw=2.4, label="measured")
        top.plot(c["time"], c["nominal"], color=NOMINAL, lw=1.2, label="nominal model")
        top.plot(c["time"], c["extended"], color=EXTENDED, lw=1.2, ls="--", label="extended model")
        margin = 0.3 * np.ptp(c["measured"]) + 1e-9
        top.set_ylim(c["measured"].min() - margin, c["measured"].max() + margin)
        top.set_title(name, fontsize=9)
        low.axhspan(-2 * noise, 2 * noise, color=NOISE, zorder=0, label="noise, 2 sigma")
        low.plot(c["time"], c["measured"] - c["nominal"], color=NOMINAL, lw=1)
        low.plot(c["time"], c["measured"] - c["extended"], color=EXTENDED, lw=1)
        # The nominal error may be a hundred times what is left: a scale that shows both.
        low.set_yscale("symlog", linthresh=max(3 * noise, 1e-9))
        low.axhline(0, color="0.6", lw=0.5)
        low.set_xlabel("time, s")
    axes[0, 0].legend(fontsize=8)
    axes[1, 0].legend(fontsize=8)
    axes[0, 0].set_ylabel(("torque" if result.held.driven else "position") + f", {unit}")
    axes[1, 0].set_ylabel(f"measured - model, {unit}")
    return figure


def in_plane(result: Diagnosis) -> Figure:
    """The torque that the nominal model lacks: in the (q, velocity) plane, over q, over velocity by direction."""
    m, p = result.fitted.motion, result.plant
    figure = Figure(figsize=(12.6, 3.6), layout="constrained")
    plane, over_q, over_v = figure.subplots(1, 3)
    size = np.percentile(np.abs(m.residual), 98) + 1e-12
    dots = plane.scatter(m.q, m.v, c=m.residual, s=3, cmap="coolwarm", vmin=-size, vmax=size)
    figure.colorbar(dots, ax=plane, label=f"missing torque, {p.torque_unit}")
    for forward, colour, word in ((True, OPENING, "opening (velocity > 0)"),
                                  (False, CLOSING, "closing (velocity < 0)")):  # fmt: skip
        some = (m.v > 0) == forward
        over_q.plot(m.q[some], m.residual[some], ".", ms=1.5, alpha=0.35, color=colour)
        over_v.plot(m.v[some], m.residual[some], ".", ms=1.5, alpha=0.35, color=colour)
        for axes, x in ((over_q, m.q), (over_v, m.v)):
            axes.plot(*_running(x[some], m.residual[some]), color=colour, lw=2, label=word)
    over_q.legend(fontsize=8)
    for axes, word in ((over_q, f"position, {p.unit}"), (over_v, f"velocity, {p.unit}/s")):
        axes.set_ylim(-1.3 * size, 1.3 * size)
        axes.axhline(0, color="0.6", lw=0.5)
        axes.set_xlabel(word)
    plane.set_xlabel(f"position, {p.unit}")
    plane.set_ylabel(f"velocity, {p.unit}/s")
    return figure


def _running(x: np.ndarray, y: np.ndarray, bins: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Medians of y in bins of x that hold five values or more."""
    if len(x) < 10:
        return x[:0], y[:0]
    edges = np.linspace(x.min(), x.max() + 1e-12, bins + 1)
    at = np.digitize(x, edges) - 1
    full = [k for k in range(bins) if np.sum(at == k) >= 5]
    return np.array([x[at == k].mean() for k in full]), np.array([np.median(y[at == k]) for k in full])


def free_torques(result: Diagnosis) -> Figure | None:
    """What the library does not explain: torques that are free over position and over velocity."""
    free = result.found.free
    if free is None or free.fit.candidate.spline is None:
        return None
    p, frame, values = result.plant, result.fitted.motion.frame, free.fit.candidate.spline
    figure = Figure(figsize=(8.4, 3.2), layout="constrained")
    over_q, over_v = figure.subplots(1, 2, sharey=True)
    for axes, (low, high), knots, word in ((over_q, frame.q, values[:KNOTS], f"position, {p.unit}"),
                                           (over_v, frame.v, values[KNOTS:], f"velocity, {p.unit}/s")):  # fmt: skip
        axes.fill_between(np.linspace(low, high, KNOTS), knots, color=EXTENDED, alpha=0.2)
        axes.plot(np.linspace(low, high, KNOTS), knots, "o-", color=EXTENDED)
        axes.axhline(0, color="0.6", lw=0.5)
        axes.set_xlabel(word)
    over_q.set_ylabel(f"free torque, {p.torque_unit}")
    return figure


def ranking(result: Diagnosis) -> Figure | None:
    """How far behind the best every set of causes is that was fitted."""
    rows = result.data["ranking"]
    if len(rows) < 2:
        return None
    figure = Figure(figsize=(8.4, 0.34 * len(rows) + 0.9), layout="constrained")
    axes = figure.subplots()
    behind = np.array([r["nats"] for r in rows])
    chosen = tuple(result.found.best.causes)
    for k, r in enumerate(rows):
        mine = tuple(r["causes"]) == chosen
        axes.barh(k, max(behind[k], 0.0), color=EXTENDED if mine else "#b9c6cc")
        axes.text(max(behind[k], 0.0), k, f"  {behind[k]:.0f}", va="center", fontsize=8)
    axes.set_yticks(range(len(rows)), [(" + ".join(r["causes"]) or "nothing") + (" (chosen)" if tuple(
        r["causes"]) == chosen else "") for r in rows], fontsize=8)  # fmt: skip
    axes.set_xscale("symlog", linthresh=10)
    axes.set_xlim(0, 3 * max(behind.max(), 10.0))
    axes.axvline(8, color=NOMINAL, lw=0.8, ls=":")
    axes.invert_yaxis()
    axes.set_xlabel("nats behind the best fit (dotted: the margin that a cause must bring)")
    return figure


def points(result: Diagnosis) -> Figure | None:
    """How far the points on the part leave the model's joint, over position: nominal and put right."""
    placed = result.placed
    if placed is None:
        return None
    figure = Figure(figsize=(12.6, 3.6), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    found = placed.found
    for k, word in enumerate("xyz"):
        for g, colour, label in ((found.nominal, NOMINAL, "the model's joint"), (found.best, EXTENDED, "put right")):
            x = np.concatenate([np.repeat(t[:, None], r.shape[1], 1).ravel()
                                for t, r in zip(g.theta, g.residuals, strict=True)])  # fmt: skip
            y = np.concatenate([r[..., k].ravel() for r in g.residuals])
            axes[k].plot(x, 1e3 * y, ".", ms=1, alpha=0.3, color=colour)
            axes[k].plot([], [], "o", color=colour, label=label)
        axes[k].set_title(f"along {word}", fontsize=9)
        axes[k].set_xlabel(f"position, {result.plant.unit}")
    axes[0].set_ylabel("points - model, mm")
    axes[0].legend(fontsize=8)
    return figure


def intervals(result: Diagnosis) -> Figure | None:
    """Every parameter's interval against its value: how sure each one is."""
    rows = [(c["name"], k, p) for c in result.data["causes"] for k, p in c["parameters"].items() if p["value"] != 0]
    if not rows:
        return None
    figure = Figure(figsize=(8.4, 0.34 * len(rows) + 0.9), layout="constrained")
    axes = figure.subplots()
    for i, (_, _, p) in enumerate(rows):
        low, high = (100 * (x / p["value"] - 1) for x in p["ci95"])
        axes.plot([low, high], [i, i], color=EXTENDED, lw=3, solid_capstyle="butt")
        axes.plot(0, i, "o", color=MEASURED, ms=4)
        words = f"{p['value']:.4g}" + (f" {p['unit']}" if p["unit"] != "1" else "")
        axes.text(1.01, i, words, va="center", fontsize=8, transform=axes.get_yaxis_transform())
    axes.set_yticks(range(len(rows)), [f"{name}: {key}" for name, key, _ in rows], fontsize=8)
    axes.axvline(0, color="0.6", lw=0.5)
    axes.invert_yaxis()
    axes.set_xlabel("95 % interval, per cent of the value")
    return figure

"""report.html: residuals before and after, the ranking, the parameters, what could not be told; one file."""

from __future__ import annotations

import base64
import html
import io
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from diagnose.diagnosis import Diagnosis

STYLE = """body{font:16px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;color:#222}
table{border-collapse:collapse;margin:1rem 0}td,th{padding:.25rem .8rem;border-bottom:1px solid #ddd;text-align:left}
img{max-width:100%}h1{font-size:1.6rem}.verdict{font-size:1.2rem;padding:.6rem 1rem;background:#f2f5f9}"""
WORDS = {"consistent": "The model agrees with the data: what is left is noise.",
         "explained": "The model differs from the data, and the cause is found.",
         "ambiguous": "The model differs from the data, and the data cannot tell which of several causes it is.",
         "unexplained": "The model differs from the data, and no known cause explains it."}  # fmt: skip


def page(result: Diagnosis) -> str:
    """The whole page."""
    d = result.data
    parts = [f"<h1>Diagnosis of joint {html.escape(result.plant.joint)}</h1>",
             f"<p class=verdict><b>{d['verdict']}</b>. {WORDS[d['verdict']]}</p>"]  # fmt: skip
    rows = []
    for c in d["causes"]:
        if c["name"] == "unknown":
            e = c["evidence"]
            parts.append(f"<p>{html.escape(e['why'])}; {html.escape(e['where'])}.</p>")
            if e["partly"]:
                parts.append(f"<p>Part of it looks like {html.escape(', '.join(e['partly']))}, without being sure.</p>")
        for name, p in c["parameters"].items():
            lo, hi = p["ci95"]
            rows.append((c["name"], name, f"{p['value']:.4g} {p['unit']}", f"{lo:.4g} to {hi:.4g}"))
    if rows:
        parts += ["<h2>Causes</h2>", _table(("cause", "parameter", "value", "95 % interval"), rows)]
    if d["alternatives"]:
        text = "; ".join(" + ".join(a) for a in d["alternatives"])
        parts.append(f"<p>The data are explained as well by: {html.escape(text)}.</p>")
    if d["next_experiment"]:
        parts.append(f"<p><b>Measure next:</b> {html.escape(d['next_experiment'])}.</p>")
    u, g = d["unit"], d["gain"]
    parts += ["<h2>Held-out episodes</h2>", _table(("", f"rms error, {u}"), [
        ("nominal model", f"{d['nominal']['heldout_rmse']:.4g}"), ("extended", f"{d['extended']['heldout_rmse']:.4g}"),
        ("noise floor", f"{d['noise_floor']:.4g}"),
        ("ratio", f"{g['heldout_rmse_ratio']:.3g} ({g['ci95'][0]:.3g} to {g['ci95'][1]:.3g})")]),
        _image(_over_time(result)), "<h2>Where the nominal model's error lives</h2>", _image(_in_plane(result)),
        "<h2>What was tried</h2>", _table(("causes", "nats behind the chosen", f"error of the fitted episodes, {u}"), [
            (" + ".join(r["causes"]) or "nothing", f"{r['nats']:.1f}", f"{r['rmse']:.4g}")
            for r in d["ranking"]]),
        "<h2>Assumptions</h2><ul>", *(f"<li>{html.escape(a)}</li>" for a in d["assumptions"]), "</ul>"]  # fmt: skip
    return (f"<!doctype html><html lang=en><meta charset=utf-8><title>Diagnosis</title><style>{STYLE}</style>"
            + "\n".join(parts) + "</html>\n")  # fmt: skip


def _table(head: tuple, rows: list[tuple]) -> str:
    cells = lambda row, tag: "".join(f"<{tag}>{html.escape(str(c))}</{tag}>" for c in row)  # noqa: E731
    return (f"<table><tr>{cells(head, 'th')}</tr>" + "".join(f"<tr>{cells(r, 'td')}</tr>" for r in rows) + "</table>")


def _image(figure) -> str:
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110, bbox_inches="tight")
    return f'<p><img alt="" src="data:image/png;base64,{base64.b64encode(out.getvalue()).decode()}"></p>'


def _over_time(result: Diagnosis):
    """Measured, nominal and extended over time, and the residuals below."""
    from matplotlib.figure import Figure

    curves = list(result.curves.items())[:3]
    figure = Figure(figsize=(4.2 * len(curves), 5), layout="constrained")
    axes = figure.subplots(2, len(curves), sharex="col", squeeze=False)
    unit = result.data["unit"]
    for k, (name, c) in enumerate(curves):
        top, low = axes[0, k], axes[1, k]
        top.plot(c["time"], c["measured"], color="k", lw=2, label="measured")
        top.plot(c["time"], c["nominal"], color="C3", lw=1, label="nominal")
        top.plot(c["time"], c["extended"], color="C0", lw=1, ls="--", label="extended")
        margin = 0.3 * np.ptp(c["measured"]) + 1e-9
        top.set_ylim(c["measured"].min() - margin, c["measured"].max() + margin)
        top.set_title(name, fontsize=9)
        low.plot(c["time"], c["measured"] - c["nominal"], color="C3", lw=1)
        low.plot(c["time"], c["measured"] - c["extended"], color="C0", lw=1)
        low.axhspan(-2 * result.data["noise_floor"], 2 * result.data["noise_floor"], color="0.9", zorder=0)
        low.set_xlabel("time, s")
    axes[0, 0].legend(fontsize=8)
    axes[0, 0].set_ylabel(unit)
    axes[1, 0].set_ylabel(f"error, {unit}")
    return figure


def _in_plane(result: Diagnosis):
    """The torque that the nominal model lacks: in the (q, velocity) plane, over q, over velocity by direction."""
    from matplotlib.figure import Figure

    m = result.fitted.motion
    p = result.plant
    figure = Figure(figsize=(12.6, 3.6), layout="constrained")
    plane, over_q, over_v = figure.subplots(1, 3)
    size = np.percentile(np.abs(m.residual), 98) + 1e-12
    dots = plane.scatter(m.q, m.v, c=m.residual, s=3, cmap="coolwarm", vmin=-size, vmax=size)
    figure.colorbar(dots, ax=plane, label=f"missing torque, {p.torque_unit}")
    for forward, colour, word in ((True, "C1", "opening (velocity > 0)"), (False, "C4", "closing (velocity < 0)")):
        some = (m.v > 0) == forward
        over_q.plot(m.q[some], m.residual[some], ".", ms=2, color=colour, label=word)
        over_v.plot(m.v[some], m.residual[some], ".", ms=2, color=colour)
    over_q.legend(fontsize=8)
    over_q.set_ylim(-1.3 * size, 1.3 * size)
    over_v.set_ylim(-1.3 * size, 1.3 * size)
    plane.set_xlabel(f"position, {p.unit}")
    plane.set_ylabel(f"velocity, {p.unit}/s")
    over_q.set_xlabel(f"position, {p.unit}")
    over_v.set_xlabel(f"velocity, {p.unit}/s")
    return figure

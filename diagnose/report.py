"""report.html: residuals before and after, the ranking, the parameters, what could not be told; one file."""

from __future__ import annotations

import base64
import html
import io
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    from diagnose import figures

    d = result.data
    parts = [f"<h1>Diagnosis of joint {html.escape(result.plant.joint)}</h1>",
             f"<p class=verdict><b>{d['verdict']}</b>. {WORDS[d['verdict']]}</p>"]  # fmt: skip
    rows = []
    for c in d["causes"]:
        if c["name"] == "unknown":
            e = c["evidence"]
            parts += _remainder(e)
        for name, p in c["parameters"].items():
            lo, hi = p["ci95"]
            rows.append((c["name"], name, f"{p['value']:.4g} {p['unit']}", f"{lo:.4g} to {hi:.4g}"))
    sentences = [f"<li><b>{c['name']}</b>. {html.escape(c['evidence']['sentence'])}</li>" for c in d["causes"]
                 if "sentence" in c["evidence"]]  # fmt: skip
    if rows:
        parts += ["<h2>Causes</h2><ul>", *sentences, "</ul>",
                  _table(("cause", "parameter", "value", "95 % interval"), rows),
                  _image(figures.intervals(result), "how sure each parameter is")]  # fmt: skip
    if "remainder" in d:
        parts += ["<h2>What is left</h2>", *_remainder(d["remainder"])]
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
        _image(figures.over_time(result), "measured, nominal and extended, and their errors, over time"),
        "<h2>Where the nominal model's error lives</h2>",
        _image(figures.in_plane(result), "the torque that the nominal model lacks"),
        _image(figures.points(result), "points on the part against the joint's paths"),
        *(["<h2>Free torques</h2><p>What would be needed beside the causes, over position and over velocity.</p>",
           _image(figures.free_torques(result), "free torques")] if result.found.free is not None else []),
        "<h2>What was tried</h2>", _image(figures.ranking(result), "sets of causes and how far behind they are"),
        "<h2>Assumptions</h2><ul>", *(f"<li>{html.escape(a)}</li>" for a in d["assumptions"]), "</ul>"]  # fmt: skip
    return (f"<!doctype html><html lang=en><meta charset=utf-8><title>Diagnosis</title><style>{STYLE}</style>"
            + "\n".join(parts) + "</html>\n")  # fmt: skip


def _table(head: tuple, rows: list[tuple]) -> str:
    cells = lambda row, tag: "".join(f"<{tag}>{html.escape(str(c))}</{tag}>" for c in row)  # noqa: E731
    return (f"<table><tr>{cells(head, 'th')}</tr>" + "".join(f"<tr>{cells(r, 'td')}</tr>" for r in rows) + "</table>")


def _remainder(e: dict) -> list[str]:
    out = [f"<p>{html.escape(e['why'])}; {html.escape(e['where'])}.</p>"]
    if e["explained_rmse"] > 0:
        out.append(f"<p>What is left has an error of {e['rmse']:.3g} (the causes explain {e['explained_rmse']:.3g}), "
                   f"{e['times_noise']:.1f} times the noise.</p>")  # fmt: skip
    if e["partly"]:
        out.append(f"<p>Part of it looks like {html.escape(', '.join(e['partly']))}, without being sure.</p>")
    return out


def _image(figure: Figure | None, words: str) -> str:
    if figure is None:
        return ""
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110, bbox_inches="tight")
    data = base64.b64encode(out.getvalue()).decode()
    return f'<p><img alt="{html.escape(words)}" src="data:image/png;base64,{data}"></p>'

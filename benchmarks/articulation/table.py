"""Tables of the results."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

PAPER = (
    # Quoted from "Track, Articulate, Act" (10 PARIS objects x 7 motions; depth, tracks and masks from the simulator).
    ("Track, Articulate, Act (quoted), static camera", "0.97", "1.96 +- 0.45", "3.93 +- 1.01"),
    ("VideoArtGS there (quoted), orbiting camera", "0.93", "1.81", "2.44"),
    ("Articulat3D there (quoted), orbiting camera", "0.91", "1.53", "2.58"),
)
NAMES = {1: "1: perfect depth, tracks, masks", 2: "2: noisy depth, tracks, masks", 3: "3: noisy tracks, no depth",
         4: "4: pixels", 5: "5: pixels, camera in a hand"}  # fmt: skip


def _mean(rows: Iterable[dict], key: str) -> float:
    values = [r[key] for r in rows if r.get(key) is not None]
    return float(np.mean(values)) if values else np.nan


def _median(rows: Iterable[dict], key: str) -> float:
    values = [r[key] for r in rows if r.get(key) is not None]
    return float(np.median(values)) if values else np.nan


def _show(value: float, digits: int = 3) -> str:
    if not np.isfinite(value):
        return ""
    return f"{value:.{digits}g}" if value < 1000 else f"{value:.0f}"


def _both(rows: list[dict], key: str) -> str:
    mean, median = _mean(rows, key), _median(rows, key)
    return f"{_show(mean)} / {_show(median)}" if np.isfinite(mean) else ""


HEAD = ("row", "cases", "type", "axis deg", "line mm", "centroid mm", "centroid % diag", "q deg", "q mm", "points mm",
        "failed", "sure and wrong", "x bound axis", "x bound place", "cover axis", "cover place", "cover q",
        "s")  # fmt: skip


def summary(rows: list[dict]) -> dict:
    """Numbers of one line of the table."""
    share = [{"v": 100 * r["centroid_mm"] / 1e3 / r["diagonal_m"]} for r in rows if r.get("centroid_mm") is not None]
    return {
        "cases": len(rows), "type": _mean(rows, "type_right"), "axis": _both(rows, "axis_deg"),
        "line": _both(rows, "location_mm"), "centroid": _both(rows, "centroid_mm"), "share": _both(share, "v"),
        "q_deg": _both(rows, "q_deg"), "q_mm": _both(rows, "q_mm"), "points": _both(rows, "point_mm"),
        "failed": sum(r["failed"] for r in rows), "wrong": sum(r["confidently_wrong"] for r in rows),
        "ratio_axis": _median(rows, "ratio_axis"), "ratio_location": _median(rows, "ratio_location"),
        "covered_axis": _mean(rows, "covered_axis"), "covered_location": _mean(rows, "covered_location"),
        "covered_q": _mean(rows, "covered_q"), "seconds": _both(rows, "seconds"),
    }  # fmt: skip


def groups(rows: list[dict]) -> dict[str, list[dict]]:
    """Lines of the table: each row of the benchmark with both cameras, full and small motion."""
    out: dict[str, list[dict]] = {}
    for small in (False, True):
        for number in sorted({r["row"] for r in rows}):
            for orbit in (False, True):
                some = [r for r in rows if (r["row"], r["orbit"], r["small"]) == (number, orbit, small)]
                for texture in sorted({r.get("texture", "") for r in some}):
                    camera = "" if number == 5 else "orbiting camera" if orbit else "static camera"
                    name = filter(None, [NAMES[number], camera, "small motion" * small, texture])
                    out[", ".join(name)] = [r for r in some if r.get("texture", "") == texture]
    return out


def markdown(rows: list[dict]) -> str:
    """The whole table; "a / b" is mean / median. The paper's rows stand in it as quoted."""
    lines = ["| " + " | ".join(HEAD) + " |", "|" + " --- |" * len(HEAD)]
    for name, kind, axis, place in PAPER:
        lines.append(f"| {name} | 70 | {kind} | {axis} | {place} |" + " |" * (len(HEAD) - 5))
    for name, some in groups(rows).items():
        s = summary(some)
        cells = [name, s["cases"], f"{s['type']:.3f}", s["axis"], s["line"], s["centroid"], s["share"], s["q_deg"],
                 s["q_mm"], s["points"], s["failed"], s["wrong"], _show(s["ratio_axis"]), _show(s["ratio_location"]),
                 _show(s["covered_axis"]), _show(s["covered_location"]), _show(s["covered_q"]),
                 s["seconds"]]  # fmt: skip
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def worst(rows: list[dict], count: int = 10) -> str:
    """The cases that went worst, for the eye."""
    order = sorted(rows, key=lambda r: (-(not r["type_right"]), -r["axis_deg"]))[:count]
    lines = [f"{r['row']} {r['case']}: {r['verdict']} {r['type']} p {r['probability']:.2f} axis {r['axis_deg']:.2f} "
             f"deg centroid {_show(r.get('centroid_mm') or np.nan)} mm; {r['reason'][:90]}" for r in order]  # fmt: skip
    return "\n".join(lines)

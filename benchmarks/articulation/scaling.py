"""How the cost of the fit with depth grows with tracks and frames."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

SIZES = ((500, 100), (1000, 100), (2000, 100), (5000, 100), (500, 200), (500, 400), (500, 1000), (2000, 400),
         (5000, 1000))  # fmt: skip


def measure(tracks: int, frames: int, seed: int = 0) -> dict:
    """CPU and wall seconds of one fit of the laptop in row 2."""
    from benchmarks.articulation.noise import give
    from benchmarks.articulation.objects import procedural
    from benchmarks.articulation.scenes import make_scene
    from reconstruct.joint.rigid import fit_rigid

    model = next(m for m in procedural() if m.name == "laptop")
    scene = make_scene(model, "open", frames=frames, moving=round(0.7 * tracks), static=tracks - round(0.7 * tracks),
                       seed=seed)  # fmt: skip
    given = give(scene, 2, seed)
    wall, cpu = time.perf_counter(), time.process_time()
    fit = fit_rigid(given.uv, given.visible, given.depth, scene.shot.K, scene.shot.T_world_camera, given.link)
    out = {"tracks": len(given.uv), "frames": frames, "cpu_s": time.process_time() - cpu,
           "wall_s": time.perf_counter() - wall, "verdict": fit.verdict, "type": fit.type}  # fmt: skip
    if fit.axis is not None:
        out["axis_deg"] = float(np.degrees(np.arctan2(np.linalg.norm(np.cross(fit.axis, scene.axis)),
                                                      abs(fit.axis @ scene.axis))))  # fmt: skip
    return out


def scaling(figure: Path, sizes=SIZES, out: Path | None = None) -> list[dict]:
    """Measure all sizes and draw seconds over tracks x frames; rows already in `out` are taken from there."""
    rows = [json.loads(line) for line in out.read_text().splitlines()] if out and out.is_file() else []
    done = {(r["tracks"], r["frames"]) for r in rows}
    for tracks, frames in sizes:
        if (tracks, frames) in done:
            continue
        row = measure(tracks, frames)
        rows.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
        if out:
            with out.open("a") as file:
                file.write(json.dumps(row) + "\n")
    draw(rows, figure)
    return rows


def draw(rows: list[dict], figure: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig, ax = plt.subplots(figsize=(6, 4), layout="constrained")
    for label, some in (("100 frames", [r for r in rows if r["frames"] == 100]),
                        ("500 tracks", [r for r in rows if r["tracks"] == 500]),
                        ("both grow", [r for r in rows if r["frames"] > 100 and r["tracks"] > 500])):  # fmt: skip
        some.sort(key=lambda r: r["tracks"] * r["frames"])
        if some:
            ax.loglog([r["tracks"] * r["frames"] for r in some], [r["cpu_s"] for r in some], "o-", label=label)
    x = np.array([min(r["tracks"] * r["frames"] for r in rows), max(r["tracks"] * r["frames"] for r in rows)], float)
    top = max(rows, key=lambda r: r["tracks"] * r["frames"])
    ax.loglog(x, top["cpu_s"] * x / x[1], "k--", lw=1, label="linear")
    ax.set(xlabel="tracks x frames", ylabel="CPU seconds of the fit")
    ax.grid(alpha=0.3, which="both")
    ax.legend()
    fig.savefig(figure, dpi=110)
    plt.close(fig)

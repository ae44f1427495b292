"""Processor time of a diagnosis against the amount of data.

    python -m benchmarks.diagnosis_cost --logs 3 6 12 24 48 --rows rows.jsonl --figure docs/images/diagnosis_cost.png

Logs of 6 s at 100 Hz from the tests' own injector (a hanging flap with hidden friction). Goes on where the file ends.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.diagnosis import injector, lines_of

SEED = 31_000


def run(count: int, seed: int) -> dict:
    from diagnose import diagnose

    case = injector.draw(seed, "flap", ("coulomb_friction",))
    with tempfile.TemporaryDirectory(prefix="taa-diagnosis-") as folder:
        model, files = injector.write(case, seed, Path(folder), count=count)
        busy = time.process_time()
        result = diagnose(model, files, "j")
        busy = time.process_time() - busy
    return {"logs": count, "seed": seed, "cpu": busy, "verdict": result.verdict, "said": list(result.causes)}


def main() -> None:
    """Make the rows that are missing, print the table, draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, nargs="+", default=[3, 6, 12, 24, 48])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--rows", type=Path, required=True)
    parser.add_argument("--figure", type=Path)
    args = parser.parse_args()
    rows = [json.loads(x) for x in args.rows.read_text().splitlines()] if args.rows.exists() else []
    run(3, 1)  # what is compiled on first use is not counted
    for count in args.logs:
        for seed in range(SEED, SEED + args.seeds):
            if not any((r["logs"], r["seed"]) == (count, seed) for r in rows):
                rows.append(run(count, seed))
                with args.rows.open("a") as f:
                    f.write(json.dumps(rows[-1]) + "\n")
    counts = sorted({r["logs"] for r in rows})
    cpu = [float(np.median([r["cpu"] for r in rows if r["logs"] == n])) for n in counts]
    right = [sum(r["said"] == ["coulomb_friction"] for r in rows if r["logs"] == n) for n in counts]
    total = [sum(r["logs"] == n for r in rows) for n in counts]
    body = [[n, k, f"{c:.1f}", f"{c / n:.2f}", g] for n, k, c, g in zip(counts, total, cpu, right, strict=True)]
    print(lines_of(["logs of 6 s", "cases", "processor time, s", "a log, s", "named exactly"], body))
    if args.figure:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(5.5, 3.6), layout="constrained")
        axes = figure.subplots()
        axes.plot([r["logs"] * 6 for r in rows], [r["cpu"] for r in rows], "o", color="#b9c6cc", label="cases")
        axes.plot([6 * n for n in counts], cpu, "o-", color="#00798c", label="median")
        axes.axvline(36, color="0.7", lw=0.8, ls=":")
        axes.set_xlabel("data, s at 100 Hz (dotted: six logs of 6 s)")
        axes.set_ylabel("processor time of a diagnosis, s")
        axes.set_ylim(0)
        axes.set_xlim(0)
        axes.legend()
        figure.savefig(args.figure, dpi=110)


if __name__ == "__main__":
    main()

"""Diagnosis of hidden effects: what is hidden, what is said.

    python -m benchmarks.diagnosis                    # one case a cell
    python -m benchmarks.diagnosis --cases 20 --seed 100
    python -m benchmarks.diagnosis --only coulomb_friction nothing:ar

The hidden effects come from the tests' own injector (own integrator, friction law and noise). A cell is a hidden
effect on one mechanism; the table gives how often the verdict was right (the exact names for effects, `consistent` for
none, `unexplained` for effects outside the library), how often a wrong cause was named with confidence, the median
error of the parameters, how many 95 % intervals hold the truth, and the held-out error over the noise.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

_SPEC = importlib.util.spec_from_file_location(
    "injector", Path(__file__).resolve().parents[1] / "tests" / "diagnose" / "injector.py")  # fmt: skip
injector = importlib.util.module_from_spec(_SPEC)
sys.modules["injector"] = injector
_SPEC.loader.exec_module(injector)

PAIRS = (("coulomb_friction", "spring"), ("viscous_damping", "constant_torque"), ("quadratic_drag", "inertia"))


def cells() -> Iterator[tuple[str, tuple[str, ...], str]]:
    """(label, hidden names, noise) of every cell."""
    for name in injector.SINGLE:
        yield name, (name,), "white"
    for pair in PAIRS:
        yield "+".join(pair), pair, "white"
    for noise in injector.NOISES:
        yield f"nothing:{noise}", (), noise
    for name in injector.OUTSIDE:
        yield name, (name,), "white"


def run(names: tuple[str, ...], noise: str, plant: str, seed: int, logs: int) -> dict:
    """Hide, diagnose, compare: one row."""
    from diagnose import diagnose

    case = injector.draw(seed, plant, names, noise)
    with tempfile.TemporaryDirectory(prefix="taa-diagnosis-") as folder:
        model, files = injector.write(case, seed, Path(folder), count=logs)
        begin = time.monotonic()
        result = diagnose(model, files, "j")
        seconds = time.monotonic() - begin
    said = {c for c in result.causes if c != "unknown"}
    outside = any(n in injector.OUTSIDE for n in names)
    want = "unexplained" if outside else "explained" if names else "consistent"
    right = result.verdict == want and (outside or said == set(names))
    wrong = result.verdict == "explained" and not right
    errors, covered = [], []
    if right and names and not outside:
        for cause in result.data["causes"]:
            for key, p in cause["parameters"].items():
                truth = case.truth.get(key if len(names) < 2 else f"{cause['name']}.{key}")
                if truth:
                    errors.append(abs(p["value"] / truth - 1))
                    covered.append(p["ci95"][0] <= truth <= p["ci95"][1])
    d = result.data
    return {"plant": plant, "seed": seed, "verdict": result.verdict, "said": sorted(said), "right": bool(right),
            "wrong": bool(wrong), "errors": [float(e) for e in errors], "covered": [bool(c) for c in covered],
            "over_noise": d["extended"]["heldout_rmse"] / case.sigma, "seconds": seconds}  # fmt: skip


def table(rows: dict[str, list[dict]]) -> str:
    """Markdown."""
    lines = ["| hidden | cases | right | wrong name | parameter error | interval holds | held-out / noise | s |",
             "|" + " --- |" * 8]  # fmt: skip
    for label, cell in rows.items():
        errors = [e for r in cell for e in r["errors"]]
        covered = [c for r in cell for c in r["covered"]]
        lines.append(
            f"| {label} | {len(cell)} | {sum(r['right'] for r in cell)} | {sum(r['wrong'] for r in cell)} "
            f"| {f'{np.median(errors):.2%}' if errors else ''} "
            f"| {f'{sum(covered)} of {len(covered)}' if covered else ''} "
            f"| {np.median([r['over_noise'] for r in cell]):.2f} | {np.median([r['seconds'] for r in cell]):.0f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Print the table; rows go to stderr as they come."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", help="labels of cells")
    parser.add_argument("--cases", type=int, default=1, help="cases a cell; mechanisms take turns, over cells too")
    parser.add_argument("--logs", type=int, default=6, help="logs a case")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rows: dict[str, list[dict]] = {}
    for number, (label, names, noise) in enumerate(cells()):
        if args.only and label not in args.only:
            continue
        plants = [p for p in injector.PLANTS if not (p == "drawer" and "gravity_torque" in names)]
        for k in range(args.cases):
            row = run(names, noise, plants[(args.seed + number + k) % len(plants)], args.seed + k, args.logs)
            rows.setdefault(label, []).append(row)
            print(json.dumps({"cell": label, **row}), file=sys.stderr, flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()

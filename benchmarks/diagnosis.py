"""Diagnosis of hidden effects: what is hidden, what is said.

    python -m benchmarks.diagnosis --cases 200 --rows rows.jsonl    # goes on where rows.jsonl ends
    python -m benchmarks.diagnosis --only coulomb_friction nothing:ar --cases 5
    python -m benchmarks.diagnosis --print rows.jsonl               # the tables of rows that were made before

The hidden effects come from the tests' own injector (own integrator, friction law and noise); six logs of 6 s at
100 Hz a case. A cell is a hidden effect; mechanisms take turns within it. Right is: the exact names for effects,
`consistent` for nothing (of a bent sensor also `unexplained`), `unexplained` for effects outside the library,
`ambiguous` with the true cause listed and
the experiment named where the protocol cannot tell. Failures count as failures; parameter errors and intervals are of
cases named exactly.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np


def _injector(name: str):
    """A module of the tests, which are no package that is installed."""
    path = Path(__file__).resolve().parents[1] / "tests" / "diagnose" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


injector, points = _injector("injector"), _injector("injector_points")

SEED = 20_000  # of the table; development used others
STRENGTHS = (0.02, 0.06, 0.2)
CURVES = ("viscous_damping", "coulomb_friction", "detent")


def cells() -> Iterator[tuple[str, tuple[str, ...], dict]]:
    """(label, hidden names, what else the injector is told) of every cell."""
    for name in injector.SINGLE:
        yield name, (name,), {}
    for pair in injector.PAIRS:
        yield "+".join(pair), pair, {}
    for noise in injector.NOISES:
        yield f"nothing:{noise}", (), {"noise": noise}
    for name in injector.OUTSIDE:
        yield f"outside:{name}", (name,), {}
    for label, (name, protocol, *_) in injector.CONFUSABLE.items():
        yield f"confusable:{label}", (name,), {"protocol": protocol}
    for effect in points.EFFECTS:
        yield f"points:{effect}", (effect,), {}
    for name in CURVES:
        for strength in STRENGTHS:
            yield f"power:{name}:{strength}", (name,), {"strength": strength}


def plants_of(label: str, names: tuple[str, ...]) -> list[str]:
    """Mechanisms of a cell."""
    if label.startswith("confusable:"):
        return list(injector.CONFUSABLE[label.split(":", 1)[1]][2])
    if label.startswith("points:"):
        return ["hinge"] if names == ("pivot_offset",) else ["hinge", "slide"]
    return injector.fits(names)


def run_points(label: str, effect: str, kind: str, seed: int) -> dict:
    """The same for a joint's place and logs with 3D points; the points' noise has a memory in every other case."""
    from diagnose import diagnose

    with tempfile.TemporaryDirectory(prefix="taa-diagnosis-") as folder:
        case, model, files = points.write_points(seed, effect, Path(folder), kind, memory=0.8 * (seed % 2))
        busy = time.process_time()
        result = diagnose(model, files, "j")
        busy = time.process_time() - busy
    d, names = result.data, () if effect == "nothing" else (effect,)
    said = {c for c in result.causes if c != "unknown"}
    loose = effect == "loose_point"
    want = "unexplained" if loose else "explained" if names else "consistent"
    right = result.verdict == want and (loose or said == set(names))
    errors, covered = [], []
    if right and case.truth:
        ((key, truth),) = case.truth.items()
        p = d["causes"][0]["parameters"][key]
        errors, covered = [abs(p["value"] / truth - 1)], [bool(p["ci95"][0] <= truth <= p["ci95"][1])]
    elif right and case.direction is not None:
        axis = np.array([d["causes"][0]["parameters"][f"axis_{c}"]["value"] for c in "xyz"])
        errors = [float(np.arccos(min(abs(axis @ case.direction) / np.linalg.norm(axis), 1.0)))]
    return {"cell": label, "plant": kind, "seed": seed, "cpu": busy, "verdict": result.verdict, "said": sorted(said),
            "right": bool(right), "wrong": bool(said != set(names) and (not names or result.verdict == "explained")),
            "errors": errors, "covered": covered, "nominal": d["nominal"]["heldout_rmse"] / 1e-3,
            "extended": d["extended"]["heldout_rmse"] / 1e-3}  # fmt: skip


def run(label: str, names: tuple[str, ...], how: dict, plant: str, seed: int, logs: int, beside: bool,
        oracle: bool) -> dict:  # fmt: skip
    """Hide, diagnose, compare: one row."""
    from diagnose import diagnose
    from diagnose.baselines import baselines

    case = injector.draw(seed, plant, names, **how)
    row: dict = {"cell": label, "plant": plant, "seed": seed}
    with tempfile.TemporaryDirectory(prefix="taa-diagnosis-") as folder:
        model, files = injector.write(case, seed, Path(folder), count=logs)
        begin, busy = time.monotonic(), time.process_time()
        result = diagnose(model, files, "j")
        row |= {"seconds": time.monotonic() - begin, "cpu": time.process_time() - busy}
        d = result.data
        if oracle:
            row["oracle"] = diagnose(model, files, "j", only=names).data["extended"]["heldout_rmse"] / case.sigma
        if beside:
            row["baselines"] = {k: v / case.sigma for k, v in baselines(result).items()}
    said = {c for c in result.causes if c != "unknown"}
    outside = label.startswith("outside:")
    if label.startswith("confusable:"):
        _, _, _, rival, words = injector.CONFUSABLE[label.split(":", 1)[1]]
        sets = [said, *(set(a) for a in d["alternatives"])]
        right = (result.verdict == "ambiguous" and set(names) in sets and any(rival in s for s in sets)
                 and words in (d["next_experiment"] or ""))  # fmt: skip
        wrong = result.verdict == "explained" and said != set(names)
    else:
        want = "unexplained" if outside else "explained" if names else "consistent"
        right = result.verdict == want and (outside or said == set(names))
        right |= how.get("noise") == "distorted" and result.verdict == "unexplained"  # the reading is bent, and said so
        wrong = result.verdict == "explained" and (outside or said != set(names)) or bool(not names and said)
    errors, covered = [], []
    if result.verdict == "explained" and said == set(names):
        for cause in d["causes"]:
            for key, p in cause["parameters"].items():
                truth = case.truth[f"{cause['name']}.{key}"]
                errors.append(float(abs(p["value"] / truth - 1)))
                covered.append(bool(p["ci95"][0] <= truth <= p["ci95"][1]))
    return row | {"verdict": result.verdict, "said": sorted(said), "right": bool(right), "wrong": bool(wrong),
                  "errors": errors, "covered": covered, "nominal": d["nominal"]["heldout_rmse"] / case.sigma,
                  "extended": d["extended"]["heldout_rmse"] / case.sigma}  # fmt: skip


def upper(bad: int, of: int) -> float:
    """Upper 95 % bound of a rate (Clopper and Pearson, one-sided)."""
    from scipy.stats import beta

    return 1.0 if bad >= of else float(beta.ppf(0.95, bad + 1, of - bad))


def share(good: int, of: int) -> str:
    """A rate with its 95 % interval (Wilson)."""
    z, p = 1.96, good / of
    middle, half = p + z * z / (2 * of), z * np.sqrt(p * (1 - p) / of + z * z / (4 * of * of))
    low, high = ((middle + s * half) / (1 + z * z / of) for s in (-1, 1))
    return f"{p:.0%} ({low:.0%} to {high:.0%})"


def lines_of(head: list[str], rows: list[list]) -> str:
    return "\n".join(["| " + " | ".join(head) + " |", "|" + " --- |" * len(head),
                      *("| " + " | ".join(str(c) for c in r) + " |" for r in rows)])  # fmt: skip


def tables(rows: list[dict]) -> str:
    """Markdown: cells, groups, confusion, power, cost."""
    by: dict[str, list[dict]] = {}
    for label, *_ in cells():
        mine = [r for r in rows if r["cell"] == label]
        if mine:
            by[label] = mine
    out, body = [], []
    for label, cell in by.items():
        if label.startswith("power:"):
            continue
        errors, covered = [e for r in cell for e in r["errors"]], [c for r in cell for c in r["covered"]]
        n, bad = len(cell), sum(r["wrong"] for r in cell)
        body.append([label, n, share(sum(r["right"] for r in cell), n), f"{bad} (<= {upper(bad, n):.0%})",
                     f"{np.median(errors):.2%}, {np.percentile(errors, 95):.2%}" if errors else "",
                     f"{sum(covered)} of {len(covered)}" if covered else "",
                     f"{np.median([r['nominal'] for r in cell]):.1f}",
                     f"{np.median([r['extended'] for r in cell]):.2f}"])  # fmt: skip
    out.append(lines_of(["hidden", "cases", "right (95 % interval)", "wrong name (95 % bound)",
                         "parameter error, median, 95th centile",
                         "intervals that hold", "nominal / noise", "extended / noise"], body))  # fmt: skip
    groups = {"single effects": lambda s: ":" not in s and "+" not in s, "pairs": lambda s: "+" in s,
              "nothing": lambda s: s.startswith("nothing:"), "outside": lambda s: s.startswith("outside:"),
              "confusable": lambda s: s.startswith("confusable:"),
              "points": lambda s: s.startswith("points:")}  # fmt: skip
    body = []
    parts = {name: [r for s, c in by.items() if mine(s) for r in c] for name, mine in groups.items()}
    clear = {f"{name}, effect / noise >= 5": [r for r in parts[name] if r["nominal"] >= 5]
             for name in ("single effects", "pairs")}  # fmt: skip
    for name, cell in (clear | parts).items():
        if not cell:
            continue
        n, bad = len(cell), sum(r["wrong"] for r in cell)
        errors, covered = [e for r in cell for e in r["errors"]], [c for r in cell for c in r["covered"]]
        body.append([name, n, share(sum(r["right"] for r in cell), n), f"{bad / n:.1%} (<= {upper(bad, n):.1%})",
                     f"{np.median(errors):.2%}" if errors else "",
                     f"{np.mean(np.array(errors) <= 0.1):.1%}" if errors else "",
                     f"{np.mean(covered):.1%} of {len(covered)}" if covered else ""])  # fmt: skip
    out.append(lines_of(["group", "cases", "right (95 % interval)", "wrong name (95 % bound)", "median error",
                         "within 10 %", "intervals that hold"], body))  # fmt: skip
    body = []
    for label, cell in by.items():
        if label.startswith("power:"):
            continue
        told = Counter(r["verdict"] + (": " + " + ".join(r["said"]) if r["said"] else "") for r in cell)
        body.append([label, "; ".join(f"{k} {v}" for k, v in told.most_common(4))])
    out.append("What is said (the four most frequent answers):\n\n" + lines_of(["hidden", "said"], body))
    body = []
    for label, cell in by.items():
        if label.startswith("power:"):
            _, name, strength = label.split(":")
            n = len(cell)
            body.append([name, strength, n, f"{np.median([r['nominal'] for r in cell]):.1f}",
                         f"{sum(r['right'] for r in cell) / n:.0%}", sum(r["wrong"] for r in cell)])  # fmt: skip
    if body:
        out.append("Power: effects scaled down.\n\n" + lines_of(
            ["hidden", "strength", "cases", "nominal error / noise", "named exactly", "wrong name"], body))  # fmt: skip
    beside = [r for r in rows if "oracle" in r and r["verdict"] == "explained" and not r["wrong"]]
    if beside:
        ratio = np.array([r["extended"] / r["oracle"] for r in beside])
        keys = sorted({k for r in beside for k in r.get("baselines", {})})
        body = [["extended model over the oracle's", len(beside), f"{np.median(ratio):.3f}",
                 f"{np.percentile(ratio, 95):.3f}", f"{np.mean(ratio <= 1.15):.0%}"]]  # fmt: skip
        for k in keys:
            r = np.array([x["baselines"][k] / x["oracle"] for x in beside if "baselines" in x])
            body.append([f"{k} over the oracle's", len(r), f"{np.median(r):.3f}", f"{np.percentile(r, 95):.3f}",
                         f"{np.mean(r <= 1.15):.0%}"])  # fmt: skip
        out.append("Held-out error of explained cases (the oracle is told the true causes).\n\n" + lines_of(
            ["", "cases", "median", "95th centile", "within 1.15"], body))  # fmt: skip
    cpu = np.array([r["cpu"] for r in rows])
    out.append(f"Processor time a diagnosis: median {np.median(cpu):.1f} s, largest {cpu.max():.1f} s "
               f"({len(cpu)} cases).")  # fmt: skip
    return "\n\n".join(out)


def main() -> None:
    """Make the rows that are missing, one case of every cell after the other, then print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", help="labels of cells (or their beginnings)")
    parser.add_argument("--cases", type=int, default=1, help="cases a cell")
    parser.add_argument("--beside", type=int, default=1, help="cases a cell with the baselines")
    parser.add_argument("--oracle", type=int, default=5, help="cases a cell with the oracle")
    parser.add_argument("--logs", type=int, default=6, help="logs a case")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--rows", type=Path, help="file of rows, one JSON object a line; read first, then added to")
    parser.add_argument("--print", type=Path, dest="only_print", help="print the tables of a file of rows")
    args = parser.parse_args()
    if args.only_print:
        print(tables([json.loads(x) for x in args.only_print.read_text().splitlines()]))
        return
    rows = []
    if args.rows and args.rows.exists():
        rows = [json.loads(x) for x in args.rows.read_text().splitlines()]
    there = {(r["cell"], r["seed"]) for r in rows}
    for k in range(args.cases):
        for number, (label, names, how) in enumerate(cells()):
            seed = args.seed + 1000 * number + k
            if (args.only and not any(label.startswith(o) for o in args.only)) or (label, seed) in there:
                continue
            plants = plants_of(label, names)
            plant, named = plants[(number + k) % len(plants)], ":" not in label
            if label.startswith("points:"):
                row = run_points(label, names[0], plant, seed)
            else:
                row = run(label, names, how, plant, seed, args.logs, k < args.beside and named,
                          k < args.oracle and named)  # fmt: skip
            rows.append(row)
            if args.rows:
                with args.rows.open("a") as f:
                    f.write(json.dumps(row) + "\n")
            print(f"{k} {label} {row['plant']}: {row['verdict']} {row['said']}", file=sys.stderr, flush=True)
    print(tables(rows))


if __name__ == "__main__":
    main()

"""The benchmark's command.

    python -m benchmarks.articulation --rows 1 2 --out results.json          # all objects, motions, cameras
    python -m benchmarks.articulation --rows 3 --objects laptop storage --motions open twice --cameras static
    python -m benchmarks.articulation --rows 4 --motions open twice          # rendered pixels, through the tracker
    python -m benchmarks.articulation --rows 5 --extents full                # the same, filmed from a hand
    python -m benchmarks.articulation --table results.json                   # the table of results on disk
    python -m benchmarks.articulation --scaling scaling.png                  # cost over tracks and frames

Every case is a line of JSON in ``--out``; a second run with the same file goes on where the first one stopped.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import zlib
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")


@dataclass(frozen=True)
class Case:
    """One estimate to make."""

    model: str
    motion: str
    orbit: bool
    small: bool
    row: int
    seed: int
    focal_known: bool
    texture: str = ""

    @property
    def key(self) -> str:
        camera = "hand" if self.row == 5 else "orbit" if self.orbit else "static"
        parts = [f"{self.row}/{self.model}", self.motion, camera]
        return ":".join([*parts, *["small"] * self.small, *filter(None, [self.texture])])


@cache
def _models() -> dict:
    from benchmarks.articulation.objects import all_models

    return {m.name: m for m in all_models()}


@cache
def _scene(model: str, motion: str, orbit: bool, small: bool, seed: int):
    from benchmarks.articulation.scenes import make_scene

    return make_scene(_models()[model], motion, orbit, small, seed)


def run(case: Case) -> dict:
    """Make, solve and score one case."""
    from benchmarks.articulation.bound import bound
    from benchmarks.articulation.engines import solve
    from benchmarks.articulation.noise import give
    from benchmarks.articulation.pixels import film
    from benchmarks.articulation.scenes import Hidden
    from benchmarks.articulation.scores import score

    try:
        if case.row in (4, 5):
            given = film(_models()[case.model], case.motion, case.texture, case.small, case.seed, held=case.row == 5)
        else:
            scene = _scene(case.model, case.motion, case.orbit, case.small, case.seed)
            given = give(scene, case.row, case.seed)
    except Hidden as reason:
        return {"key": case.key, "left_out": str(reason)}
    best = bound(given, case.focal_known) if case.row in (2, 3) else None
    row = score(given, solve(given, best, case.focal_known, case.seed), best)
    return {"key": case.key, "seed": case.seed, **({"texture": case.texture} if case.texture else {}), **row}


def cases(args: argparse.Namespace) -> Iterator[Case]:
    from benchmarks.articulation.motions import MOTIONS
    from benchmarks.articulation.pixels import TEXTURES

    names = [n for n in _models() if not args.objects or any(o == n or o == n.split("/")[0] for o in args.objects)]
    for model in names:
        for motion in args.motions or MOTIONS:
            for camera in args.cameras:
                for extent in args.extents:
                    for row in args.rows:
                        # Pixels: painted boxes before a camera that rests or is held in a hand.
                        if row in (4, 5) and (camera == "orbit" or _models()[model].source != "procedural"):
                            continue
                        for texture in TEXTURES if row in (4, 5) else [""]:
                            yield Case(model, motion, camera == "orbit", extent == "small", row, args.seed,
                                       not args.focal_unknown, texture)  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    from benchmarks.articulation.table import markdown, worst

    parser = argparse.ArgumentParser(prog="python -m benchmarks.articulation", description=__doc__.split("\n")[0])
    parser.add_argument("--rows", type=int, nargs="+", default=[1, 2, 3], choices=[1, 2, 3, 4, 5])
    parser.add_argument("--objects", nargs="*", help="names or models; all when left out")
    parser.add_argument("--motions", nargs="*", help="open half close return pause hurry twice; all when left out")
    parser.add_argument("--cameras", nargs="+", default=["static", "orbit"], choices=["static", "orbit"])
    parser.add_argument("--extents", nargs="+", default=["full", "small"], choices=["full", "small"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--limit", type=int, help="only so many cases, drawn from all that were asked for")
    parser.add_argument("--focal-unknown", action="store_true", help="rows 3 to 5: do not give the focal length")
    parser.add_argument("--out", type=Path, help="JSON lines, one a case; appended to")
    parser.add_argument("--table", type=Path, help="print the table of such a file and stop")
    parser.add_argument("--scaling", type=Path, help="measure the fit's cost over tracks and frames, draw it, and stop")
    parser.add_argument("--calibration", type=int, metavar="N", help="N hard cases: stated type probability against "
                        "how often it is right (rows into --out), and stop")
    args = parser.parse_args(argv)
    if args.calibration:
        from benchmarks.articulation.calibration import calibration, reliability

        print(reliability(calibration(args.calibration, args.out or Path("calibration.jsonl"))))
        return 0
    if args.scaling:
        from benchmarks.articulation.scaling import scaling

        scaling(args.scaling, out=args.out)
        return 0
    if args.table:
        rows = [json.loads(line) for line in args.table.read_text().splitlines()]
        rows = [r for r in rows if "left_out" not in r]
        print(markdown(rows))
        print(worst(rows), file=sys.stderr)
        return 0
    from benchmarks.articulation.motions import MOTIONS

    known = {n for model in _models() for n in (model, model.split("/")[0])}
    for wanted, there, what in ((args.motions, set(MOTIONS), "motions"), (args.objects, known, "objects")):
        if missing := set(wanted or ()) - there:
            parser.error(f"no {what} {', '.join(sorted(missing))}; known: {', '.join(sorted(there))}")
    todo = list(cases(args))
    if args.limit and args.limit < len(todo):
        # The same order for every limit: a larger one goes on with the cases of a smaller one.
        order = sorted(range(len(todo)), key=lambda k: zlib.crc32(f"{args.seed} {todo[k].key}".encode()))
        todo = [todo[k] for k in order[: args.limit]]
    rows = []
    if args.out and args.out.is_file():
        rows = [json.loads(line) for line in args.out.read_text().splitlines()]
        done = {r["key"] for r in rows}
        todo = [c for c in todo if c.key not in done]
    with ProcessPoolExecutor(args.workers) as pool:
        jobs = pool.map(run, todo) if args.workers > 1 else map(run, todo)
        for k, row in enumerate(jobs, 1):
            rows.append(row)
            if args.out:
                with args.out.open("a") as file:
                    file.write(json.dumps(row) + "\n")
            if k % 20 == 0 or k == len(todo):
                print(f"{k} of {len(todo)}", file=sys.stderr, flush=True)
    left_out = sorted({r["left_out"] for r in rows if "left_out" in r})
    rows = [r for r in rows if "left_out" not in r]
    print(markdown(rows))
    for reason in left_out:
        print(f"left out: {reason}", file=sys.stderr)
    print(worst(rows), file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())

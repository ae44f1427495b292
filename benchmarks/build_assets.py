"""Build the assets that ship: render each clip, reconstruct it from its pixels, put the result into ``assets/``.

    python -m benchmarks.build_assets                       # all, into assets/
    python -m benchmarks.build_assets --only laptop oven    # some
    python -m benchmarks.build_assets --work build/assets   # keeps clips and scenes: a second run resumes

Nothing but the video reaches the reconstruction; the truth beside the clip is read afterwards, for the table that is
printed and written into ``assets/README.md``. A clip that is refused, whose joint has the wrong type, whose
replay moves the part by less than half, or whose replay a control equals, is a row of the table and does not ship.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

CLIPS = ("demo", "demo_handheld", "cabinet", "locker", "drawer", "crate", "box", "laptop", "oven", "monitor", "puncher",
         "stapler")  # fmt: skip
"""All with a joint that `taa synth` renders."""
PREFIX = "synth-"
"""Of the ids: an asset that a user calls ``drawer`` must not stand behind one of ours."""
LEAST_PROGRESS = 0.5
MOST_CONTROL = 0.5
"""A part that moves as far without the hand's push says nothing about the push."""
MAX_BYTES = 20_000_000
LEFT_OUT = ("*.mp4", "report.html")
"""Films weigh more than all else; ``--work`` keeps the whole folders."""
ROOT = Path(__file__).resolve().parents[1]
BEGIN, END = "<!-- table: python -m benchmarks.build_assets -->", "<!-- end of the table -->"


def build(clip: str, work: Path) -> dict:
    """Render, reconstruct and score one clip; a row of the table, "asset" is the built folder or None."""
    from benchmarks.clips import true_errors
    from reconstruct.pipeline import reconstruct
    from reconstruct.synth import load_truth, render_clip

    begin = time.monotonic()
    folder = work / "clips" / clip
    if not (folder / "video.mp4").is_file():
        folder = render_clip(clip, work / "clips")
    row: dict = {"clip": clip, "asset": None, "words": ""}
    try:
        made = reconstruct(folder / "video.mp4", PREFIX + clip, scene=work / "scenes" / clip, out=work / "assets",
                           overwrite=True)  # fmt: skip
    except Exception as error:  # a failed clip is a row like any other
        return {**row, "words": f"{type(error).__name__}: {error}", "seconds": time.monotonic() - begin}
    row |= {"seconds": time.monotonic() - begin, "joint": made.joint["type"], "words": made.error or ""}
    if made.asset is None:
        return row
    truth = load_truth(folder)
    right = made.joint["type"] == truth.type
    row |= true_errors(made.joint, truth) if right else {"words": f"the truth is {truth.type}"}
    row |= {"range": float(np.ptp(made.joint["q"])), "true_range": float(np.ptp(truth.q)),
            "progress": made.replay["joint_progress"], "control": max(made.replay["controls"].values()),
            "gate": made.asset.metadata["gate"]["passed"], "asset": made.asset.path}  # fmt: skip
    if not right:
        row["asset"] = None
    elif row["progress"] < LEAST_PROGRESS:
        row |= {"asset": None, "words": f"replay reaches {row['progress']:.0%} only"}
    elif row["control"] > MOST_CONTROL:
        row |= {"asset": None, "words": f"a control reaches {row['control']:.0%}"}
    return row


def size_of(folder: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())


def table(rows: list[dict]) -> str:
    """Markdown, one line a clip."""
    out = ["| id | joint | axis | place | range (true) | scale | replay | worst control | kB | |",
           "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"]  # fmt: skip
    for r in rows:
        angle = r.get("joint") == "revolute"

        def span(key: str, r: dict = r, angle: bool = angle) -> str:
            return "" if key not in r else f"{np.degrees(r[key]):.0f} deg" if angle else f"{r[key]:.3f} m"

        cells = [
            f"`{PREFIX}{r['clip']}`" if r.get("bytes") else r["clip"], r.get("joint") or "",
            f"{r['angle_deg']:.1f} deg" if "angle_deg" in r else "", f"{r['distance']:.1%}" if "distance" in r else "",
            f"{span('range')} ({span('true_range')})" if "range" in r else "",
            f"{r['scale']:.2f}" if "scale" in r else "", f"{r['progress']:.0%}" if "progress" in r else "",
            f"{r['control']:.0%}" if "control" in r else "", f"{r['bytes'] / 1000:.0f}" if r.get("bytes") else "",
            r["words"],
        ]  # fmt: skip
        out.append("| " + " | ".join(cells) + " |")
    return "\n".join(out)


def write_readme(folder: Path, text: str) -> None:
    """The table into ``README.md`` between its two marks; rows of clips that are not in it stay as they were."""
    file = folder / "README.md"
    head, rest = file.read_text(encoding="utf-8").split(BEGIN)
    old, tail = rest.split(END)

    def clip(line: str) -> str:
        return line.split("|")[1].strip().strip("`").removeprefix(PREFIX)

    titles, new = text.splitlines()[:2], text.splitlines()[2:]
    rows = {clip(line): line for line in [*old.strip().splitlines()[2:], *new]}
    lines = [*titles, *(rows[name] for name in CLIPS if name in rows)]
    file.write_text(f"{head}{BEGIN}\n\n" + "\n".join(lines) + f"\n\n{END}{tail}", encoding="utf-8")


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=CLIPS, default=CLIPS)
    parser.add_argument("--out", type=Path, default=ROOT / "assets", help="folder that the assets go to")
    parser.add_argument("--work", type=Path, help="keeps clips, scenes and rows, so that a second run resumes")
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(prefix="taa-assets-") as scratch:
        work = arguments.work or Path(scratch)
        (work / "rows").mkdir(parents=True, exist_ok=True)
        for clip in arguments.only:
            print(clip, file=sys.stderr, flush=True)
            row = build(clip, work)
            target = arguments.out / (PREFIX + clip)
            shutil.rmtree(target, ignore_errors=True)
            if row["asset"] is not None:
                shutil.copytree(row["asset"], target, ignore=shutil.ignore_patterns(*LEFT_OUT))
                row["bytes"] = size_of(target)
            row["asset"] = row["asset"] and str(row["asset"])
            (work / "rows" / f"{clip}.json").write_text(json.dumps(row))
        rows = [json.loads(f.read_text()) for clip in CLIPS if (f := work / "rows" / f"{clip}.json").is_file()]
    text = table(rows)
    print(text)
    if (arguments.out / "README.md").is_file():
        write_readme(arguments.out, text)
    total = sum(size_of(f) for f in arguments.out.iterdir() if f.is_dir())
    shipped = sum(1 for r in rows if r.get("bytes"))
    print(f"{shipped} of {len(rows)} ship, {total / 1e6:.1f} MB in all")
    return int(shipped < len(rows) or total > MAX_BYTES)


if __name__ == "__main__":
    sys.exit(main())

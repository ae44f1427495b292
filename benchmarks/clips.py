"""End to end: videos in, scored joints and replays out.

    python -m benchmarks.clips                 # the rendered clips, and the real ones where they are present
    python -m benchmarks.clips --only demo dishwasher.mp4

Real clips are scored against lines drawn on them by eye (good to about 2 % of the image diagonal), rendered ones
against the truth. A location in 3D is compared after the monocular scale is taken out; the scale has its own column.
A clip that fails, or is refused wrongly, is a row like any other.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np

REAL = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "videos"
RENDERED = ("demo", "demo_handheld", "drawer", "laptop", "oven", "locker", "puncher", "lift", "still")
"""Those of :func:`reconstruct.synth.list_clips` that run when no clip is named."""


def annotations() -> dict[str, dict]:
    """Annotated real clips that are present: name -> annotation; empty where there are none."""
    file = REAL / "annotations.json"
    return json.loads(file.read_text())["videos"] if file.is_file() else {}


def image_errors(line: np.ndarray, truth: dict) -> dict[str, float]:
    """Errors of a drawn axis: ``angle_deg`` and ``distance`` as a share of the image diagonal.

    Args:
        line: (2, 2) px.
        truth: an annotation with axis_line, axis_point or direction in shares of width and height.
    """
    size = np.array([truth["width"], truth["height"]], float)
    u = line[1] - line[0]
    u = u / max(np.linalg.norm(u), 1e-9)
    out = {}
    if truth.get("axis_line"):
        a = np.array(truth["axis_line"]) * size
        v = (a[1] - a[0]) / np.linalg.norm(a[1] - a[0])
        out["angle_deg"] = float(np.degrees(np.arccos(min(1.0, abs(u @ v)))))
        out["distance"] = float(np.abs((a - line[0]) @ [-u[1], u[0]]).mean() / np.linalg.norm(size))
    elif truth.get("axis_point"):
        # A hinge that points at the camera is drawn as a short piece: the distance from that piece counts.
        p = np.array(truth["axis_point"]) * size
        s = np.clip((p - line[0]) @ u, 0, np.linalg.norm(line[1] - line[0]))
        out["distance"] = float(np.linalg.norm(line[0] + s * u - p) / np.linalg.norm(size))
    elif truth.get("direction"):
        a = np.array(truth["direction"]) * size
        v = (a[1] - a[0]) / np.linalg.norm(a[1] - a[0])
        out["angle_deg"] = float(np.degrees(np.arccos(np.clip(u @ v, -1, 1))))
    return out


def true_errors(joint: dict, truth) -> dict[str, float]:
    """3D errors of a rendered clip: ``angle_deg``, ``distance`` over the object's diagonal, ``scale`` (1 is right).

    The scale is the ratio that puts the fitted axis at the true one's distance from the camera.
    """
    Te, Tt = np.array(joint["T_camera_world"]), np.asarray(truth.T_camera_world)[0]
    a, b = Te[:3, :3] @ joint["axis"], Tt[:3, :3] @ truth.axis
    out = {"angle_deg": float(np.degrees(np.arccos(min(1.0, abs(a @ b)))))}
    if truth.type == "prismatic":
        out["scale"] = float(np.ptp(joint["q"]) / np.ptp(truth.q))
        return out
    across = lambda v: v - (v @ b) * b  # noqa: E731
    found = across(Te[:3, :3] @ joint["point"] + Te[:3, 3])
    right = across(Tt[:3, :3] @ truth.point + Tt[:3, 3])
    out["scale"] = float(np.linalg.norm(found) / np.linalg.norm(right))
    out["distance"] = float(np.linalg.norm(found / out["scale"] - right) / truth.diagonal)
    return out


def run(name: str, folder: Path) -> dict:
    """Reconstruct and score one clip.

    Args:
        name: a rendered clip, or the file name of a real one.
        folder: where assets and rendered clips are written.

    Returns:
        One row: clip, truth, verdict, type, errors, range (deg or m), replay, notes, seconds, error.
    """
    from reconstruct.errors import TaaError
    from reconstruct.pipeline import reconstruct
    from reconstruct.synth import list_clips, load_truth, render_clip

    rendered = name in list_clips()
    truth = None
    if rendered:
        clip = render_clip(name, folder / "clips")
        truth = load_truth(clip)
        video, kind = truth.video, truth.type
    else:
        truth = annotations()[name]
        video, kind = REAL / name, None if truth["joint"] == "none" else truth["joint"]
    row: dict = {"clip": name, "truth": kind or "none"}
    begin = time.monotonic()
    try:
        id = "clip-" + "".join(c for c in name.lower() if c.isalnum())
        result = reconstruct(video, id, out=folder / "assets", overwrite=True).as_dict()
    except TaaError as error:
        return {**row, "verdict": "error", "error": str(error), "seconds": time.monotonic() - begin}
    joint = result["joint"]
    row |= {"verdict": joint["verdict"], "type": joint.get("type"), "reason": joint["reason"],
            "replay": result["replay"], "asset": result["asset"], "notes": result["notes"],
            "seconds": time.monotonic() - begin}  # fmt: skip
    if joint.get("q") and kind:
        span = float(np.ptp(joint["q"]))
        row["range"] = float(np.degrees(span)) if joint["type"] != "prismatic" else span
        row["axis_std_deg"] = joint["std"]["axis_deg"]
        row |= true_errors(joint, truth) if rendered else image_errors(np.array(joint["image_line"]), truth)
    return row


def table(rows: list[dict]) -> str:
    """Markdown."""
    lines = [
        "| clip | truth | answer | axis | place | range | scale | replay | worst control | s |",
        "|" + " --- |" * 10,
    ]
    show = lambda r, k, f: f.format(r[k]) if r.get(k) is not None else ""  # noqa: E731
    for r in rows:
        replay = r.get("replay") or {}
        answer = r.get("type") or r["verdict"]
        if r["verdict"] == "ambiguous":
            answer += " (ambiguous)"
        unit = " m" if r.get("type") == "prismatic" else " deg"
        lines.append(
            f"| {r['clip']} | {r['truth']} | {answer} | {show(r, 'angle_deg', '{:.1f} deg')} "
            f"| {show(r, 'distance', '{:.1%}')} | {show(r, 'range', '{:.3g}' + unit)} | {show(r, 'scale', '{:.2f}')} "
            f"| {show(replay, 'joint_progress', '{:.0%}')} "
            f"| {format(max(replay['controls'].values()), '.0%') if replay else ''} | {r['seconds']:.0f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Print the table; rows go to stderr as they come."""
    import sys

    from reconstruct.synth import list_clips

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", help="clips to run")
    parser.add_argument("--keep", type=Path, help="folder for clips and assets (default: a temporary one)")
    args = parser.parse_args()
    known = [*list_clips(), *annotations()]
    if unknown := [name for name in args.only or () if name not in known]:
        parser.error(f"no clip {unknown[0]!r}; there are {', '.join(known)}")
    rows = []
    with tempfile.TemporaryDirectory(prefix="taa-clips-") as scratch:
        for name in args.only or [*RENDERED, *annotations()]:
            rows.append(run(name, args.keep or Path(scratch)))
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()

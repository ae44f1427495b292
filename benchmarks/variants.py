"""Real clips once more: mirrored, played backwards, smaller, at half the rate, compressed, darker, shaken.

    python -m benchmarks.variants                                   # every clip and variant, two at a time
    python -m benchmarks.variants --only suitcase.mp4 --kinds mirrored backwards
    python -m benchmarks.variants --workers 16 --out rows.jsonl     # a line a run, written as it ends

What was found must not hang on any of that. There are few real clips, and all were looked at while the project was
built: their variants give other corners, other orders of draws and other frames to begin from. Each goes from its
pixels to its joint (no asset is built) and is scored against the clip's annotation, which is changed the same way. The
files are lossless.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.clips import REAL, annotations, image_errors

KINDS = ("as it is", "mirrored", "backwards", "smaller", "half rate", "compressed", "darker", "shaken")
SMALLER = 2 / 3
"""Of width and height."""
QUALITY = 25
"""Of JPEG, each frame by itself."""
DARKER = 0.4
"""Of the grey values, rounded: three of five levels are gone."""
SWAY_DEG, MARGIN = 2.0, 0.06
"""By which a camera in a hand turns to and fro about each axis at most, deg, and what is cut off for it at each side,
over the longer one."""
FOCAL = 0.8
"""Focal length of a shaken clip's camera, over the longer side."""


def change(frames: np.ndarray, fps: float, kind: str) -> tuple[np.ndarray, float]:
    """A variant's frames, (T', h', w', 3), and how many of them there are a second.

    Args:
        frames: (T, h, w, 3) uint8 BGR of the clip.  fps: of them a second.  kind: one of KINDS.

    Raises:
        ValueError: no such kind.
    """
    import cv2

    if kind == "as it is":
        return frames, fps
    if kind == "mirrored":
        return frames[:, :, ::-1], fps
    if kind == "backwards":
        return frames[::-1], fps
    if kind == "smaller":
        size = (round(frames.shape[2] * SMALLER), round(frames.shape[1] * SMALLER))
        return np.stack([cv2.resize(f, size, interpolation=cv2.INTER_AREA) for f in frames]), fps
    if kind == "half rate":
        return frames[::2], fps / 2
    if kind == "compressed":
        packed = (cv2.imencode(".jpg", f, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1] for f in frames)
        return np.stack([cv2.imdecode(p, cv2.IMREAD_COLOR) for p in packed]), fps
    if kind == "darker":
        return np.stack([np.round(f * DARKER).astype(np.uint8) for f in frames]), fps
    if kind == "shaken":
        return shaken(frames, fps), fps
    raise ValueError(f"no variant {kind!r}; there are {', '.join(KINDS)}")


def margin(width: int, height: int) -> int:
    """px that a shaken picture lacks at each side."""
    return round(MARGIN * max(width, height))


def shaken(frames: np.ndarray, fps: float) -> np.ndarray:
    """The clip as a camera sees it that a hand holds: it turns, and does not go anywhere, by slow and quick sways (0.4
    to 3 Hz) from its first direction on.

    Args:
        frames: (T, h, w, 3) uint8.  fps: of them a second.

    Returns:
        (T, h - 2 m, w - 2 m, 3) with m of :func:`margin`; the first is the clip's without its rim.
    """
    import cv2
    from scipy.spatial.transform import Rotation

    T, h, w = frames.shape[:3]
    cut, rng, t = margin(w, h), np.random.default_rng(0), np.arange(T) / fps
    sway = sum(rng.normal(size=3) * np.sin(2 * np.pi * f * t[:, None] + rng.uniform(0, 6, 3)) / f for f in (0.4, 1, 3))
    sway = sway - sway[0]
    turn = Rotation.from_rotvec(np.radians(SWAY_DEG) * sway / np.abs(sway).max()).as_matrix()
    K = np.array([[FOCAL * max(w, h), 0, (w - 1) / 2], [0, FOCAL * max(w, h), (h - 1) / 2], [0, 0, 1]])
    shift = np.array([[1.0, 0, -cut], [0, 1, -cut], [0, 0, 1]])
    size = (w - 2 * cut, h - 2 * cut)
    return np.stack([
        cv2.warpPerspective(f, shift @ K @ R @ np.linalg.inv(K), size, flags=cv2.INTER_CUBIC)
        for f, R in zip(frames, turn, strict=True)
    ])  # fmt: skip


def change_truth(truth: dict, kind: str) -> dict:
    """The annotation of a variant, in the format of the clip's own."""
    out = dict(truth)
    if kind == "mirrored":
        for key in ("axis_line", "direction"):
            if truth.get(key):
                out[key] = [[1 - x, y] for x, y in truth[key]]
        if truth.get("axis_point"):
            out["axis_point"] = [1 - truth["axis_point"][0], truth["axis_point"][1]]
    elif kind == "backwards" and truth.get("direction"):
        out["direction"] = truth["direction"][::-1]
    elif kind == "smaller":
        out |= {"width": round(truth["width"] * SMALLER), "height": round(truth["height"] * SMALLER)}
    elif kind == "shaken":
        size = np.array([truth["width"], truth["height"]])
        cut = margin(*size)
        out |= {"width": int(size[0]) - 2 * cut, "height": int(size[1]) - 2 * cut}
        for key in ("axis_line", "axis_point", "direction"):
            if truth.get(key):
                out[key] = ((np.array(truth[key]) * size - cut) / (size - 2 * cut)).tolist()
    return out


def write_video(file: Path, frames: np.ndarray, fps: float) -> None:
    """(T, h, w, 3) uint8 BGR frames as FFV1, which is lossless, so that a variant's pixels are the clip's.

    Raises:
        RuntimeError: OpenCV's video writer cannot.
    """
    import cv2

    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"FFV1"), fps, frames.shape[2:0:-1])
    if not writer.isOpened():
        raise RuntimeError(f"OpenCV cannot write {file.name} as FFV1")
    for frame in frames:
        writer.write(np.ascontiguousarray(frame))
    writer.release()


def run(name: str, kind: str) -> dict[str, Any]:
    """One row: clip, kind, verdict, type, probability, range (deg or m), errors in the picture, reason, seconds."""
    import cv2

    from reconstruct.container import open_video
    from reconstruct.errors import Refused, TaaError
    from reconstruct.pipeline import Silent, Stages, look
    from reconstruct.video import load_video

    cv2.setNumThreads(1)
    truth = change_truth(annotations()[name], kind)
    row: dict[str, Any] = {"clip": name, "kind": kind, "truth": truth["joint"]}
    begin = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="taa-variant-") as scratch:
        path = REAL / name
        if kind != "as it is":
            capture, frames = open_video(path), []
            fps = capture.get(cv2.CAP_PROP_FPS)
            while True:
                more, frame = capture.read()
                if not more:
                    break
                frames.append(frame)
            capture.release()
            path = Path(scratch) / "variant.avi"
            write_video(path, *change(np.stack(frames), fps, kind))
            del frames
        try:
            video = load_video(path, Path(scratch))
            fit = look(video, None, None, 0, Stages(None, Silent(), {"seed": 0}), Path(scratch)).fit
        except (Refused, TaaError) as error:
            verdict = "refused" if isinstance(error, Refused) else "error"
            return row | {"verdict": verdict, "reason": str(error), "seconds": time.monotonic() - begin}
        row |= {"verdict": fit.verdict, "type": fit.type, "reason": fit.reason}
        if fit.verdict != "refused":
            span = float(np.ptp(fit.q))
            row |= {"probability": fit.type_probability, "stated": float(fit.std["axis_deg"]),
                    "tracks": len(fit.point_track),
                    "range": span if fit.type == "prismatic" else float(np.degrees(span))}  # fmt: skip
            row |= image_errors(np.asarray(fit.image_line), truth)
    return row | {"seconds": time.monotonic() - begin}


def cell(row: dict[str, Any]) -> str:
    """A row in one cell of the table."""
    if row["verdict"] in ("refused", "error"):
        right = row["truth"] == "none" and row["verdict"] == "refused"
        return row["verdict"] + ("" if right else " (wrong)")
    words = [row["type"] + (" (ambiguous)" if row["verdict"] == "ambiguous" else "")]
    if row["type"] != row["truth"]:
        words[0] += " (wrong)"
    if row["type"] != "prismatic":
        words.append(f"{row['range']:.0f} deg")
    if "angle_deg" in row:
        words.append(f"{row['angle_deg']:.1f} deg off")
    if "distance" in row:
        words.append(f"{row['distance']:.1%}")
    return ", ".join(words)


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: a line a clip, a column a variant."""
    kinds = [k for k in KINDS if any(r["kind"] == k for r in rows)]
    lines = ["| clip | truth | " + " | ".join(kinds) + " |", "|" + " --- |" * (2 + len(kinds))]
    for name in dict.fromkeys(r["clip"] for r in rows):
        mine = {r["kind"]: r for r in rows if r["clip"] == name}
        truth = next(iter(mine.values()))["truth"]
        lines.append(f"| {name} | {truth} | " + " | ".join(cell(mine[k]) if k in mine else "" for k in kinds) + " |")
    return "\n".join(lines)


def main() -> None:
    """Print the table; rows go to stderr, and to a file, as they come."""
    import sys

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", help="clips to run")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, help="file that rows are appended to, a line of JSON each")
    arguments = parser.parse_args()
    if arguments.workers < 1:
        parser.error("--workers needs one at least")
    if arguments.out and not arguments.out.parent.is_dir():
        parser.error(f"no folder {arguments.out.parent} for --out")
    known = annotations()
    if not known:
        parser.error(f"no annotated clips in {REAL}")
    if unknown := [name for name in arguments.only or () if name not in known]:
        parser.error(f"no clip {unknown[0]!r}; there are {', '.join(known)}")
    names = arguments.only or list(known)
    rows = []
    with ProcessPoolExecutor(arguments.workers, mp_context=get_context("spawn")) as pool:
        for job in as_completed([pool.submit(run, name, kind) for kind in arguments.kinds for name in names]):
            rows.append(job.result())
            line = json.dumps(rows[-1], default=float)
            print(line, file=sys.stderr, flush=True)
            if arguments.out:
                with arguments.out.open("a", encoding="utf-8") as f:
                    f.write(line + "\n")
    rows.sort(key=lambda r: (names.index(r["clip"]), KINDS.index(r["kind"])))
    print(table(rows))


if __name__ == "__main__":
    main()

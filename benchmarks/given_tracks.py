"""Real clips by the tracks of a learned tracker, where such files lie beside the videos: no pixel is read.

    python -m benchmarks.given_tracks

The files hold `pred_tracks` (1, T, N, 2) px and `pred_visibility`; the joint is fitted to all of them, hands and
shadows included, and scored against the lines drawn by eye as in `benchmarks.clips`.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.clips import REAL, annotations, image_errors


def load(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """(N, T, 2) px and (N, T) bool."""
    held = np.load(file, allow_pickle=True).item()
    uv, seen = (np.asarray(held[key]).squeeze() for key in ("pred_tracks", "pred_visibility"))
    return np.swapaxes(uv, 0, 1).astype(float), np.swapaxes(seen, 0, 1) > 0.5


def run(name: str, truth: dict, seed: int = 0) -> dict:
    """One row: clip, truth, verdict, type, errors, range (deg or m over the link's depth), CPU seconds."""
    from reconstruct.cues import ProviderInfo, Tracks
    from reconstruct.joint.fit import fit_joint
    from reconstruct.video import Video

    uv, seen = load(REAL / f"{Path(name).stem}_cotracker.npy")
    T = uv.shape[1]
    size = (truth["width"], truth["height"])
    scale = min(1.0, 960 / max(size))
    work = np.broadcast_to(np.zeros((1, 1, 1, 3), np.uint8), (T, round(size[1] * scale), round(size[0] * scale), 3))
    video = Video(REAL / name, "0" * 64, size, np.arange(T) / truth["fps"], np.arange(T), T, work, scale)
    tracks = Tracks(uv.astype(np.float32), seen, np.zeros(len(uv), int), ProviderInfo("file", "1", "CC-BY-SA-4.0"))
    begin = time.process_time()
    fit = fit_joint(video, tracks, None, seed)
    kind = None if truth["joint"] == "none" else truth["joint"]
    row = {"clip": name, "truth": kind or "none", "verdict": fit.verdict, "type": fit.type, "tracks": len(uv),
           "agree": fit.inliers, "reason": fit.reason, "seconds": time.process_time() - begin}  # fmt: skip
    if fit.q is not None and fit.image_line is not None:
        span = float(np.ptp(fit.q))
        row |= {"range": span if fit.type == "prismatic" else float(np.degrees(span)),
                "probability": max(fit.type_probability.values()), "axis_std_deg": fit.std["axis_deg"]}  # fmt: skip
        if kind:
            row |= image_errors(fit.image_line, truth)
    return row


def main() -> None:
    """Print a table; rows go to stderr as they come."""
    print("| clip | truth | answer | p | axis | place | range | agree | s |\n|" + " --- |" * 9)
    show = lambda r, k, f: f.format(r[k]) if r.get(k) is not None else ""  # noqa: E731
    for name, truth in annotations().items():
        if not (REAL / f"{Path(name).stem}_cotracker.npy").is_file():
            continue
        r = run(name, truth)
        print(json.dumps(r), file=sys.stderr, flush=True)
        unit = " of the depth" if r["type"] == "prismatic" else " deg"
        answer = r["type"] if r["verdict"] == "ok" else r["verdict"]
        cells = [name, r["truth"], answer, show(r, "probability", "{:.2f}"), show(r, "angle_deg", "{:.1f} deg"),
                 show(r, "distance", "{:.1%}"), show(r, "range", "{:.3g}" + unit), f"{r['agree']} of {r['tracks']}",
                 f"{r['seconds']:.0f}"]  # fmt: skip
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()

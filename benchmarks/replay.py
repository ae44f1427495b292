"""How far the demonstrated hand moves the passive joint by contact alone, over rendered and real clips.

    python -m benchmarks.replay                              # all clips, with refinement
    python -m benchmarks.replay --only drawer oven --cues given --keep work

Rendered clips run twice: with the truth as cues (tracks, masks, depth, camera, hand) and from pixels alone; real clips
from pixels alone. Progress and error are the contract's, against the asset's own demonstration, so a joint of the wrong
type counts as failed: progress 0, error 100 %. So does a refusal. Nothing is left out.

``robust`` is the mean and the worst progress with the hand off by 5 mm along each axis and by 20 ms either way; ``hand
off`` the median distance of the hand to the true one while it drives, and ``size`` the fitted lengths over the true
ones (rendered clips).
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.clips import REAL, true_errors

RENDERED = ("laptop", "monitor", "stapler", "puncher", "drawer", "cabinet", "box", "oven")
PUSHED = ("dishwasher.mp4", "stapler_fold.mp4", "suitcase.mp4", "treasurebox01.avi", "cabinet01.avi", "microwave01.avi")
"""Real clips in which a hand is seen to move the part for at least a part of the stroke."""
PAPER = (("laptop", 0.63, 0.35), ("monitor", 0.39, 0.59), ("stapler", 0.92, 0.04), ("puncher", 0.97, 0.01))
"""Joint progress and final q error of the paper's own replay on its four objects."""


def prepare(name: str, cues: str, folder: Path) -> tuple[Path, Path, object | None]:
    """The video, its scene folder (with the truth as cues where asked), and the truth of a rendered clip."""
    scene = folder / "scenes" / f"{name}-{cues}"
    if name not in RENDERED:
        return REAL / name, scene, None
    from reconstruct.synth import load_truth, render_clip
    from reconstruct.synth.truth import write_cues

    clip = folder / "clips" / name
    if not (clip / "truth.json").is_file():
        render_clip(name, folder / "clips")
    if cues == "given" and not (scene / "cues" / "tracks.npz").is_file():
        write_cues(clip, scene)
    truth = load_truth(clip)
    return truth.video, scene, truth


def hand_distance(asset, truth) -> float:
    """Median distance, m, of the driving hand's landmarks to the true ones, both in their camera's frame."""
    r = asset.reference
    driven = r.contact & np.isin(np.arange(len(r.time)), np.arange(len(truth.time)))
    index = np.array([int(np.abs(truth.time - t).argmin()) for t in r.time])
    use = np.flatnonzero(driven)
    if not len(use):
        return float("nan")
    T, S = np.array(asset.camera["T_camera_world"], float), np.asarray(truth.T_camera_world)[0]
    found = r.hand_joints[use] @ T[:3, :3].T + T[:3, 3]
    true = truth.hand_joints[index[use]] @ S[:3, :3].T + S[:3, 3]
    return float(np.median(np.linalg.norm(found - true, axis=-1)))


def run(name: str, cues: str, folder: Path, hands: tuple[str, ...], seconds: float) -> dict:
    """One clip under one kind of cues: a row."""
    from reconstruct.errors import TaaError
    from reconstruct.pipeline import reconstruct
    from taa_envs.errors import TaaEnvsError
    from taa_envs.refine import refine, robustness
    from taa_envs.replay import Diverged, replay

    row: dict = {"clip": name, "cues": cues, "joint_progress": 0.0, "final_q_error": 1.0, "controls": {}}
    begin = time.monotonic()
    try:
        video, scene, truth = prepare(name, cues, folder)
        id = f"{cues}-" + "".join(c for c in name.lower() if c.isalnum())
        made = reconstruct(video, id, scene=scene, out=folder / "assets", overwrite=True)
    except TaaError as error:
        return {**row, "failed": str(error), "seconds": time.monotonic() - begin}
    row |= {"seconds": time.monotonic() - begin, "type": made.joint.get("type")}
    if made.asset is None:
        return {**row, "failed": "refused: " + made.joint["reason"]}
    asset = made.asset
    if truth is not None:
        if made.joint["type"] != truth.type:
            return {**row, "failed": f"{made.joint['type']} found, {truth.type} is true"}
        row |= true_errors(made.joint, truth)
        row["hand_off"] = hand_distance(asset, truth)
    row["driven"] = bool(asset.reference.contact.any())
    row |= made.replay or {}
    row["robust"] = robustness(asset)
    row["hands"] = {}
    for hand in hands:
        entry: dict = {"before": 0.0, "progress": 0.0, "error": 1.0}
        try:
            if row["driven"]:
                found = refine(asset, hand, seconds=seconds)
                entry = {"before": found.before.joint_progress, "progress": found.after.joint_progress,
                         "error": found.after.final_q_error, "controls": found.after.controls,
                         "rollouts": found.rollouts, "seconds": found.seconds, "changed": found.changed}
            else:
                done = replay(asset, hand)
                entry |= {"before": done.joint_progress, "progress": done.joint_progress, "error": done.final_q_error}
        except Diverged:
            entry["failed"] = "unstable"
        except TaaEnvsError as error:
            entry["failed"] = str(error)
        row["hands"][hand] = entry
    return row


def _percent(value: float | None) -> str:
    return "" if value is None or not np.isfinite(value) else f"{value:.0%}"


def table(rows: list[dict]) -> str:
    """Markdown: the rows, their means, the paper's rows; then the hands after refinement."""
    head = ["clip", "cues", "progress", "final error", "worst control", "robust: mean, worst", "refined", "error",
            "refining", "hand off", "size", ""]  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for r in rows:
        points = r.get("hands", {}).get("points", {})
        robust = r.get("robust") or {}
        worst = _percent(max(r["controls"].values())) if r.get("controls") else ""
        cells = [r["clip"], r["cues"], _percent(r["joint_progress"]), _percent(r["final_q_error"]), worst,
                 f"{_percent(robust['mean'])}, {_percent(robust['worst'])}" if robust else "",
                 _percent(points.get("progress", 0.0)), _percent(points.get("error", 1.0)),
                 f"{points['seconds']:.0f} s" if "seconds" in points else "",
                 f"{1e3 * r['hand_off']:.0f} mm" if np.isfinite(r.get("hand_off", np.nan)) else "",
                 f"{r['scale']:.2f}" if "scale" in r else "", r.get("failed", "")[:70]]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    for kind, some in (("rendered, cues given", [r for r in rows if r["cues"] == "given"]),
                       ("rendered, pixels alone", [r for r in rows if r["cues"] == "pixels" and r["clip"] in RENDERED]),
                       ("real, pixels alone", [r for r in rows if r["clip"] not in RENDERED])):
        if some:
            refined = [r.get("hands", {}).get("points", {}) for r in some]
            lines.append(f"| **mean, {kind}** | | {_percent(float(np.mean([r['joint_progress'] for r in some])))} "
                         f"| {_percent(float(np.mean([min(r['final_q_error'], 1.0) for r in some])))} | | "
                         f"| {_percent(float(np.mean([p.get('progress', 0.0) for p in refined])))} "
                         f"| {_percent(float(np.mean([min(p.get('error', 1.0), 1.0) for p in refined])))} | | | | |")
    for name, progress, error in PAPER:
        lines.append(f"| {name} (paper) | | {progress:.0%} | {error:.0%} | | | | | | | | |")
    lines.append("| **mean (paper)** | | 73% | 25% | | | | | | | | |")
    return "\n".join(lines)


def hand_table(rows: list[dict]) -> str:
    """Markdown: progress before and after refinement of every hand, clip by clip."""
    hands = list(dict.fromkeys(h for r in rows for h in r.get("hands", {})))
    lines = ["| clip | cues | " + " | ".join(hands) + " |", "|" + " --- |" * (2 + len(hands))]
    for r in rows:
        cells = []
        for hand in hands:
            e = r.get("hands", {}).get(hand)
            if e is None:
                cells.append("0% (no asset)")
            else:
                cells.append(e.get("failed", "")[:40] or f"{_percent(e['before'])} to {_percent(e['progress'])}")
        lines.append("| " + " | ".join([r["clip"], r["cues"], *cells]) + " |")
    for cues in dict.fromkeys(r["cues"] for r in rows):
        some = [r for r in rows if r["cues"] == cues]
        means = [np.mean([r.get("hands", {}).get(h, {}).get("progress", 0.0) for r in some]) for h in hands]
        lines.append(f"| **mean** | {cues} | " + " | ".join(_percent(float(m)) for m in means) + " |")
    return "\n".join(lines)


def main() -> None:
    """Print the tables; rows go to stderr as they come."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", help="clips to run")
    parser.add_argument("--cues", nargs="*", default=["given", "pixels"], choices=["given", "pixels"])
    parser.add_argument("--hands", nargs="*", default=["points"], help="hands to refine")
    parser.add_argument("--seconds", type=float, default=60.0, help="for refining one clip with one hand")
    parser.add_argument("--keep", type=Path, help="folder for clips, scenes and assets (default: a temporary one)")
    args = parser.parse_args()
    real = [name for name in PUSHED if (REAL / name).is_file()]
    rows = []
    with tempfile.TemporaryDirectory(prefix="taa-replay-") as scratch:
        for name in args.only or [*RENDERED, *real]:
            for cues in args.cues:
                if cues == "given" and name not in RENDERED:
                    continue
                rows.append(run(name, cues, args.keep or Path(scratch), tuple(args.hands), args.seconds))
                print(json.dumps(rows[-1], default=float), file=sys.stderr, flush=True)
    print(table(rows))
    if args.hands != ["points"]:
        print()
        print(hand_table(rows))


if __name__ == "__main__":
    main()

"""What each ``taa`` command does: call one function of the library, and put its result into words.

Imports happen inside the functions, so that ``taa list`` does not wait for OpenCV.
"""

from __future__ import annotations

import csv
import dataclasses
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from taa_envs.arrays import read_npy
from taa_envs.asset import Asset
from taa_envs.errors import TaaEnvsError
from taa_envs.files import folder_written_whole, written_whole

MAX_LOG_BYTES = 256 << 20


@dataclass(frozen=True)
class Outcome:
    """What a command hands back.

    Attributes:
        data: the JSON object of ``--json``, plain types only.
        show: prints the same for a person.
        error: one line if the answer is a refusal (exit code 1).
    """

    data: dict
    show: Callable[[], None]
    error: str | None = None


class StageBars:
    """Progress of a pipeline on stderr: a bar a stage on a terminal, else one line a finished stage."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        self.console = Console(stderr=True, highlight=False)
        self.bars = Progress(
            SpinnerColumn(finished_text="[green]✓"), TextColumn("{task.description:<10}"), BarColumn(bar_width=32),
            TimeElapsedColumn(), TextColumn("[dim]{task.fields[note]}"), console=self.console,
            disable=not self.console.is_terminal,
        )  # fmt: skip
        self.task = None
        self.name = ""

    def __enter__(self) -> StageBars:
        self.bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bars.stop()

    def start(self, stage: str) -> None:
        self.name = stage
        self.task = self.bars.add_task(stage, total=None, note="")

    def update(self, share: float) -> None:
        if self.task is not None:
            self.bars.update(self.task, total=1.0, completed=min(max(share, 0.0), 1.0))

    def finish(self, seconds: float, note: str = "") -> None:
        if self.task is not None:
            self.bars.update(self.task, total=1.0, completed=1.0, note=note)
            self.bars.stop_task(self.task)
        if not self.console.is_terminal:
            self.console.print(f"{self.name:<10} {seconds:6.1f} s  {note}".rstrip())


def _how_to_make(asset: Asset, **options: str) -> str:
    """The line of Python that makes the asset's environment: by its id where that is found, else by its folder."""
    from taa_envs import registry

    more = "".join(f", {name}={value!r}" for name, value in options.items())
    found = registry.find_assets().get(asset.id)
    if found is not None and found.resolve() == asset.path.resolve():
        return f"gymnasium.make({f'TAA/{asset.id}'!r}{more})"
    return f"taa_envs.env.ArticulationEnv({str(asset.path)!r}{more})"


def reconstruct(video: Path, asset_id: str, scene: Path | None, out: Path | None, focal: float | None,
                providers: dict[str, str], overwrite: bool, seed: int) -> Outcome:  # fmt: skip
    from reconstruct.pipeline import reconstruct as run

    with StageBars() as bars:
        result = run(video, asset_id, scene=scene, out=out, focal=focal, providers=providers, overwrite=overwrite,
                     seed=seed, progress=bars)  # fmt: skip

    def show() -> None:
        for note in result.notes:
            print(f"note: {note}")
        if result.asset is None:
            return
        _table(f"{asset_id}: {result.asset.joint['type']} joint", _joint_rows(result.joint))
        if result.replay is not None:
            _table("open-loop replay through contact", replay_rows(result.replay))
        print(f"asset   {result.asset.path}")
        print(f"report  {result.asset.path / 'report.html'}")
        print(f"use     {_how_to_make(result.asset)}")

    return Outcome(result.as_dict(), show, result.error)


def fit(scene: Path, focal: float | None, out: Path | None, seed: int) -> Outcome:
    import json

    from reconstruct.pipeline import fit_scene

    with StageBars() as bars:
        joint = fit_scene(scene, focal=focal, seed=seed, progress=bars)
    if out is not None:
        with written_whole(out) as partial:
            partial.write_text(json.dumps(joint, allow_nan=False), encoding="utf-8")
    refused = f"{joint['reason']}; see the video's notes in the scene folder" if joint["verdict"] == "refused" else None
    return Outcome(joint, lambda: _table(f"{scene}: {joint['verdict']}", _joint_rows(joint)), refused)


def import_scene(source: Path, scene: Path, label: str | None, rate: float, ground: bool) -> Outcome:
    from reconstruct.import_scene import import_scene as run

    data = run(source, scene, label, rate, ground)

    def words() -> None:
        _table(f"{scene}: {data['frames']} frames of {data['size'][0]} x {data['size'][1]} px",
               [("cue", "made from"), *data["cues"].items()], header=True)  # fmt: skip
        if data["missing"]:
            print(f"not there: {', '.join(data['missing'])}")
        for note in data["notes"]:
            print(f"note: {note}")
        print(f"use     taa fit {scene}")
        if data["video"]:
            print(f"        taa reconstruct {data['video']} --id ID --scene {scene}")

    return Outcome(data, words)


def list_assets() -> Outcome:
    from taa_envs import registry
    from taa_envs.asset import read_metadata

    rows = []
    for asset_id, path in sorted(registry.find_assets().items()):
        joint = read_metadata(path)["joint"]
        rows.append({"id": asset_id, "path": str(path), "type": joint["type"], "verdict": joint.get("verdict")})

    def show() -> None:
        if not rows:
            print("no assets yet; make one with: taa reconstruct VIDEO --id ID")
            return
        _table(None, [(r["id"], r["type"], r["verdict"] or "", r["path"]) for r in rows])

    return Outcome({"assets": rows}, show)


def show(asset_id: str) -> Outcome:
    from taa_envs import registry

    asset = registry.get_asset(asset_id)
    data = {**asset.metadata, "path": str(asset.path)}

    def words() -> None:
        _table(f"{asset.id}: {asset.joint['type']} joint, {asset.path}", _joint_rows(asset.joint))
        rows = [(name, _short(p["value"]), p.get("unit", ""), p["origin"], _short(p.get("std")))
                for name, p in sorted(asset.provenance.items())]  # fmt: skip
        _table("numbers and where they come from", [("name", "value", "unit", "origin", "std"), *rows], header=True)
        for note in asset.metadata.get("notes", ()):
            print(f"note: {note}")

    return Outcome(data, words)


def view(asset_id: str, port: int) -> Outcome:
    from taa_envs import registry
    from taa_envs.viewer import serve

    asset = registry.get_asset(asset_id)
    try:
        viewer = serve(asset, port)
    except ImportError:
        raise TaaEnvsError(
            "the viewer needs the package viser; install it with: pip install 'taa-envs[view]'"
        ) from None
    # A shell that starts it in the background leaves Ctrl-C ignored; a service manager ends it with SIGTERM.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    print(f"{asset_id} at {viewer.url}; stop with Ctrl-C", file=sys.stderr)
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        viewer.stop()
    return Outcome({"id": asset_id, "url": viewer.url}, lambda: None)


def replay(asset_id: str, hand: str, video: Path | None, refining: bool, reference: str, out: Path | None, seed: int,
           seconds: float) -> Outcome:  # fmt: skip
    from taa_envs import registry
    from taa_envs.refined import with_reference, write_refinement
    from taa_envs.replay import replay as run

    asset = registry.get_asset(asset_id)
    if video is not None and not video.parent.is_dir():
        raise TaaEnvsError(f"no such folder: {video.parent}; make it first")
    if out is not None and not refining:
        raise TaaEnvsError("--out is where --refine writes; give both or neither")
    notes: list[str] = []
    if refining:
        from taa_envs.refine import refine

        if reference != "demonstration":
            raise TaaEnvsError("--refine begins with the demonstration; leave --reference out")
        with StageBars() as bars:
            bars.start("refine")
            found = refine(asset, hand, seed=seed, seconds=seconds, progress=bars.update)
            bars.finish(found.seconds, f"{found.rollouts} replays")
        where = write_refinement(asset, found, out)
        result = found.after
        asset = dataclasses.replace(asset, reference=found.reference)
        data = {**result.as_dict(), "refinement": {**found.as_dict(), "path": str(where)}}
        if not found.changed:
            notes.append("no correction within the stated uncertainty is better than the demonstration itself")
        if not found.stated:
            notes.append("the asset does not state how uncertain its hand is; common deviations were assumed")
        there = dataclasses.replace(asset, path=where)
        notes.append(f"use it: {_how_to_make(there, hand=hand, reference='refined')}")
    else:
        asset = with_reference(asset, reference, hand)
        result = run(asset, hand)
        data = result.as_dict()
    if video is not None:
        from reconstruct.film import replay_video

        replay_video(asset, result, hand, video)

    def words() -> None:
        if refining:
            before = replay_rows(found.before.as_dict())
            rows = [(name, old, new) for (name, old), (_, new) in zip(before, replay_rows(result.as_dict()),
                                                                      strict=True)]  # fmt: skip
            _table(f"{asset_id}: replay, hand {hand}", [("", "demonstration", "refined"), *rows], header=True)
        else:
            _table(f"{asset_id}: open-loop replay, hand {hand}", replay_rows(data))
        for note in (*result.notes, *notes):
            print(f"note: {note}")
        if video is not None:
            print(f"video   {video}")

    return Outcome(data, words)


def _dataset_name(asset: Asset, name: str) -> str:
    from taa_envs.datasets import default_name, is_dataset_name

    return name if is_dataset_name(name) else default_name(asset, name)


def record_replays(asset_id: str, name: str, hand: str, episodes: int, seed: int, overwrite: bool) -> Outcome:
    from taa_envs import datasets, registry

    asset = registry.get_asset(asset_id)
    with StageBars() as bars:
        begin = time.monotonic()
        bars.start("record")
        made = datasets.record(asset, _dataset_name(asset, name), episodes, seed=seed, hand=hand, overwrite=overwrite,
                               progress=bars.update)  # fmt: skip
        bars.finish(time.monotonic() - begin, f"{episodes} episodes")
    again = list(datasets.replayed(asset, made))
    data = {"dataset": made, "episodes": again}

    def words() -> None:
        same = sum(row["same"] for row in again)
        print(f"dataset {made}, {same} of {len(again)} episodes the same when their actions are played again")
        print(f'use     minari.load_dataset("{made}"); taa score {asset_id} {made} --episode 0')

    return Outcome(data, words)


def score(asset_id: str, file: Path, hand: str, episode: int) -> Outcome:
    from taa_envs import registry, scoring

    asset = registry.get_asset(asset_id)
    try:
        if not file.exists() and file.suffix not in (".npy", ".csv"):
            from taa_envs.datasets import is_dataset_name, score_episode

            if not is_dataset_name(file.as_posix()):
                raise TaaEnvsError(f"no such file: {file}; give a joint log (.csv), an action file (.npy) or the name "
                                   f"of a Minari dataset (TAA/{asset.id}/replay-v0)")  # fmt: skip
            data = score_episode(asset, file.as_posix(), episode, hand)
        elif file.suffix == ".npy":
            data = scoring.score_actions(asset, read_npy(file), hand)
        else:
            data = scoring.score_joint_log(asset, *read_joint_log(file))
    except ValueError as error:
        raise TaaEnvsError(f"{file}: {error}") from None
    return Outcome(data, lambda: _table(f"{asset_id}: {file}", replay_rows(data)))


def read_joint_log(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Columns time (N,) s and q (N,) of a joint log; extra columns are ignored.

    Raises:
        TaaEnvsError: a column is missing or a row does not hold numbers.
    """
    if file.is_file() and file.stat().st_size > MAX_LOG_BYTES:
        raise TaaEnvsError(f"{file} is larger than {MAX_LOG_BYTES >> 20} MiB; give one episode, thinned if need be")
    try:
        return _columns(file)
    except (UnicodeDecodeError, csv.Error) as error:
        raise TaaEnvsError(f"{file} is no CSV ({str(error)[:80]}); a joint log is a CSV with time and q") from None


def _columns(file: Path) -> tuple[np.ndarray, np.ndarray]:
    with file.open(newline="", encoding="utf-8") as f:
        rows = csv.DictReader(f)
        missing = {"time", "q"} - set(rows.fieldnames or ())
        if missing:
            raise TaaEnvsError(f"{file} has no column {' and '.join(sorted(missing))}; a joint log is a CSV with time "
                               "and q, an action file an .npy array")  # fmt: skip
        time, q = [], []
        for row in rows:
            try:
                time.append(float(row["time"]))
                q.append(float(row["q"]))
            except (TypeError, ValueError):
                raise TaaEnvsError(f"{file}, line {rows.line_num}: time and q must be numbers; mend that row") from None
    return np.asarray(time), np.asarray(q)


def export(asset_id: str, kind: str, out: Path | None, overwrite: bool) -> Outcome:
    from taa_envs import registry
    from taa_envs.exports import export_asset
    from taa_envs.exports.check import check_export

    asset = registry.get_asset(asset_id)
    target = out if out is not None else Path(f"{asset_id}_{kind}")
    if target.exists() and not overwrite:
        raise TaaEnvsError(f"{target} exists; choose another --out or use --overwrite")
    with folder_written_whole(target, overwrite) as work:
        work.rmdir()
        file = export_asset(asset, kind, work)
        if wrong := check_export(asset, kind, file):
            raise TaaEnvsError(f"the {kind} export of {asset_id} comes back changed: {wrong[0]}; report this as a bug")
    main = target / file.name
    data = {"id": asset_id, "format": kind, "path": str(target), "file": str(main)}
    return Outcome(data, lambda: print(main))


def diagnose(model: str, joint: str, data: list[Path], out: Path, overwrite: bool, from_video: bool = False,
             revise: bool = False) -> Outcome:  # fmt: skip
    from diagnose import diagnose as run
    from diagnose.causes import CAUSES

    if out.exists() and not overwrite:
        raise TaaEnvsError(f"{out} exists; choose another --out or use --overwrite")
    if from_video == bool(data):
        raise TaaEnvsError("measured data are wanted: give CSV files with --data, or --from-video for an asset's own")
    logs, known, only, asset = list(data), [], None, None
    if from_video or revise:
        from taa_envs.registry import get_asset

        if Path(model).suffix:
            raise TaaEnvsError(f"{model} is a file; --from-video and --revise need the id of an asset")
        asset = get_asset(model)
    if from_video:
        from diagnose.video import assumptions, video_logs

        logs, known = video_logs(asset), assumptions(asset)
        only = [name for name in CAUSES if name != "inertia"]  # the measure of all that a video can show
    result = run(model, logs, joint, say=lambda line: print(line, file=sys.stderr), known=known, only=only)
    new = None
    if revise and result.extends:
        from diagnose.revision import revise as write
        from taa_envs.replay import replay as play

        new = write(asset, result)
        result.data["revision"] = {"id": new.id, "path": str(new.path), "replay_progress": {
            "before": float(play(asset, controls=False).joint_progress),
            "after": float(play(new, controls=False).joint_progress)}}  # fmt: skip
    with folder_written_whole(out, overwrite) as work:
        result.write(work, final=out)

    def words() -> None:
        d = result.data
        rows = [(c["name"], name, _short(p["value"]) + " " + p["unit"], f"{p['ci95'][0]:.4g} to {p['ci95'][1]:.4g}")
                for c in d["causes"] for name, p in c["parameters"].items()]  # fmt: skip
        rows = rows or [(c["name"], "", "", "") for c in d["causes"]]
        _table(f"{joint}: {d['verdict']}", [("cause", "parameter", "value", "95 % interval"), *rows], header=True)
        for other in d["alternatives"]:
            print(f"as well explained by: {' + '.join(other)}")
        if d["next_experiment"]:
            print(f"measure next: {d['next_experiment']}")
        print(f"held-out error {d['nominal']['heldout_rmse']:.4g} -> {d['extended']['heldout_rmse']:.4g} {d['unit']} "
              f"(noise {d['noise_floor']:.4g})")  # fmt: skip
        if new is not None:
            change = d["revision"]["replay_progress"]
            print(f"new revision {new.id}: replay {change['before']:.0%} -> {change['after']:.0%}  {new.path}")
        elif revise:
            print("no new revision: nothing was found that changes the model")
        print(f"report  {out / 'report.html'}")

    return Outcome(result.data, words)


def build(videos: Path, out: Path | None, engine: str, workers: int | None, retries: int, timeout: float,
          again: tuple[str, ...], providers: dict[str, str], focal: float | None, overwrite: bool,
          seed: int) -> Outcome:  # fmt: skip
    from rich.console import Console
    from rich.markup import escape

    from reconstruct.fleet import Build
    from reconstruct.fleet import build as run

    if workers is not None and workers < 1 or retries < 0 or not timeout > 0:
        raise TaaEnvsError("--workers must be at least 1, --retries at least 0, --timeout positive; mend them")
    videos = videos.resolve()
    out = out if out is not None else videos.with_name(f"{videos.name}_taa")
    err = Console(stderr=True, highlight=False)

    def tell(row, counts: dict[str, int]) -> None:
        ended = counts["done"] + counts["refused"] + counts["failed"]
        words = row.result or row.error
        share = f"{ended:>4}/{sum(counts.values())}"
        err.print(f"{share}  {row.state:<8} {escape(row.id)}  {escape(words)}", soft_wrap=True)

    manifest = run(Build(videos, out, engine, workers, retries, timeout, again, providers, focal, seed,
                         overwrite), tell)
    counts = manifest.counts()
    rows = [(r.id, r.state, f"{r.seconds:.0f}", r.result or r.error) for r in manifest.rows.values()]
    data = {"out": str(out), "counts": counts, "rows": [vars(r) for r in manifest.rows.values()],
            "manifest": str(out / "manifest.csv"), "page": str(out / "index.html")}  # fmt: skip

    def show() -> None:
        _table(f"{videos.name}: " + ", ".join(f"{n} {state}" for state, n in counts.items() if n),
               [("video", "state", "s", "result"), *rows], header=True)  # fmt: skip
        print(f"page    {out / 'index.html'}")
        print(f"table   {out / 'manifest.csv'}")
        print(f"use     TAA_ASSETS={out / 'assets'}")

    return Outcome(data, show)


def synth(out: Path, clip: str | None, overwrite: bool, seed: int) -> Outcome:
    from reconstruct.synth import list_clips, render_clip

    known = list_clips()
    if clip is not None and clip not in known:
        raise TaaEnvsError(f"no clip is named {clip!r}; known: {', '.join(known)}")
    names = [clip] if clip is not None else known
    taken = [name for name in names if (out / name).exists()]
    if taken and not overwrite:
        raise TaaEnvsError(f"{out / taken[0]} exists; choose another folder or use --overwrite")
    folders = []
    with StageBars() as bars:
        for name in names:
            begin = time.monotonic()
            bars.start(name)
            folders.append(str(render_clip(name, out, seed=seed)))
            bars.finish(time.monotonic() - begin)
    return Outcome({"clips": folders}, lambda: print("\n".join(folders)))


def doctor(rendering: bool) -> Outcome:
    from taa_envs import doctor as checks

    if rendering:
        backend = checks.check_rendering()
        return Outcome({"rendering": backend}, lambda: print(f"off-screen rendering works ({backend})"))
    data = checks.examine()

    def words() -> None:
        print(f"Python {data['python']}, {data['machine']}")
        _table("packages", [(name, version or "not installed") for name, version in data["packages"].items()])
        head = ("stage", "provider", "runs here", "why not, or what to know; licence; how to get it")
        rows = [(p["stage"], p["name"] + (" (default)" if p["default"] else ""), "yes" if p["runs"] else "no",
                 "\n".join((p["why"], _licences(p), *([p["get"]] if p["kind"] != "embedded" else []),
                            *([p["apart"]] if p["apart"] else []))))
                for p in data["providers"]]  # fmt: skip
        _table("providers", [head, *rows], header=True, lines=True)
        if data["settings"]:
            print(f"settings of the providers: {data['settings']}")
        print(
            "rendering: " + (data["rendering"]["backend"] if data["rendering"]["works"] else data["rendering"]["why"])
        )
        print("assets are looked for in " + ", ".join(data["assets"]))

    return Outcome(data, words)


def _licences(provider: dict) -> str:
    code, weights = provider["code_licence"], provider["weights_licence"]
    words = f"code {code}" if weights == "-" else code if weights == code else f"code {code}; weights {weights}"
    return words + ("; NON-COMMERCIAL" if provider["non_commercial"] else "")


def train(asset_id: str, algo: str, steps: int | None, envs: int | None, config: Path | None, out: Path | None,
          seed: int, minutes: float | None) -> Outcome:  # fmt: skip
    from taa_envs import registry

    asset = registry.get_asset(asset_id)
    from train.config import load_config
    from train.run import train as run

    settings = load_config(algo, config, steps=steps, envs=envs, seed=seed)
    folder = out if out is not None else Path("runs") / f"{asset.id}-{algo}-{seed}"
    with StageBars() as bars:
        begin = time.monotonic()
        bars.start(algo)
        last = {}

        def progress(share: float, row: dict) -> None:
            last.update(row)
            bars.update(share)

        data = run(asset, settings, folder, minutes=minutes, progress=progress)
        known = last and np.isfinite(last["success"])
        bars.finish(time.monotonic() - begin, f"success {last['success']:.0%} with exploration" if known else "")

    def words() -> None:
        if data["resumed_at"]:
            print(f"went on from {data['resumed_at']} steps")
        print(f"policy  {data['policy']}")
        print(f"curve   {Path(data['run']) / 'curve.csv'}")
        print(f"use     taa evaluate {asset.id} {data['policy']}")

    return Outcome(data, words)


def evaluate(asset_id: str, policy: Path, episodes: int, seed: int, video: Path | None, name: str | None,
             overwrite: bool) -> Outcome:  # fmt: skip
    from taa_envs import registry

    asset = registry.get_asset(asset_id)
    if video is not None and not video.parent.is_dir():
        raise TaaEnvsError(f"no such folder: {video.parent}; make it first")
    from train.evaluate import evaluate as run
    from train.film import record

    data = run(asset, policy, episodes, seed=seed)
    if video is not None:
        record(asset, policy, video, seed=seed)
    if name is not None:
        from train.evaluate import record_dataset

        data["dataset"] = record_dataset(asset, policy, _dataset_name(asset, name), episodes, seed=seed,
                                         overwrite=overwrite)  # fmt: skip

    def words() -> None:
        rows = [(name, f"{data[key]['success']:.0%}", "{:.0%} to {:.0%}".format(*data[key]["success_ci95"]),
                 f"{data[key]['joint_progress']:.0%}")
                for name, key in ((f"{data['algo']} policy", "policy"), ("open-loop replay", "replay"))]  # fmt: skip
        _table(f"{asset.id}: {episodes} episodes under the asset's own randomisation",
               [("", "success", "95 % interval", "joint progress"), *rows], header=True)  # fmt: skip
        if video is not None:
            print(f"video   {video}")
        if name is not None:
            print(f"dataset {data['dataset']}")

    return Outcome(data, words)


def replay_rows(result: dict) -> list[tuple[str, str]]:
    """The result table of a replay or a score; rows for the keys that are there."""
    names = {"joint_progress": "joint progress", "final_q_error": "final q error", "max_progress": "max progress",
             "contact_fraction": "contact fraction", "wrong_way": "wrong way"}  # fmt: skip
    rows = [(name, f"{result[key]:.0%}") for key, name in names.items() if key in result]
    if "max_penetration_m" in result:
        rows.append(("max penetration", f"{1e3 * result['max_penetration_m']:.1f} mm"))
    if "is_success" in result:
        rows.append(("success", "yes" if result["is_success"] else "no"))
    words = {"no_hand": "without a hand", "mirrored_hand": "mirrored hand", "late_hand": "late hand"}
    rows += [(f"control: {words.get(k, k)}", f"{v:.0%}") for k, v in (result.get("controls") or {}).items()]
    return rows


def _joint_rows(joint: dict) -> list[tuple[str, str]]:
    rows = [("verdict", joint.get("verdict") or "not stated"), ("reason", joint.get("reason") or "")]
    if joint.get("type") is None:
        return rows
    std = joint.get("std") or {}
    probability = joint.get("type_probability") or {}
    sure = ", ".join(f"{name} {p:.2f}" for name, p in probability.items() if p is not None)
    rows += [("type", joint["type"] + (f" ({sure})" if sure else ""))]
    rows += [("axis", _short(joint["axis"]) + _plus_minus(std.get("axis_deg"), "deg"))]
    if joint.get("point") is not None:
        rows += [("point", _short(joint["point"]) + " m" + _plus_minus(std.get("point_m"), "m"))]
    q = [v for v in joint.get("q") or () if v is not None]
    if q:
        import math

        factor, unit = (1000.0, "mm") if joint["type"] == "prismatic" else (180.0 / math.pi, "deg")
        rows += [("range", f"{factor * min(q):.1f} to {factor * max(q):.1f} {unit}")]
    rows += [("scale", f"metric, from {joint.get('scale_source')}" if joint.get("metric") else "not metric")]
    if joint.get("residual_px") is not None:
        rows += [("residual", f"{joint['residual_px']:.2f} px, {joint['inliers']} of {joint['tracks']} tracks")]
    return rows


def _plus_minus(std: object, unit: str) -> str:
    return f"  ± {std:.3g} {unit}" if isinstance(std, (int, float)) else ""


def _short(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return "0" if abs(value) < 1e-9 else f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        count = np.asarray(value, dtype=object).size
        return "(" + ", ".join(_short(v) for v in value) + ")" if count <= 4 else f"{count} numbers"
    return str(value)


def _table(title: str | None, rows: list[tuple], header: bool = False, lines: bool = False) -> None:
    from rich import box
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=title and escape(title), title_justify="left", title_style="bold", box=box.SIMPLE_HEAD,
                  show_header=header, show_lines=lines)  # fmt: skip
    for name in rows[0] if rows else ():
        table.add_column(str(name) if header else "", overflow="fold")
    for row in rows[1:] if header else rows:
        table.add_row(*(escape(str(cell)) for cell in row))
    Console(highlight=False).print(table)

"""Coverage-guided fuzzing of everything that reads a file from a stranger.

    python -m benchmarks.fuzz                          every target, its usual share of 10^5 inputs
    python -m benchmarks.fuzz --targets video --runs 500

Each target runs in a process of its own under atheris (libFuzzer). A parser may answer or raise one of the package's
own errors; any other exception, a crash of native code, an input that takes over 10 s or 3 GB is a finding. Findings
are kept, one file each, in ``--out``; inputs are counted as libFuzzer counts them.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TIMEOUT = 10
RSS_MB = 3072

# target -> inputs of a full run; native decoders and MuJoCo's compiler take milliseconds an input
RUNS = {
    "metadata": 20_000,
    "model_xml": 20_000,
    "arrays": 15_000,
    "reference": 15_000,
    "cues": 15_000,
    "log": 10_000,
    "config": 10_000,
    "scene": 3_000,
    "stage": 3_000,
    "mesh": 2_000,
    "asset": 1_000,
    "video": 700,
}
INSTRUMENTED = [
    "taa_envs.arrays",
    "taa_envs.checks",
    "taa_envs.asset",
    "diagnose.log",
    "train.config",
    "reconstruct.cues_io",
    "reconstruct.store",
    "json.decoder",
    "tomllib",
    "zipfile",
    "csv",
]


def write_member(name: str, raw: bytes) -> bytes:
    """A zip archive of one member, so that mutations reach what lies behind the checksum."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, raw)
    return out.getvalue()


def npy(value: object) -> bytes:
    import numpy as np

    out = io.BytesIO()
    np.save(out, np.asarray(value), allow_pickle=False)
    return out.getvalue()


def array_from(data: object) -> object:
    """An array of a drawn type, shape and content, from an atheris.FuzzedDataProvider."""
    import numpy as np

    kinds = ("f8", "f4", "i8", "u1", "?", "U3", "f2")
    dtype = np.dtype(kinds[data.ConsumeIntInRange(0, len(kinds) - 1)])
    shapes = ((), (0,), (6,), (6, 21, 3), (6, 21, 2), (6, 4, 4), (3, 3), (5, 6, 2), (5, 6), (6, 8, 8), (2, 2, 2, 2))
    shape = shapes[data.ConsumeIntInRange(0, len(shapes) - 1)]
    fill = (0.0, 1.0, np.nan, np.inf, -1e300, 3.7, 500.0)[data.ConsumeIntInRange(0, 6)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        array = np.full(shape, fill).astype(dtype) if dtype.kind != "U" else np.full(shape, "x", dtype)
    if array.size and dtype.kind == "f":
        flat = array.reshape(-1)
        for _ in range(data.ConsumeIntInRange(0, 8)):
            with np.errstate(all="ignore"):
                flat[data.ConsumeIntInRange(0, array.size - 1)] = data.ConsumeFloat()
    return array


class Targets:
    """What is fuzzed: one method a target takes the input's bytes; ``seeds`` gives it something to begin with.

    Args:
        folder: to write inputs into that a parser wants as a file.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def put(self, name: str, raw: bytes) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(raw)
        return path

    def metadata(self, raw: bytes) -> None:
        from taa_envs.checks import parse_metadata

        parse_metadata(raw, "asset.json")

    def model_xml(self, raw: bytes) -> None:
        from taa_envs.checks import parse_model

        parse_model(raw, "model.xml", lambda value: ["meshes/moving.obj"] if value == "moving.obj" else [])

    def arrays(self, raw: bytes) -> None:
        from taa_envs.arrays import read_npy, read_npz

        how, rest = raw[:1], raw[1:]
        if how < b"@":
            read_npz(self.put("a.npz", rest), max_bytes=1 << 24)
        elif how < b"\xa0":
            read_npz(self.put("a.npz", write_member("uv.npy", rest)), max_bytes=1 << 24)
        else:
            read_npy(self.put("a.npy", rest), max_bytes=1 << 24)

    def reference(self, raw: bytes) -> None:
        import atheris

        from taa_envs.asset import Reference, demonstration

        data = atheris.FuzzedDataProvider(raw)
        names = ("time", "q", "hand_joints", "hand_valid", "contact")
        made = Reference.from_arrays({name: array_from(data) for name in names if data.ConsumeIntInRange(0, 9)})
        demonstration(made.q)

    def cues(self, raw: bytes) -> None:
        import atheris
        import numpy as np

        from reconstruct import cues_io
        from reconstruct.joint.models import JointFit
        from reconstruct.video import Video

        data = atheris.FuzzedDataProvider(raw)
        black = np.zeros((6, 64, 64, 3), np.uint8)
        video = Video(Path("v"), "", (64, 64), np.arange(6) / 30, np.arange(6), 6, black, 1.0)

        def drawn(*names: str) -> dict:
            return {name: array_from(data) for name in names}

        which = data.ConsumeIntInRange(0, 5)
        if which == 0:
            cues_io.tracks_from_cue(drawn("uv", "visible"), 6)
        elif which == 1:
            camera = drawn("K", "T_world_camera")
            if data.ConsumeBool():
                camera["T_world_camera"] = np.tile(np.eye(4), (6, 1, 1))
            cue = drawn("joints_world", "joints_uv", "valid", "side")
            if data.ConsumeBool():
                cue["side"] = np.array("left")
            cues_io.hands_from_cue(cue, camera, video, black[..., 0] > 0)
        elif which == 2:
            cues_io.masks_from_cue(drawn("moving", "static", "hand"), video)
        elif which == 3:
            cues_io.focal_of(drawn("K"))
        elif which == 4:
            cues_io.metric_depth_from_cue(drawn("depth", "metric"), 6)
        else:
            fit = JointFit("ok", "", axis=np.array([0, 0, 1.0]), point=np.zeros(3), T_camera_world=np.eye(4))
            cues_io.in_world_of(fit, drawn("T_world_camera"))

    def scene(self, raw: bytes) -> None:
        import numpy as np

        from reconstruct import cues_io

        folder = self.folder / "scene"
        if not (folder / "cues" / "tracks.npz").is_file():
            self.put("scene/cues/tracks.npz", b"")
            np.savez(folder / "cues" / "tracks.npz", uv=np.zeros((3, 6, 2)), visible=np.ones((3, 6), bool))
        file = ("scene.json", "cues/written.json")[raw[:1] > b"\xc0"]
        self.put("scene/" + file, raw[1:])
        try:
            cues_io.CueFolder(folder).given()
            cues_io.video_of_cues(folder)
        finally:
            (folder / file).unlink()

    def stage(self, raw: bytes) -> None:
        import numpy as np

        from reconstruct.store import load_stage

        if raw[:1] < b"\xc0":
            out = io.BytesIO()
            np.savez(out, head=np.frombuffer(raw[1:], np.uint8), a0=np.arange(6.0), a1=np.arange(3, dtype=np.uint8))
            load_stage(self.put("s.npz", out.getvalue()), None)
        else:
            load_stage(self.put("s.npz", raw[1:]), None)

    def log(self, raw: bytes) -> None:
        from diagnose.log import load_log
        from taa_envs.cli_commands import read_joint_log

        path = self.put("log.csv", raw)
        for read in (load_log, read_joint_log):
            try:
                read(path)
            except own_errors():
                pass

    def config(self, raw: bytes) -> None:
        from train.config import load_config

        load_config("ppo", self.put("c.toml", raw))

    def mesh(self, raw: bytes) -> None:
        from reconstruct.cues_io import read_mesh

        read_mesh(self.put("moving.glb", raw))

    def asset(self, raw: bytes) -> None:
        from taa_envs.asset import load_asset

        folder = self.folder / "door"
        if not folder.is_dir():
            make_door(self.folder)
        name = ("model.xml", "meshes/moving_part1.obj", "meshes/moving.png")[raw[0] % 3 if raw else 0]
        kept = (folder / name).read_bytes()
        self.put(f"door/{name}", raw[1:])
        try:
            load_asset(folder)
        finally:
            self.put(f"door/{name}", kept)

    def video(self, raw: bytes) -> None:
        from reconstruct.video import load_video

        load_video(self.put("v.mp4", raw), self.folder / "scratch")

    def seeds(self, target: str) -> list[bytes]:
        """Valid inputs and the beginnings of hostile ones."""
        import numpy as np

        tracks = io.BytesIO()
        np.savez_compressed(tracks, uv=np.zeros((3, 6, 2)), visible=np.ones((3, 6), bool))
        door = make_door(self.folder) if target in ("metadata", "model_xml", "asset") else None
        log = "time,q,torque\n" + "".join(f"{0.01 * i},{0.1 * i},{0.5}\n" for i in range(25))
        facts = {
            "video": "a.mp4",
            "sha256": "0",
            "size": [640, 480],
            "decoded": 6,
            "index": [0, 1, 2, 3, 4, 5],
            "focal_px": 500.0,
        }
        tree = {
            "schema": 1,
            "key": "k",
            "tree": {
                "dataclass": "ProviderInfo",
                "fields": {
                    "name": {"value": "a"},
                    "version": {"list": [{"array": "a0"}]},
                    "licence": {"bits": "a1", "shape": [8]},
                },
            },
        }
        made: dict[str, Callable[[], list[bytes]]] = {
            "metadata": lambda: [
                (door / "asset.json").read_bytes()[:6000],
                small_metadata(),
                small_metadata(notes=["x"], camera=None),
            ],
            "model_xml": lambda: [
                (door / "model.xml").read_bytes(),
                b'<mujoco><worldbody><body name="a"/></worldbody></mujoco>',
                b'<mujoco><asset><mesh file="moving.obj"/></asset></mujoco>',
            ],
            "arrays": lambda: [b"\0" + tracks.getvalue(), b"P" + npy(np.arange(6.0)), b"\xff" + npy(np.ones((2, 3)))],
            "reference": lambda: [bytes(range(64)), b"\0" * 64],
            "cues": lambda: [bytes(range(96)), b"\0" * 96],
            "scene": lambda: [b"\0" + json.dumps(facts).encode(), b"\xff" + b'{"tracks": "0"}'],
            "stage": lambda: [b"\0" + json.dumps(tree).encode(), b"\xff" + tracks.getvalue()],
            "log": lambda: [log.encode(), log.replace("torque", "force_x").encode(), b"time,q\n0,1\n"],
            "config": lambda: [p.read_bytes() for p in (ROOT / "train" / "configs").glob("*.toml")],
            "mesh": lambda: [small_glb()],
            "asset": lambda: [
                b"\0" + (door / "model.xml").read_bytes(),
                b"\1" + (door / "meshes/moving_part1.obj").read_bytes(),
                b"\2" + (door / "meshes/moving.png").read_bytes(),
            ],
            "video": lambda: small_videos(self.folder),
        }
        return made[target]()


def own_errors() -> tuple[type[Exception], ...]:
    """What a parser may raise: the package's errors, each one sentence."""
    from reconstruct.errors import TaaError
    from taa_envs.errors import TaaEnvsError

    return TaaError, TaaEnvsError


def make_door(folder: Path, name: str = "door") -> Path:
    """A small asset to spoil: a door of two boxes."""
    import numpy as np
    import trimesh

    from taa_envs.asset import save_asset

    class Link:
        def __init__(self, low: tuple, high: tuple) -> None:
            box = trimesh.creation.box(bounds=[low, high])
            self.vertices, self.faces = np.array(box.vertices), np.array(box.faces)
            self.colors = np.full((len(self.vertices), 4), 200, np.uint8)
            self.parts = ((self.vertices, self.faces),) * 2

    time_ = np.arange(0, 1, 0.05)
    n = len(time_)
    reference = {
        "time": time_,
        "q": time_,
        "hand_joints": np.zeros((n, 21, 3)),
        "hand_valid": np.ones(n, bool),
        "contact": np.ones(n, bool),
    }
    joint = {"type": "revolute", "axis": [0.0, 0.0, 1.0], "point": [0.0, 0.0, 0.0], "verdict": "ok", "reason": "made"}
    return save_asset(
        folder,
        name,
        joint=joint,
        static=Link((-0.2, 0, 0), (-0.1, 0.1, 0.5)),
        overwrite=True,
        moving=Link((0, 0, 0), (0.4, 0.02, 0.5)),
        reference=reference,
    ).path


def small_metadata(**more: object) -> bytes:
    document = {
        "schema": "taa-asset/1",
        "id": "door",
        "provenance": {"a": {"value": 1, "origin": "given", "std": 0.1}},
        "joint": {"type": "revolute", "axis": [0, 0, 1], "point": [0, 0, 0], "q": [0, 1]},
        "demo": {"q_start": 0, "q_demo_end": 1, "q_min": 0, "q_max": 1, "duration": 2, "demo_end_frame": 5},
        "camera": {
            "K": [[500, 0, 320], [0, 500, 240], [0, 0, 1]],
            "width": 640,
            "height": 480,
            "T_camera_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        },
    }
    return json.dumps({**document, **more}).encode()


def small_glb() -> bytes:
    import trimesh

    return trimesh.creation.box(extents=(1, 1, 1)).export(file_type="glb")


def small_videos(folder: Path) -> list[bytes]:
    """A few frames in three containers."""
    import imageio_ffmpeg

    videos = []
    for name, options in (
        ("s.mp4", ["-c:v", "libx264", "-g", "4"]),
        ("s.avi", ["-c:v", "mpeg4"]),
        ("s.mkv", ["-c:v", "libx264"]),
    ):
        path = folder / name
        subprocess.run(
            [
                imageio_ffmpeg.get_ffmpeg_exe(),
                "-v",
                "error",
                "-y",
                "-f",
                "lavfi",
                "-i",
                "testsrc=size=64x48:rate=10:duration=0.8",
                *options,
                str(path),
            ],
            check=True,
        )
        videos.append(path.read_bytes())
    return videos


def child(target: str, runs: int, seconds: int, out: Path, corpus: Path, seed: int) -> None:
    """Fuzz one target in this process; does not return."""
    import atheris

    with atheris.instrument_imports(include=INSTRUMENTED, enable_loader_override=False):
        import csv  # noqa: F401
        import json.decoder  # noqa: F401
        import tomllib  # noqa: F401

        import diagnose.log  # noqa: F401
        import reconstruct.cues_io
        import reconstruct.store  # noqa: F401
        import taa_envs.asset  # noqa: F401
        import train.config  # noqa: F401
    warnings.simplefilter("ignore")
    place = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="taa-fuzz-", dir=place) as folder:
        targets = Targets(Path(folder))
        if not any(corpus.iterdir()):
            for i, raw in enumerate(targets.seeds(target)):
                (corpus / f"seed{i}").write_bytes(raw)
        fine = own_errors()

        def one(raw: bytes) -> None:
            try:
                getattr(targets, target)(raw)
            except fine:
                pass
            except Exception as error:
                keep(out, target, raw, error)

        arguments = [
            sys.argv[0],
            f"-runs={runs}",
            f"-timeout={TIMEOUT}",
            f"-rss_limit_mb={RSS_MB}",
            f"-max_total_time={seconds}",
            f"-artifact_prefix={out}/{target}-",
            f"-seed={seed + 1}",
            "-print_final_stats=1",
            "-verbosity=0",
            "-max_len=20000",
            str(corpus),
        ]
        atheris.Setup(arguments, one)
        atheris.Fuzz()


def keep(out: Path, target: str, raw: bytes, error: Exception) -> None:
    """One file for every place in which a parser failed."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if str(ROOT) in f.filename and "fuzz.py" not in f.filename] or frames
    place = f"{type(error).__name__}-{Path(ours[-1].filename).stem}-{ours[-1].lineno}"
    file = out / f"{target}-{place}"
    if not file.exists():
        file.write_bytes(raw)
        file.with_name(file.name + ".txt").write_text("".join(traceback.format_exception(error)), encoding="utf-8")


def run_child(command: list[str], seconds: float) -> tuple[int | None, str]:
    """Exit code (None: it was ended after that time) and stderr."""
    with tempfile.TemporaryFile("w+", errors="replace") as words:
        try:
            code = subprocess.run(command, cwd=ROOT, stdout=words, stderr=words, timeout=seconds).returncode
        except subprocess.TimeoutExpired:
            code = None
        words.seek(0)
        return code, words.read()


def fuzz(target: str, runs: int, seconds: int, out: Path, seed: int) -> dict:
    """Run one target until that many inputs or seconds; a process that dies is started again."""
    begin, done, deaths = time.monotonic(), 0, 0
    corpus = out / "corpus" / target
    corpus.mkdir(parents=True, exist_ok=True)
    longest = 0
    while done < runs and deaths < 20 and time.monotonic() - begin < seconds:
        left = max(1, int(seconds - (time.monotonic() - begin)))
        command = [
            sys.executable,
            "-m",
            "benchmarks.fuzz",
            "--child",
            target,
            "--runs",
            str(runs - done),
            "--seconds",
            str(left),
            "--out",
            str(out),
            "--seed",
            str(seed + deaths),
        ]
        code, words = run_child(command, left + 60)
        if code is None:  # native code that libFuzzer's own alarm does not reach
            (out / f"{target}-timeout-outer{deaths}").write_text(words, encoding="utf-8")
        count = (
            re.findall(r"number_of_executed_units:\s*(\d+)", words)
            or re.findall(r"Done (\d+) runs", words)
            or re.findall(r"^#(\d+)", words, re.M)
        )
        slow = re.findall(r"slowest_unit_time_sec:\s*(\d+)", words)
        longest = max([longest, *map(int, slow)])
        done += int(count[-1]) if count else 0
        if code != 0:
            deaths += 1
            (out / f"{target}-death{deaths}.txt").write_text(words[-6000:], encoding="utf-8")
            if not count:
                break
        elif not count:
            break
    findings = [f.name for f in out.glob(f"{target}-*") if f.suffix != ".txt"]
    return {
        "target": target,
        "inputs": done,
        "seconds": round(time.monotonic() - begin, 1),
        "slowest_s": longest,
        "crashes": len([f for f in findings if "timeout-" not in f]),
        "hangs": len([f for f in findings if "timeout-" in f]),
        "findings": findings,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", nargs="*", default=list(RUNS), choices=list(RUNS))
    parser.add_argument("--runs", type=int, help="inputs a target (default: its usual share)")
    parser.add_argument("--seconds", type=int, default=600, help="at most, a target")
    parser.add_argument("--out", type=Path, default=Path("fuzz_findings"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--child", choices=list(RUNS), help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path, help="write the counts here as well")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.child:
        corpus = args.out.resolve() / "corpus" / args.child
        corpus.mkdir(parents=True, exist_ok=True)
        child(args.child, args.runs, args.seconds, args.out.resolve(), corpus, args.seed)
        return
    print("| target | inputs | crashes | hangs over 10 s | slowest, s | s |\n| --- | --- | --- | --- | --- | --- |")
    rows = []
    for target in args.targets:
        row = fuzz(target, args.runs or RUNS[target], args.seconds, args.out.resolve(), args.seed)
        rows.append(row)
        columns = ("target", "inputs", "crashes", "hangs", "slowest_s", "seconds")
        print("| " + " | ".join(str(row[k]) for k in columns) + " |", flush=True)
    total = {k: sum(r[k] for r in rows) for k in ("inputs", "crashes", "hangs")}
    print(f"| together | {total['inputs']} | {total['crashes']} | {total['hangs']} | | |")
    for row in rows:
        for name in row["findings"]:
            print(f"finding: {args.out / name}")
    if args.json:
        args.json.write_text(json.dumps({"rows": rows, **total}, indent=1), encoding="utf-8")
    sys.exit(1 if total["crashes"] or total["hangs"] else 0)


if __name__ == "__main__":
    main()

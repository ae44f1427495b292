"""Kill -9 at random moments: afterwards everything is whole or absent, and goes on to the same result.

    python -m benchmarks.faults --kills 200
    python -m benchmarks.faults --jobs save train --kills 40 --seed 1

The kills are shared out over the jobs (``--jobs``), the cheap ones getting most. A job is forked off, killed after a
random part of the time that an unbroken run takes, and its files are looked at; then it is begun again, until the job's
kills are used up. At last it runs through, and its result is compared with that of an unbroken run.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import mujoco
import numpy as np

os.environ.setdefault("MUJOCO_GL", "egl")

# job -> its share of the kills; a reconstruction takes minutes, saving an asset a tenth of a second
SHARES = {
    "save": 0.46,
    "two_writers": 0.20,
    "fit": 0.10,
    "build": 0.08,
    "train": 0.05,
    "train_sac": 0.03,
    "diagnose": 0.03,
    "reconstruct": 0.05,
}


def fork(work: Callable[[], object]) -> int:
    """Process id of a child that does the work, silent, and leaves with 0, or with 1 after an exception."""
    sys.stdout.flush()
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        os.setsid()
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, 1)
        if "TAA_FAULTS_LOUD" not in os.environ:
            os.dup2(nothing, 2)
        work()
        code = 0
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        os._exit(code)


def killed(work: Callable[[], object], seconds: float) -> bool:
    """Whether the work was still going on when it was killed after that time."""
    child = fork(work)
    time.sleep(seconds)
    try:
        os.killpg(child, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):  # not yet leader of its group, or gone
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    return os.WIFSIGNALED(status)


def unbroken(work: Callable[[], object]) -> float:
    """Seconds that the work takes when nothing stops it.

    Raises:
        RuntimeError: it failed.
    """
    begin = time.monotonic()
    _, status = os.waitpid(fork(work), 0)
    if status != 0:
        raise RuntimeError("the job failed without being killed; set TAA_FAULTS_LOUD to see why")
    return time.monotonic() - begin


def remains(folder: Path) -> list[str]:
    """Hidden files and folders below a folder: what an unfinished write left. A build's lock file is none."""
    return [str(p.relative_to(folder)) for p in folder.rglob(".*") if p.name != ".lock"]


def digests(folder: Path, leave_out: Iterable[str] = ()) -> dict[str, str]:
    """Name -> sha256 of every file below a folder, except those of these names."""
    return {
        p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and p.name not in leave_out
    }


class Job:
    """One thing that is killed.

    Args:
        folder: its own.
        draw: generator of the moments.
    """

    def __init__(self, folder: Path, draw: np.random.Generator) -> None:
        self.folder, self.draw = folder, draw
        folder.mkdir(parents=True)
        self.count = self.early = 0
        self.problems: list[str] = []

    def work(self) -> None:
        """What is killed; the same every time."""

    def look(self) -> None:
        """What must hold after every kill; adds to ``problems``."""

    def compare(self) -> None:
        """What must hold after the last, unbroken run."""

    def attack(self, kills: int) -> None:
        """Kill, look, begin again; then run through and compare."""
        length = self.first()
        while self.count < kills and self.early < 10 * kills:
            if killed(self.work, float(self.draw.uniform(0, length))):
                self.count += 1
            else:
                self.early += 1
                self.again()
            self.look()
        unbroken(self.work)
        self.look()
        self.compare()
        if left := remains(self.folder):
            self.problems.append(f"left behind: {left[:3]}")

    def first(self) -> float:
        """An unbroken run to compare with; returns its seconds."""
        return unbroken(self.work)

    def again(self) -> None:
        """It was done before it could be killed: make it something to do again."""


class Save(Job):
    """Saving an asset over itself, now with one mass, now with another."""

    def work(self) -> None:
        for mass in (1.0, 2.0):
            self.write(mass)

    def write(self, mass: float) -> None:
        from taa_envs.asset import save_asset

        save_asset(self.folder, "door", mass=mass, overwrite=True, **door_arguments())

    def look(self) -> None:
        from taa_envs.asset import AssetError, load_asset

        if not (self.folder / "door").exists():
            if self.count + self.early > 1 and getattr(self, "seen", False):
                self.problems.append("an asset that was there is gone")
            return
        self.seen = True
        try:
            asset = load_asset(self.folder / "door")
        except AssetError as error:
            self.problems.append(str(error))
            return
        if asset.provenance["moving.mass"]["value"] not in (1.0, 2.0):
            self.problems.append("a mass that nobody wrote")

    def compare(self) -> None:
        from taa_envs.asset import load_asset

        if load_asset(self.folder / "door").provenance["moving.mass"]["value"] != 2.0:
            self.problems.append("the last write is not what is there")


class TwoWriters(Save):
    """The same by two processes at once, one of which is killed."""

    def attack(self, kills: int) -> None:
        length = self.first()
        while self.count < kills and self.early < 10 * kills:
            other = fork(self.work)
            if killed(self.work, float(self.draw.uniform(0, 1.5 * length))):
                self.count += 1
            else:
                self.early += 1
            self.look()
            _, status = os.waitpid(other, 0)
            if status != 0:
                self.problems.append("the other writer failed")
            self.look()
        unbroken(self.work)
        self.compare()
        if left := remains(self.folder):
            self.problems.append(f"left behind: {left[:3]}")

    def look(self) -> None:
        """Again where the other writer has put its asset in this one's place while it was read, file by file."""
        for _ in range(20):
            known, which = len(self.problems), self.which()
            super().look()
            if which is None or self.which() in (which, None):
                return
            del self.problems[known:]

    def which(self) -> int | None:
        """The folder that is there."""
        try:
            return (self.folder / "door").stat().st_ino
        except FileNotFoundError:
            return None


class Fit(Job):
    """``taa fit`` of a small scene into a JSON file."""

    def first(self) -> float:
        small_scene(self.folder / "scene")
        seconds = unbroken(self.work)
        self.whole = (self.folder / "joint.json").read_bytes()
        self.again()
        return seconds

    def work(self) -> None:
        from taa_envs import cli

        if cli.main(["fit", str(self.folder / "scene"), "--out", str(self.folder / "joint.json"), "--json"]):
            raise RuntimeError("taa fit failed")

    def look(self) -> None:
        file = self.folder / "joint.json"
        if file.exists() and file.read_bytes() != self.whole:
            self.problems.append("joint.json is not whole")

    def again(self) -> None:
        (self.folder / "joint.json").unlink(missing_ok=True)

    def compare(self) -> None:
        self.look()
        if not (self.folder / "joint.json").exists():
            self.problems.append("no joint.json")


def small_asset(job: dict) -> dict:
    """A build's task: saves a small asset, as a reconstruction does at its end."""
    from benchmarks.fuzz import make_door

    time.sleep(0.1)
    if not (Path(job["assets"]) / job["id"]).exists():
        make_door(Path(job["assets"]), job["id"])
    return {"state": "done", "result": "revolute (ok)", "error": ""}


class BuildAll(Job):
    """``taa build`` of six videos by two workers; the workers die with it, or are killed alone."""

    def first(self) -> float:
        (self.folder / "videos").mkdir()
        for k in range(6):
            (self.folder / "videos" / f"v{k}.mp4").write_text(str(k))
        seconds = unbroken(self.work)
        self.whole = self.results()
        self.again()
        return seconds

    def work(self) -> None:
        from reconstruct.fleet import Build, build

        made = build(
            Build(self.folder / "videos", self.folder / "out", workers=2, task="benchmarks.faults:small_asset")
        )
        if made.counts()["done"] != 6:
            raise RuntimeError(str(made.rows))

    def results(self) -> dict:
        rows = json.loads((self.folder / "out" / "manifest.json").read_text())["rows"]
        return {"states": [(r["id"], r["state"]) for r in rows], **digests(self.folder / "out" / "assets")}

    def look(self) -> None:
        from taa_envs.asset import AssetError, load_asset

        time.sleep(0.3)  # workers notice that nobody waits for them
        for asset in (self.folder / "out" / "assets").glob("[a-z]*"):
            try:
                load_asset(asset)
            except AssetError as error:
                self.problems.append(str(error))

    def again(self) -> None:
        shutil.rmtree(self.folder / "out")

    def compare(self) -> None:
        if self.results() != self.whole:
            self.problems.append("the build that went on made something else")


class Train(Job):
    """``taa train`` with PPO; checkpoints eight times."""

    settings: dict = {
        "algo": "ppo",
        "envs": 2,
        "steps": 2048,
        "checkpoint_every": 256,
        "policy": {"net_arch": [16]},
        "algorithm": {"n_steps": 64, "batch_size": 64, "n_epochs": 2},
    }

    def first(self) -> float:
        import train.run  # here, and not in every child: the kills are to hit the training, not the imports

        train.run.CHUNK = 256  # rows of SAC's curve, for a run as short as this
        save_door(self.folder)
        seconds = unbroken(self.work)
        self.whole, self.learnt = self.curve(), self.weights()
        self.again()
        return seconds

    def work(self) -> None:
        from taa_envs.asset import load_asset
        from train.config import Config
        from train.run import train

        train(load_asset(self.folder / "door"), Config(**self.settings), self.folder / "run")

    def curve(self) -> list[list[str]]:
        """Rows of the curve, but for the two columns that hold durations."""
        with (self.folder / "run" / "curve.csv").open(newline="") as f:
            header, *rows = csv.reader(f)
        kept = [k for k, name in enumerate(header) if name not in ("seconds", "processor")]
        return [[row[k] for k in kept] for row in (header, *rows)]

    def weights(self) -> str:
        """Digest of the policy's weights."""
        from train.policy import load_policy

        state = load_policy(self.folder / "run")[0].network.state_dict()
        return hashlib.sha256(b"".join(state[name].numpy().tobytes() for name in sorted(state))).hexdigest()

    def look(self) -> None:
        run = self.folder / "run"
        if (run / "policy.pt").exists():
            from train.policy import load_policy

            load_policy(run / "policy.pt")
        if (run / "curve.csv").exists() and self.curve() != self.whole[: len(self.curve())]:
            self.problems.append("the curve differs from the unbroken one")

    def again(self) -> None:
        shutil.rmtree(self.folder / "run")

    def compare(self) -> None:
        if self.curve() != self.whole:
            self.problems.append("the finished curve differs from the unbroken one")
        if self.weights() != self.learnt:
            self.problems.append("the finished policy is not that of the unbroken run")


class TrainSac(Train):
    """The same with SAC, whose replay buffer and temperature go on too."""

    settings = {
        "algo": "sac",
        "envs": 2,
        "steps": 2048,
        "checkpoint_every": 256,
        "policy": {"net_arch": [16]},
        "algorithm": {"buffer_size": 900, "learning_starts": 100, "batch_size": 16, "gradient_steps": 1},
    }


class Diagnose(Job):
    """``taa diagnose`` of a door with hidden damping."""

    def first(self) -> float:
        from benchmarks.diagnosis import injector

        case = injector.draw(1, "door", ("viscous_damping",))
        self.model, self.logs = injector.write(case, 1, self.folder, count=3, seconds=3.0)
        self.joint = mujoco.MjModel.from_xml_path(str(self.model)).joint(0).name
        seconds = unbroken(self.work)
        self.whole = self.result()
        self.again()
        return seconds

    def work(self) -> None:
        from taa_envs import cli

        if cli.main(
            [
                "diagnose",
                str(self.model),
                "--joint",
                self.joint,
                "--data",
                *map(str, self.logs),
                "--out",
                str(self.folder / "out"),
                "--json",
            ]
        ):
            raise RuntimeError("taa diagnose failed")

    def result(self) -> dict:
        return json.loads((self.folder / "out" / "diagnosis.json").read_text())

    def look(self) -> None:
        out = self.folder / "out"
        if out.exists() and (self.result() != self.whole or not (out / "report.html").is_file()):
            self.problems.append("the diagnosis is not whole")

    def again(self) -> None:
        shutil.rmtree(self.folder / "out")

    def compare(self) -> None:
        if not (self.folder / "out").exists():
            self.problems.append("no diagnosis")


class Reconstruct(Job):
    """``taa reconstruct --scene`` of a short clip; every attempt goes on from what the scene folder holds."""

    def first(self) -> float:
        import imageio_ffmpeg

        from reconstruct.synth import render_clip

        with tempfile.TemporaryDirectory() as made:
            clip = render_clip("demo", Path(made), seed=0)
            subprocess.run(
                [
                    imageio_ffmpeg.get_ffmpeg_exe(),
                    "-v",
                    "error",
                    "-i",
                    str(clip / "video.mp4"),
                    "-vf",
                    "fps=15,scale=384:-2",
                    str(self.folder / "clip.mp4"),
                ],
                check=True,
            )
        seconds = unbroken(self.work)
        self.whole = self.result()
        self.again()
        # The asset's folder appears at the very end; most moments lie in the stages before it.
        return seconds

    def work(self) -> None:
        from taa_envs import cli

        os.environ["TMPDIR"] = str(self.folder / "scratch")
        (self.folder / "scratch").mkdir(exist_ok=True)
        tempfile.tempdir = None
        if cli.main(
            [
                "reconstruct",
                str(self.folder / "clip.mp4"),
                "--id",
                "demo",
                "--out",
                str(self.folder / "assets"),
                "--scene",
                str(self.folder / "scene"),
                "--json",
            ]
        ):
            raise RuntimeError("taa reconstruct failed")

    def result(self) -> dict:
        """Everything but the pages, the films and how long it took."""
        folder = self.folder / "assets" / "demo"
        made = digests(folder, ("report.html", "film.mp4", "preview.png", "asset.json"))
        facts = json.loads((folder / "asset.json").read_text())
        facts["provenance"].pop("seconds", None)
        return {**made, "asset.json": json.dumps(facts)}

    def look(self) -> None:
        from taa_envs.asset import AssetError, load_asset

        shutil.rmtree(self.folder / "scratch", ignore_errors=True)  # TMPDIR is the system's to clear
        if (self.folder / "assets" / "demo").exists():
            try:
                load_asset(self.folder / "assets" / "demo")
            except AssetError as error:
                self.problems.append(str(error))

    def again(self) -> None:
        shutil.rmtree(self.folder / "assets")
        shutil.rmtree(self.folder / "scene")

    def compare(self) -> None:
        made = self.result()
        if made != self.whole:
            self.problems.append(f"differs from the unbroken run: {[k for k in made if made[k] != self.whole.get(k)]}")


JOBS: dict[str, type[Job]] = {
    "save": Save,
    "two_writers": TwoWriters,
    "fit": Fit,
    "build": BuildAll,
    "train": Train,
    "train_sac": TrainSac,
    "diagnose": Diagnose,
    "reconstruct": Reconstruct,
}


def door_arguments() -> dict:
    """What :func:`taa_envs.asset.save_asset` takes for a door of two boxes."""
    import trimesh

    class Link:
        def __init__(self, low: tuple, high: tuple) -> None:
            box = trimesh.creation.box(bounds=[low, high])
            self.vertices, self.faces = np.array(box.vertices), np.array(box.faces)
            self.colors = np.full((len(self.vertices), 4), 200, np.uint8)
            self.parts = ((self.vertices, self.faces),)

    seconds = np.arange(0, 2, 1 / 30)
    n = len(seconds)
    hand = np.array([0.35, 0.05, 0.25]) + 0.01 * np.random.default_rng(0).normal(size=(n, 21, 3))
    reference = {
        "time": seconds,
        "q": 0.5 * seconds,
        "hand_joints": hand,
        "hand_valid": np.ones(n, bool),
        "contact": np.ones(n, bool),
    }
    joint = {"type": "revolute", "axis": [0.0, 0.0, 1.0], "point": [0.0, 0.0, 0.0], "verdict": "ok", "reason": "made"}
    return {
        "joint": joint,
        "static": Link((-0.2, 0, 0), (-0.1, 0.1, 0.5)),
        "moving": Link((0, 0, 0), (0.4, 0.02, 0.5)),
        "reference": reference,
    }


def save_door(folder: Path) -> None:
    from taa_envs.asset import save_asset

    save_asset(folder, "door", **door_arguments())


def small_scene(folder: Path) -> None:
    """A scene folder with the tracks of a flat link that turns about a vertical axis."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(0)
    frames, count = 30, 40
    points = np.c_[rng.uniform(0.05, 0.5, count), rng.uniform(-0.3, 0.3, count), np.zeros(count)]
    still = np.c_[rng.uniform(-0.8, 0.8, (30, 2)), rng.uniform(1.5, 2.5, 30)]
    uv = np.zeros((count + 30, frames, 2))
    for t, angle in enumerate(np.linspace(0, 1.2, frames)):
        link = Rotation.from_rotvec([0, angle, 0]).apply(points) + [0, 0, 2.0]
        for rows, where in ((slice(0, count), link), (slice(count, None), still)):
            uv[rows, t] = 600 * where[:, :2] / where[:, 2:] + [320, 240]
    uv += rng.normal(0, 0.2, uv.shape)
    (folder / "cues").mkdir(parents=True)
    np.savez(folder / "cues" / "tracks.npz", uv=uv, visible=np.ones(uv.shape[:2], bool))
    np.savez(
        folder / "cues" / "camera.npz",
        K=np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]),
        T_world_camera=np.tile(np.eye(4), (frames, 1, 1)),
    )
    (folder / "scene.json").write_text(
        json.dumps(
            {
                "video": "made.mp4",
                "sha256": "",
                "size": [640, 480],
                "work_size": [640, 480],
                "decoded": frames,
                "index": list(range(frames)),
                "focal_px": 600.0,
            }
        )
    )


def preload() -> None:
    """Import before forking what every child would import again."""
    import cv2
    import torch

    import diagnose  # noqa: F401
    import reconstruct.joint.fit
    import reconstruct.pipeline  # noqa: F401
    import taa_envs.authoring
    import taa_envs.cli  # noqa: F401
    import train.run  # noqa: F401

    cv2.setNumThreads(1)  # threads do not survive a fork
    torch.set_num_threads(1)


def run(jobs: dict[str, int], seed: int, folder: Path) -> list[dict]:
    """Attack each job with its number of kills; one row a job."""
    preload()
    rows = []
    for k, (name, kills) in enumerate(jobs.items()):
        begin = time.monotonic()
        job = JOBS[name](folder / name, np.random.default_rng([seed, k]))
        job.attack(kills)
        rows.append(
            {
                "job": name,
                "kills": job.count,
                "over_before_the_kill": job.early,
                "problems": job.problems,
                "seconds": round(time.monotonic() - begin, 1),
            }
        )
        print(f"| {name} | {job.count} | {len(job.problems)} | {rows[-1]['seconds']} |", flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--jobs", nargs="*", choices=list(JOBS), default=list(JOBS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    share = sum(SHARES[j] for j in args.jobs)
    jobs = {j: max(1, round(args.kills * SHARES[j] / share)) for j in args.jobs}
    print("| job | kills | problems | s |\n| --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory(prefix="taa-faults-") as folder:
        rows = run(jobs, args.seed, Path(folder))
    problems = [p for row in rows for p in row["problems"]]
    print(f"| together | {sum(r['kills'] for r in rows)} | {len(problems)} | |")
    for problem in problems:
        print(f"problem: {problem}")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    sys.exit(1 if problems else 0)


if __name__ == "__main__":
    main()

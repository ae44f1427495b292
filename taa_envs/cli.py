"""The ``taa`` command: parses, calls one function, prints.

Exit codes: 0 done; 1 refused or failed, with one line ``error: what is wrong; what to do`` on stderr; 2 usage.
With ``--json`` stdout carries one JSON object and nothing else; progress and words go to stderr.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import shutil
import signal
import sys
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Annotated, Literal

import tyro

from taa_envs import cli_commands as commands
from taa_envs.cli_commands import Outcome
from taa_envs.errors import TaaEnvsError


@dataclass(kw_only=True)
class Common:
    json: bool = False
    """One JSON object on stdout and nothing else there."""
    debug: bool = False
    """Show the traceback of an error."""


@dataclass(kw_only=True)
class Reconstruct(Common):
    """Turn one video of a hand moving an articulated object into a registered asset."""

    video: tyro.conf.Positional[Path]
    """One unbroken shot; a static or gently hand-held camera."""
    id: str
    """Name of the asset: 1 to 64 of a-z 0-9 _ -."""
    scene: Path | None = None
    """Folder that keeps every cue, so that a second run resumes and a cue can be replaced by hand."""
    out: Path | None = None
    """Folder of assets to write into (default: the user's data folder)."""
    focal: float | None = None
    """Focal length of the upright full-size frame, px (default: metadata, else estimated with the joint)."""
    segment: str | None = None
    """Provider of the link masks: motion, sam2, sam3 (`taa doctor` says which of these can run here)."""
    depth: str | None = None
    """Provider of depth: none, da3, depth-anything-v2, moge."""
    track: str | None = None
    """Provider of point tracks: lk, xfeat, cotracker3, trackcraft3r."""
    hand: str | None = None
    """Provider of hands: mediapipe, hawor, wilor."""
    mesh: str | None = None
    """Provider of link meshes: hull, sam3d."""
    labels: str | None = None
    """Provider of the part labels of whole meshes: votes, segvigen."""
    features: str | None = None
    """Provider of descriptors for the refinement against given masks and meshes: none, xfeat, dinov2."""
    camera: str | None = None
    """Provider of camera poses: none, colmap, da3."""
    overwrite: bool = False
    """Replace an asset of this id."""
    seed: int = 0
    """Seed of everything that draws."""

    def run(self) -> Outcome:
        names = ("segment", "depth", "track", "hand", "mesh", "labels", "features", "camera")
        chosen = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return commands.reconstruct(self.video, self.id, self.scene, self.out, self.focal, chosen, self.overwrite,
                                    self.seed)  # fmt: skip


@dataclass(kw_only=True)
class Fit(Common):
    """Fit the articulation alone, from the cues in a scene folder."""

    scene: tyro.conf.Positional[Path]
    """A scene folder of `taa reconstruct --scene`, its cues replaced or not."""
    focal: float | None = None
    """Focal length of the upright full-size frame, px."""
    out: Path | None = None
    """JSON file to write the joint into as well."""
    seed: int = 0
    """Seed of everything that draws."""

    def run(self) -> Outcome:
        return commands.fit(self.scene, self.focal, self.out, self.seed)


@dataclass(kw_only=True)
class ImportScene(Common):
    """Read the scene folder of the paper's released pipeline into a scene folder of ours."""

    source: tyro.conf.Positional[Path]
    """Its scene folder: any of da3/, masks/, trackcraft/, hawor_scaled/, registered_static/."""
    scene: tyro.conf.Positional[Path]
    """Scene folder to write; go on with `taa fit SCENE`, or `taa reconstruct SCENE/video.mp4 --scene SCENE ...`."""
    label: str | None = None
    """The moving part, where several move."""
    rate: float = 30.0
    """Frames a second at which its frames were extracted."""
    ground: bool = False
    """Put the tracks onto the key frames' meshes (sam3d_scaled/)."""

    def run(self) -> Outcome:
        return commands.import_scene(self.source, self.scene, self.label, self.rate, self.ground)


@dataclass(kw_only=True)
class List(Common):
    """List the assets there are."""

    def run(self) -> Outcome:
        return commands.list_assets()


@dataclass(kw_only=True)
class Show(Common):
    """Show one asset's facts, each number with its origin."""

    id: tyro.conf.Positional[str]
    """Id of an asset."""

    def run(self) -> Outcome:
        return commands.show(self.id)


@dataclass(kw_only=True)
class View(Common):
    """Look at one asset interactively in the browser: the joint, the hand through time."""

    id: tyro.conf.Positional[str]
    """Id of an asset."""
    port: int = 8080
    """Port to serve on."""

    def run(self) -> Outcome:
        return commands.view(self.id, self.port)


@dataclass(kw_only=True)
class Replay(Common):
    """Replay the demonstrated hand open loop through contact, with its controls, and score it."""

    id: tyro.conf.Positional[str]
    """Id of an asset."""
    hand: str = "points"
    """Hand that replays."""
    video: Path | None = None
    """MP4 file to write: the source video (where its scene is known) beside the replay."""
    refine: bool = False
    """Search for small corrections of the demonstrated hand, within its stated uncertainty, and keep what is found."""
    seconds: float = 60.0
    """With --refine: how long to search at most."""
    seed: int = 0
    """With --refine: seed of the draws."""
    out: Path | None = None
    """With --refine: folder of assets to write a copy with the refined reference into (default: the asset itself)."""
    reference: Literal["demonstration", "refined"] = "demonstration"
    """Which hand motion: as reconstructed, or what --refine found earlier."""
    record: str | None = None
    """Write replays as the Minari dataset of this name (`replay`: TAA/ID/replay-v0) instead of scoring one."""
    episodes: int = 20
    """With --record: how many, each under the asset's own randomisation, seeds from --seed on."""
    overwrite: bool = False
    """With --record: replace a dataset of that name."""

    def run(self) -> Outcome:
        if self.record is not None:
            if self.refine or self.video is not None or self.reference != "demonstration":
                raise TaaEnvsError("--record writes plain replays; leave --refine, --reference and --video out")
            return commands.record_replays(self.id, self.record, self.hand, self.episodes, self.seed, self.overwrite)
        return commands.replay(self.id, self.hand, self.video, self.refine, self.reference, self.out, self.seed,
                               self.seconds)  # fmt: skip


@dataclass(kw_only=True)
class Score(Common):
    """Score a replay that somebody else made."""

    id: tyro.conf.Positional[str]
    """Id of an asset."""
    file: tyro.conf.Positional[Path]
    """A joint log (.csv with the columns time and q), an action file (.npy, one row an environment step), or the name
    of a Minari dataset (TAA/ID/replay-v0)."""
    hand: str = "points"
    """Hand whose actions an action file or another's dataset holds."""
    episode: int = 0
    """Which episode of a dataset."""

    def run(self) -> Outcome:
        return commands.score(self.id, self.file, self.hand, self.episode)


@dataclass(kw_only=True)
class Train(Common):
    """Train a policy with Stable-Baselines3; a run that was killed goes on where it was."""

    id: tyro.conf.Positional[str]
    """Id of an asset."""
    algo: Literal["ppo", "sac"] = "ppo"
    """Algorithm; its settings are in train/configs."""
    steps: int | None = None
    """Environment steps in all (default: as the settings say)."""
    minutes: float | None = None
    """Stop after so many by the clock; the same command goes on."""
    envs: int | None = None
    """Simulations at once (default: as the settings say)."""
    config: Path | None = None
    """TOML file of settings in place of the shipped one."""
    out: Path | None = None
    """Folder of the run (default: runs/<id>-<algo>-<seed>)."""
    seed: int = 0
    """Seed of everything that draws."""

    def run(self) -> Outcome:
        return commands.train(self.id, self.algo, self.steps, self.envs, self.config, self.out, self.seed, self.minutes)


@dataclass(kw_only=True)
class Evaluate(Common):
    """Compare a policy with the open-loop replay in the same randomised episodes."""

    id: tyro.conf.Positional[str]
    """Id of an asset."""
    policy: tyro.conf.Positional[Path]
    """policy.pt of `taa train`, or its run's folder."""
    episodes: int = 100
    """How many."""
    video: Path | None = None
    """MP4 file to write: three episodes, the policy beside the replay."""
    record: str | None = None
    """Write the policy's episodes as the Minari dataset of this name too (a word stands for TAA/ID/WORD-v0)."""
    overwrite: bool = False
    """With --record: replace a dataset of that name."""
    seed: int = 1_000_000
    """Seed of the first episode; the others follow it."""

    def run(self) -> Outcome:
        return commands.evaluate(self.id, self.policy, self.episodes, self.seed, self.video, self.record,
                                 self.overwrite)  # fmt: skip


@dataclass(kw_only=True)
class Export(Common):
    """Write an asset as a self-contained folder for other programs."""

    id: tyro.conf.Positional[str]
    """Id of an asset."""
    format: Literal["mjcf", "urdf", "usd"] = "mjcf"
    """mjcf: model.xml; urdf: <id>.urdf; usd: <id>.usda with UsdPhysics (needs the extra usd); each with its meshes."""
    out: Path | None = None
    """Folder to write (default: ./<id>_<format>)."""
    overwrite: bool = False
    """Replace that folder."""

    def run(self) -> Outcome:
        return commands.export(self.id, self.format, self.out, self.overwrite)


@dataclass(kw_only=True)
class Diagnose(Common):
    """Say what a model gets wrong about a joint, from measured logs, and write the extended model."""

    model: tyro.conf.Positional[str]
    """Id of an asset, or an MJCF file."""
    joint: str = "joint"
    """Name of the joint in the model."""
    data: list[Path] = field(default_factory=list)
    """Joint logs, one episode a CSV: time, q, then torque or a hand's force and point."""
    from_video: bool = False
    """Use the asset's own video instead: its joint's state over the frames in which no hand touches the part."""
    revise: bool = False
    """Of an asset's id: also write the asset's next revision (<id>-r2) beside it, with the extended model."""
    out: Path
    """Folder to write: diagnosis.json, report.html, model_extended.xml."""
    overwrite: bool = False
    """Replace that folder."""

    def run(self) -> Outcome:
        return commands.diagnose(self.model, self.joint, self.data, self.out, self.overwrite, self.from_video,
                                 self.revise)


@dataclass(kw_only=True)
class Build(Common):
    """Reconstruct every video below a folder; a run that was killed goes on, one bad video stops nothing."""

    videos: tyro.conf.Positional[Path]
    """Folder that holds videos at any depth."""
    out: Path | None = None
    """Folder of the build: manifest.csv, index.html, assets, scenes (default: <videos>_taa beside it)."""
    engine: Literal["local", "ray"] = "local"
    """Processes of this machine, or a Ray cluster ($RAY_ADDRESS, else a local one is started)."""
    workers: int | None = None
    """Videos at once (default: as many as cores and memory allow)."""
    retries: int = 2
    """Further tries for a video whose worker died."""
    timeout: float = 3600.0
    """Seconds after which a video is given up."""
    again: tuple[Literal["failed", "refused", "done"], ...] = ()
    """States of an earlier run to try again; what was left unfinished goes on in any case."""
    segment: str | None = None
    """Provider of the link masks, as for `taa reconstruct`."""
    depth: str | None = None
    """Provider of depth."""
    track: str | None = None
    """Provider of point tracks."""
    hand: str | None = None
    """Provider of hands."""
    mesh: str | None = None
    """Provider of link meshes."""
    labels: str | None = None
    """Provider of the part labels of whole meshes."""
    features: str | None = None
    """Provider of descriptors for the refinement."""
    camera: str | None = None
    """Provider of camera poses."""
    focal: float | None = None
    """Focal length of the upright full-size frame, px, if all videos share one."""
    overwrite: bool = False
    """Replace assets that are there."""
    seed: int = 0
    """Seed of everything that draws."""

    def run(self) -> Outcome:
        names = ("segment", "depth", "track", "hand", "mesh", "labels", "features", "camera")
        chosen = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return commands.build(self.videos, self.out, self.engine, self.workers, self.retries, self.timeout, self.again,
                              chosen, self.focal, self.overwrite, self.seed)  # fmt: skip


@dataclass(kw_only=True)
class Synth(Common):
    """Render videos with known ground truth."""

    out: tyro.conf.Positional[Path]
    """Folder to write; one subfolder a clip with video.mp4 and the truth beside it."""
    clip: str | None = None
    """Name of one clip (default: all)."""
    overwrite: bool = False
    """Replace clips that are there."""
    seed: int = 0
    """Seed of textures, noise and hand-held motion."""

    def run(self) -> Outcome:
        return commands.synth(self.out, self.clip, self.overwrite, self.seed)


@dataclass(kw_only=True)
class Doctor(Common):
    """Say what is installed, which providers can run here and why the others cannot."""

    rendering: bool = False
    """Only check off-screen rendering, and fail where it does not work."""

    def run(self) -> Outcome:
        return commands.doctor(self.rendering)


Command = (
    Annotated[Reconstruct, tyro.conf.subcommand("reconstruct")]
    | Annotated[Fit, tyro.conf.subcommand("fit")]
    | Annotated[ImportScene, tyro.conf.subcommand("import-scene")]
    | Annotated[List, tyro.conf.subcommand("list")]
    | Annotated[Show, tyro.conf.subcommand("show")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Replay, tyro.conf.subcommand("replay")]
    | Annotated[Score, tyro.conf.subcommand("score")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Diagnose, tyro.conf.subcommand("diagnose")]
    | Annotated[Build, tyro.conf.subcommand("build")]
    | Annotated[Synth, tyro.conf.subcommand("synth")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code (usage errors raise SystemExit(2), as argparse does)."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    command = tyro.cli(
        Command,  # type: ignore[arg-type]
        prog="taa",
        description="Articulated objects from casual video: reconstruct, replay, look, export.",
        args=argv,
        config=(tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone),
    )
    with contextlib.suppress(ValueError):  # only the main thread may; a batch system's end is then as orderly as Ctrl-C
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    data: dict | None = None
    code = 0
    # A process that ends after this command keeps its stdout redirected: libraries may print while they unload.
    with _stdout_kept_clean(command.json, restore=argv is not None) as stdout:
        try:
            outcome = command.run()
            if command.json:
                data = outcome.data
            else:
                outcome.show()
            if outcome.error:
                print(f"error: {outcome.error}", file=sys.stderr)
                code = 1
        except SystemExit:
            raise
        except BaseException as error:
            if command.debug:
                traceback.print_exc()
            sentence = error_sentence(error)
            print(f"error: {sentence}", file=sys.stderr)
            data, code = {"error": sentence}, 1
        try:
            if command.json:
                print(json.dumps(data, allow_nan=False), file=stdout)
            stdout.flush()
        except OSError as error:  # a closed pipe, a full disk
            print(f"error: cannot write to stdout ({error.strerror}); look at where it goes", file=sys.stderr)
            os.dup2(os.open(os.devnull, os.O_WRONLY), stdout.fileno())  # nothing more will fail while closing
            code = 1
    return code


@contextlib.contextmanager
def _stdout_kept_clean(wanted: bool, restore: bool) -> Iterator[IO[str]]:
    """With --json, send whatever libraries print (native ones too) to stderr; yields the real stdout."""
    if not wanted:
        yield sys.stdout
        return
    real = sys.stdout
    real.flush()
    kept = os.dup(1)
    # Python's own prints go by sys.stdout, native ones by descriptor 1.
    if real is sys.__stdout__:
        real = os.fdopen(os.dup(kept), "w", encoding="utf-8")
    os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield real
    finally:
        real.flush()
        if restore:
            os.dup2(kept, 1)
        os.close(kept)


def error_sentence(error: BaseException) -> str:
    """One line for the user: what is wrong; what to do."""
    from taa_envs.errors import TaaEnvsError

    if isinstance(error, shutil.Error):  # copying a folder: (from, to, words) of each file, numbers in the words
        number = re.search(r"\[Errno (\d+)\]", str(error))
        error = OSError(int(number[1]), os.strerror(int(number[1])), str(error.args[0][0][1])) if number else error
    text = " ".join(str(error).split())
    if isinstance(error, KeyboardInterrupt):
        return "interrupted; run the same command again, with --scene it goes on where it was"
    if isinstance(error, TaaEnvsError) or any(c.__name__ == "TaaError" for c in type(error).__mro__):
        return text
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        where = f" at {error.filename}" if error.filename else ""
        return f"the disk is full{where}; free some space or write elsewhere (--out, --scene, TMPDIR)"
    if isinstance(error, OSError) and error.errno == errno.EROFS:
        return f"read-only file system at {error.filename or 'a file'}; write elsewhere (--out, --scene)"
    if isinstance(error, PermissionError):
        return f"no permission for {error.filename or 'a file'}; write elsewhere (--out, --scene) or change its mode"
    if isinstance(error, OSError) and error.filename:
        return f"{error.strerror or text}: {error.filename}; check the path"
    if isinstance(error, MemoryError):
        return "out of memory; give a shorter video or close other programs"
    return f"{type(error).__name__}: {text[:300]}; run again with --debug and report what it shows"


if __name__ == "__main__":
    sys.exit(main())

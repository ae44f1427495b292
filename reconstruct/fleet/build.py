"""``taa build``: every video of a folder, whatever happens to any of them."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from reconstruct.errors import TaaError
from reconstruct.fleet.engines import GB, Engine, Needs, make_engine
from reconstruct.fleet.job import TASK
from reconstruct.fleet.manifest import Manifest, Row, find_videos, name_rows, row_key
from reconstruct.fleet.page import write_page

RETRIES = 2
SECONDS = 3600.0
LAST_CUE = "scale"
"""Stage after which no provider of cues is needed any more, and the second part of a job begins."""


CUES = ("depth", "track", "hand", "camera")
"""Stages of providers that run up to it."""


@dataclass
class Build:
    """What a build is to do.

    Attributes:
        videos: folder that holds videos at any depth.
        out: the build's folder: manifest, ``assets/``, ``scenes/``, ``index.html``.
        engine: "local" or "ray".  workers: jobs at once, None for as many as there is room for.
        retries: further tries for a video whose worker died.  seconds: limit for one try.
        again: states of an earlier run that are tried again beside those it left unfinished.
        providers, focal, seed, overwrite: see :func:`reconstruct.pipeline.reconstruct`.
        gpu: share of a GPU for the cues, if a provider that uses one is chosen.
        task: module:function that does one job.
    """

    videos: Path
    out: Path
    engine: str = "local"
    workers: int | None = None
    retries: int = RETRIES
    seconds: float = SECONDS
    again: tuple[str, ...] = ()
    providers: Mapping[str, str] = field(default_factory=dict)
    focal: float | None = None
    seed: int = 0
    overwrite: bool = False
    gpu: float = 0.25
    task: str = TASK

    def options(self) -> dict:
        """What a row's result depends on beside its video."""
        return {"providers": dict(self.providers), "focal": self.focal, "seed": self.seed, "task": self.task}


Told = Callable[[Row, dict[str, int]], None]


def build(plan: Build, tell: Told | None = None) -> Manifest:
    """Reconstruct every video below a folder.

    A row that is done or refused stays as it is while its video and the options are the same; one that a killed build
    left waiting or running goes on from what its scene folder holds. A worker that dies is tried again; a video that
    kills every worker ends as ``failed`` and stops nothing.

    Args:
        plan: what to do.
        tell: called with a row and the counts of all states whenever a row's state changes.

    Returns:
        The manifest, as written.

    Raises:
        TaaError: the folder holds no video, another build is at work in ``out``, or the engine cannot run.
    """
    if not plan.videos.is_dir():
        raise TaaError(f"no such folder: {plan.videos}; give a folder of videos")
    from reconstruct.providers.table import choose

    choose(plan.providers)
    videos = find_videos(plan.videos, plan.out)
    if not videos:
        raise TaaError(f"{plan.videos} holds no video; known by their endings: mp4, mov, avi, mkv, webm and others")
    manifest = Manifest(plan.out)
    with manifest.owned():
        todo = _plan_rows(plan, manifest, videos)
        manifest.save()
        if todo:
            engine = make_engine(plan.engine, plan.workers, plan.retries)
            try:
                _Run(plan, manifest, engine, tell).all(todo)
            finally:
                engine.close()
                manifest.save()
        write_page(manifest, plan.videos)
    return manifest


def _plan_rows(plan: Build, manifest: Manifest, videos: list[Path]) -> list[Row]:
    """Rows of all videos, those of an earlier run kept where they still hold; returns the ones to do."""
    manifest.load()
    known, manifest.rows = manifest.rows, {}
    todo = []
    for row in name_rows(videos, plan.videos):
        old = known.get(row.id)
        try:
            row.key = row_key(plan.videos / row.video, plan.options())
        except OSError as error:
            row.state, row.error = "failed", f"cannot read {row.video} ({error.strerror}); check its permissions"
            manifest.rows[row.id] = row
            continue
        if old is not None and old.key == row.key and old.video == row.video:
            row = old
            gone = row.state == "done" and not (plan.out / "assets" / row.id / "asset.json").is_file()
            if row.state in ("waiting", "running", *plan.again) or gone:
                row.state, row.attempts, row.error = "waiting", 0, ""
        manifest.rows[row.id] = row
        if row.state == "waiting":
            todo.append(row)
    return todo


class _Run:
    """The loop of one build: hands jobs to the engine, takes answers, writes the manifest."""

    def __init__(self, plan: Build, manifest: Manifest, engine: Engine, tell: Told | None) -> None:
        self.plan, self.manifest, self.engine, self.tell = plan, manifest, engine, tell
        self._saved = 0.0
        self._needs = {"": Needs()}
        cues, rest = (
            uses_gpu({k: v for k, v in plan.providers.items() if (k in CUES) is early}) for early in (True, False)
        )
        if cues or rest:  # a GPU is held only by the half of a job that uses one
            self._needs = {LAST_CUE: _share(plan.gpu, cues), "": _share(plan.gpu, rest)}

    def all(self, todo: list[Row]) -> None:
        first = next(iter(self._needs))
        queue = deque((row, first) for row in todo)
        running = 0
        while queue or running:
            while queue and self.engine.room() > 0:
                row, until = queue.popleft()
                row.attempts += until == first
                self._change(row, "running")
                self.engine.submit(self._job(row, until), self._needs[until])
                running += 1
            for job, answer in self.engine.collect(1.0):
                running -= 1
                row = self.manifest.rows[job["id"]]
                row.seconds = answer["seconds"] + (row.seconds if job["until"] is None and first else 0.0)
                if answer["state"] == "running":  # its cues are there
                    queue.append((row, ""))
                elif answer["state"] == "died" and row.attempts <= self.plan.retries:
                    row.error = answer["error"]
                    queue.append((row, first))  # at the end: others first
                    self._change(row, "waiting")
                else:
                    self._end(row, answer)
        self._save(now=True)

    def _job(self, row: Row, until: str) -> dict:
        plan = self.plan
        return {
            "task": plan.task,
            "seconds": plan.seconds,
            "id": row.id,
            "video": str((plan.videos / row.video).resolve()),
            "assets": str((plan.out / "assets").resolve()),
            "scene": str((plan.out / "scenes" / row.id).resolve()),
            "seed": plan.seed,
            "focal": plan.focal,
            "providers": dict(plan.providers),
            "until": until or None,
            "overwrite": plan.overwrite,
            "attempt": row.attempts,
        }

    def _end(self, row: Row, answer: dict) -> None:
        row.result, row.error = answer["result"], answer["error"]
        state = answer["state"]
        if state == "died":
            tries = f"{row.attempts} times" if row.attempts > 1 else "once"
            row.error = f"{row.error} {tries}; look at the video, or give it a machine with more memory"
            state = "failed"
        self._change(row, state)

    def _change(self, row: Row, state: str) -> None:
        row.state = state
        self._save()
        if self.tell is not None:
            self.tell(row, self.manifest.counts())

    def _save(self, now: bool = False) -> None:
        """Every change with a few hundred rows, at most every two seconds with many more."""
        if now or len(self.manifest.rows) < 500 or time.monotonic() - self._saved > 2.0:
            self.manifest.save()
            self._saved = time.monotonic()


def _share(gpu: float, used: bool) -> Needs:
    return Needs(1.0, gpu, 6 * GB) if used else Needs()


def uses_gpu(providers: Mapping[str, str]) -> bool:
    """Whether a chosen provider is one that is not embedded: those are large networks."""
    from reconstruct.providers.table import PROVIDERS

    return any(
        getattr(p, "kind", "embedded") != "embedded"
        for cue, name in providers.items()
        for p in PROVIDERS.get(cue, ())
        if p.name == name
    )

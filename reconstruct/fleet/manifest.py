"""The manifest of a build: one row a video, written whole after every change, owned by one process at a time."""

from __future__ import annotations

import csv
import fcntl
import hashlib
import io
import json
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from reconstruct.errors import TaaError
from reconstruct.store import file_digest
from taa_envs.files import written_whole

STATES = ("waiting", "running", "done", "refused", "failed")
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".3gp", ".wmv", ".ts")
SCHEMA = "taa-build/1"


@dataclass
class Row:
    """One video.

    Attributes:
        id: of the asset it becomes.  video: path below the build's folder of videos.
        state: waiting, running (or was, when the build was killed), done, refused (the video was looked at and does not
            support an answer) or failed (it could not be looked at, or its worker died).
        seconds: of the last attempt.  attempts: how often a worker began it.
        result: of a done one its joint and replay in words.  error: one line of a refused or failed one.
        key: digest of the video and of the options; a row with another key is made again.
    """

    id: str
    video: str
    state: str = "waiting"
    seconds: float = 0.0
    attempts: int = 0
    result: str = ""
    error: str = ""
    key: str = ""


COLUMNS = tuple(f.name for f in fields(Row))


class Manifest:
    """``manifest.json`` (what a build goes on from) and ``manifest.csv`` (the same for people) in a build's folder.

    Args:
        folder: of the build.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)
        self.file = self.folder / "manifest.json"
        self.rows: dict[str, Row] = {}

    def load(self) -> None:
        """Rows of an earlier run, if there was one.

        Raises:
            TaaError: the file is not a manifest.
        """
        try:
            data = json.loads(self.file.read_text(encoding="utf-8"))
            if data["schema"] != SCHEMA:
                raise ValueError(f"its schema is {str(data['schema'])[:40]!r}")
            rows = [Row(**entry) for entry in data["rows"]]
            if any(r.state not in STATES or not isinstance(r.seconds, (int, float)) for r in rows):
                raise ValueError("a row has no known state")
        except FileNotFoundError:
            return
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise TaaError(
                f"{self.file} is not a build's manifest ({str(error)[:80]}); remove it or choose another --out"
            ) from None
        self.rows = {row.id: row for row in rows}

    def save(self) -> None:
        """Write both files, each whole or not at all."""
        rows = [asdict(row) for row in self.rows.values()]
        for row in rows:
            row["seconds"] = round(row["seconds"], 2)
        table = io.StringIO()
        writer = csv.DictWriter(table, COLUMNS)
        writer.writeheader()
        # A cell that begins like a formula would be run by a spreadsheet; video names come from strangers.
        writer.writerows(
            {k: f"'{v}" if isinstance(v, str) and v[:1] in "=+-@" and v else v for k, v in row.items()} for row in rows
        )
        with written_whole(self.file) as partial:
            partial.write_text(json.dumps({"schema": SCHEMA, "rows": rows}, indent=1), encoding="utf-8")
        with written_whole(self.folder / "manifest.csv") as partial:
            partial.write_text(table.getvalue(), encoding="utf-8", newline="")

    def counts(self) -> dict[str, int]:
        """Number of rows in each state."""
        return {state: sum(row.state == state for row in self.rows.values()) for state in STATES}

    @contextmanager
    def owned(self) -> Iterator[None]:
        """Keep other builds away; the kernel gives the lock back however this process ends.

        Raises:
            TaaError: another build works in this folder.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(self.folder / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise TaaError(
                    f"another build is at work in {self.folder}; wait for it or choose another --out"
                ) from None
            yield
        finally:
            os.close(handle)


def find_videos(folder: Path, besides: Path) -> list[Path]:
    """Videos below a folder by their suffix, in order of their names; hidden folders and ``besides`` are left out."""
    found = []
    for root, folders, files in os.walk(folder):
        folders[:] = sorted(
            f for f in folders if not f.startswith(".") and (Path(root) / f).resolve() != besides.resolve()
        )
        found += [Path(root) / f for f in sorted(files) if f.lower().endswith(VIDEO_SUFFIXES) and not f.startswith(".")]
    return found


def name_rows(videos: Iterable[Path], folder: Path) -> list[Row]:
    """A row with an id for each video; the id follows from the path alone, so that a second run finds the same."""
    rows: list[Row] = []
    taken: set[str] = set()
    for video in videos:
        path = video.relative_to(folder).as_posix()
        slug = re.sub(r"[^a-z0-9]+", "-", video.stem.lower()).strip("-")[:48] or "video"
        mark = hashlib.sha256(path.encode("utf-8", "surrogateescape")).hexdigest()[:8]
        name = slug if slug not in taken and _only_one(slug, videos) else f"{slug}-{mark}"
        taken.add(name)
        rows.append(Row(name, path))
    return rows


def _only_one(slug: str, videos: Iterable[Path]) -> bool:
    slugs = [re.sub(r"[^a-z0-9]+", "-", v.stem.lower()).strip("-")[:48] or "video" for v in videos]
    return slugs.count(slug) == 1


def row_key(video: Path, options: dict) -> str:
    """Digest of a video's bytes and of what it is made with.

    Raises:
        OSError: the video cannot be read.
    """
    text = json.dumps([file_digest(video), options], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()

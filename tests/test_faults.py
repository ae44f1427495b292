"""A small slice of ``python -m benchmarks.faults``, and disks that are full or closed: one clear line, nothing left."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.faults import JOBS, door_arguments, fork, killed, remains
from taa_envs import files
from taa_envs.asset import save_asset
from taa_envs.files import folder_written_whole, written_whole

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.slow
@pytest.mark.parametrize("name, kills", [("save", 8), ("two_writers", 3), ("build", 2)])
def test_kills_leave_assets_whole_or_absent(tmp_path: Path, name: str, kills: int) -> None:
    job = JOBS[name](tmp_path / name, np.random.default_rng(7))
    job.attack(kills)
    assert job.count == kills and job.problems == []


@pytest.mark.slow
def test_killed_training_goes_on_to_the_same_curve_and_policy(tmp_path: Path) -> None:
    """In a process of its own: the killed trainings are forked off before it has threads."""
    out = subprocess.run(
        [sys.executable, "-m", "benchmarks.faults", "--jobs", "train", "train_sac", "--kills", "3", "--seed", "2",
         "--json", str(tmp_path / "rows.json")],
        cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert out.returncode == 0, out.stdout
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert [row["kills"] for row in rows] == [2, 1] and not any(row["problems"] for row in rows)


def test_what_a_killed_writer_left_goes_with_the_next_write(tmp_path: Path) -> None:
    def begin() -> None:
        with folder_written_whole(tmp_path / "thing", True) as work, written_whole(tmp_path / "note.txt") as partial:
            (work / "half").write_text("x")
            partial.write_text("half")
            import time

            time.sleep(60)

    (tmp_path / "thing").mkdir()
    (tmp_path / "thing" / "old").write_text("old")
    assert killed(begin, 0.5)
    assert len(remains(tmp_path)) == 2 and (tmp_path / "thing" / "old").is_file()
    with written_whole(tmp_path / "note.txt") as partial:
        partial.write_text("whole")
    with folder_written_whole(tmp_path / "thing", True) as work:
        (work / "new").write_text("new")
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["new", "note.txt", "thing"]


def test_a_writer_that_ended_and_that_nobody_waited_for_is_dead(tmp_path: Path) -> None:
    """Its id stays taken, as where the first process of a container does not wait for orphans."""

    def begin() -> None:
        with folder_written_whole(tmp_path / "thing") as work:
            (work / "half").write_text("x")
            os.kill(os.getpid(), signal.SIGKILL)

    child = fork(begin)
    try:
        os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
        assert len(remains(tmp_path)) == 1
        with folder_written_whole(tmp_path / "thing") as work:
            (work / "new").write_text("new")
        assert sorted(p.name for p in tmp_path.rglob("*")) == ["new", "thing"]
    finally:
        os.waitpid(child, 0)


def test_what_a_living_writer_writes_is_left_alone(tmp_path: Path) -> None:
    with written_whole(tmp_path / "a.txt") as mine:
        mine.write_text("mine")
        with written_whole(tmp_path / "a.txt") as other:
            other.write_text("other")
        assert mine.is_file()
    assert (tmp_path / "a.txt").read_text() == "mine"


@pytest.mark.parametrize("kernel", [True, False], ids=["renameat2", "plain renames"])
def test_folders_are_replaced_whole(tmp_path: Path, kernel: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not kernel:
        monkeypatch.setattr(files.ctypes, "CDLL", lambda *a, **k: object())
    target = tmp_path / "thing"
    for text in ("one", "two", "three"):
        with folder_written_whole(target, overwrite=True) as work:
            (work / text).write_text(text)
        assert [p.name for p in target.iterdir()] == [text]
    with pytest.raises(FileExistsError), folder_written_whole(target):
        pass
    with pytest.raises(FileExistsError), folder_written_whole(tmp_path / "late") as work:
        (tmp_path / "late").mkdir()  # somebody else was faster
        (tmp_path / "late" / "theirs").write_text("x")
    assert [p.name for p in (tmp_path / "late").iterdir()] == ["theirs"] and not remains(tmp_path)


def taa(*arguments: object, limit: int | None = None, user: int | None = None, **environment: str) -> tuple[int, str]:
    """Exit code and the last line of stderr; ``limit`` bounds the size of any file, as a full disk does."""

    def before() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    done = subprocess.run(
        [sys.executable, "-m", "taa_envs.cli", *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        preexec_fn=before,
        user=user,
        env={**os.environ, **environment},
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode, (done.stderr.strip().splitlines() or [""])[-1]


@pytest.fixture(scope="module")
def assets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("assets")
    save_asset(folder, "door", **door_arguments())
    return folder


def test_a_full_disk_is_one_line(assets: Path, tmp_path: Path) -> None:
    code, line = taa("export", "door", "--out", tmp_path / "out", limit=400, TAA_ASSETS=str(assets))
    assert code == 1 and line.startswith("error: ") and "disk is full" in line and "; " in line
    assert not list(tmp_path.iterdir())
    work = [
        sys.executable,
        "-c",
        "import sys; from benchmarks.faults import save_door; from pathlib import Path; save_door(Path(sys.argv[1]))",
        str(tmp_path),
    ]

    def before() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))

    done = subprocess.run(work, cwd=ROOT, capture_output=True, text=True, preexec_fn=before)
    assert done.returncode == 1 and not list(tmp_path.iterdir())


def test_a_small_disk_is_one_line(assets: Path, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    if os.geteuid() or subprocess.run(["mount", "-t", "tmpfs", "-o", "size=16k", "none", disk]).returncode:
        pytest.skip("only root may mount a small disk")
    try:
        code, line = taa("export", "door", "--out", disk / "out", TAA_ASSETS=str(assets))
        assert code == 1 and "disk is full" in line and not list(disk.iterdir())
        subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
        code, line = taa("export", "door", "--out", disk / "out", TAA_ASSETS=str(assets))
        assert code == 1 and "read-only" in line.lower() and "; " in line
    finally:
        subprocess.run(["umount", disk], check=True)


def test_a_folder_without_permission_is_one_line(assets: Path, tmp_path: Path) -> None:
    if os.geteuid() == 0:
        pytest.skip("root may write everywhere; run as another user")
    tmp_path.chmod(0o555)
    code, line = taa("export", "door", "--out", tmp_path / "out", TAA_ASSETS=str(assets))
    tmp_path.chmod(0o755)
    assert code == 1 and "no permission" in line and "; " in line


def test_a_clock_that_jumps_changes_nothing(assets: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No duration, key or name of a file follows the wall clock."""
    import time

    monkeypatch.setattr(time, "time", lambda: -1e9)
    first = save_asset(tmp_path / "a", "door", **door_arguments())
    monkeypatch.setattr(time, "time", lambda: 4e9)
    second = save_asset(tmp_path / "b", "door", **door_arguments())
    for name in ("asset.json", "model.xml"):
        assert (first.path / name).read_bytes() == (second.path / name).read_bytes()
    sources = [p for room in ("taa_envs", "reconstruct", "diagnose", "train") for p in (ROOT / room).rglob("*.py")]
    assert not [p.name for p in sources if "time.time()" in p.read_text() or "datetime.now" in p.read_text()]

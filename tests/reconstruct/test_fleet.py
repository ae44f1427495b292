"""Many videos: one row each, poison stops nothing, a kill at any point is gone on from, two nodes and then one."""

from __future__ import annotations

import csv
import importlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from reconstruct.errors import TaaError
from reconstruct.fleet import Build, Manifest, build
from reconstruct.fleet.manifest import find_videos, name_rows
from taa_envs.asset import load_asset

ROOT = Path(__file__).resolve().parents[2]
TASK = "tests.reconstruct.fleet_tasks:act"


def plan(folder: Path, names: list[str], **changes: object) -> Build:
    videos = folder / "videos"
    for name in names:
        (videos / name).parent.mkdir(parents=True, exist_ok=True)
        (videos / name).write_text(name)
    return Build(videos, folder / "out", task=TASK, **{"workers": 2, **changes})


def attempts(plan: Build, name: str) -> int:
    log = plan.videos / f"{name}.log"
    return len(log.read_text().splitlines()) if log.is_file() else 0


def test_every_video_has_an_end(tmp_path: Path) -> None:
    work = plan(tmp_path, ["a/good.mp4", "poison.mp4", "once.mov", "broken.avi", "odd.mp4", "nothing.mkv", "hang.mp4",
                           "<b>good.mp4"], seconds=12.0, retries=1)  # fmt: skip
    told: list[str] = []
    rows = {r.video: r for r in build(work, lambda row, counts: told.append(f"{row.id} {row.state}")).rows.values()}
    assert {v: r.state for v, r in rows.items()} == {
        "a/good.mp4": "done", "<b>good.mp4": "done", "once.mov": "done", "nothing.mkv": "refused",
        "poison.mp4": "failed", "broken.avi": "failed", "odd.mp4": "failed", "hang.mp4": "failed"}  # fmt: skip
    assert (
        "SIGSEGV" in rows["poison.mp4"].error
        and "2 times" in rows["poison.mp4"].error
        and rows["once.mov"].attempts == 2
    )
    assert rows["broken.avi"].error == "this video is broken; film another" and attempts(work, "broken.avi") == 1
    assert "within 12 s" in rows["hang.mp4"].error and "ZeroDivisionError" in rows["odd.mp4"].error
    assert all("\n" not in r.error and ("; " in r.error) == (r.state != "done") for r in rows.values())
    for row in rows.values():
        if row.state == "done":
            load_asset(work.out / "assets" / row.id)
    assert told[-1].split()[1] in ("done", "refused", "failed") and not list(work.out.glob(".manifest*"))

    with (work.out / "manifest.csv").open(newline="") as f:
        assert {r["video"]: r["state"] for r in csv.DictReader(f)} == {v: r.state for v, r in rows.items()}
    page = (work.out / "index.html").read_text()
    assert "&lt;b&gt;good.mp4" in page and "<b>good" not in page and "http" not in page.replace("http://www.w3.org", "")

    # A second run has nothing to do; asked to, it tries the failed ones again, and a changed video is a new one.
    (work.videos / "nothing.mkv").write_text("another")
    before = {name: attempts(work, name) for name in ("a/good.mp4", "poison.mp4", "nothing.mkv")}
    build(work)
    assert attempts(work, "a/good.mp4") == before["a/good.mp4"] and attempts(work, "poison.mp4") == before["poison.mp4"]
    assert attempts(work, "nothing.mkv") == before["nothing.mkv"] + 1


def test_a_job_in_two_halves_holds_the_gpu_in_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from reconstruct.fleet.engines import Local

    asked: list[tuple[str, str | None, float]] = []
    submit = Local.submit

    def note(self: Local, job: dict, needs: object) -> None:
        asked.append((job["id"], job["until"], needs.gpus))
        submit(self, job, needs)

    monkeypatch.setattr(Local, "submit", note)
    module = importlib.import_module("reconstruct.fleet.build")  # the package's attribute of that name is the function
    monkeypatch.setattr(module, "uses_gpu", lambda providers: "depth" in providers)
    monkeypatch.setattr("reconstruct.providers.table.choose", lambda providers: providers)
    work = plan(tmp_path, ["good.mp4", "good2.mp4"], providers={"depth": "da3", "segment": "motion"})
    assert build(work).counts()["done"] == 2
    assert sorted(asked, key=str) == sorted(
        [("good", "scale", 0.25), ("good", None, 0.0), ("good2", "scale", 0.25), ("good2", None, 0.0)], key=str
    )


def test_ids_follow_from_paths_alone(tmp_path: Path) -> None:
    work = plan(tmp_path, ["x/door.mp4", "y/door.mp4", "Türe & Tor.MOV", "--.mp4", ".hidden.mp4", "notes.txt"])
    videos = find_videos(work.videos, work.out)
    rows = name_rows(videos, work.videos)
    assert len({r.id for r in rows}) == len(rows) == 4 and {r.id for r in rows} >= {"t-re-tor", "video"}
    assert [r.id for r in name_rows(videos, work.videos)] == [r.id for r in rows]
    assert sum(r.id.startswith("door-") for r in rows) == 2


def test_errors_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(TaaError, match="no such folder"):
        build(Build(tmp_path / "none", tmp_path / "out"))
    (tmp_path / "videos").mkdir()
    with pytest.raises(TaaError, match="holds no video"):
        build(Build(tmp_path / "videos", tmp_path / "out"))
    work = plan(tmp_path, ["good.mp4"], engine="slurm")
    with pytest.raises(TaaError, match="known: local, ray"):
        build(work)
    with Manifest(work.out).owned(), pytest.raises(TaaError, match="another build"):
        build(plan(tmp_path, ["good.mp4"]))
    for text in ("[]", "{", '{"schema": "taa-build/1", "rows": [{"id": 1}]}', '{"schema": "taa-build/2", "rows": []}'):
        (work.out / "manifest.json").write_text(text)
        with pytest.raises(TaaError, match="not a build's manifest"):
            build(plan(tmp_path, ["good.mp4"]))


def workers_of(mark: str) -> list[int]:
    """Processes of jobs whose environment carries the mark."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            command, environment = (entry / "cmdline").read_bytes(), (entry / "environ").read_bytes()
        except OSError:
            continue
        if b"reconstruct.fleet.job" in command and mark.encode() in environment:
            found.append(int(entry.name))
    return found


def test_a_killed_build_leaves_no_worker_and_goes_on(tmp_path: Path) -> None:
    names = [f"slow{i}.mp4" for i in range(4)] + ["good.mp4"]
    work = plan(tmp_path, names)
    mark = f"killed-{os.getpid()}"
    arguments = f"Path({str(work.videos)!r}), Path({str(work.out)!r}), task={TASK!r}, workers=2"
    code = f"from pathlib import Path; from reconstruct.fleet import Build, build; build(Build({arguments}))"
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, env={**os.environ, "MARK": mark})
    deadline = time.monotonic() + 60
    while attempts(work, "slow0.mp4") + attempts(work, "slow1.mp4") + attempts(work, "good.mp4") < 2:
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    while workers_of(mark):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    states = {r["id"]: r["state"] for r in json.loads((work.out / "manifest.json").read_text())["rows"]}
    assert "running" in states.values()
    for folder in (work.out / "assets").glob("[a-z]*"):
        load_asset(folder)
    assert build(work).counts()["done"] == 5
    for name in names:
        load_asset(work.out / "assets" / Path(name).stem)


@pytest.mark.slow
def test_two_ray_nodes_one_of_them_killed(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    from benchmarks.fleet import two_nodes

    work = plan(tmp_path, [f"slow{i}.mp4" for i in range(8)], engine="ray", workers=None)
    told = two_nodes(work, kill_after=2)
    assert told["nodes_before"] == 2 and told["nodes_after"] == 1 and told["done_when_killed"] < 8
    assert told["counts"]["done"] == 8
    for row in Manifest(work.out).folder.glob("assets/slow*"):
        load_asset(row)

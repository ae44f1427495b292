"""One video in one process: ``python -m reconstruct.fleet.job JOB.json ANSWER.json``.

A process of its own bounds what a video can do: a crash of native code, memory that is never given back, and a decoder
that never returns end with it. It ends by itself when whoever started it is gone.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from taa_envs.files import written_whole

TASK = "reconstruct.fleet.job:reconstruct_one"


def reconstruct_one(job: dict) -> dict:
    """Reconstruct the video of a job; see :func:`run_job` for both objects."""
    from reconstruct.pipeline import reconstruct
    from reconstruct.store import file_digest
    from taa_envs.asset import load_asset

    root, name = Path(job["assets"]), job["id"]
    if (root / name / "asset.json").is_file() and not job["overwrite"]:
        asset = load_asset(root / name)
        if (asset.metadata.get("source") or {}).get("sha256") == file_digest(Path(job["video"])):
            # The build was killed between the asset's rename and the manifest's.
            return {"state": "done", "result": asset_words(asset.joint, None), "error": ""}
    result = reconstruct(
        job["video"],
        id=name,
        out=root,
        scene=job["scene"],
        seed=job["seed"],
        focal=job.get("focal"),
        providers=job.get("providers"),
        overwrite=job["overwrite"],
        until=job.get("until"),
    )
    if result.error is not None:
        return {"state": "refused", "result": "", "error": result.error}
    if result.asset is None:
        return {"state": "running", "result": "", "error": ""}  # the first part of two
    return {"state": "done", "result": asset_words(result.joint, result.replay), "error": "", "stages": result.seconds}


def asset_words(joint: dict, replay: dict | None) -> str:
    """A joint and its replay in a few words, for the table."""
    words = [f"{joint['type']} ({joint.get('verdict', 'ok')})"]
    if replay is not None:
        worst = max((replay.get("controls") or {"": 0.0}).values())
        words.append(f"replay {replay['joint_progress']:.0%}, worst control {worst:.0%}")
    return ", ".join(words)


def run_job(job: dict, threads: int = 1, stop: threading.Event | None = None) -> dict:
    """Run a job in a process of its own and wait for it.

    Args:
        job: "task" (module:function that does it), "seconds" (limit), and what the task takes.
        threads: that the process may use.
        stop: ends the process when set; the state is then ``stopped``.

    Returns:
        "state" (done, refused, failed, died), "result", "error" (one line), "seconds". ``died``: the process ended
        without an answer, which is worth another try; everything else is an answer.
    """
    begin = time.monotonic()
    environment = {**os.environ, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl"), "TAA_JOB": "1"}
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        environment[name] = str(threads)
    where = Path(__file__).resolve().parents[2]
    environment["PYTHONPATH"] = os.pathsep.join([str(where), *filter(None, [os.environ.get("PYTHONPATH")])])
    with tempfile.TemporaryDirectory(prefix="taa-job-") as folder:
        asked, answer, words = (Path(folder) / n for n in ("job.json", "answer.json", "words.txt"))
        asked.write_text(json.dumps(job), encoding="utf-8")
        environment["TMPDIR"] = folder  # frames of a process that is killed go with this folder
        with words.open("w") as log:
            process = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    __name__ if __name__ != "__main__" else "reconstruct.fleet.job",
                    str(asked),
                    str(answer),
                ],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                env=environment,
                start_new_session=True,
            )
            try:
                code = _wait(process, job.get("seconds"), stop)
            finally:
                _end(process)
        made: dict[str, Any]
        if stop is not None and stop.is_set():
            made = {"state": "stopped", "error": ""}
        elif code is None:
            made = {
                "state": "failed",
                "error": f"no answer within {job['seconds']:.0f} s; give a shorter video or raise --timeout",
            }
        elif answer.is_file():
            made = json.loads(answer.read_text(encoding="utf-8"))
        else:
            last = (words.read_text(encoding="utf-8", errors="replace").strip().splitlines() or [""])[-1]
            made = {"state": "died", "error": f"the worker died ({_how(code)}){': ' + last[:120] if last else ''}"}
    return {"result": "", **made, "seconds": time.monotonic() - begin}


def _wait(process: subprocess.Popen, seconds: float | None, stop: threading.Event | None) -> int | None:
    """Its exit code; None where it took too long or was to stop."""
    deadline = None if seconds is None else time.monotonic() + seconds
    while deadline is None or time.monotonic() < deadline:
        with contextlib.suppress(subprocess.TimeoutExpired):
            return process.wait(0.2)
        if stop is not None and stop.is_set():
            break
    return None


def _how(code: int) -> str:
    if code < 0:
        name = signal.Signals(-code).name if -code in list(signal.Signals) else str(-code)
        return f"signal {name}" + (", perhaps out of memory" if -code == signal.SIGKILL else "")
    return f"exit code {code}"


def _end(process: subprocess.Popen) -> None:
    """The process and whatever it started."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass
    process.wait()
    if process.stdin is not None:
        process.stdin.close()


def _end_with_parent() -> None:
    """Leave when stdin closes: nobody waits for the answer then. Also what this process started leaves."""

    def watch() -> None:
        while os.read(0, 4096):
            pass
        os.killpg(0, signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


def main(asked: Path, answer: Path) -> None:
    """Do the job and write the answer, whole or not at all."""
    from reconstruct.errors import TaaError
    from taa_envs.cli import error_sentence
    from taa_envs.errors import TaaEnvsError

    _end_with_parent()
    job = json.loads(asked.read_text(encoding="utf-8"))
    module, _, name = job["task"].partition(":")
    try:
        made = getattr(importlib.import_module(module), name)(job)
    except (TaaError, TaaEnvsError) as error:
        made = {"state": "failed", "error": " ".join(str(error).split())}
    except Exception as error:
        if isinstance(error, MemoryError):
            raise  # dies: another worker may have more
        made = {"state": "failed", "error": error_sentence(error)}
    with written_whole(answer) as partial:
        partial.write_text(json.dumps(made), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
    sys.stdout.flush()
    os._exit(0)  # libraries that unload badly must not turn an answer into a death

"""Jobs for the fleet's tests: what a video does is its name; a good one becomes a small asset."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from reconstruct.errors import TaaError


def act(job: dict) -> dict:
    """Crash, hang, refuse, fail, or make an asset, as the video's name says."""
    from benchmarks.fuzz import make_door

    name = Path(job["video"]).stem
    with open(job["video"] + ".log", "a") as log:
        log.write(f"{job['attempt']}\n")
    if job["until"]:
        return {"state": "running", "result": "", "error": ""}
    if name.startswith("poison") or (name.startswith("once") and job["attempt"] == 1):
        os.kill(os.getpid(), signal.SIGSEGV)
    if name.startswith("hang"):
        time.sleep(600)
    if name.startswith("slow"):
        time.sleep(2.0)
    if name.startswith("broken"):
        raise TaaError("this video is broken; film another")
    if name.startswith("odd"):
        raise ZeroDivisionError("division by zero")
    if name.startswith("no"):
        return {"state": "refused", "result": "", "error": "no joint is seen; film one"}
    root = Path(job["assets"])
    if not (root / job["id"]).exists():
        make_door(root, job["id"])
    return {"state": "done", "result": "revolute (ok)", "error": ""}

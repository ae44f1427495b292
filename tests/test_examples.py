"""Every numbered example runs and says what it is to say."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))
SAYS = {
    "01": "control no_hand: 0%",
    "02": "success True",
    "03": "progress of the replay",
    "04": "stops half-way: progress 50%",
    "05": "open-loop replay",
    "06": "ok: revolute",
}


def test_examples_are_numbered_without_gaps() -> None:
    assert [e.name[:2] for e in EXAMPLES] == sorted(SAYS) == [f"{k:02}" for k in range(1, len(EXAMPLES) + 1)]
    listed = (ROOT / "examples" / "README.md").read_text()
    assert all(f"`{e.name}`" in listed for e in EXAMPLES)


@pytest.mark.slow
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda e: e.stem)
def test_example(example: Path, tmp_path: Path) -> None:
    environment = {**os.environ, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl"), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, str(example), str(tmp_path)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert SAYS[example.name[:2]] in done.stdout, done.stdout

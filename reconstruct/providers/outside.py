"""Models in environments of their own: their scripts run there as a subprocess, and files go between.

What a script says on stderr and stdout is kept beside its files; when it fails, ends too late, or leaves a file out,
one line says so and names that log.
"""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from reconstruct.errors import TaaError

TIMEOUT = 3600.0
"""Seconds; ``timeout`` of the provider's section in ``taa.toml`` changes it."""
KEPT_OUT = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "PYTHONSTARTUP")
"""Variables of this environment that would mix its packages into the other one."""


def setting(section: Mapping[str, Any], name: str, key: str) -> Path:
    """A path of a provider's section.

    Raises:
        TaaError: it is not set.
    """
    if not section.get(key):
        raise TaaError(f"{key} of [{name}] is not set; put it into taa.toml (see docs/providers.md)")
    return Path(str(section[key])).expanduser()


def run_script(name: str, section: Mapping[str, Any], script: Path, arguments: Sequence[str | Path], log: Path,
               made: Sequence[Path] = (), tell: Callable[[float], None] = lambda share: None) -> None:  # fmt: skip
    """Run a provider's script with its own interpreter.

    Args:
        name: of the provider.  section: its settings (python, timeout, args).
        script: the file.  arguments: of the script; those of ``args`` in the settings follow.
        log: file that keeps its stdout and stderr.
        made: files or folders that must be there afterwards, and not empty.
        tell: called with the share of the time-out that has passed.

    Raises:
        TaaError: it cannot be started, ends with an error or too late, or something is missing; one line.
    """
    python, limit = setting(section, name, "python"), float(section.get("timeout", TIMEOUT))
    command = [str(python), str(script), *map(str, arguments), *map(str, section.get("args", ()))]
    # Unbuffered: else what it printed before an error would stand after it in the log.
    environment = {k: v for k, v in os.environ.items() if k not in KEPT_OUT} | {"PYTHONUNBUFFERED": "1"}
    log.parent.mkdir(parents=True, exist_ok=True)
    begin = time.monotonic()
    with log.open("w", encoding="utf-8") as words:
        words.write(" ".join(command) + "\n")
        words.flush()
        try:
            # A session of its own: what the script starts ends with it.
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=words, stderr=subprocess.STDOUT,
                                       env=environment, cwd=script.parent.parent, start_new_session=True)  # fmt: skip
        except OSError as error:
            raise TaaError(f"{name} cannot be started ({error.strerror}: {error.filename}); correct [{name}] in "
                           "taa.toml") from None  # fmt: skip
        try:
            while True:
                try:
                    code = process.wait(timeout=min(1.0, max(0.01, limit - (time.monotonic() - begin))))
                    break
                except subprocess.TimeoutExpired:
                    passed = time.monotonic() - begin
                    tell(min(0.99, passed / limit))
                    if passed >= limit:
                        raise TaaError(f"{name} did not end within {limit:.0f} s; set timeout of [{name}] in taa.toml, "
                                       f"its words are in {log}") from None  # fmt: skip
        finally:
            if process.poll() is None:
                _end(process)
    if code:
        raise TaaError(f"{name} failed with exit code {code} ({last_words(log)}); its words are in {log}")
    for path in made:
        empty = path.is_dir() and not any(path.iterdir())
        if not path.exists() or empty or (path.is_file() and not path.stat().st_size):
            raise TaaError(f"{name} ended without an error but wrote no {path.name} ({last_words(log)}); "
                           f"its words are in {log}")  # fmt: skip


def _end(process: subprocess.Popen) -> None:
    for sign in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(process.pid, sign)
        except ProcessLookupError:
            return
        try:
            process.wait(timeout=5)
            return
        except subprocess.TimeoutExpired:
            continue


def last_words(log: Path, most: int = 160) -> str:
    """The last line that is not empty, shortened."""
    lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    return lines[-1][-most:] if len(lines) > 1 else "it said nothing"


def pipeline_script(name: str, settings: Any, script: str) -> Path:
    """A script of the released pipeline's checkout.

    Raises:
        TaaError: the checkout is not set, or has no such script.
    """
    section = settings.section(name)
    root = section.get("pipeline") or settings.section("released").get("repository")
    if not root:
        raise TaaError(f"{name} is driven by the released pipeline's {script}; set repository of [released] in "
                       "taa.toml to its checkout")  # fmt: skip
    path = Path(str(root)).expanduser() / script
    if not path.is_file():
        raise TaaError(f"there is no {path}; set repository of [released] in taa.toml to the released pipeline's "
                       "checkout")  # fmt: skip
    return path

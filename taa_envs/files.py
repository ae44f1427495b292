"""Files and folders that appear under their final name only when they are whole."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A temporary file beside ``path`` to write into; renamed to ``path`` if the block ends well, else removed."""
    path = Path(path)
    handle, partial = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    try:
        yield Path(partial)
        os.chmod(partial, 0o666 & ~_umask())
        os.replace(partial, path)
    except BaseException:
        Path(partial).unlink(missing_ok=True)
        raise


@contextmanager
def folder_written_whole(target: Path, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder beside ``target``, put in its place if the block ends well, else removed.

    One that was there is moved aside first and comes back if the rename fails.

    Raises:
        FileExistsError: there is one and overwrite is False.
    """
    target = Path(target)
    if target.exists() and not overwrite:
        raise FileExistsError(17, "exists already", str(target))
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    try:
        work = temporary / target.name
        work.mkdir()
        yield work
        aside = temporary / "replaced"
        if target.exists():
            if not overwrite:  # made by somebody else while we worked
                raise FileExistsError(17, "exists already", str(target))
            os.replace(target, aside)
        try:
            os.replace(work, target)
        except OSError:
            if aside.exists():
                os.replace(aside, target)
            raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask

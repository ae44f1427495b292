"""Files and folders that appear under their final name only when they are whole.

Everything is written beside its place under a hidden name and renamed. A process that is killed leaves at most such a
hidden name behind; it carries the process's id, and whoever writes to the same place next removes what the dead left.
"""

from __future__ import annotations

import ctypes
import errno
import os
import shutil
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

AT_FDCWD, NOREPLACE, EXCHANGE = -100, 1, 2


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A temporary file beside ``path`` to write into; renamed to ``path`` if the block ends well, else removed."""
    path = Path(path)
    _sweep(path.parent, path.name)
    handle, partial = tempfile.mkstemp(prefix=_prefix(path.name), suffix=path.suffix, dir=path.parent)
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

    One that was there stays until the new one is whole; the two then change places in one step, so that there is no
    moment in which neither is there.

    Raises:
        FileExistsError: there is one and overwrite is False.
    """
    target = Path(target)
    if target.exists() and not overwrite:
        raise FileExistsError(errno.EEXIST, "exists already", str(target))
    target.parent.mkdir(parents=True, exist_ok=True)
    _sweep(target.parent, target.name)
    temporary = Path(tempfile.mkdtemp(prefix=_prefix(target.name), dir=target.parent))
    try:
        work = temporary / target.name
        work.mkdir()
        yield work
        _put(work, target, overwrite, temporary / "replaced")
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _put(work: Path, target: Path, overwrite: bool, aside: Path) -> None:
    """Rename work to target; what was there ends under work's name or aside."""
    for _ in range(100):  # others may write to the same place: what was true a moment ago may not be now
        try:
            _rename(work, target, NOREPLACE)
            return
        except FileExistsError:
            if not overwrite:
                raise FileExistsError(errno.EEXIST, "exists already", str(target)) from None
        try:
            _rename(work, target, EXCHANGE)
            return
        except FileNotFoundError:
            continue  # gone meanwhile
        except OSError as error:
            if error.errno not in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP):
                raise
        # A file system that cannot exchange: for a moment neither is there.
        os.replace(target, aside)
        try:
            os.replace(work, target)
        except OSError:
            os.replace(aside, target)
            raise
        return
    raise FileExistsError(errno.EEXIST, "is being replaced by others all the time", str(target))


def _rename(source: Path, target: Path, how: int) -> None:
    """Linux's renameat2, which Python does not offer; elsewhere a plain rename where nothing is to be replaced."""
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if call is not None:
        if call(AT_FDCWD, os.fsencode(source), AT_FDCWD, os.fsencode(target), how) == 0:
            return
        number = ctypes.get_errno()
        if how == EXCHANGE or number not in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP):
            raise OSError(number, os.strerror(number), str(source), None, str(target))
    elif how == EXCHANGE:
        raise OSError(errno.ENOSYS, "folders cannot be exchanged here", str(target))
    if target.exists():
        raise FileExistsError(errno.EEXIST, "exists already", str(target))
    os.rename(source, target)


def _prefix(name: str) -> str:
    return f".{name[:100]}.{_host()}-{os.getpid()}-"


def _host() -> str:
    return "".join(c for c in socket.gethostname() if c.isalnum())[:32] or "here"


def _sweep(folder: Path, name: str) -> None:
    """Remove what processes of this machine that are gone left beside ``folder/name``."""
    before = f".{name[:100]}.{_host()}-"
    try:
        entries = [e for e in os.scandir(folder) if e.name.startswith(before)]
    except OSError:
        return  # the write itself will say what is wrong
    for entry in entries:
        number = entry.name.removeprefix(before).split("-")[0]
        if not number.isdigit() or _alive(int(number)):
            continue
        if entry.is_dir(follow_symlinks=False):
            shutil.rmtree(entry.path, ignore_errors=True)
        else:
            Path(entry.path).unlink(missing_ok=True)


def _alive(number: int) -> bool:
    """Whether a process has that id and has not ended; one that nobody waited for keeps its id, in some containers for
    ever."""
    with suppress(OSError, IndexError):
        if Path(f"/proc/{number}/stat").read_text(errors="replace").rpartition(")")[2].split()[0] in "ZX":
            return False
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask

"""Arrays in files from strangers: ``.npz`` and ``.npy`` of plain numbers, read within bounds.

``numpy.load`` believes what a header says: it allocates the shape that is claimed before it reads a byte, and raises
whatever zip, deflate and literal parsing raise. Here every size is checked against what the file really holds first.
"""

from __future__ import annotations

import io
import math
import os
import zipfile
from collections.abc import Collection
from pathlib import Path

import numpy as np

from taa_envs.errors import TaaEnvsError

MAX_BYTES = 256 << 20  # of an array file once unpacked
MAX_MEMBERS = 256
MAX_HEADER = 1024  # characters of an array's header; it is parsed as a Python literal, which deep nesting can break
MAX_DIMENSIONS = 8
KINDS = "biufUS"  # bool, integers, floats, text; no objects, records, dates or complex numbers


class ArrayFileError(TaaEnvsError):
    """A file of arrays cannot be used; the message says what is wrong with it."""


def read_npz(path: str | os.PathLike, names: Collection[str] | None = None, max_bytes: int = MAX_BYTES
             ) -> dict[str, np.ndarray]:
    """Arrays of an ``.npz`` file; new, writable, contiguous arrays.

    Args:
        path: the file.
        names: arrays to read, those that are there; None for all.
        max_bytes: that all members together may unpack to.

    Raises:
        ArrayFileError: it is not a zip archive of plain arrays, or larger than allowed.
        OSError: the file cannot be opened.
    """
    path = Path(path)
    arrays = {}
    with path.open("rb") as file:
        try:
            with zipfile.ZipFile(file) as archive:
                members = archive.infolist()
                if len(members) > MAX_MEMBERS:
                    raise ArrayFileError(f"{path} holds {len(members)} arrays, more than {MAX_MEMBERS}")
                if sum(m.file_size for m in members) > max_bytes:
                    raise ArrayFileError(f"{path} unpacks to more than {max_bytes >> 20} MiB")
                for member in members:
                    name = member.filename.removesuffix(".npy")
                    if names is None or name in names:
                        with archive.open(member) as packed:
                            # The directory may understate a size; no more than it says is ever unpacked.
                            arrays[name] = _array(packed.read(member.file_size + 1), f"{path}, array {name[:40]!r}")
        except ArrayFileError:
            raise
        except Exception as error:  # zipfile and zlib raise a dozen kinds for a broken archive, OSError for its offsets
            raise ArrayFileError(f"{path} is not an archive of plain arrays ({_brief(error)})") from None
    return arrays


def read_npy(path: str | os.PathLike, max_bytes: int = MAX_BYTES) -> np.ndarray:
    """The array of an ``.npy`` file; new, writable, contiguous.

    Raises:
        ArrayFileError: it does not hold one plain array, or is larger than allowed.
        OSError: the file cannot be read.
    """
    path = Path(path)
    if path.stat().st_size > max_bytes:
        raise ArrayFileError(f"{path} is larger than {max_bytes >> 20} MiB")
    return _array(path.read_bytes(), str(path))


def _array(raw: bytes, what: str) -> np.ndarray:
    """One array from the bytes of a ``.npy`` file."""
    stream = io.BytesIO(raw)
    try:
        version = np.lib.format.read_magic(stream)
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
        shape, by_columns, dtype = read(stream, max_header_size=MAX_HEADER)
    except Exception as error:  # the header is a Python literal: its parser raises what it likes
        raise ArrayFileError(f"{what} is not a plain array ({_brief(error)}); write plain arrays with numpy.savez"
                             ) from None
    if dtype.kind not in KINDS or dtype.hasobject or dtype.itemsize == 0:
        raise ArrayFileError(f"{what} is not one of plain arrays: it holds {str(dtype)[:40]}, not numbers")
    if len(shape) > MAX_DIMENSIONS or any(n < 0 for n in shape):
        raise ArrayFileError(f"{what} has an impossible shape")
    count, held = math.prod(shape), len(raw) - stream.tell()
    if count * dtype.itemsize != held:
        raise ArrayFileError(f"{what} claims {count} numbers and holds {held // dtype.itemsize}; it is cut off")
    values = np.frombuffer(raw, dtype, count, stream.tell())
    if dtype.kind == "b":  # a byte that is neither 0 nor 1 would count as both in places
        values = values.view(np.uint8) != 0
    if dtype.kind == "U" and (values.view(dtype.str[0] + "u4") > 0x10FFFF).any():
        raise ArrayFileError(f"{what} holds text that is not Unicode")
    values = values.reshape(shape, order="F" if by_columns else "C")
    return np.array(values, dtype=dtype.newbyteorder("="), order="C")


def _brief(error: Exception) -> str:
    return " ".join((str(error) or type(error).__name__).split())[:80]

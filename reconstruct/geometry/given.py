"""A mesh that somebody gave as a solid with convex parts, worked out in a process that can be ended.

Meshes of our own making are closed and simple. Others may be heaps of overlapping pieces, have holes or cut through
themselves, on which the decomposition can run for ever in native code that no exception stops. So the pieces are united
first, or the surface is wrapped where they are no solids (:mod:`reconstruct.geometry.closing`); and where the union
still brings no answer in time, it is wrapped after all.
"""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reconstruct.errors import TaaError
from reconstruct.geometry.collision import MAX_PARTS, Part, convex_parts
from taa_envs.arrays import read_npz

SECONDS = 240.0
FIRST_SHARE = 0.5
"""Of the time, for the exact union; the rest is for the wrapped surface."""
CLOCK = 5.0
"""A limit in processor seconds is one of this many seconds by the clock: a busy machine is no reason to refuse."""
COARSE, COARSER = 2e-3, 5e-3
"""Detail, in parts of the mesh's diagonal, that collision parts do without: the decomposition's time grows with it.
The second is for the wrapped surface, which stands off by more than that."""
LOOSER = 0.1
"""Threshold of the decomposition for the wrapped surface: a thin shell cut to twice that in at most
:data:`~reconstruct.geometry.collision.MAX_PARTS` parts is filled no more (measured on an oven's: volume 2.3 times the
shell's either way) and takes half the time."""


@dataclass(frozen=True)
class GivenSolid:
    """A given mesh made solid.

    Attributes:
        vertices: (V, 3).  faces: (F, 3) of the closed surface.
        parts: convex collision parts, each (vertices (v, 3), faces (f, 3)).
        pieces: connected closed pieces that were united.
        wrapped: the surface was not closed, or cut through itself, and a coarse one was put round it.
    """

    vertices: np.ndarray
    faces: np.ndarray
    parts: tuple[Part, ...]
    pieces: int
    wrapped: bool


def bounded_solid(vertices: np.ndarray, faces: np.ndarray, seconds: float = SECONDS) -> GivenSolid:
    """Closed surface and convex parts (see :func:`reconstruct.geometry.collision.convex_parts`) of any mesh.

    Args:
        vertices, faces: (V, 3) finite, (F, 3) within the vertices.
        seconds: of processor time after which to give up.

    Raises:
        TaaError: there is no answer in that time, or none at all.
    """
    with tempfile.TemporaryDirectory(prefix="taa-parts-") as folder:
        asked, answer = Path(folder) / "mesh.npz", Path(folder) / "parts.npz"
        np.savez(asked, vertices=vertices, faces=faces)
        why = _ask(asked, answer, False, FIRST_SHARE * seconds)
        if why:
            why = _ask(asked, answer, True, (1 - FIRST_SHARE) * seconds)
        if why:
            raise TaaError(f"the mesh {why}; give a closed surface that does not cut through itself")
        arrays = read_npz(answer)
    count = sum(name.startswith("part_v") for name in arrays)
    parts = tuple((arrays[f"part_v{i}"], arrays[f"part_f{i}"]) for i in range(count))
    return GivenSolid(arrays["vertices"], arrays["faces"], parts, int(arrays["pieces"]), bool(arrays["wrapped"]))


def _ask(asked: Path, answer: Path, wrapped: bool, seconds: float) -> str:
    """Run :func:`main` in a process of its own; "" when it answered, else why not."""
    try:
        done = subprocess.run(
            [sys.executable, "-m", __name__, str(asked), str(answer), "wrap" if wrapped else "unite", f"{seconds:g}"],
            capture_output=True,
            text=True,
            errors="replace",
            timeout=max(CLOCK * seconds, 0.01),
            cwd=Path(__file__).resolve().parents[2],
        )
    except subprocess.TimeoutExpired:
        return "was not cut into convex parts in time"
    if done.returncode < 0 and -done.returncode == getattr(signal, "SIGXCPU", None):
        return "was not cut into convex parts in time"
    if done.returncode or not answer.is_file():
        last = (done.stderr.strip().splitlines() or ["it ended without a word"])[-1][:120]
        return f"cannot be cut into convex parts ({last})"
    return ""


def nearest_colours(points: np.ndarray, vertices: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """(n, 4) colours of the vertices (V, 3) nearest to points (n, 3)."""
    from scipy.spatial import cKDTree

    return colours[cKDTree(vertices).query(points)[1]]


def make_solid(vertices: np.ndarray, faces: np.ndarray, wrapped: bool) -> GivenSolid:
    """As :func:`bounded_solid`, here and now.

    Args:
        wrapped: do not try the union.
    """
    from reconstruct.geometry.closing import unite, wrap
    from reconstruct.geometry.solids import from_arrays, to_arrays

    union = None if wrapped else unite(vertices, faces)
    if union is not None and union.convex and len(union.pieces) <= MAX_PARTS:
        return GivenSolid(union.vertices, union.faces, union.pieces, len(union.pieces), False)
    closed = (union.vertices, union.faces) if union is not None else wrap(vertices, faces)
    detail = COARSER if union is None else COARSE
    coarse = from_arrays(*closed).simplify(detail * float(np.linalg.norm(np.ptp(closed[0], axis=0))))
    parts, _ = convex_parts(*to_arrays(coarse), **({"concavity": LOOSER} if union is None else {}))
    return GivenSolid(*closed, parts, len(union.pieces) if union is not None else 1, union is None)


def main(asked: str, answer: str, how: str, seconds: str) -> None:
    with contextlib.suppress(ImportError):  # not everywhere; the caller's clock runs anyway
        import resource

        limit = max(1, int(np.ceil(float(seconds))))
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
    given = read_npz(Path(asked))
    solid = make_solid(given["vertices"], given["faces"], how == "wrap")
    parts = {f"part_{k}{i}": value for i, part in enumerate(solid.parts) for k, value in zip("vf", part, strict=True)}
    np.savez(answer, vertices=solid.vertices, faces=solid.faces, pieces=solid.pieces, wrapped=solid.wrapped,
             **parts)  # fmt: skip


if __name__ == "__main__":
    main(*sys.argv[1:])

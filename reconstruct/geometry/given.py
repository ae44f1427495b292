"""Convex parts of a mesh that somebody gave, in a process that can be ended.

Meshes of our own making are closed and simple. Others may cut through themselves, on which the decomposition can run
for ever in native code that no exception stops.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from reconstruct.errors import TaaError
from reconstruct.geometry.collision import Part, convex_parts
from taa_envs.arrays import read_npz

SECONDS = 120.0


def bounded_parts(vertices: np.ndarray, faces: np.ndarray, seconds: float = SECONDS) -> tuple[Part, ...]:
    """Convex parts (see :func:`reconstruct.geometry.collision.convex_parts`) of any mesh.

    Args:
        vertices, faces: (V, 3) finite, (F, 3) within the vertices.
        seconds: after which to give up.

    Raises:
        TaaError: there is no answer in that time, or none at all.
    """
    with tempfile.TemporaryDirectory(prefix="taa-parts-") as folder:
        asked, answer = Path(folder) / "mesh.npz", Path(folder) / "parts.npz"
        np.savez(asked, vertices=vertices, faces=faces)
        try:
            done = subprocess.run(
                [sys.executable, "-m", __name__, str(asked), str(answer)],
                capture_output=True,
                text=True,
                errors="replace",
                timeout=seconds,
                cwd=Path(__file__).resolve().parents[2],
            )
        except subprocess.TimeoutExpired:
            raise TaaError(
                f"the mesh was not cut into convex parts within {seconds:.0f} s; give a closed surface that "
                "does not cut through itself"
            ) from None
        if done.returncode or not answer.is_file():
            why = (done.stderr.strip().splitlines() or ["it ended without a word"])[-1][:120]
            raise TaaError(
                f"the mesh cannot be cut into convex parts ({why}); give a closed surface that does not cut "
                "through itself"
            )
        arrays = read_npz(answer)
    return tuple((arrays[f"v{i}"], arrays[f"f{i}"]) for i in range(len(arrays) // 2))


def main(asked: str, answer: str) -> None:
    given = read_npz(asked)
    parts, _ = convex_parts(given["vertices"], given["faces"])
    np.savez(answer, **{f"{k}{i}": value for i, part in enumerate(parts) for k, value in zip("vf", part, strict=True)})


if __name__ == "__main__":
    main(*sys.argv[1:])

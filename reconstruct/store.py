"""Stage results on disk: dataclasses of plain arrays as one ``.npz``, and the keys that say when one is still valid.

Nothing is pickled. A stage's key covers all it depends on: the video, the options, the keys of the stages
before it, and the source files of the code that made it; a result is used again only if its key is the same.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from taa_envs.arrays import read_npz
from taa_envs.files import written_whole

SCHEMA = 1
MAX_STAGE_BYTES = 8 << 30
ROOT = Path(__file__).resolve().parent


def _known() -> dict[str, type]:
    from reconstruct import cues
    from reconstruct.geometry import Geometry, LinkMesh, Skin
    from reconstruct.joint.models import JointFit
    from reconstruct.motion import CameraMotion

    types = (cues.ProviderInfo, cues.HandTrack, cues.Hands, cues.Tracks, cues.LinkMasks, cues.HandReference, JointFit,
             LinkMesh, Skin, Geometry, CameraMotion)  # fmt: skip
    return {t.__name__: t for t in types}


def pack(value: Any) -> tuple[Any, dict[str, np.ndarray]]:
    """A JSON tree and the arrays it names, from dataclasses, mappings, sequences, arrays and scalars."""
    arrays: dict[str, np.ndarray] = {}

    def walk(v: Any) -> Any:
        if dataclasses.is_dataclass(v) and not isinstance(v, type):
            fields = {f.name: walk(getattr(v, f.name)) for f in dataclasses.fields(v)}
            return {"dataclass": type(v).__name__, "fields": fields}
        if isinstance(v, np.ndarray):
            if v.dtype == object:
                raise TypeError("an array of objects cannot be stored")
            name = f"a{len(arrays)}"
            if v.dtype == bool and v.size > 4096:
                arrays[name] = np.packbits(v.reshape(-1))
                return {"bits": name, "shape": list(v.shape)}
            arrays[name] = v
            return {"array": name}
        if isinstance(v, np.generic):
            return walk(v.item())
        if isinstance(v, Mapping):
            return {"map": {str(k): walk(x) for k, x in v.items()}}
        if isinstance(v, (list, tuple)):
            return {"tuple" if isinstance(v, tuple) else "list": [walk(x) for x in v]}
        if v is None or isinstance(v, (str, int, float, bool)):
            return {"value": v}
        raise TypeError(f"cannot store a {type(v).__name__}")

    return walk(value), arrays


def unpack(tree: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """The inverse of :func:`pack`; fields that a dataclass no longer has raise TypeError."""
    known = _known()

    def walk(t: dict) -> Any:
        if "dataclass" in t:
            return known[t["dataclass"]](**{name: walk(x) for name, x in t["fields"].items()})
        if "bits" in t:
            count = int(np.prod(t["shape"]))
            return np.unpackbits(arrays[t["bits"]], count=count).astype(bool).reshape(t["shape"])
        if "array" in t:
            return arrays[t["array"]]
        if "map" in t:
            return {k: walk(x) for k, x in t["map"].items()}
        if "tuple" in t:
            return tuple(walk(x) for x in t["tuple"])
        if "list" in t:
            return [walk(x) for x in t["list"]]
        return t["value"]

    return walk(tree)


def save_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Compressed ``.npz``, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as partial, partial.open("wb") as f:
        np.savez_compressed(f, **arrays)


def save_stage(path: Path, key: str, value: Any) -> None:
    """Write one stage's result with its key."""
    tree, arrays = pack(value)
    head = json.dumps({"schema": SCHEMA, "key": key, "tree": tree})
    save_npz(path, {**arrays, "head": np.frombuffer(head.encode(), np.uint8)})


def load_stage(path: Path, key: str | None) -> Any | None:
    """The stored result if it is there, readable and made under the same key (None: any key), else None."""
    try:
        head = json.loads(read_npz(path, ("head",), MAX_STAGE_BYTES)["head"].tobytes())
        if head["schema"] != SCHEMA or key not in (None, head["key"]):
            return None
        return unpack(head["tree"], read_npz(path, max_bytes=MAX_STAGE_BYTES))
    except Exception:  # whatever is wrong with a kept result, it is made again
        return None


@cache
def code_digest(*parts: str) -> str:
    """Digest of source files: names of modules or packages relative to ``reconstruct`` ("joint", "video.py")."""
    digest = hashlib.sha256()
    for part in parts:
        place = ROOT / part
        for file in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(file.relative_to(ROOT).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()


def stage_key(name: str, parts: Sequence[str], inputs: Mapping[str, Any]) -> str:
    """Digest of all that a stage's result depends on."""
    text = json.dumps([SCHEMA, name, code_digest("cues.py", *parts), inputs], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def file_digest(path: Path) -> str:
    """sha256 hex digest of a file."""
    with path.open("rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()

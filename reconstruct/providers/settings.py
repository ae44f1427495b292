"""``taa.toml``: where models are, and the environments of those that live in a repository of their own.

Read from ``$TAA_CONFIG``, else ``./taa.toml``, else the user's configuration folder; no file is needed.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from reconstruct.errors import TaaError

LIBRARY = {"model": str, "device": str, "dtype": str, "batch": int}
REPOSITORY = {"python": str, "repository": str, "checkpoint": str, "pipeline": str, "timeout": (int, float),
              "args": list}  # fmt: skip
SECTIONS: dict[str, dict[str, Any]] = {
    "sam3": {**LIBRARY, "moving": str, "static": str, "hand": str},
    "sam2": LIBRARY,
    "da3": {**LIBRARY, "process_res": int},
    "depth-anything-v2": LIBRARY,
    "moge": LIBRARY,
    "dinov2": LIBRARY,
    "cotracker3": LIBRARY,
    "trackcraft3r": {**REPOSITORY, "frames": int},
    "sam3d": REPOSITORY,
    "segvigen": REPOSITORY,
    "hawor": REPOSITORY,
    "wilor": REPOSITORY,
    "released": {"repository": str},
}
"""Sections and the types of their keys."""


@dataclass(frozen=True)
class Settings:
    """The file's sections; empty where there is no file.

    Attributes:
        path: the file, or None.  sections: name -> keys.
    """

    path: Path | None = None
    sections: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def section(self, name: str) -> Mapping[str, Any]:
        """Keys of one section, {} where it is missing."""
        return self.sections.get(name, {})

    @property
    def where(self) -> str:
        return str(self.path) if self.path else "taa.toml"


def settings_file() -> Path | None:
    """The file that counts, or None where there is none.

    Raises:
        TaaError: ``$TAA_CONFIG`` names a file that is not there.
    """
    import platformdirs

    if named := os.environ.get("TAA_CONFIG"):
        if not Path(named).is_file():
            raise TaaError(f"TAA_CONFIG names {named}, which is no file; correct or unset it")
        return Path(named)
    for path in (Path("taa.toml"), platformdirs.user_config_path("taa-envs") / "taa.toml"):
        if path.is_file():
            return path
    return None


def load_settings(path: Path | None = None) -> Settings:
    """Read and check the settings.

    Args:
        path: a file; found as the module says when None.

    Raises:
        TaaError: not TOML, an unknown section or key, or a value of the wrong type.
    """
    path = path or settings_file()
    if path is None:
        return Settings()
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise TaaError(f"cannot read {path} ({error}); it must be TOML") from None
    for name, keys in data.items():
        if name not in SECTIONS or not isinstance(keys, dict):
            raise TaaError(f"{path} has no use for {name!r}; its sections are {', '.join(SECTIONS)}")
        for key, value in keys.items():
            kind = SECTIONS[name].get(key)
            if kind is None:
                raise TaaError(f"{path}: [{name}] has no key {key!r}; known: {', '.join(SECTIONS[name])}")
            if not isinstance(value, kind) or isinstance(value, bool):
                wanted = getattr(kind, "__name__", "number")
                raise TaaError(f"{path}: {key} of [{name}] must be a {wanted}, not {value!r}")
    return Settings(path, data)

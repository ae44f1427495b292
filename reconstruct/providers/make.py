"""Running a chosen provider: its output becomes a cue file, as if a user had put it into the scene folder.

A provider is a function that takes a :class:`Request` and returns :class:`Made`. A cue file of the user's is never
replaced; one that the same provider made from the same inputs is used again.
"""

from __future__ import annotations

import hashlib
import importlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from reconstruct.cues import Hands, LinkMasks, ProviderInfo, Tracks
from reconstruct.cues_io import CueFolder
from reconstruct.errors import TaaError
from reconstruct.joint.models import JointFit
from reconstruct.providers.settings import Settings, load_settings
from reconstruct.providers.table import find, is_default
from reconstruct.store import code_digest
from reconstruct.video import Video


@dataclass(frozen=True)
class Request:
    """What a provider may look at.

    Attributes:
        video: (stabilised) working frames; every cue counts its frames and, in full px, its pixels.
        folder: the cues that are there already.
        work: folder for a provider's own files, kept with the scene.
        settings: ``taa.toml``.  chosen: stage -> provider of this run.
        seed: of everything that draws.  tell: called with the done share in [0, 1].
        hands, tracks, fit, masks: results of the stages before, or None.
    """

    video: Video
    folder: CueFolder
    work: Path
    settings: Settings = field(default_factory=Settings)
    chosen: Mapping[str, str] = field(default_factory=dict)
    seed: int = 0
    tell: Callable[[float], None] = lambda share: None
    hands: Hands | None = None
    tracks: Tracks | None = None
    fit: JointFit | None = None
    masks: LinkMasks | None = None

    def cue(self, name: str, why: str) -> dict[str, np.ndarray]:
        """A cue that the provider cannot do without.

        Args:
            name: of the cue.  why: "what needs it", for the error.

        Raises:
            TaaError: it is not there.
        """
        if name not in self.folder.given():
            options = {"camera": "--camera da3 or colmap", "depth": "--depth da3 or moge"}.get(name, "a provider of it")
            raise TaaError(f"{why} needs the cue {name}, which nobody made; choose {options}, or put "
                           f"{self.folder.path(name)} there")  # fmt: skip
        return self.folder.read(name)


@dataclass(frozen=True)
class Made:
    """What a provider made.

    Attributes:
        cues: name of the cue file ("depth", "tracks", "meshes/moving.glb") -> arrays, or the bytes of a mesh.
        version: of the provider, with the weights' name.
        licence: in place of the table's where it depends on the weights.
        notes: what a user should know.
    """

    cues: Mapping[str, Mapping[str, np.ndarray] | bytes]
    version: str
    licence: str | None = None
    notes: tuple[str, ...] = ()


_MODULES: dict[tuple[str, str], str] = {
    ("camera", "colmap"): "colmap:camera",
    ("camera", "da3"): "da3:camera",
    ("depth", "da3"): "da3:depth",
    ("depth", "depth-anything-v2"): "depth_anything:depth",
    ("depth", "moge"): "moge:depth",
    ("hand", "hawor"): "mano_hands:hawor",
    ("hand", "wilor"): "mano_hands:wilor",
    ("track", "xfeat"): "xfeat:tracks",
    ("track", "cotracker3"): "cotracker:tracks",
    ("track", "trackcraft3r"): "trackcraft:tracks",
    ("segment", "sam2"): "sam:sam2",
    ("segment", "sam3"): "sam:sam3",
    ("mesh", "sam3d"): "sam3d:meshes",
}
"""(stage, provider) -> module:function of this package; loaded when used, so that a package that a provider needs
is imported only then."""


def maker_of(stage: str, name: str) -> Callable[[Request], Made]:
    """The function of a provider."""
    module, function = _MODULES[stage, name].split(":")
    return getattr(importlib.import_module(f"reconstruct.providers.{module}"), function)


def provide(stage: str, cue: str, request: Request) -> tuple[str, ...]:
    """Let the chosen provider of a stage make its cue, unless the user's or a fresh one is there.

    Args:
        stage: "depth", "track", ...  cue: name of the first cue file that the stage makes.
        request: inputs; ``request.chosen`` says which provider.

    Returns:
        Notes of the provider; () for the embedded default, which the pipeline runs itself.

    Raises:
        TaaError: the provider failed, or lacks something; one line.
    """
    name = request.chosen.get(stage)
    if name is None or is_default(stage, name):
        return ()
    if request.folder.users(cue):
        return (f"cues/{cue} is yours; the {stage} provider {name} was not run",)
    key = _key(stage, name, request)
    if request.folder.fresh(cue, key):
        return ()
    provider = find(stage, name)
    request.work.mkdir(parents=True, exist_ok=True)
    made = maker_of(stage, name)(request)
    if cue not in made.cues:
        raise TaaError(f"the {stage} provider {name} made no {cue}; report it")
    info = ProviderInfo(name, made.version, made.licence or provider.licence, stage)
    for part, content in made.cues.items():
        if not request.folder.users(part):
            request.folder.put(part, content, replace(info, stage=stage), key)
    return made.notes


def _key(stage: str, name: str, request: Request) -> str:
    """Digest of all that a provider's output depends on."""
    given = request.folder.given()
    own = {"depth": ("depth", "camera"), "camera": ("camera",), "track": ("tracks",), "hand": ("hand",),
           "segment": ("masks",), "mesh": ("meshes/static.glb", "meshes/moving.glb")}[stage]  # fmt: skip
    before = {n: d for n, d in given.items() if n not in own}
    pieces: list[Any] = [stage, name, request.video.sha256, list(request.video.frames.shape), request.seed,
                         dict(request.settings.section(name)), before, code_digest("providers")]  # fmt: skip
    for part in (request.hands, request.tracks, request.fit, request.masks):
        pieces.append(_digest(part))
    return hashlib.sha256(json.dumps(pieces, sort_keys=True, default=str).encode()).hexdigest()


def _digest(value: Any) -> str:
    from reconstruct.store import pack

    if value is None:
        return ""
    tree, arrays = pack(value)
    digest = hashlib.sha256(json.dumps(tree, sort_keys=True).encode())
    for name in sorted(arrays):
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def request_for(video: Video, scene: Path, chosen: Mapping[str, str], seed: int = 0,
                tell: Callable[[float], None] | None = None) -> Request:  # fmt: skip
    """A request with nothing but the video and the cues that are there."""
    return Request(video, CueFolder(scene, chosen), Path(scene) / "providers", load_settings(), dict(chosen), seed,
                   tell or (lambda share: None))  # fmt: skip

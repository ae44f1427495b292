"""Which providers there are for each cue, and whether they can run here."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass

from reconstruct.errors import TaaError


@dataclass(frozen=True)
class Provider:
    """One provider: the Python modules it needs, what else a user should know, and its licence."""

    name: str
    needs: tuple[str, ...]
    note: str
    licence: str


PROVIDERS: dict[str, tuple[Provider, ...]] = {
    "camera": (Provider("homography", ("cv2",), "hand-held drift by homographies to the first view", "Apache-2.0"),),
    "hand": (
        Provider("mediapipe", ("ai_edge_litert", "cv2"), "weights are fetched once through pip at first use",
                 "Apache-2.0"),
    ),
    "track": (Provider("lucas-kanade", ("cv2",), "corners from many reference frames, both directions", "Apache-2.0"),),
    "segment": (Provider("grabcut", ("cv2",), "link masks from tracks and the uncovered background", "Apache-2.0"),),
    "depth": (Provider("none", (), "no depth network is embedded; the joint is fitted without depth", "-"),),
    "mesh": (Provider("outline", ("trimesh", "coacd", "manifold3d"), "planar patches and outlines", "Apache-2.0"),),
}  # fmt: skip


def missing_module(provider: Provider) -> str | None:
    """The first module that the provider needs and that is not installed."""
    return next((m for m in provider.needs if importlib.util.find_spec(m) is None), None)


def choose(wanted: Mapping[str, str] | None) -> dict[str, str]:
    """One provider for each cue: the wanted one, else the first.

    Raises:
        TaaError: no such cue or provider, or it cannot run here.
    """
    chosen = {cue: options[0].name for cue, options in PROVIDERS.items()}
    for cue, name in (wanted or {}).items():
        if cue not in PROVIDERS:
            raise TaaError(f"no cue is named {cue!r}; known: {', '.join(PROVIDERS)}")
        known = {p.name: p for p in PROVIDERS[cue]}
        if name not in known:
            raise TaaError(f"no {cue} provider is named {name!r}; known: {', '.join(known)}")
        chosen[cue] = name
    for cue, name in chosen.items():
        provider = next(p for p in PROVIDERS[cue] if p.name == name)
        if lacking := missing_module(provider):
            raise TaaError(f"the {cue} provider {name} needs the Python module {lacking}; install taa-envs whole")
    return chosen


def states() -> list[dict]:
    """{"cue", "name", "runs", "why", "licence"} of every provider, for ``taa doctor``."""
    rows = []
    for cue, options in PROVIDERS.items():
        for p in options:
            lacking = missing_module(p)
            why = f"the Python module {lacking} is not installed" if lacking else p.note
            rows.append({"cue": cue, "name": p.name, "runs": lacking is None, "why": why, "licence": p.licence})
    return rows

"""Refined demonstrations beside the ones they correct: written, found again, never mixed up.

``reference.npz`` of an asset is the demonstration and stays as it was reconstructed. ``taa replay --refine`` adds
``refined-<hand>.npz`` (the same arrays, other ``hand_joints``) and ``refined-<hand>.json`` (by how much what was
moved, within which stated uncertainty, what the replay made of it before and after).
"""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from taa_envs.asset import Asset, AssetError, _read_reference
from taa_envs.files import folder_written_whole, written_whole

if TYPE_CHECKING:
    from taa_envs.refine import Refinement

REFERENCES = ("demonstration", "refined")


def _digest(asset: Asset) -> str:
    return hashlib.sha256((asset.path / "reference.npz").read_bytes()).hexdigest()


def write_refinement(asset: Asset, found: Refinement, out: Path | None = None) -> Path:
    """Keep a refinement beside the demonstration that it corrects, as ``refined-<hand>.npz`` and ``.json``.

    ``reference.npz`` is not touched. With ``out`` the asset is copied to ``out/<id>`` first, replacing an asset there.

    Returns:
        The asset's folder that holds it.
    """
    record = {**found.as_dict(), "of_reference_sha256": _digest(asset),
              "note": "hand_joints of reference.npz within the stated uncertainty of the hand; the joint stays passive"}
    r = found.reference

    def put(folder: Path) -> None:
        stem = f"refined-{found.hand}"
        with written_whole(folder / f"{stem}.npz") as partial, partial.open("wb") as file:
            np.savez_compressed(file, time=r.time, q=r.q, hand_joints=r.hand_joints, hand_valid=r.hand_valid,
                                contact=r.contact)
        with written_whole(folder / f"{stem}.json") as partial:
            partial.write_text(json.dumps(record, indent=1, allow_nan=False), encoding="utf-8")

    if out is None:
        put(asset.path)
        return asset.path
    with folder_written_whole(out / asset.id, True) as work:
        shutil.copytree(asset.path, work, dirs_exist_ok=True)
        put(work)
    return out / asset.id


def with_reference(asset: Asset, name: str, hand: str) -> Asset:
    """The asset with one of :data:`REFERENCES`: its ``demonstration``, or what was ``refined`` for that hand.

    Raises:
        ValueError: no reference has that name.
        AssetError: nothing was refined for that hand, or from another demonstration.
    """
    if name not in REFERENCES:
        raise ValueError(f"no reference is named {name!r}; known: {', '.join(REFERENCES)}")
    if name == "demonstration":
        return asset
    file = asset.path / f"refined-{hand}.npz"
    how = f"run: taa replay {asset.id} --hand {hand} --refine"
    if file.is_symlink() or not file.is_file():
        raise AssetError(f"{asset.id} has no refined reference for the hand {hand}; {how}")
    try:
        record = json.loads(file.with_suffix(".json").read_bytes())
        same = record["of_reference_sha256"] == _digest(asset)
    except (OSError, ValueError, KeyError, TypeError):
        same = False
    if not same:
        raise AssetError(f"{file} was not refined from this demonstration; {how}")
    reference = replace(_read_reference(file, 0), further=asset.reference.further)
    if len(reference.time) != len(asset.reference.time):
        raise AssetError(f"{file} has {len(reference.time)} frames, the demonstration {len(asset.reference.time)}; "
                         f"{how}")
    return replace(asset, reference=reference)

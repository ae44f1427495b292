"""A new revision of an asset from a diagnosis; the old one stays as it is.

The revision is an asset of its own, ``<id>-r2`` (then ``-r3``), beside the old one, so that both can be made and
compared. What was fitted replaces what was assumed: value, standard deviation and origin in ``asset.json``, which is
what domain randomisation draws from.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from taa_envs.asset import Asset, load_asset
from taa_envs.errors import TaaEnvsError
from taa_envs.files import folder_written_whole

if TYPE_CHECKING:
    from diagnose.diagnosis import Diagnosis


def next_id(asset_id: str, taken: set[str]) -> str:
    """The id of an asset's next revision."""
    stem, number = re.fullmatch(r"(.*?)(?:-r(\d+))?", asset_id).groups()  # type: ignore[union-attr]
    k = int(number or 1) + 1
    while f"{stem}-r{k}" in taken:
        k += 1
    return f"{stem[: 63 - len(str(k)) - 2]}-r{k}"


def revise(asset: Asset, result: Diagnosis, root: Path | None = None) -> Asset:
    """Write the next revision of an asset with the extended model.

    Args:
        root: folder of assets; default the old one's, or the user's where that cannot be written.

    Raises:
        TaaEnvsError: nothing was found that changes the model.
    """
    from taa_envs.registry import find_assets, user_folder

    if not result.extends:
        raise TaaEnvsError(f"nothing was found that changes the model of {asset.id}; there is no new revision to write")
    if root is None:
        root = asset.path.parent if os.access(asset.path.parent, os.W_OK) else user_folder()
    taken = set(find_assets()) | {p.name for p in Path(root).glob("*") if p.is_dir()}
    new_id = next_id(asset.id, taken)
    with folder_written_whole(Path(root) / new_id) as work:
        shutil.copytree(asset.path, work, dirs_exist_ok=True)
        spec = result.extended_spec()
        spec.modelname = new_id
        (work / "model.xml").write_text(spec.to_xml(), encoding="utf-8")
        model = mujoco.MjModel.from_xml_path(str(work / "model.xml"))
        data = json.loads((work / "asset.json").read_text(encoding="utf-8"))
        data["id"] = new_id
        data["provenance"] |= entries(result, model)
        if result.placed is not None:
            best = result.placed.found.best
            if "axis_misalignment" in result.placed.causes:
                data["joint"]["axis"] = best.axis.tolist()
            if "pivot_offset" in result.placed.causes:
                data["joint"]["point"] = best.anchor.tolist()
        data["diagnosis"] = {
            "revision_of": asset.id, "verdict": result.verdict, "causes": result.data["causes"],
            "heldout_rmse": {k: result.data[k]["heldout_rmse"] for k in ("nominal", "extended")},
            "logs": result.data["episodes"], "assumptions": result.data["assumptions"]}  # fmt: skip
        data.setdefault("notes", []).append(f"revision of {asset.id} by a diagnosis ({result.verdict})")
        (work / "asset.json").write_text(json.dumps(data, indent=1, allow_nan=False), encoding="utf-8")
        load_asset(work)
    return load_asset(Path(root) / new_id)


def entries(result: Diagnosis, model: mujoco.MjModel) -> dict[str, dict]:
    """Provenance of all numbers that the diagnosis fitted, as ``asset.json`` holds them.

    The joint's own numbers have the names that domain randomisation draws by; those of other causes (catches, stops,
    weights) are ``diagnosis.<cause>.<parameter>``. Standard deviations are a quarter of the reported intervals, which
    are wider than the fit's own where something is left unexplained.
    """
    std = result.found.best.fit.std()
    reported = {c["name"]: c["parameters"] for c in result.data["causes"] if c["parameters"]}
    if not reported and result.data["causes"]:  # unexplained: what explains part of it is under the evidence
        reported = result.data["causes"][0]["evidence"].get("parameters", {})
    per_inertia = any("ratios to the inertia" in a for a in result.data["assumptions"])
    note = "fitted to measured motion" + (", as a ratio to the inertia: the inertia itself is as before"
                                          if per_inertia else "")  # fmt: skip
    unit = result.plant.unit
    joint = model.joint(result.plant.joint)
    numbers = {
        "joint.damping": ("damping", float(joint.damping[0]), f"{result.plant.torque_unit} s/{unit}"),
        "joint.frictionloss": ("coulomb", float(joint.frictionloss[0]), result.plant.torque_unit),
        "joint.stiffness": ("stiffness", float(joint.stiffness[0]), f"{result.plant.torque_unit}/{unit}"),
        "joint.armature": ("inertia", float(joint.armature[0]), "kg m2" if result.plant.hinge else "kg"),
    }
    out: dict[str, dict] = {}
    for cause, parameters in reported.items():
        for name, p in parameters.items():
            out[f"diagnosis.{cause}.{name}"] = {
                "value": p["value"], "unit": p["unit"], "origin": "fitted", "std": _std(p), "note": note}  # fmt: skip
    if "rest" in reported.get("spring", {}):
        rest = reported["spring"]["rest"]
        out["joint.springref"] = {
            "value": float(model.qpos_spring[joint.qposadr[0]]), "unit": unit, "origin": "fitted", "std": _std(rest),
            "note": note}  # fmt: skip
    if result.placed is not None:
        best = result.placed.found.best
        if "axis_misalignment" in result.placed.causes:
            out["joint.axis"] = {
                "value": best.axis.tolist(), "unit": "1", "origin": "fitted", "note": "std: angle, rad",
                "std": float(np.sqrt(np.trace(best.cov[:2, :2])))}  # fmt: skip
        if "pivot_offset" in result.placed.causes:
            out["joint.point"] = {"value": best.anchor.tolist(), "unit": "m", "origin": "fitted",
                                  "std": float(np.sqrt(np.trace(best.cov[2:, 2:]))), "note": note}  # fmt: skip
    for key, (term, value, words) in numbers.items():
        if term in std and np.isfinite(std[term]):
            out[key] = {"value": value, "unit": words, "origin": "fitted", "std": float(std[term]), "note": note}
    return out


def _std(parameter: dict) -> float:
    """Standard deviation that a reported 95 % interval stands for."""
    low, high = parameter["ci95"]
    return float((high - low) / 3.92)

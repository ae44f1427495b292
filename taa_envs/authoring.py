"""From meshes and a joint to an asset folder, written whole or not at all."""

from __future__ import annotations

import importlib.metadata
import itertools
import json
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from taa_envs.asset import (
    SCHEMA,
    Asset,
    AssetError,
    AssetExists,
    Reference,
    check_id,
    demonstration,
    load_asset,
)
from taa_envs.checks import numbered
from taa_envs.errors import GateFailed
from taa_envs.files import folder_written_whole
from taa_envs.gate import examine
from taa_envs.mechanism import DENSITY, FurtherLink, Moving, prepare, typical_speed
from taa_envs.surface import Link, write_convex_part, write_textured_obj

if TYPE_CHECKING:
    import mujoco


def _plain(value: object) -> Any:
    """JSON-ready copy: arrays to lists, numbers that are not finite to None."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, (str, int, float)) or value is None:
        return value
    raise AssetError(f"cannot write a {type(value).__name__} into asset.json")


def _write_model(folder: Path, asset_id: str, static: Link, moving: Sequence[Moving]) -> list[str]:
    """``model.xml`` and ``meshes/``; returns notes."""
    import mujoco

    notes: list[str] = []
    (folder / "meshes").mkdir()
    spec = mujoco.MjSpec()
    spec.modelname = asset_id
    spec.modelfiledir = str(folder)
    spec.compiler.degree = False
    spec.compiler.inertiafromgeom = int(mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE)
    spec.meshdir = spec.texturedir = "meshes"
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    notes += _write_link(spec, folder, "static", static, None)
    for one in moving:
        name = numbered("moving", one.number)
        notes += _write_link(spec, folder, name, one.link, one)
        if not any(g.name.startswith(f"{name}_part") for g in spec.geoms):
            raise AssetError(f"the {name} link has no solid collision part; a hand could not touch it")
    names = ["static", *(numbered("moving", one.number) for one in moving)]
    for k, other in enumerate(names):
        for name in names[k + 1:]:
            spec.add_exclude(name="links" if (other, name) == ("static", "moving") else f"{other}_{name}",
                             bodyname1=other, bodyname2=name)
    try:
        spec.compile()
    except ValueError as error:
        raise AssetError(f"MuJoCo does not accept the model: {str(error)[:200]}") from None
    (folder / "model.xml").write_text(spec.to_xml(), encoding="utf-8")
    return notes


def _write_link(spec: mujoco.MjSpec, folder: Path, name: str, link: Link, moving: Moving | None) -> list[str]:
    """One link's body, joint, surface and collision parts; returns notes."""
    import mujoco

    notes: list[str] = []
    body = spec.worldbody.add_body(name=name)
    if moving is not None:
        moving.add_joint(spec, body)
    write_textured_obj(folder / "meshes", name, link)
    spec.add_mesh(name=name, file=f"{name}.obj", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, file=f"{name}.png")
    material = spec.add_material(name=name, specular=0.1, shininess=0.2)
    textures = list(material.textures)
    textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = texture.name
    material.textures = textures
    body.add_geom(name=f"{name}_visual", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name,
                  contype=0, conaffinity=0, group=2, mass=0)
    for i, part in enumerate(link.parts):
        part_name = f"{name}_part{i}"
        if not write_convex_part(folder / "meshes" / f"{part_name}.obj", part):
            notes.append(f"collision part {i} of the {name} link is flat and was left out")
            continue
        spec.add_mesh(name=part_name, file=f"{part_name}.obj", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        body.add_geom(name=part_name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=part_name, group=3, mass=0,
                      rgba=[0.3, 0.7, 0.4, 0.5])
    return notes


def save_asset(root: str | os.PathLike, asset_id: str, *, joint: Mapping, static: Link, moving: Link,
               reference: object, joint_range: tuple[float, float] | None = None, joint_origin: str = "fitted",
               mass: float | None = None, density: float = DENSITY, damping: float | None = None,
               frictionloss: float | None = None, camera: Mapping | None = None, provenance: Mapping | None = None,
               source: Mapping | None = None, providers: Sequence[Mapping] = (), notes: Sequence[str] = (),
               files: Mapping[str, bytes | str | os.PathLike] | None = None, overwrite: bool = False,
               gate: bool = True, further: Sequence[FurtherLink] = ()) -> Asset:
    """Write ``root/<asset_id>/``: model, meshes, reference and ``asset.json``; atomic.

    Before the folder takes its name it passes :mod:`taa_envs.gate`; what the gate found is in ``asset.json``.

    All is written into a hidden sibling folder that is loaded back and then renamed, so a crash or a full disk leaves
    nothing under the final name.

    Args:
        root: folder of assets; made if missing.
        asset_id: ``[a-z0-9][a-z0-9_-]{0,63}``.
        joint: the joint result of the contract: at least type, axis, point (revolute).
        static, moving: links at q = 0 in the asset frame, each with vertices (V, 3) m, faces (F, 3), colors (V, 4)
            uint8 and parts, a sequence of convex (vertices (v, 3), faces (f, 3)).
        reference: time, q, hand_joints, hand_valid, contact, as attributes or keys (see :class:`Reference`).
        joint_range: limits, rad or m; default the observed ends of the reference's q.
        joint_origin: where axis, point and q came from.
        mass: kg of the moving link; default its volume times ``density`` (kg/m3), both assumed.
        damping, frictionloss: of the joint; default :func:`passive_forces`, assumed.
        camera: K (3, 3) full px, T_camera_world (4, 4), width, height px: the video's camera, for rendering over it.
        provenance: further name -> {"value", "unit"?, "origin", "std"?} entries; they win over the ones made here.
        source: facts of the video, at least {"sha256"}.
        providers: {"name", "version", "licence"} of each that took part.
        files: further files: name -> bytes, or the path of a file to copy (preview.png, report.html).
        overwrite: replace an asset of that id.
        gate: False leaves the gate out, for a body that is to be looked at although it may not behave; ``asset.json``
            then says null under "gate".
        further: the other moving links of an object with several joints, ``moving_2`` with ``joint_2`` and so on.

    Raises:
        AssetExists: there is one and overwrite is False.
        AssetError: an argument is not valid, or the body does not pass the gate (GateFailed); nothing was written.
    """
    import mujoco

    check_id(asset_id)
    root = Path(root)
    final = root / asset_id
    if (final.exists() or final.is_symlink()) and not overwrite:
        raise AssetExists(f"{final} exists; choose another id or overwrite it")
    ref = Reference.from_arrays(reference, [link.q for link in further])
    demo = demonstration(ref.q)
    end = demo["demo_end_frame"] + 1
    demo["duration"] = float(ref.time[end - 1] - ref.time[0])
    if mass is not None and not (math.isfinite(mass) and mass > 0):
        raise AssetError(f"mass must be positive, is {mass}")
    first = prepare(1, joint, moving, ref.q, typical_speed(ref.time[:end], ref.q[:end]), joint_range, joint_origin,
                    density, mass, damping, frictionloss)
    limits = first.limits
    slack = 1e-6 * (limits[1] - limits[0])
    if min(demo["q_start"], demo["q_demo_end"]) < limits[0] - slack or (
            max(demo["q_start"], demo["q_demo_end"]) > limits[1] + slack):
        raise AssetError(f"joint range {limits} does not hold the demonstration's start and end; widen it")
    more = [prepare(k, link.joint, link.link, q, typical_speed(ref.time, q), link.joint_range, joint_origin)
            for k, (link, q) in enumerate(zip(further, ref.further, strict=True), 2)]
    links = [first, *more]
    joints = {numbered("joint", m.number): {**given, "type": m.kind, "axis": m.axis,
                                            "point": None if m.kind == "prismatic" else m.point}
              for m, given in zip(links, [joint, *(link.joint for link in further)], strict=True)}
    made = {name: value for m in links for name, value in m.provenance.items()} | dict(provenance or {})
    names = ["static", *(numbered("moving", m.number) for m in links)]

    try:
        with folder_written_whole(final, overwrite) as folder:
            model_notes = _write_model(folder, asset_id, static, links)
            np.savez_compressed(folder / "reference.npz", **ref.arrays())
            document = {
                "schema": SCHEMA, "id": asset_id,
                **joints,
                "demo": demo, "camera": camera, "provenance": made,
                "collision": {"excluded_pairs": [list(pair) for pair in itertools.combinations(names, 2)],
                              "reason": "the joint's range is its stop; the links are made not to meet within it"},
                "source": source, "providers": list(providers), "mujoco_version": mujoco.__version__,
                "taa_envs_version": _own_version(), "notes": [*notes, *model_notes],
            }
            for name, content in (files or {}).items():
                if Path(name).name != name or name in ("asset.json", "model.xml", "reference.npz", "meshes"):
                    raise AssetError(f"cannot put a further file under the name {name!r}")
                if isinstance(content, bytes):
                    (folder / name).write_bytes(content)
                else:
                    shutil.copyfile(content, folder / name)
            document["gate"] = None
            _write_json(folder / "asset.json", document)
            made_asset = load_asset(folder)
            if gate:
                found = examine(made_asset)
                if not found.passed:
                    raise GateFailed(f"{asset_id} does not pass the gate: {found.failures[0]}")
                _write_json(folder / "asset.json", {**document, "gate": found.as_dict()})
    except FileExistsError:  # made by somebody else while we worked
        raise AssetExists(f"{final} exists; choose another id or overwrite it") from None
    return load_asset(final, check_model=False)


def _write_json(path: Path, document: Mapping) -> None:
    path.write_text(json.dumps(_plain(document), indent=1, allow_nan=False), encoding="utf-8")


def _own_version() -> str:
    try:
        return importlib.metadata.version("taa-envs")
    except importlib.metadata.PackageNotFoundError:
        return "source"

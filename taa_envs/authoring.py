"""From meshes and a joint to an asset folder, written whole or not at all."""

from __future__ import annotations

import importlib.metadata
import json
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taa_envs.asset import (
    JOINT_TYPES,
    SCHEMA,
    Asset,
    AssetError,
    AssetExists,
    Reference,
    check_id,
    demonstration,
    load_asset,
)
from taa_envs.files import folder_written_whole
from taa_envs.gate import examine
from taa_envs.surface import Link, link_inertia, write_convex_part, write_textured_obj

# A video carries no forces: these are assumptions, and asset.json says so.
DENSITY = 500.0  # kg/m3 of the closed surface: wood, or plastic and sheet with air between
DENSITY_STD = 500.0  # kg/m3, a factor of two: from hollow plastic and thin sheet (100) to oak and glass (1000)
STOP_TIME = 0.2  # s in which friction alone stops the link from the demonstration's speed
DAMPING_TIME = 0.1  # s, time constant of viscous decay
HAND_FORCE = (0.5, 8.0)  # N at the link's far end: least and most that friction, and as much that damping, may ask
ARMATURE_SHARE = 0.01  # of the link's inertia, for the solver's conditioning


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


def passive_forces(inertia: float, lever: float, speed: float) -> tuple[float, float]:
    """Damping and friction loss of a joint nobody measured.

    Scaled to the inertia about the joint so that the link stops soon after the hand does, and kept between forces
    that real mechanisms ask of a hand at the link's far end.

    Args:
        inertia: kg m2 (revolute) or kg (prismatic).
        lever: m from the axis to the link's far end; 1 for a prismatic joint.
        speed: typical speed of the demonstration, rad/s or m/s.

    Returns:
        damping (N m s/rad or N s/m) and frictionloss (N m or N).
    """
    low, high = HAND_FORCE[0] * lever, HAND_FORCE[1] * lever
    friction = float(np.clip(inertia * speed / STOP_TIME, low, high))
    damping = float(np.clip(inertia / DAMPING_TIME, low / speed, high / speed))
    return damping, friction


def _demo_speed(reference: Reference, end: int) -> float:
    rate = np.abs(np.diff(reference.q[:end + 1]) / np.diff(reference.time[:end + 1]))
    # The mean over the frames that move: peaks of a noisy q would ask for a far too sticky joint.
    moving = rate[rate > 0.1 * rate.max()]
    return float(max(moving.mean(), 1e-3))


def _joint_numbers(joint: Mapping) -> tuple[str, np.ndarray, np.ndarray]:
    kind = joint.get("type")
    if kind not in JOINT_TYPES:
        raise AssetError(f"joint type {kind!r} cannot be simulated as one passive joint; known: "
                         + ", ".join(JOINT_TYPES))
    axis = np.asarray(joint["axis"], float)
    point = np.zeros(3) if joint.get("point") is None else np.asarray(joint["point"], float)
    norm = float(np.linalg.norm(axis))
    if axis.shape != (3,) or point.shape != (3,) or not np.isfinite([*axis, *point]).all() or norm < 1e-9:
        raise AssetError("joint axis and point must be three finite numbers each")
    if kind == "revolute" and joint.get("point") is None:
        raise AssetError("a revolute joint needs a point on its axis")
    return kind, axis / norm, point


def _write_model(folder: Path, asset_id: str, links: Mapping[str, Link], kind: str, axis: np.ndarray,
                 point: np.ndarray, joint_range: tuple[float, float], numbers: Mapping[str, float],
                 inertial: tuple[float, np.ndarray, np.ndarray]) -> list[str]:
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
    for name, link in links.items():
        # The links keep the asset frame: at q = 0 the moving body's pose is the identity.
        body = spec.worldbody.add_body(name=name)
        if name == "moving":
            body.gravcomp = 1.0
            mass, centre, tensor = inertial
            body.mass, body.ipos = mass, centre
            body.fullinertia = [tensor[0, 0], tensor[1, 1], tensor[2, 2], tensor[0, 1], tensor[0, 2], tensor[1, 2]]
            body.explicitinertial = True
            hinge = kind == "revolute"
            body.add_joint(name="joint", type=mujoco.mjtJoint.mjJNT_HINGE if hinge else mujoco.mjtJoint.mjJNT_SLIDE,
                           axis=axis, pos=point if hinge else np.zeros(3), range=joint_range, limited=1,
                           damping=[numbers["damping"], 0, 0], frictionloss=numbers["frictionloss"],
                           armature=numbers["armature"],
                           # A hard stop: MuJoCo's default yields to a hand in proportion to the link's lightness.
                           solref_limit=[0.005, 1.0], solimp_limit=[0.99, 0.9999, 0.001, 0.5, 2.0])
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
    if not any(g.name.startswith("moving_part") for g in spec.geoms):
        raise AssetError("the moving link has no solid collision part; a hand could not touch it")
    spec.add_exclude(name="links", bodyname1="static", bodyname2="moving")
    try:
        spec.compile()
    except ValueError as error:
        raise AssetError(f"MuJoCo does not accept the model: {str(error)[:200]}") from None
    (folder / "model.xml").write_text(spec.to_xml(), encoding="utf-8")
    return notes


def _entry(value: object, unit: str, origin: str, std: float | None = None, note: str | None = None) -> dict:
    entry = {"value": _plain(value), "unit": unit, "origin": origin}
    if std is not None:
        entry["std"] = _plain(std)
    if note:
        entry["note"] = note
    return entry


def _joint_provenance(joint: Mapping, joint_range: tuple[float, float], unit: str, origin: str,
                      range_given: bool) -> dict:
    std = joint.get("std") or {}
    scale = f" (lengths from: {joint.get('scale_source', 'none')})"
    q_std = np.asarray(std.get("q") if std.get("q") is not None else np.nan, float)
    out = {
        "joint.axis": _entry(joint["axis"], "1", origin, _plain(np.deg2rad(std["axis_deg"]))
                             if std.get("axis_deg") is not None else None, "std: angle, rad"),
        "joint.q": _entry([float(np.min(joint["q"])), float(np.max(joint["q"]))], unit, origin,
                          float(np.nanmedian(q_std)) if np.isfinite(q_std).any() else None,
                          "least and greatest; all of it in reference.npz"),
        "joint.range": _entry(joint_range, unit, "given" if range_given else "observed", None,
                              None if range_given else "the ends the video shows; the real stops may lie beyond"),
    }
    if joint.get("point") is not None:
        out["joint.point"] = _entry(joint["point"], "m", origin, _plain(std.get("point_m")),
                                    "the asset's unit of length" + scale)
    return out


def save_asset(root: str | os.PathLike, asset_id: str, *, joint: Mapping, static: Link, moving: Link,
               reference: object, joint_range: tuple[float, float] | None = None, joint_origin: str = "fitted",
               mass: float | None = None, density: float = DENSITY, damping: float | None = None,
               frictionloss: float | None = None, camera: Mapping | None = None, provenance: Mapping | None = None,
               source: Mapping | None = None, providers: Sequence[Mapping] = (), notes: Sequence[str] = (),
               files: Mapping[str, bytes | str | os.PathLike] | None = None, overwrite: bool = False,
               gate: bool = True) -> Asset:
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

    Raises:
        AssetExists: there is one and overwrite is False.
        AssetError: an argument is not valid, or the body does not pass the gate; nothing was written.
    """
    import mujoco

    check_id(asset_id)
    root = Path(root)
    final = root / asset_id
    if (final.exists() or final.is_symlink()) and not overwrite:
        raise AssetExists(f"{final} exists; choose another id or overwrite it")
    kind, axis, point = _joint_numbers(joint)
    unit = "m" if kind == "prismatic" else "rad"
    ref = Reference.from_arrays(reference)
    demo = demonstration(ref.q)
    demo["duration"] = float(ref.time[demo["demo_end_frame"]] - ref.time[0])
    limits = joint_range if joint_range is not None else (float(ref.q.min()), float(ref.q.max()))
    limits = (float(limits[0]), float(limits[1]))
    if not (np.isfinite(limits).all() and limits[0] < limits[1]):
        raise AssetError(f"joint range {limits} is empty")
    slack = 1e-6 * (limits[1] - limits[0])
    if min(demo["q_start"], demo["q_demo_end"]) < limits[0] - slack or (
            max(demo["q_start"], demo["q_demo_end"]) > limits[1] + slack):
        raise AssetError(f"joint range {limits} does not hold the demonstration's start and end; widen it")

    if mass is not None and not (math.isfinite(mass) and mass > 0):
        raise AssetError(f"mass must be positive, is {mass}")
    body_mass, centre, tensor, volume, inertia_note = link_inertia(moving, density, mass)
    about = tensor + body_mass * (np.dot(centre - point, centre - point) * np.eye(3)
                                  - np.outer(centre - point, centre - point))
    inertia = body_mass if kind == "prismatic" else float(axis @ about @ axis)
    offset = np.asarray(moving.vertices, float) - point
    lever = 1.0
    if kind == "revolute":
        lever = float(np.linalg.norm(offset - (offset @ axis)[:, None] * axis, axis=1).max())
    assumed_damping, assumed_friction = passive_forces(inertia, lever, _demo_speed(ref, demo["demo_end_frame"]))
    numbers = {"damping": assumed_damping if damping is None else float(damping),
               "frictionloss": assumed_friction if frictionloss is None else float(frictionloss),
               "armature": ARMATURE_SHARE * inertia}
    if not all(math.isfinite(v) and v >= 0 for v in numbers.values()):
        raise AssetError("damping and frictionloss must be finite and not negative")
    force = "N" if kind == "prismatic" else "N m"
    made = {
        **_joint_provenance({**joint, "axis": axis, "q": ref.q}, limits, unit, joint_origin, joint_range is not None),
        "moving.density": _entry(density if mass is None else body_mass / volume, "kg/m3", "assumed",
                                 DENSITY_STD if mass is None else None),
        "moving.mass": _entry(body_mass, "kg", "assumed" if mass is None else "given",
                              DENSITY_STD * volume if mass is None else None, inertia_note),
        "joint.damping": _entry(numbers["damping"], f"{force} s/{unit}", "assumed" if damping is None else "given"),
        "joint.frictionloss": _entry(numbers["frictionloss"], force, "assumed" if frictionloss is None else "given"),
        "joint.armature": _entry(numbers["armature"], "kg" if kind == "prismatic" else "kg m2", "assumed"),
        "moving.gravcomp": _entry(1.0, "1", "assumed", None, "balanced at rest: a video carries no forces"),
        **(provenance or {}),
    }

    try:
        with folder_written_whole(final, overwrite) as folder:
            model_notes = _write_model(folder, asset_id, {"static": static, "moving": moving}, kind, axis, point,
                                       limits, numbers, (body_mass, centre, tensor))
            np.savez_compressed(folder / "reference.npz", time=ref.time, q=ref.q, hand_joints=ref.hand_joints,
                                hand_valid=ref.hand_valid, contact=ref.contact)
            document = {
                "schema": SCHEMA, "id": asset_id,
                "joint": {**joint, "type": kind, "axis": axis, "point": point if kind == "revolute" else None},
                "demo": demo, "camera": camera, "provenance": made,
                "collision": {"excluded_pairs": [["static", "moving"]],
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
                    raise AssetError(f"{asset_id} does not pass the gate: {found.failures[0]}")
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

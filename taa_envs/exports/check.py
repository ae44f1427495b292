"""Reading an export back with its own ecosystem's loader, and comparing it with the asset."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from taa_envs.asset import Asset
from taa_envs.errors import TaaEnvsError
from taa_envs.exports.body import Inertial, Joint, inertial_of, joint_of, read_body

TOLERANCE = 1e-4
"""Relative; USD keeps single precision."""


@dataclass(frozen=True)
class Loaded:
    """What a loader made of an export."""

    joint: Joint
    inertial: Inertial
    colliders: int


def load_mujoco(path: Path) -> Loaded:
    """MJCF or URDF through MuJoCo.

    Raises:
        ValueError: MuJoCo does not load it.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(path))
    if model.njnt != 1:
        raise ValueError(f"{model.njnt} joints")
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return Loaded(joint_of(model), inertial_of(model), int(solid.sum()))


def load_usd(path: Path) -> Loaded:
    """USD through usd-core's own physics parser.

    Raises:
        TaaEnvsError: usd-core is not installed.  ValueError: the stage holds no valid joint.
    """
    try:
        from pxr import Usd, UsdPhysics
    except ImportError:
        raise TaaEnvsError("reading USD needs the package usd-core; install it with: pip install 'taa-envs[usd]'"
                           ) from None
    from scipy.spatial.transform import Rotation

    stage = Usd.Stage.Open(str(path))
    found = UsdPhysics.LoadUsdPhysicsFromRange(stage, ["/"])
    kinds = {UsdPhysics.ObjectType.RevoluteJoint: "revolute", UsdPhysics.ObjectType.PrismaticJoint: "prismatic"}
    joints = [(kinds[kind], d) for kind, (_, descs) in found.items() if kind in kinds for d in descs]
    if len(joints) != 1 or not joints[0][1].isValid:
        raise ValueError(f"{len(joints)} valid joints")
    kind, desc = joints[0]
    prim = stage.GetPrimAtPath(desc.primPath)
    q = desc.localPose0Orientation
    local = {"X": [1.0, 0, 0], "Y": [0, 1.0, 0], "Z": [0, 0, 1.0]}[str(desc.axis.name if hasattr(desc.axis, "name")
                                                                         else desc.axis)[-1]]
    axis = Rotation.from_quat([*q.GetImaginary(), q.GetReal()]).apply(local)
    unit = np.pi / 180 if kind == "revolute" else 1.0
    drive = UsdPhysics.DriveAPI(prim, "angular" if kind == "revolute" else "linear")
    point = np.array(desc.localPose0Position) if kind == "revolute" else np.zeros(3)
    joint = Joint(kind, axis, point, (desc.limit.lower * unit, desc.limit.upper * unit),
                  float(drive.GetDampingAttr().Get()) / unit, float(prim.GetAttribute("taa:frictionloss").Get()))
    mass = UsdPhysics.MassAPI(stage.GetPrimAtPath(desc.body1))
    p = mass.GetPrincipalAxesAttr().Get()
    turn = Rotation.from_quat([*p.GetImaginary(), p.GetReal()]).as_matrix()
    tensor = turn @ np.diag(np.array(mass.GetDiagonalInertiaAttr().Get())) @ turn.T
    colliders = sum(prim.HasAPI(UsdPhysics.CollisionAPI) for prim in stage.Traverse())
    return Loaded(joint, Inertial(float(mass.GetMassAttr().Get()), np.array(mass.GetCenterOfMassAttr().Get()), tensor),
                  colliders)


def check_export(asset: Asset, kind: str, path: Path) -> list[str]:
    """What an export changed: joint type, axis, point, limits, damping, friction, mass, inertia or colliders.

    Args:
        path: the file :func:`taa_envs.exports.export_asset` returned.

    Returns:
        One line a difference; empty where it is the same object.
    """
    try:
        got = load_usd(path) if kind == "usd" else load_mujoco(path)
    except ValueError as error:
        return [f"it does not load: {str(error)[:200]}"]
    body = read_body(asset.model_path)
    want = Loaded(body.joint, body.inertial, sum(s.collides for s in body.shapes))
    size = max(float(np.linalg.norm(body.inertial.centre - body.joint.point)), 1e-3)
    pairs = [
        ("axis", got.joint.axis, want.joint.axis, 1.0),
        ("point", _foot(got.joint), _foot(want.joint), size),
        ("limits", got.joint.limits, want.joint.limits, want.joint.limits[1] - want.joint.limits[0]),
        ("damping", got.joint.damping, want.joint.damping, want.joint.damping),
        ("friction", got.joint.friction, want.joint.friction, want.joint.friction),
        ("mass", got.inertial.mass, want.inertial.mass, want.inertial.mass),
        ("centre of mass", got.inertial.centre, want.inertial.centre, size),
        ("inertia", got.inertial.tensor, want.inertial.tensor, float(np.trace(want.inertial.tensor))),
        ("colliders", got.colliders, want.colliders, 1e-3),
    ]
    wrong = [] if got.joint.kind == want.joint.kind else [f"joint type {got.joint.kind}, was {want.joint.kind}"]
    for name, a, b, scale in pairs:
        if np.abs(np.asarray(a, float) - np.asarray(b, float)).max() > TOLERANCE * max(scale, 1e-9):
            wrong.append(f"{name} {np.round(a, 6).tolist()}, was {np.round(b, 6).tolist()}")
    return wrong


def _foot(joint: Joint) -> np.ndarray:
    """The axis' point nearest to the origin: any point on the axis is the same joint."""
    return joint.point - (joint.point @ joint.axis) * joint.axis if joint.kind == "revolute" else np.zeros(3)

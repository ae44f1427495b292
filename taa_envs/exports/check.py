"""Reading an export back with its own ecosystem's loader, and comparing it with the asset."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from taa_envs.asset import Asset
from taa_envs.checks import numbered
from taa_envs.errors import TaaEnvsError
from taa_envs.exports.body import Inertial, Joint, inertial_of, joint_of, read_body

TOLERANCE = 1e-4
"""Relative; USD keeps single precision."""


@dataclass(frozen=True)
class Loaded:
    """What a loader made of an export."""

    joints: tuple[Joint, ...]
    inertials: tuple[Inertial, ...]
    colliders: int

    @property
    def joint(self) -> Joint:
        return self.joints[0]

    @property
    def inertial(self) -> Inertial:
        return self.inertials[0]


def load_mujoco(path: Path) -> Loaded:
    """MJCF or URDF through MuJoCo.

    Raises:
        ValueError: MuJoCo does not load it.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(path))
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    jointed = [k for k in range(model.njnt) if model.jnt_limited[k]]
    return Loaded(tuple(joint_of(model, k) for k in jointed), tuple(inertial_of(model, k) for k in jointed),
                  int(solid.sum()))


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
    inertial = Inertial(float(mass.GetMassAttr().Get()), np.array(mass.GetCenterOfMassAttr().Get()), tensor)
    return Loaded((joint,), (inertial,), colliders)


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
    if len(got.joints) != len(body.joints):
        return [f"it does not load: {len(got.joints)} joints, were {len(body.joints)}"]
    solid = sum(s.collides for s in body.shapes)
    wrong = [] if got.colliders == solid else [f"colliders {got.colliders}, was {solid}"]
    for k in range(len(body.joints)):
        where = "" if k == 0 else f" of {numbered('joint', k + 1)}"
        wrong += [line + where for line in _changed(got.joints[k], body.joints[k], got.inertials[k], body.inertials[k])]
    return wrong


def _changed(got: Joint, want: Joint, mass: Inertial, was: Inertial) -> list[str]:
    """One line a difference."""
    size = max(float(np.linalg.norm(was.centre - want.point)), 1e-3)
    pairs = [
        ("axis", got.axis, want.axis, 1.0),
        ("point", _foot(got), _foot(want), size),
        ("pitch", got.pitch, want.pitch, abs(want.pitch)),
        ("limits", got.limits, want.limits, want.limits[1] - want.limits[0]),
        ("damping", got.damping, want.damping, want.damping),
        ("friction", got.friction, want.friction, want.friction),
        ("mass", mass.mass, was.mass, was.mass),
        ("centre of mass", mass.centre, was.centre, size),
        ("inertia", mass.tensor, was.tensor, float(np.trace(was.tensor))),
    ]
    wrong = [] if got.kind == want.kind else [f"joint type {got.kind}, was {want.kind}"]
    for name, a, b, scale in pairs:
        if np.abs(np.asarray(a, float) - np.asarray(b, float)).max() > TOLERANCE * max(scale, 1e-9):
            wrong.append(f"{name} {np.round(a, 6).tolist()}, was {np.round(b, 6).tolist()}")
    return wrong


def _foot(joint: Joint) -> np.ndarray:
    """The axis' point nearest to the origin: any point on the axis is the same joint."""
    return joint.point - (joint.point @ joint.axis) * joint.axis if joint.kind != "prismatic" else np.zeros(3)

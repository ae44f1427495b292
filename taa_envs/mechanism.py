"""A moving link on its way into an asset: its joint, range, mass and passive forces, and the MJCF they become.

A hinge or a slide is one MuJoCo joint. MuJoCo has no screw: it is the hinge ``joint`` and, on the same body, the slide
``advance`` along the same axis, tied to it by an equality ``advance = pitch * joint``. The hinge alone carries range,
damping and friction; the tie does work on neither.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from taa_envs.checks import JOINT_TYPES, numbered
from taa_envs.errors import AssetError
from taa_envs.surface import Link, link_inertia

if TYPE_CHECKING:
    import mujoco

# A video carries no forces: these are assumptions, and asset.json says so.
DENSITY = 500.0  # kg/m3 of the closed surface: wood, or plastic and sheet with air between
DENSITY_STD = 500.0  # kg/m3, a factor of two: from hollow plastic and thin sheet (100) to oak and glass (1000)
STOP_TIME = 0.2  # s in which friction alone stops the link from the demonstration's speed
DAMPING_TIME = 0.1  # s, time constant of viscous decay
HAND_FORCE = (0.5, 8.0)  # N at the link's far end: least and most that friction, and as much that damping, may ask
ARMATURE_SHARE = 0.01  # of the link's inertia, for the solver's conditioning
STIFF = {"solref": [0.005, 1.0], "solimp": [0.99, 0.9999, 0.001, 0.5, 2.0]}
"""Stops: MuJoCo's default yields to a hand in proportion to the link's lightness."""
TIE = {"solref": [0.005, 1.0], "solimp": [0.9999, 0.9999, 0.001, 0.5, 2.0]}
"""Of a screw: a thread is stiffer than a stop."""


@dataclass(frozen=True)
class FurtherLink:
    """A moving link beside the one whose joint is the task.

    Attributes:
        joint: like the first's: at least type, axis, point (unless prismatic), pitch (screw).
        link: its surface and collision parts at q = 0, asset frame.
        q: (T,) its states in the reference's frames, rad or m.
        joint_range: limits, rad or m; default the observed ends of q.
    """

    joint: Mapping
    link: Link
    q: np.ndarray
    joint_range: tuple[float, float] | None = None


@dataclass(frozen=True)
class Moving:
    """All that the model needs to know of a moving link.

    Attributes:
        number: 1 for ``moving`` and ``joint``, 2 for ``moving_2`` and ``joint_2``, ...
        kind, axis (3,) unit, point (3,) m, pitch m/rad: of its joint.
        limits: rad or m.  damping, frictionloss, armature: of the joint.
        mass: kg.  centre: (3,) m.  tensor: (3, 3) kg m2 about it.
        provenance: what ``asset.json`` says of all that.
    """

    number: int
    link: Link
    kind: str
    axis: np.ndarray
    point: np.ndarray
    pitch: float
    limits: tuple[float, float]
    damping: float
    frictionloss: float
    armature: float
    mass: float
    centre: np.ndarray
    tensor: np.ndarray
    provenance: dict

    def add_joint(self, spec: mujoco.MjSpec, body: Any) -> None:
        """Put mass and joint on the link's body; the links keep the asset frame: at q = 0 its pose is the identity."""
        import mujoco

        body.gravcomp = 1.0
        body.mass, body.ipos = self.mass, self.centre
        t = self.tensor
        body.fullinertia = [t[0, 0], t[1, 1], t[2, 2], t[0, 1], t[0, 2], t[1, 2]]
        body.explicitinertial = True
        slides = self.kind == "prismatic"
        joint = body.add_joint(
            name=numbered("joint", self.number),
            type=mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE, axis=self.axis,
            pos=np.zeros(3) if slides else self.point, range=self.limits, limited=1, damping=[self.damping, 0, 0],
            frictionloss=self.frictionloss, armature=self.armature, solref_limit=STIFF["solref"],
            solimp_limit=STIFF["solimp"])  # fmt: skip
        if self.kind == "screw":
            advance = body.add_joint(name=numbered("advance", self.number), type=mujoco.mjtJoint.mjJNT_SLIDE,
                                     axis=self.axis, pos=np.zeros(3))
            tie = spec.add_equality(name=advance.name, type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT,
                                    name1=advance.name, name2=joint.name, solref=TIE["solref"],
                                    solimp=TIE["solimp"])  # fmt: skip
            data = np.zeros(len(tie.data))
            data[1] = self.pitch
            tie.data = data


def entry(value: object, unit: str, origin: str, std: object = None, note: str | None = None) -> dict:
    """A number of ``asset.json`` and where it comes from."""
    out = {"value": value, "unit": unit, "origin": origin}
    if std is not None:
        out["std"] = std
    if note:
        out["note"] = note
    return out


def joint_numbers(joint: Mapping) -> tuple[str, np.ndarray, np.ndarray, float]:
    """Type, unit axis (3,), point (3,) m (the origin of a slide) and pitch m/rad (0 but for a screw), checked.

    Raises:
        AssetError: what is wrong with them.
    """
    kind = joint.get("type")
    if kind not in JOINT_TYPES:
        raise AssetError(f"joint type {kind!r} cannot be simulated as one passive joint; known: "
                         + ", ".join(JOINT_TYPES))
    axis = np.asarray(joint["axis"], float)
    point = np.zeros(3) if joint.get("point") is None else np.asarray(joint["point"], float)
    norm = float(np.linalg.norm(axis))
    if axis.shape != (3,) or point.shape != (3,) or not np.isfinite([*axis, *point]).all() or norm < 1e-9:
        raise AssetError("joint axis and point must be three finite numbers each")
    if kind != "prismatic" and joint.get("point") is None:
        raise AssetError(f"a {kind} joint needs a point on its axis")
    pitch = 0.0
    if kind == "screw":
        pitch = float(joint["pitch"]) if isinstance(joint.get("pitch"), (int, float)) else math.nan
        if not math.isfinite(pitch) or pitch == 0.0:
            raise AssetError("a screw needs its pitch, m/rad and not 0; without one it is a hinge")
    return kind, axis / norm, point, pitch


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


def typical_speed(time: np.ndarray, q: np.ndarray) -> float:
    """Mean speed of q (T,) over the frames that move, rad/s or m/s."""
    rate = np.abs(np.diff(q) / np.diff(time))
    # The mean over the frames that move: peaks of a noisy q would ask for a far too sticky joint.
    moving = rate[rate > 0.1 * rate.max()]
    return float(max(moving.mean(), 1e-3)) if len(moving) else 1e-3


def prepare(number: int, joint: Mapping, link: Link, q: np.ndarray, speed: float, limits: tuple[float, float] | None,
            origin: str = "fitted", density: float = DENSITY, mass: float | None = None, damping: float | None = None,
            frictionloss: float | None = None) -> Moving:  # fmt: skip
    """A link's joint, range, mass and passive forces.

    Args:
        number: see :class:`Moving`.
        joint: of the contract.  q: (T,) its states.  speed: typical, rad/s or m/s.
        limits: rad or m; the ends of q when None.
        origin: where axis, point and q came from.
        density, mass, damping, frictionloss: as in :func:`taa_envs.authoring.save_asset`.

    Raises:
        AssetError: an argument is not valid.
    """
    kind, axis, point, pitch = joint_numbers(joint)
    given = limits is not None
    limits = limits if limits is not None else (float(q.min()), float(q.max()))
    limits = (float(limits[0]), float(limits[1]))
    if not (np.isfinite(limits).all() and limits[0] < limits[1]):
        raise AssetError(f"joint range {limits} is empty")
    body_mass, centre, tensor, volume, inertia_note = link_inertia(link, density, mass)
    about = tensor + body_mass * (np.dot(centre - point, centre - point) * np.eye(3)
                                  - np.outer(centre - point, centre - point))
    inertia = body_mass if kind == "prismatic" else float(axis @ about @ axis) + pitch**2 * body_mass
    offset = np.asarray(link.vertices, float) - point
    lever = 1.0
    if kind != "prismatic":
        lever = float(np.linalg.norm(offset - (offset @ axis)[:, None] * axis, axis=1).max())
    assumed_damping, assumed_friction = passive_forces(inertia, lever, speed)
    forces = {"damping": assumed_damping if damping is None else float(damping),
              "frictionloss": assumed_friction if frictionloss is None else float(frictionloss)}
    if not all(math.isfinite(v) and v >= 0 for v in forces.values()):
        raise AssetError("damping and frictionloss must be finite and not negative")
    unit, force = ("m", "N") if kind == "prismatic" else ("rad", "N m")
    armature = ARMATURE_SHARE * inertia
    j, m = numbered("joint", number), numbered("moving", number)
    provenance = {
        **_joint_provenance(j, {**joint, "axis": axis, "q": q}, limits, unit, origin, given, numbered("q", number)),
        f"{m}.density": entry(density if mass is None else body_mass / volume, "kg/m3", "assumed",
                              DENSITY_STD if mass is None else None),
        f"{m}.mass": entry(body_mass, "kg", "assumed" if mass is None else "given",
                           DENSITY_STD * volume if mass is None else None, inertia_note),
        f"{j}.damping": entry(forces["damping"], f"{force} s/{unit}", "assumed" if damping is None else "given"),
        f"{j}.frictionloss": entry(forces["frictionloss"], force, "assumed" if frictionloss is None else "given"),
        f"{j}.armature": entry(armature, "kg" if kind == "prismatic" else "kg m2", "assumed"),
        f"{m}.gravcomp": entry(1.0, "1", "assumed", None, "balanced at rest: a video carries no forces"),
    }
    return Moving(number, link, kind, axis, point, pitch, limits, forces["damping"], forces["frictionloss"], armature,
                  body_mass, centre, tensor, provenance)  # fmt: skip


def _joint_provenance(name: str, joint: Mapping, joint_range: tuple[float, float], unit: str, origin: str,
                      range_given: bool, states: str) -> dict:
    std = joint.get("std") or {}
    scale = f" (lengths from: {joint.get('scale_source', 'none')})"
    q_std = np.asarray(std.get("q") if std.get("q") is not None else np.nan, float)
    out = {
        f"{name}.axis": entry(joint["axis"], "1", origin,
                              np.deg2rad(std["axis_deg"]) if std.get("axis_deg") is not None else None,
                              "std: angle, rad"),
        f"{name}.q": entry([float(np.min(joint["q"])), float(np.max(joint["q"]))], unit, origin,
                           float(np.nanmedian(q_std)) if np.isfinite(q_std).any() else None,
                           "least and greatest; all of it in reference.npz" + (f" as {states}" if states != "q" else "")
                           ),
        f"{name}.range": entry(joint_range, unit, "given" if range_given else "observed", None,
                               None if range_given else "the ends the video shows; the real stops may lie beyond"),
    }
    if joint.get("point") is not None:
        out[f"{name}.point"] = entry(joint["point"], "m", origin, std.get("point_m"),
                                     "the asset's unit of length" + scale)
    if joint.get("type") == "screw":
        out[f"{name}.pitch"] = entry(joint["pitch"], "m/rad", origin, std.get("pitch"), "advance" + scale)
    return out

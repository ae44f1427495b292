"""Domain randomisation: what the reconstruction knows that it does not know.

Every amount comes from the asset: the ``std`` of the entry of that name in its provenance. Nothing is drawn for a
number that has none, but for the assumed mass, damping and friction: a video carries no force, the asset says
``assumed``, and an assumption is taken to hold within a factor of two (:data:`ASSUMED_FACTOR`, one standard deviation),
the one number here that no asset gives. Spring and armature are drawn where a diagnosis has fitted them.

==============  ======================================  ================================================================
name            standard deviation                      what is drawn
==============  ======================================  ================================================================
axis            ``joint.axis`` std, rad                 a tilt of the axis in a random direction across it
point           ``joint.point`` std, m                  a shift of the pivot across the axis (revolute joints)
scale           ``scale`` std, relative                 the size of everything, s: at equal density, hand force and time
                                                        the link's inertia in the asset's units goes with s^4
mass            ``moving.mass`` std / value             a factor on mass and inertia, log-normal
damping         ``joint.damping`` std / value           a factor, log-normal
frictionloss    ``joint.frictionloss`` std / value      a factor, log-normal
stiffness       ``joint.stiffness`` std / value         a factor on the joint's spring, log-normal
armature        ``joint.armature`` std / value          a factor, log-normal
springref       ``joint.springref`` std, rad or m       a shift of where the spring is at rest
hand            ``hand.offset`` std, m; where absent    a shift of the whole demonstrated hand against the object
                that of ``joint.point``
==============  ======================================  ================================================================
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from taa_envs.asset import Asset

NAMES = ("axis", "point", "scale", "mass", "damping", "frictionloss", "hand", "stiffness", "armature", "springref")
ASSUMED_FACTOR = 2.0
_ENTRIES = {"axis": "joint.axis", "point": "joint.point", "scale": "scale", "mass": "moving.mass",
            "damping": "joint.damping", "frictionloss": "joint.frictionloss", "hand": "hand.offset",
            "stiffness": "joint.stiffness", "armature": "joint.armature", "springref": "joint.springref"}
_FACTORS = ("mass", "damping", "frictionloss")
_FITTED = ("stiffness", "armature")  # factors too, but only where the asset states how well they are known

# Model fields that a draw changes; the others only where something of a spring or an armature is drawn.
FIELDS = ("jnt_axis", "jnt_pos", "body_mass", "body_inertia", "dof_damping", "dof_frictionloss")
SPRING_FIELDS = ("jnt_stiffness", "dof_armature", "qpos_spring")


@dataclass(frozen=True)
class Draw:
    """One draw. axis: (3,) unit, asset frame.  point: (3,) m.  mass, damping, frictionloss, stiffness, armature:
    factors on the model's numbers (mass: of the inertia too).  hand: (3,) m.  springref: shift, rad or m."""

    axis: np.ndarray
    point: np.ndarray
    mass: float = 1.0
    damping: float = 1.0
    frictionloss: float = 1.0
    hand: np.ndarray | None = None
    stiffness: float = 1.0
    armature: float = 1.0
    springref: float = 0.0

    @property
    def springs(self) -> bool:
        """Whether something of the :data:`SPRING_FIELDS` is drawn."""
        return (self.stiffness, self.armature, self.springref) != (1.0, 1.0, 0.0)

    def as_dict(self) -> dict:
        """The draw as arrays, for ``info``; copies."""
        return {"axis": self.axis.copy(), "point": self.point.copy(), "mass": self.mass, "damping": self.damping,
                "frictionloss": self.frictionloss, "hand": np.zeros(3) if self.hand is None else self.hand.copy(),
                "stiffness": self.stiffness, "armature": self.armature, "springref": self.springref}


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, (int, float)) and np.isfinite(value) and value >= 0 else None


def uncertainties(asset: Asset) -> dict[str, float]:
    """Name -> standard deviation, of the names in :data:`NAMES` about which the asset says something."""
    out: dict[str, float] = {}
    for name, key in _ENTRIES.items():
        entry = asset.provenance.get(key) or {}
        std, value = _number(entry.get("std")), _number(entry.get("value"))
        if name in _FACTORS + _FITTED:
            if std is not None and value:
                out[name] = float(np.log1p(std / value))
            elif name in _FACTORS and entry.get("origin") == "assumed":
                out[name] = float(np.log(ASSUMED_FACTOR))
        elif std is not None:
            out[name] = std
    if asset.joint_type == "prismatic":
        out.pop("point", None)
    point = _number((asset.provenance.get("joint.point") or {}).get("std"))
    if "hand" not in out and point is not None:
        out["hand"] = point
    return out


def chosen(asset: Asset, wanted: bool | Iterable[str] | Mapping[str, float]) -> dict[str, float]:
    """Standard deviations to draw with: all the asset's (True), those of some names, or given ones.

    Raises:
        ValueError: a name is unknown, or an amount is not a finite number >= 0.
    """
    if wanted is True or wanted is False:
        return uncertainties(asset) if wanted else {}
    unknown = set(wanted) - set(NAMES)
    if unknown:
        raise ValueError(f"cannot randomize {', '.join(sorted(unknown))}; known: {', '.join(NAMES)}")
    if isinstance(wanted, Mapping):
        if any(_number(v) is None for v in wanted.values()):
            raise ValueError("amounts of randomize must be finite and not negative")
        return {name: float(value) for name, value in wanted.items()}
    return {name: std for name, std in uncertainties(asset).items() if name in set(wanted)}


def nominal(asset: Asset, model_axis: np.ndarray, model_point: np.ndarray) -> Draw:
    """No randomisation at all."""
    return Draw(np.array(model_axis, float), np.array(model_point, float), hand=np.zeros(3))


def covariance(asset: Asset) -> np.ndarray | None:
    """(6, 6) covariance of axis (rad) and point (m) that the asset's joint states, None where it states none."""
    try:
        C = np.array((asset.joint.get("std") or {}).get("covariance"), float)
    except (TypeError, ValueError):
        return None
    if C.shape not in ((3, 3), (6, 6)) or not np.isfinite(C).all():
        return None
    return np.pad(C, (0, 6 - len(C)))


def _together(joint: np.ndarray, across: np.ndarray) -> np.ndarray:
    """(4, 4) root of how tilt and shift across the axis err together, each of unit total variance."""
    B = np.kron(np.eye(2), across)  # (4, 6)
    C = B @ joint @ B.T
    size = np.repeat([np.sqrt(max(np.trace(C[k:k + 2, k:k + 2]), 0.0)) for k in (0, 2)], 2)
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh((C + C.T) / 2 / np.outer(size, size))
    return vectors * np.sqrt(np.maximum(values, 0.0))


def draw(rng: np.random.Generator, std: Mapping[str, float], axis: np.ndarray, point: np.ndarray,
         joint: np.ndarray | None = None) -> Draw:
    """One draw about a joint's axis (3,) and point (3,) m with the standard deviations of :func:`chosen`.

    The generator is asked for the same numbers whatever the standard deviations are.

    Args:
        joint: (6, 6) covariance of axis and point: in which directions they err, and how together. The amounts remain
            those of std. Without it all directions across the axis are alike, and tilt and shift are independent.
    """
    normal = rng.standard_normal(14)
    across = np.linalg.svd(axis[None])[2][1:]  # (2, 3)
    # Two directions share the angle's variance, and the shift's.
    unit = normal[:4] / np.sqrt(2) if joint is None else _together(joint, across) @ normal[:4]
    tilt = (unit[:2] @ across) * std.get("axis", 0.0)
    shift = (unit[2:] @ across) * std.get("point", 0.0)
    angle = float(np.linalg.norm(tilt))
    turned = axis if angle == 0.0 else np.cos(angle) * axis + np.sin(angle) * tilt / angle
    factor = {name: float(np.exp(std.get(name, 0.0) * normal[4 + i])) for i, name in enumerate(_FACTORS)}
    size = float(np.exp(std.get("scale", 0.0) * normal[7]))
    return Draw(turned / np.linalg.norm(turned), point + shift, factor["mass"] * size**4, factor["damping"],
                factor["frictionloss"], normal[8:11] * std.get("hand", 0.0) / np.sqrt(3),
                *(float(np.exp(std.get(name, 0.0) * normal[11 + i])) for i, name in enumerate(_FITTED)),
                springref=float(std.get("springref", 0.0) * normal[13]))


def write(fields: Mapping[str, np.ndarray], before: Mapping[str, np.ndarray], made: Draw, joints: list[int],
          body: int, dof: int, qpos: int) -> None:
    """Write a draw into model fields, relative to what they were; ``before`` holds copies of them.

    The :data:`SPRING_FIELDS` are written if they are among the fields.
    """
    fields["jnt_axis"][joints] = made.axis
    fields["jnt_pos"][joints[0]] = made.point
    for name in ("body_mass", "body_inertia"):
        fields[name][body] = before[name][body] * made.mass
    fields["dof_damping"][dof] = before["dof_damping"][dof] * made.damping
    fields["dof_frictionloss"][dof] = before["dof_frictionloss"][dof] * made.frictionloss
    if "jnt_stiffness" in fields:
        fields["jnt_stiffness"][joints[0]] = before["jnt_stiffness"][joints[0]] * made.stiffness
        fields["dof_armature"][dof] = before["dof_armature"][dof] * made.armature
        fields["qpos_spring"][qpos] = before["qpos_spring"][qpos] + made.springref

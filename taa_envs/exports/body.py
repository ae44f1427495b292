"""What every format needs to know of an asset, read once from its compiled model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from taa_envs.checks import numbered

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class Inertial:
    """Mass of the moving link, asset frame: kg, (3,) m, (3, 3) kg m2 about the centre of mass."""

    mass: float
    centre: np.ndarray
    tensor: np.ndarray


@dataclass(frozen=True)
class Joint:
    """The passive joint, asset frame at q = 0.

    Attributes:
        kind: "revolute", "prismatic" or "screw".  axis: (3,) unit.  pitch: m/rad of a screw.
        point: (3,) m on the axis (the origin for a slide).
        limits: rad or m.  damping, friction: N m s/rad and N m, or N s/m and N.
    """

    kind: str
    axis: np.ndarray
    point: np.ndarray
    limits: tuple[float, float]
    damping: float
    friction: float
    pitch: float = 0.0


@dataclass(frozen=True)
class Shape:
    """One mesh of a link: its file, and its picture where it has one."""

    name: str
    link: str
    file: Path
    texture: Path | None
    collides: bool


@dataclass(frozen=True)
class Body:
    """An asset's object: shapes, and joint and mass of each moving link (``moving``, ``moving_2``, ...)."""

    joints: tuple[Joint, ...]
    inertials: tuple[Inertial, ...]
    shapes: tuple[Shape, ...]

    @property
    def joint(self) -> Joint:
        return self.joints[0]

    @property
    def inertial(self) -> Inertial:
        return self.inertials[0]

    @property
    def links(self) -> tuple[str, ...]:
        return tuple(numbered("moving", k + 1) for k in range(len(self.joints)))

    def of(self, link: str, collides: bool) -> list[Shape]:
        return [s for s in self.shapes if s.link == link and s.collides == collides]


def read_body(model_path: Path) -> Body:
    """Joint, mass and shapes of an MJCF file with the bodies ``static`` and ``moving``.

    Raises:
        ValueError: MuJoCo does not load the file.
    """
    import mujoco

    spec = mujoco.MjSpec.from_file(str(model_path))
    folder = model_path.parent / (spec.meshdir or ".")
    textures = model_path.parent / (spec.texturedir or ".")
    files = {mesh.name: folder / mesh.file for mesh in spec.meshes}
    pictures = {}
    for material in spec.materials:
        name = material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)]
        if name:
            pictures[material.name] = textures / spec.texture(name).file
    shapes = [Shape(geom.name, link, files[geom.meshname], pictures.get(geom.material),
                    bool(geom.contype or geom.conaffinity))
              for link in ("static", *(b.name for b in spec.bodies if b.name.startswith("moving")))
              for geom in spec.body(link).geoms if geom.meshname]
    model = spec.compile()
    jointed = [k for k in range(model.njnt) if model.jnt_limited[k]]
    return Body(tuple(joint_of(model, k) for k in jointed), tuple(inertial_of(model, k) for k in jointed),
                tuple(shapes))


def joint_of(model: mujoco.MjModel, index: int = 0) -> Joint:
    """A joint of a compiled model, in the world at q = 0."""
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    hinge = int(model.jnt_type[index]) == int(mujoco.mjtJoint.mjJNT_HINGE)
    low, high = model.jnt_range[index]
    pitch = sum(float(model.eq_data[e, 1]) for e in range(model.neq) if int(model.eq_obj2id[e]) == index)
    return Joint("screw" if pitch else "revolute" if hinge else "prismatic", data.xaxis[index].copy(),
                 data.xanchor[index].copy() if hinge else np.zeros(3), (float(low), float(high)),
                 float(np.ravel(model.dof_damping[index])[0]), float(model.dof_frictionloss[index]), pitch)


def inertial_of(model: mujoco.MjModel, index: int = 0) -> Inertial:
    """Mass properties of a joint's body, in the world at q = 0."""
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    body = int(model.jnt_bodyid[index])
    turn = data.ximat[body].reshape(3, 3)
    return Inertial(float(model.body_mass[body]), data.xipos[body].copy(),
                    turn @ np.diag(model.body_inertia[body]) @ turn.T)

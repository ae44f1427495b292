"""The nominal model reduced to the one joint that a log measures.

All other joints rest at the model's reference position and contacts are off, so that

    I q'' = tau(t) + s(q) - b1 q' - b2 q'|q'| - b3 q'^3 - f sign(q')

with the static torque ``s`` (gravity, springs, passive actuators) read from MuJoCo itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from diagnose.log import JointLog
from taa_envs.errors import TaaEnvsError


@dataclass(frozen=True)
class Plant:
    """One joint of a model.

    Attributes:
        path: the MJCF file.  joint: its name.  hinge: True for a hinge, False for a slide.
        axis, anchor: (3,) world, of the joint at the reference position.
        inertia: kg m^2 or kg, all that moves with the joint.
        gravity: (sin, cos, constant) coefficients of the static torque without the joint's spring.
        static_table: (q (M,), torque (M,)) of the static torque where the closed form does not hold, else None.
        damping: (3,) coefficients of v, v|v|, v^3.  frictionloss: N m or N.
        stiffness, springref: of the joint's linear spring.
        limits: (lower, upper) or None.  timestep: s.
        reference: position in which the file draws the part.
        edit: what is changed in the file's model before all else (the joint's place); None for nothing.
    """

    path: Path
    joint: str
    hinge: bool
    axis: np.ndarray
    anchor: np.ndarray
    inertia: float
    gravity: tuple[float, float, float]
    static_table: tuple[np.ndarray, np.ndarray] | None
    damping: tuple[float, float, float]
    frictionloss: float
    stiffness: float
    springref: float
    limits: tuple[float, float] | None
    timestep: float
    reference: float = 0.0
    edit: Callable[[mujoco.MjSpec], None] | None = None

    def spec(self) -> mujoco.MjSpec:
        """A fresh spec of the model."""
        spec = mujoco.MjSpec.from_file(str(self.path))
        if self.edit is not None:
            self.edit(spec)
        return spec

    def row(self) -> tuple[np.ndarray, np.ndarray]:
        """The joint as numbers for :mod:`diagnose.kernel`: (16,) and the table of static torques (M,)."""
        low, high = self.limits if self.limits is not None else (0.0, 0.0)
        grid, table = self.static_table if self.static_table is not None else (np.zeros(2), np.zeros(2))
        return np.array([self.inertia, *(self.gravity if self.hinge else (0.0, 0.0, self.gravity[2])), self.stiffness,
                         self.springref, *self.damping, self.frictionloss, self.limits is not None, low, high,
                         self.static_table is not None, grid[0], grid[1] - grid[0]], float), table  # fmt: skip

    @property
    def unit(self) -> str:
        return "rad" if self.hinge else "m"

    @property
    def torque_unit(self) -> str:
        return "N m" if self.hinge else "N"

    def static(self, q: np.ndarray) -> np.ndarray:
        """Static torque at q, any shape."""
        if self.static_table is not None:
            return np.interp(q, *self.static_table)
        a, b, c = self.gravity
        out = c - self.stiffness * (q - self.springref)
        if self.hinge:
            out = out + a * np.sin(q) + b * np.cos(q)
        return out

    def input_torque(self, log: JointLog) -> np.ndarray:
        """(N,) the log's inputs as a generalized force on this joint."""
        total = np.zeros(len(log.time))
        if log.torque is not None:
            total += log.torque
        if log.force is not None:
            # The point is logged in the world, so no pose of the link is needed.
            along = np.cross(log.point - self.anchor, log.force) if self.hinge else log.force
            total += along @ self.axis
        return total


def isolated(spec: mujoco.MjSpec, joint: str) -> mujoco.MjModel:
    """Compile with every other joint held and without contacts."""
    for other in list(spec.joints):
        if other.name != joint:
            spec.delete(other)
    model = spec.compile()
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return model


def load_plant(path: Path | str, joint: str, edit: Callable[[mujoco.MjSpec], None] | None = None) -> Plant:
    """Read the joint from an MJCF file, after an edit of its spec if one is given.

    Raises:
        TaaEnvsError: the file does not load, has no such joint, or the joint is no hinge and no slide.
    """
    path = Path(path)
    if not path.is_file():
        raise TaaEnvsError(f"no such model: {path}; give an asset id or an MJCF file")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        if edit is not None:
            edit(spec)
        model = spec.compile()
    except ValueError as error:
        raise TaaEnvsError(f"{path} does not load in MuJoCo ({error}); mend the file") from None
    names = [model.joint(i).name for i in range(model.njnt)]
    if joint not in names:
        raise TaaEnvsError(f"{path} has no joint {joint!r}; it has: {', '.join(n or '(unnamed)' for n in names)}")
    kind = int(model.joint(joint).type[0])
    if kind not in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)):
        raise TaaEnvsError(f"joint {joint!r} is neither a hinge nor a slide; name one of those")
    hinge = kind == int(mujoco.mjtJoint.mjJNT_HINGE)
    # Free bodies fall off when their joint is deleted from the copy; what moves with our joint stays.
    model = isolated(spec, joint)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    jid = model.joint(joint).id
    axis, anchor = data.xaxis[jid].copy(), data.xanchor[jid].copy()
    limited = bool(model.jnt_limited[jid])
    limits = tuple(float(v) for v in model.jnt_range[jid]) if limited else None

    stiffness, springref = float(model.jnt_stiffness[jid]), float(model.qpos_spring[0])
    grid = np.linspace(-2 * np.pi, 2 * np.pi, 2001) if hinge else np.linspace(-3, 3, 2001)
    static = np.empty(len(grid))
    for i, q in enumerate(grid):
        data.qpos[0] = q
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_fwdActuation(model, data)
        static[i] = data.qfrc_passive[0] + data.qfrc_actuator[0] - data.qfrc_bias[0]
    rest = static + stiffness * (grid - springref)
    basis = np.stack([np.sin(grid), np.cos(grid), np.ones_like(grid)] if hinge else
                     [0 * grid, 0 * grid, np.ones_like(grid)], axis=1)  # fmt: skip
    gravity = np.linalg.lstsq(basis, rest, rcond=None)[0]
    exact = np.abs(basis @ gravity - rest).max() <= 1e-6 * (np.abs(static).max() + 1e-9)
    poly = model.dof_dampingpoly[0]
    return Plant(path, joint, hinge, axis, anchor, float(full[0, 0]), tuple(float(v) for v in gravity),
                 None if exact else (grid, static), (float(model.dof_damping[0]), float(poly[0]), float(poly[1])),
                 float(model.dof_frictionloss[0]), stiffness, springref, limits, float(model.opt.timestep),
                 float(model.qpos0[0]), edit)

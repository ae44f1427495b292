"""Stepping a scene under a demonstrated hand: what replay and environment share.

Nothing here writes the object's joint after :meth:`Simulation.reset`; the hand's targets are all that goes in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taa_envs.scene import Scene


@dataclass(frozen=True)
class HandPath:
    """Landmarks over time, linear between frames, still before the first and after the last.

    Attributes:
        time: (T,) s.  joints: (T, 21, 3) m.
    """

    time: np.ndarray
    joints: np.ndarray

    def at(self, t: float) -> np.ndarray:
        """(21, 3) m at time t, s."""
        i = min(max(int(self.time.searchsorted(t)) - 1, 0), len(self.time) - 2)
        w = min(max((t - self.time[i]) / (self.time[i + 1] - self.time[i]), 0.0), 1.0)
        return (1 - w) * self.joints[i] + w * self.joints[i + 1]


@dataclass
class Step:
    """What happened in one or more simulation steps.

    Attributes:
        contact: whether the hand pushed on the moving link.
        penetration: m, deepest overlap of hand and link.
        driven: change of q made, in the demonstration's direction, while the hand's contact did positive work on the
            joint; rad or m.  moved: all change of q, signed.
        impulse: the contact's generalized impulse on the joint, N m s or N s.
    """

    contact: bool = False
    penetration: float = 0.0
    driven: float = 0.0
    moved: float = 0.0
    impulse: float = 0.0

    def add(self, other: Step) -> None:
        self.contact |= other.contact
        self.penetration = max(self.penetration, other.penetration)
        self.driven += other.driven
        self.moved += other.moved
        self.impulse += other.impulse


class Diverged(RuntimeError):
    """The simulation's state is no longer finite."""


class Simulation:
    """A scene's state.

    Attributes:
        scene, model, data.
        direction: +1 or -1, sign of the demonstration's stroke.
    """

    def __init__(self, scene: Scene) -> None:
        import mujoco

        self.scene, self.model = scene, scene.model
        self.data = mujoco.MjData(scene.model)
        demo = scene.asset.demo
        self.direction = 1.0 if demo["q_demo_end"] > demo["q_start"] else -1.0
        self._mujoco = mujoco
        self._contact_rows = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
        self._force = np.zeros(scene.model.nv)
        self._advance = None if scene.advance is None else int(scene.model.joint("advance").dofadr[0])
        # MuJoCo resets a state that is not finite and counts it here.
        self._bad = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}")) for what in ("QPOS", "QVEL", "QACC")]

    @property
    def q(self) -> float:
        """State of the object's joint, rad or m."""
        return float(self.data.qpos[self.scene.qpos])

    @property
    def qvel(self) -> float:
        return float(self.data.qvel[self.scene.dof])

    def reset(self, q: float, joints: np.ndarray) -> None:
        """Start of an episode: the joint at q and at rest, the hand at landmarks (21, 3)."""
        self._mujoco.mj_resetData(self.model, self.data)
        self.scene.put(self.data.qpos, q)
        self.scene.put_further(self.data.qpos, float(self.scene.asset.reference.time[0]))
        if self.scene.hand is not None:
            self.scene.hand.place(self.data, joints)
        self._mujoco.mj_forward(self.model, self.data)

    def _contact_force(self) -> float:
        """Generalized force of the contacts on the object's joint, N m or N."""
        d = self.data
        if not d.ncon:
            return 0.0
        forces = np.where(d.efc_type >= self._contact_rows, d.efc_force, 0.0)
        self._mujoco.mj_mulJacTVec(self.model, d, self._force, forces)
        force = float(self._force[self.scene.dof])
        # The work of a screw's link is done along its advance too.
        return force if self._advance is None else force + self.scene.asset.pitch * float(self._force[self._advance])

    def _touching(self) -> tuple[bool, float]:
        """Whether the hand pushes on the moving link, and how deep they overlap, m."""
        if not self.data.ncon:
            return False, 0.0
        contact = self.data.contact
        pairs = contact.geom
        on_link = (self.scene.moving_geoms[pairs].any(axis=1) & self.scene.hand_geoms[pairs].any(axis=1)
                   & (contact.efc_address >= 0))
        if not on_link.any():
            return False, 0.0
        normal = self.data.efc_force[contact.efc_address[on_link]]
        return bool((normal > 0).any()), max(0.0, float(-contact.dist[on_link].min()))

    def step(self, joints: np.ndarray | None) -> Step:
        """One step of the model with the hand aimed at landmarks (21, 3).

        Raises:
            Diverged: the state is no longer finite.
        """
        before = self.q
        if self.scene.hand is not None and joints is not None:
            self.scene.hand.control(self.data, joints)
        self._mujoco.mj_step(self.model, self.data)
        # mj_step leaves the contacts and forces that made this step.
        force = self._contact_force()
        contact, penetration = self._touching()
        moved = self.q - before
        if any(self.data.warning[w].number for w in self._bad):
            raise Diverged(f"the simulation of {self.scene.asset.id} became unstable at {self.data.time:.3f} s")
        along = moved * self.direction
        driven = along if along > 0 and force * moved > 0 else 0.0
        return Step(contact, penetration, driven, moved, force * self.model.opt.timestep)

    def surface_distance(self, points: np.ndarray) -> float:
        """m, least distance of points (n, 3) to the corners of the moving link's collision surface."""
        body = self.model.body("moving").id
        local = (points - self.data.xpos[body]) @ self.data.xmat[body].reshape(3, 3)
        return float(np.sqrt(((local[:, None] - self.scene.surface[None]) ** 2).sum(-1).min()))

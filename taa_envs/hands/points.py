"""A hand of contact spheres.

Spheres sit on the 21 landmarks, along the fingers' bones and across the palm. Each is a small mass of its own on three
slides (x, y, z of the asset frame), pulled to where the demonstration had it by position actuators of limited force.
There is no skeleton between them: landmarks from a monocular video change their bone lengths from frame to frame, and a
rigid chain would turn that noise into force. A sphere that meets the link stays behind its target and pushes with
``stiffness x lag``, so a centimetre of error costs newtons, not a blocked or exploding simulation.

The whole hand's force on anything is limited as well: where the actuators together would ask for more than
``total_force`` their targets are drawn in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import mujoco

TIPS = (4, 8, 12, 16, 20)
FINGERS = ((1, 2, 3, 4), (5, 6, 7, 8), (9, 10, 11, 12), (13, 14, 15, 16), (17, 18, 19, 20))
# (from, to, spheres between): the 20 bones, more spheres where the bone is long, so that neighbours overlap.
BONES = tuple((a, b, 2 if i < (2 if f == 0 else 1) else 1)
              for f, finger in enumerate(FINGERS) for i, (a, b) in enumerate(zip(finger, finger[1:], strict=False))
              ) + ((0, 1, 2), (0, 5, 4), (0, 9, 4), (0, 13, 4), (0, 17, 4))
KNUCKLES = ((5, 9), (9, 13), (13, 17))


def sphere_weights() -> np.ndarray:
    """(S, 21): sphere centres are ``weights @ landmarks``; the first 21 are the landmarks themselves."""
    rows = [np.eye(21)]
    for a, b, between in (*BONES, *((a, b, 1) for a, b in KNUCKLES)):
        for k in range(1, between + 1):
            row = np.zeros((1, 21))
            row[0, b] = k / (between + 1)
            row[0, a] = 1 - row[0, b]
            rows.append(row)
    return np.concatenate(rows)


@dataclass(frozen=True)
class PointsHand:
    """Hand of contact spheres on position actuators.

    Attributes:
        tip_radius, radius: m, of finger tips and of the other spheres.
        mass: kg a sphere; all together a hand and some of its forearm. Light beside most links, so that where the two
            overlap the hand gives way; heavy enough not to follow the landmarks' jitter from frame to frame.
        stiffness: N/m of each position actuator; damping is critical.
        sphere_force: N, limit of each actuator (one axis of one sphere).
        total_force: N, limit of the sum over spheres.
        friction: sliding friction of skin on the link.
    """

    name: str = "points"
    tip_radius: float = 0.007
    radius: float = 0.008
    mass: float = 0.02
    stiffness: float = 600.0
    sphere_force: float = 12.0
    total_force: float = 60.0
    friction: float = 1.0

    @property
    def damping(self) -> float:
        """N s/m, critical for one sphere."""
        return 2.0 * float(np.sqrt(self.stiffness * self.mass))

    def attach(self, spec: mujoco.MjSpec) -> None:
        """Add the spheres' bodies (``hand0`` ...), slides and actuators to an MjSpec."""
        import mujoco

        weights = sphere_weights()
        for i in range(len(weights)):
            tip = i in TIPS
            body = spec.worldbody.add_body(name=f"hand{i}")
            body.gravcomp = 1.0
            body.mass, body.explicitinertial = self.mass, True
            body.inertia = [0.4 * self.mass * self.radius**2] * 3
            body.add_geom(name=f"hand{i}", type=mujoco.mjtGeom.mjGEOM_SPHERE,
                          size=[self.tip_radius if tip else self.radius, 0, 0], mass=0, condim=4,
                          friction=[self.friction, 0.005, 0.0001], priority=1, group=0,
                          # Softer than MuJoCo's default: centimetres of overlap resolve in a tenth of a second.
                          solref=[0.02, 1.0], solimp=[0.9, 0.95, 0.002, 0.5, 2.0],
                          rgba=[0.9, 0.55, 0.45, 1.0] if tip else [0.9, 0.72, 0.6, 1.0])
            for k, axis in enumerate(np.eye(3)):
                joint = body.add_joint(name=f"hand{i}_{'xyz'[k]}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
                actuator = spec.add_actuator(name=joint.name, target=joint.name,
                                             trntype=mujoco.mjtTrn.mjTRN_JOINT)
                # A position servo whose target is a state that ``ctrl`` moves at so many m/s: MuJoCo then carries the
                # target along inside its own steps, with no Python between them.
                actuator.set_to_intvelocity(kp=self.stiffness, kv=self.damping)
                actuator.forcerange = [-self.sphere_force, self.sphere_force]
                actuator.forcelimited = 1

    def bind(self, model: mujoco.MjModel) -> PointsController:
        return PointsController(self, model)


class PointsController:
    """Turns landmark positions into actuator targets of a compiled scene.

    Attributes:
        lead: s by which targets must run ahead of the demonstration: a critically damped servo follows a ramp
            ``damping / stiffness`` late.
        geoms: (S,) ids of the spheres.  tip_geoms: (5,).
        qpos, dof, act, target: (S, 3) addresses in ``qpos``, ``qvel``, ``ctrl`` (velocities of the targets) and ``act``
            (the targets).
    """

    def __init__(self, hand: PointsHand, model: mujoco.MjModel) -> None:
        self.hand = hand
        self.weights = sphere_weights()
        names = [f"hand{i}" for i in range(len(self.weights))]
        self.geoms = np.array([model.geom(n).id for n in names])
        self.tip_geoms = self.geoms[list(TIPS)]
        self.qpos = np.array([[model.joint(f"{n}_{a}").qposadr[0] for a in "xyz"] for n in names])
        self.dof = np.array([[model.joint(f"{n}_{a}").dofadr[0] for a in "xyz"] for n in names])
        self.act = np.array([[model.actuator(f"{n}_{a}").id for a in "xyz"] for n in names])
        self.target = model.actuator_actadr[self.act]
        self.ctrl = model.actuator_ctrladr[self.act]  # an object's passive actuators have none
        self.lead = hand.damping / hand.stiffness

    def place(self, data: mujoco.MjData, joints: np.ndarray, velocity: np.ndarray | None = None) -> None:
        """Put the hand at landmarks (21, 3) m, moving at velocity (21, 3) m/s, and its targets there too."""
        data.qpos[self.qpos] = self.weights @ joints
        data.qvel[self.dof] = 0.0 if velocity is None else self.weights @ velocity
        data.act[self.target] = self.weights @ joints
        data.ctrl[self.ctrl] = 0.0

    def control(self, data: mujoco.MjData, joints: np.ndarray) -> None:
        """Aim at landmarks (21, 3) m within the limit of the whole hand's force."""
        target = self.weights @ joints
        here, drag = data.qpos[self.qpos], self.hand.damping * data.qvel[self.dof]
        limit = self.hand.sphere_force
        pull = np.minimum(np.maximum(self.hand.stiffness * (target - here) - drag, -limit), limit)
        total = float(np.sqrt(np.einsum("ij,ij->i", pull, pull)).sum())
        # In free motion the pull only carries the spheres' own mass; it counts against the limit all the same.
        if total > self.hand.total_force:
            target = here + (pull * (self.hand.total_force / total) + drag) / self.hand.stiffness
        data.act[self.target] = target
        data.ctrl[self.ctrl] = 0.0

    def landmarks(self, data: mujoco.MjData) -> np.ndarray:
        """(21, 3) where the landmarks are, m, asset frame; a copy."""
        return data.qpos[self.qpos[:21]].copy()

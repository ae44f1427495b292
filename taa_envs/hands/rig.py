"""Hands with joints: a hand model on a floating base, driven towards demonstrated landmarks.

The base is free. Six force-limited servos pull it towards a frame that is moved by hand (a mocap body): the arm that
nobody modelled. The fingers have their own position actuators. Targets of both come from :mod:`.retarget`, every
:data:`PERIOD` steps, and live in ``ctrl`` and the mocap pose, so that a snapshot of the simulation is one of the hand.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from taa_envs.hands.landmarks import FINGERS
from taa_envs.hands.retarget import Retargeting

if TYPE_CHECKING:
    import mujoco

PREFIX = "hand_"
PERIOD = 5  # simulation steps between two retargetings
BASE_RATE = 80.0  # rad/s, natural frequency of the base's servos
METACARPAL = 0.087  # m from the middle knuckle to the wrist, which a robot has elsewhere
BASE_FORCE, BASE_TORQUE = 60.0, 6.0  # N and N m: what an arm gives; the force is that of the hand of points


@dataclass(frozen=True)
class Skeleton:
    """Where things are in a hand model.

    Attributes:
        root: body that floats.  side: "right" or "left".
        palm: body of the palm.
        knuckles: finger -> body at its knuckle.
        chain: finger -> bodies of its two joints after the knuckle.
        tips: finger -> (body, offset (3,) m in it) of the tip's centre.
    """

    root: str
    side: str
    palm: str
    knuckles: dict[str, str]
    chain: dict[str, tuple[str, str]]
    tips: dict[str, tuple[str, tuple[float, float, float]]]


@dataclass(frozen=True)
class JointedHand:
    """A hand model with joints, ready to be put into scenes.

    Attributes:
        name: its registered name.
        load: makes a fresh ``mujoco.MjSpec`` of the hand alone.
        skeleton: where things are in it.
    """

    name: str
    load: Callable[[], mujoco.MjSpec]
    skeleton: Skeleton
    _alone: list = field(default_factory=list, repr=False, compare=False)

    def spec(self) -> mujoco.MjSpec:
        """The hand alone, floating, with the sites that :class:`.retarget.Retargeting` asks for."""
        import mujoco

        spec, s = self.load(), self.skeleton
        spec.compiler.degree = False
        for key in list(spec.keys):
            spec.delete(key)
        root = spec.body(s.root)
        if not any(j.type == mujoco.mjtJoint.mjJNT_FREE for j in root.joints):
            root.add_freejoint(name="base")
        for body in spec.bodies:
            body.gravcomp = 1.0
        turn, origin = self._palm_axes()
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, turn.ravel())
        spec.body(s.palm).add_site(name="palm", pos=origin, quat=quat, group=5)
        spec.body(s.root).add_site(name="base", group=5)
        for finger, (body, offset) in s.tips.items():
            spec.body(body).add_site(name=f"tip_{finger}", pos=list(offset), group=5)
        return spec

    def _palm_axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotation (3, 3) and origin (3,) m of the palm's site in the palm's body, from where the knuckles are."""
        import mujoco

        spec, s = self.load(), self.skeleton
        spec.compiler.degree = False
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        palm = model.body(s.palm).id
        at = {f: (data.xpos[model.body(b).id] - data.xpos[palm]) @ data.xmat[palm].reshape(3, 3)
              for f, b in s.knuckles.items()}
        last = at["little"] if "little" in at else at["ring"]
        x = (at["index"] - last) * (1 if s.side == "right" else -1)
        x /= np.linalg.norm(x)
        y = at["middle"] - model.body(s.palm).ipos  # fingers grow away from the palm's mass
        y -= (y @ x) * x
        y /= np.linalg.norm(y)
        return np.stack([x, y, np.cross(x, y)], axis=1), at["middle"]

    def attach(self, spec: mujoco.MjSpec) -> None:
        """Add the hand, the frame that its base follows, and the base's servos."""
        import mujoco

        alone = self.spec()
        model = self.spec().compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        spec.attach(alone, prefix=PREFIX, frame=spec.worldbody.add_frame())
        target = spec.worldbody.add_body(name=f"{PREFIX}target", mocap=True)
        target.add_site(name=f"{PREFIX}target", group=5)
        for i, axis in enumerate("xyz" * 2):
            turning = i >= 3
            moved = float(inertia[3:6, 3:6].diagonal().max() if turning else inertia[0, 0])
            actuator = spec.add_actuator(name=f"{PREFIX}base_{'r' if turning else ''}{axis}",
                                         trntype=mujoco.mjtTrn.mjTRN_SITE, target=f"{PREFIX}base",
                                         refsite=f"{PREFIX}target")
            actuator.set_to_position(kp=moved * BASE_RATE**2, kv=2 * moved * BASE_RATE)
            gear = np.zeros(6)
            gear[i] = 1.0
            actuator.gear = gear
            limit = BASE_TORQUE if turning else BASE_FORCE
            actuator.forcerange, actuator.forcelimited = [-limit, limit], 1
        self._alone[:] = [model]

    def bind(self, model: mujoco.MjModel) -> JointedController:
        return JointedController(self, model, self._alone[0] if self._alone else self.spec().compile())


class JointedController:
    """Retargets landmarks and aims a compiled hand's servos.

    Attributes:
        lead: s by which its targets must run ahead: the lag of the base's critically damped servos.
        retargeting: the solver; ``retargeting.unsolved`` counts steps without a solution.
    """

    def __init__(self, hand: JointedHand, model: mujoco.MjModel, alone: mujoco.MjModel) -> None:
        self.hand, self.model = hand, model
        self.lead = 2.0 / BASE_RATE
        s = hand.skeleton
        self.retargeting = Retargeting(alone, s.side, tuple(s.tips))
        names = [alone.joint(j).name for j in range(alone.njnt)]
        base = model.joint(PREFIX + names[0])
        self._base_q, self._base_v = int(base.qposadr[0]), int(base.dofadr[0])
        self._q = np.array([int(model.joint(PREFIX + n).qposadr[0]) for n in names[1:]])
        self._v = np.array([int(model.joint(PREFIX + n).dofadr[0]) for n in names[1:]])
        self._mocap = int(model.body(f"{PREFIX}target").mocapid[0])
        own = [alone.actuator(i).name for i in range(alone.nu)]
        self._ctrl = model.actuator_ctrladr[[model.actuator(PREFIX + n).id for n in own]]
        self._servos = model.actuator_ctrladr[[model.actuator(f"{PREFIX}base_{a}").id
                                               for a in ("x", "y", "z", "rx", "ry", "rz")]]  # fmt: skip
        self._transmission = _transmission(alone)
        self._inverse = np.linalg.pinv(self._transmission)
        self._range = (np.where(alone.actuator_ctrllimited, alone.actuator_ctrlrange[:, 0], -np.inf),
                       np.where(alone.actuator_ctrllimited, alone.actuator_ctrlrange[:, 1], np.inf))
        body = lambda name: model.body(PREFIX + name).id  # noqa: E731
        self._palm = model.site(f"{PREFIX}palm").id
        self._sites = {f: model.site(f"{PREFIX}tip_{f}").id for f in s.tips}
        self._chains = {f: [body(s.knuckles[f]), *(body(b) for b in s.chain[f])] for f in s.tips}

    def place(self, data: mujoco.MjData, joints: np.ndarray, velocity: np.ndarray | None = None) -> None:
        """Put the hand, as far as its joints allow, at landmarks (21, 3) m, moving at their mean velocity."""
        q = self.retargeting.start(joints)
        data.qpos[self._base_q:self._base_q + 7] = q[:7]
        data.qpos[self._q] = q[7:]
        data.qvel[self._base_v:self._base_v + 6] = 0.0
        data.qvel[self._v] = 0.0
        if velocity is not None:
            data.qvel[self._base_v:self._base_v + 3] = velocity.mean(0)
        self.aim(data, q)

    def aim(self, data: mujoco.MjData, q: np.ndarray) -> None:
        """Make configuration q (7 + n,) the target of all servos."""
        data.mocap_pos[self._mocap], data.mocap_quat[self._mocap] = q[:3], q[3:7]
        data.ctrl[self._ctrl] = np.clip(self._transmission @ q[7:], *self._range)
        data.ctrl[self._servos] = 0.0

    def target(self, data: mujoco.MjData) -> np.ndarray:
        """(7 + n,) configuration that the servos aim at; joints that share an actuator share its target."""
        hinges = np.clip(self._inverse @ data.ctrl[self._ctrl], self.retargeting.low, self.retargeting.high)
        return np.concatenate([data.mocap_pos[self._mocap], data.mocap_quat[self._mocap], hinges])

    def control(self, data: mujoco.MjData, joints: np.ndarray) -> None:
        """Aim at landmarks (21, 3) m; between two retargetings the targets stay."""
        dt = self.model.opt.timestep
        if round(data.time / dt) % PERIOD == 0:
            self.aim(data, self.retargeting.step(self.target(data), joints, PERIOD * dt))

    def landmarks(self, data: mujoco.MjData) -> np.ndarray:
        """(21, 3) m where the landmarks are; a finger that the hand has not is where its neighbour is."""
        out = np.empty((21, 3))
        out[0] = data.site_xpos[self._palm] - METACARPAL * data.site_xmat[self._palm].reshape(3, 3)[:, 1]
        for finger, joints in FINGERS.items():
            name = finger if finger in self._sites else "ring"
            for joint, body in zip(joints, self._chains[name], strict=False):
                out[joint] = data.xpos[body]
            out[joints[-1]] = data.site_xpos[self._sites[name]]
        return out


def _transmission(model: mujoco.MjModel) -> np.ndarray:
    """(nu, n) how actuator lengths follow from the hinges: 1 for its own joint, coefficients for a fixed tendon."""
    import mujoco

    out = np.zeros((model.nu, model.njnt - 1))
    for i in range(model.nu):
        kind, target = int(model.actuator_trntype[i]), int(model.actuator_trnid[i, 0])
        if kind == int(mujoco.mjtTrn.mjTRN_JOINT):
            out[i, target - 1] = model.actuator_gear[i, 0]
        elif kind == int(mujoco.mjtTrn.mjTRN_TENDON):
            first = int(model.tendon_adr[target])
            for k in range(first, first + int(model.tendon_num[target])):
                out[i, int(model.wrap_objid[k]) - 1] = model.actuator_gear[i, 0] * model.wrap_prm[k]
        else:
            raise ValueError(f"actuator {model.actuator(i).name} moves neither a joint nor a tendon")
    return out

"""What a cause is: a name, parameters with bounds, features for a first guess, and an edit of an MjSpec."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import mujoco
import numpy as np

from diagnose.plant import Plant
from diagnose.simulate import Episode, Frame

Terms = dict[str, float]


@dataclass(frozen=True)
class Motion:
    """The measured motion, pooled over the episodes that are fitted; all (N,) unless said otherwise.

    Attributes:
        q, v, a: smoothed position, velocity, acceleration.
        residual: the torque that the nominal model lacks, u + s(q) - damping - friction - I a.
        plant, frame: the joint and the box the motion fills.
        torque: a typical torque, N m or N.  largest: the largest torque in play.
        speed: 95th percentile of |v|.  dt: sampling interval, s.
    """

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    residual: np.ndarray
    plant: Plant
    frame: Frame
    torque: float
    largest: float
    speed: float
    dt: float

    @property
    def span(self) -> float:
        return self.frame.q[1] - self.frame.q[0]

    @classmethod
    def of(cls, plant: Plant, episodes: list[Episode]) -> Motion:
        q, v, a, u = (np.concatenate([getattr(e, k) for e in episodes]) for k in ("q", "v", "a", "u"))
        static = plant.static(q)
        b1, b2, b3 = plant.damping
        residual = (u + static - b1 * v - b2 * v * np.abs(v) - b3 * v**3 - plant.frictionloss * np.sign(v)
                    - plant.inertia * a)  # fmt: skip
        rms = lambda x: float(np.sqrt(np.mean(x * x)))  # noqa: E731
        largest = float(max(np.percentile(np.abs(plant.inertia * a), 98), np.abs(u).max(), np.abs(static).max()))
        speed = float(np.percentile(np.abs(v), 95)) + 1e-9
        return cls(q, v, a, residual, plant, frame_of(episodes), max(rms(plant.inertia * a), 0.1 * largest, 1e-12),
                   max(largest, 1e-12), speed, float(np.median([e.log.dt for e in episodes])))  # fmt: skip


def frame_of(episodes: list[Episode]) -> Frame:
    q = np.concatenate([e.q for e in episodes])
    v = np.concatenate([e.v for e in episodes])
    return Frame((float(q.min()), float(q.max())), (float(v.min()), float(v.max())))


@dataclass(frozen=True)
class Parameter:
    """One number of a cause.

    Attributes:
        term: the simulation's term it sets.  name: as reported.
        unit: with {q} for rad or m and {t} for N m or N.
        bounds: (lower, upper) from the motion.  scale: a step that matters.
        prior: one line, what is usual.
    """

    term: str
    name: str
    unit: str
    bounds: Callable[[Motion], tuple[float, float]]
    scale: Callable[[Motion], float]
    prior: str = ""


@dataclass(frozen=True)
class Cause:
    """One thing that can be wrong.

    Attributes:
        name: of the contract.  sentence: the physics.  parameters: what is fitted.
        features: (motion, shape) -> {term: (N,) torque against the motion per unit of the term}, for the first guess.
        reading: the same for what a term of the measurement adds to the position read, (N,) rad or m.
        shapes: motion -> starts for the terms that are not linear, one dict a start.
        decisive: terms of which one must differ from 0.
        edit: (spec, joint, terms, plant, frame) puts it into the model; None for faults of the measurement.
        measurement: True if the sensor is at fault, not the mechanism.
        contains: names of causes that are special cases of this one.
        hinge_only: not for slides.
        experiment: what to record to tell it from others.
    """

    name: str
    sentence: str
    parameters: tuple[Parameter, ...]
    decisive: tuple[str, ...]
    features: Callable[[Motion, Terms], dict[str, np.ndarray]] = lambda motion, shape: {}
    reading: Callable[[Motion, Terms], dict[str, np.ndarray]] = lambda motion, shape: {}
    shapes: Callable[[Motion], list[Terms]] = field(default=lambda motion: [{}])
    edit: Callable[[mujoco.MjSpec, str, Terms, Plant, Frame], None] | None = None
    measurement: bool = False
    contains: tuple[str, ...] = ()
    hinge_only: bool = False
    experiment: str = ""


def angle(spec: mujoco.MjSpec, plant: Plant, value: float) -> float:
    """A joint position in the unit that the spec's compiler expects."""
    return float(np.degrees(value)) if plant.hinge and spec.compiler.degree else float(value)


def add_linear(spec: mujoco.MjSpec, joint: str, plant: Plant, stiffness: float, rest: float) -> None:
    """Add the torque ``-stiffness (q - rest)`` to the joint's own spring."""
    j = spec.joint(joint)
    old = float(j.stiffness[0])
    reference = float(j.springref) * (np.pi / 180 if plant.hinge and spec.compiler.degree else 1.0)
    total = old + stiffness
    poly = np.array(j.stiffness, float)
    poly[0] = total
    j.stiffness = poly
    if total != 0:
        j.springref = angle(spec, plant, (old * reference + stiffness * rest) / total)


def add_constant(spec: mujoco.MjSpec, joint: str, plant: Plant, frame: Frame, torque: float) -> None:
    """Add a constant torque: a spring so soft, its rest so far away, that it varies by 1e-6 over the motion."""
    k = 1e-6 * abs(torque) / (frame.q[1] - frame.q[0])
    if k > 0:
        add_linear(spec, joint, plant, k, frame.middle + torque / k)


def add_wave(spec: mujoco.MjSpec, joint: str, name: str, sine: float, cosine: float, rate: float) -> None:
    """Add the torque ``sine sin(rate q) + cosine cos(rate q)``: a passive dcmotor's position ripple (nu stays)."""
    motor = spec.add_actuator()
    motor.name = name
    motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
    motor.target = joint
    passive_motor(motor, cogging=[float(np.hypot(sine, cosine)), rate, float(np.arctan2(cosine, sine))])


def passive_motor(motor: mujoco.MjsActuator, **terms: list[float]) -> None:
    """Make an actuator a dcmotor without input: a tiny motor constant behind a large resistance."""
    donor = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><body><joint name='j'/><geom size='.1'/></body></worldbody><actuator>"
        f"<dcmotor joint='j' motorconst='1e-6' resistance='1e6' input='none' {text_of(terms)}/></actuator></mujoco>"
    ).actuators[0]
    for key in ("gaintype", "biastype", "dyntype", "gainprm", "biasprm", "dynprm", "ctrlspec", "actdim", "damping",
                "actearly"):
        setattr(motor, key, getattr(donor, key))


def add_dry_friction(spec: mujoco.MjSpec, joint: str, plant: Plant, level: float) -> None:
    """Add to the joint's friction loss and make its constraint hard.

    MuJoCo's default creeps under load (3e-4 rad/s at half the break-away load) and needs 10 ms to stop.
    """
    j = spec.joint(joint)
    j.frictionloss = float(j.frictionloss) + level
    j.solimp_friction = [0.9999, 0.9999, 0.001, 0.5, 2.0]
    j.solref_friction = [2.0 * plant.timestep, 1.0]


def text_of(terms: dict[str, list[float]]) -> str:
    return " ".join(f"{k}='{' '.join(repr(float(x)) for x in v)}'" for k, v in terms.items())

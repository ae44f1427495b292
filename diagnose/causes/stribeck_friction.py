"""Dry friction that is higher near standstill: it sticks, then slips."""

import mujoco
import numpy as np

from diagnose.causes.base import Cause, Parameter, add_dry_friction, passive_motor


def edit(spec, joint, terms, plant, frame):
    add_dry_friction(spec, joint, plant, terms["coulomb"])
    # The part above the Coulomb level is a LuGre element; its bristles yield over 1e-4 of the motion.
    motor = spec.add_actuator()
    motor.name = f"{joint}_stribeck"
    motor.trntype, motor.target = mujoco.mjtTrn.mjTRN_JOINT, joint
    stiff = min(terms["stiction"] / (1e-4 * (frame.q[1] - frame.q[0])), 0.05 * plant.inertia / plant.timestep**2)
    passive_motor(motor, lugre=[stiff, 0.0, 0.0, terms["stiction"], terms["stribeck_velocity"]])


def features(m, shape):
    x = np.exp(-np.minimum((m.v / shape["stribeck_velocity"]) ** 2, 80))
    return {"coulomb": np.sign(m.v), "stiction": np.sign(m.v) * x}


CAUSE = Cause(
    "stribeck_friction", "Dry friction that falls from a static to a sliding level as the speed rises.",
    (Parameter("coulomb", "sliding_friction", "{t}", lambda m: (-m.plant.frictionloss, 2 * m.largest),
               lambda m: m.torque, "door hinges 0.1 to 3 N m"),
     Parameter("stiction", "static_minus_sliding", "{t}", lambda m: (0.0, 2 * m.largest), lambda m: m.torque,
               "0.2 to 1 times the sliding friction"),
     Parameter("stribeck_velocity", "stribeck_velocity", "{q}/s", lambda m: (0.01 * m.speed, m.speed),
               lambda m: 0.2 * m.speed, "0.01 to 0.3 rad/s")),
    ("stiction",), features=features, shapes=lambda m: [{"stribeck_velocity": s * m.speed} for s in (0.08, 0.3)],
    edit=edit, contains=("coulomb_friction",),
    experiment="pull very slowly, with many stops and starts in both directions",
)  # fmt: skip

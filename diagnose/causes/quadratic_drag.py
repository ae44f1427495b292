"""Resistance that grows with the square of speed: air, a fluid."""

import numpy as np

from diagnose.causes.base import Cause, Parameter


def edit(spec, joint, terms, plant, frame):
    j = spec.joint(joint)
    damping = list(j.damping)
    damping[1] += terms["drag"]
    j.damping = damping


CAUSE = Cause(
    "quadratic_drag", "A torque against the motion in proportion to the square of its speed.",
    (Parameter("drag", "drag", "{t} s^2/{q}^2", lambda m: (-m.plant.damping[1], 50 * m.largest / m.speed**2),
               lambda m: m.torque / m.speed**2, "a door leaf in air 0.05 to 1 N m s^2/rad^2"),),
    ("drag",), features=lambda m, _: {"drag": m.v * np.abs(m.v)}, edit=edit,
    experiment="record the same motion at twice and at half the speed",
)  # fmt: skip

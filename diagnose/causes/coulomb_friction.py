"""Dry friction: a constant resistance that turns round with the motion."""

import numpy as np

from diagnose.causes.base import Cause, Parameter, add_dry_friction


def edit(spec, joint, terms, plant, frame):
    add_dry_friction(spec, joint, plant, terms["coulomb"])


CAUSE = Cause(
    "coulomb_friction", "A constant torque against the motion, whatever its speed; it changes sign on reversal.",
    (Parameter("coulomb", "friction", "{t}", lambda m: (-m.plant.frictionloss, 2 * m.largest),
               lambda m: m.torque, "door hinges 0.1 to 3 N m"),),
    ("coulomb",), features=lambda m, _: {"coulomb": np.sign(m.v)}, edit=edit,
    experiment="let go from the other side, so that the motion also runs in the other direction",
)  # fmt: skip

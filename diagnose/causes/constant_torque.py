"""A torque that is always there: a closer, a counterweight, a tilt of a slide."""

import numpy as np

from diagnose.causes.base import Cause, Parameter, add_constant


def edit(spec, joint, terms, plant, frame):
    add_constant(spec, joint, plant, frame, terms["torque"])


CAUSE = Cause(
    "constant_torque", "The same torque at every position and speed, in one direction.",
    (Parameter("torque", "torque", "{t}", lambda m: (-3 * m.largest, 3 * m.largest), lambda m: m.torque,
               "closers 0.5 to 20 N m"),),
    ("torque",), features=lambda m, _: {"torque": -np.ones_like(m.q)}, edit=edit,
    experiment="let go from the other side, so that the motion also runs in the other direction",
)  # fmt: skip

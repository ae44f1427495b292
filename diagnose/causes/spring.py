"""A spring: torque in proportion to the distance from a rest position."""

import numpy as np

from diagnose.causes.base import Cause, Parameter, add_linear


def edit(spec, joint, terms, plant, frame):
    k = terms["stiffness"]
    add_linear(spec, joint, plant, k, frame.middle + terms["spring_torque"] / k)


CAUSE = Cause(
    "spring", "A torque towards a rest position, in proportion to the distance from it.",
    (Parameter("stiffness", "stiffness", "{t}/{q}", lambda m: (-m.plant.stiffness, 50 * m.largest / m.span),
               lambda m: m.torque / m.span, "spring hinges 0.2 to 5 N m/rad"),
     Parameter("spring_torque", "torque_at_middle", "{t}", lambda m: (-5 * m.largest, 5 * m.largest),
               lambda m: m.torque)),
    ("stiffness",), edit=edit, contains=("constant_torque",),
    features=lambda m, _: {"stiffness": m.q - m.frame.middle, "spring_torque": -np.ones_like(m.q)},
    experiment="hold it still at several positions over the whole range and log the torque that this takes",
)  # fmt: skip

"""Resistance in proportion to speed: grease, a linear damper."""

from diagnose.causes.base import Cause, Parameter


def edit(spec, joint, terms, plant, frame):
    j = spec.joint(joint)
    damping = list(j.damping)
    damping[0] += terms["damping"]
    j.damping = damping


CAUSE = Cause(
    "viscous_damping", "A torque against the motion in proportion to its speed.",
    (Parameter("damping", "damping", "{t} s/{q}", lambda m: (-m.plant.damping[0], 50 * m.largest / m.speed),
               lambda m: m.torque / m.speed, "furniture 0.01 to 2 N m s/rad"),),
    ("damping",), features=lambda m, _: {"damping": m.v}, edit=edit,
    experiment="let it coast from a high speed down to rest: friction that grows with speed decays exponentially",
)  # fmt: skip

"""The library of causes, one file each; :data:`CAUSES` maps the contract's names to them."""

from diagnose.causes import (
    backlash,
    constant_torque,
    coulomb_friction,
    detent,
    end_stop,
    gravity_torque,
    inertia,
    quadratic_drag,
    sensor_bias,
    sensor_distortion,
    sensor_gain,
    spring,
    stribeck_friction,
    time_delay,
    viscous_damping,
)
from diagnose.causes.base import Cause, Motion, Parameter, frame_of

CAUSES: dict[str, Cause] = {
    m.CAUSE.name: m.CAUSE
    for m in (viscous_damping, quadratic_drag, coulomb_friction, stribeck_friction, spring, constant_torque,
              gravity_torque, inertia, backlash, end_stop, detent, time_delay, sensor_bias, sensor_gain,
              sensor_distortion)
}  # fmt: skip

#: Causes that compete but are never named; where one wins the verdict is ``unexplained``.
UNNAMED = ("sensor_distortion",)

__all__ = ["CAUSES", "UNNAMED", "Cause", "Motion", "Parameter", "frame_of"]

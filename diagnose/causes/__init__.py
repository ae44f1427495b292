"""The library of causes, one file each; :data:`CAUSES` maps the contract's names to them."""

from diagnose.causes import (
    axis_misalignment,
    backlash,
    constant_torque,
    coulomb_friction,
    detent,
    end_stop,
    free_torques,
    gravity_torque,
    inertia,
    pivot_offset,
    quadratic_drag,
    second_joint,
    sensor_bias,
    sensor_distortion,
    sensor_gain,
    spring,
    stribeck_friction,
    time_delay,
    viscous_damping,
)
from diagnose.causes.base import Cause, Motion, Parameter, frame_of
from diagnose.causes.place import PlaceCause

CAUSES: dict[str, Cause] = {
    m.CAUSE.name: m.CAUSE
    for m in (viscous_damping, quadratic_drag, coulomb_friction, stribeck_friction, spring, constant_torque,
              gravity_torque, inertia, backlash, end_stop, detent, time_delay, sensor_bias, sensor_gain,
              sensor_distortion)
}  # fmt: skip

#: Faults of the joint's place, seen in 3D points only; see :mod:`diagnose.geometry`.
PLACES: dict[str, PlaceCause] = {m.CAUSE.name: m.CAUSE for m in (axis_misalignment, pivot_offset, second_joint)}

#: Causes that compete but are never named; where one wins the verdict is ``unexplained``.
UNNAMED = ("sensor_distortion",)

__all__ = ["CAUSES", "PLACES", "UNNAMED", "Cause", "Motion", "Parameter", "PlaceCause", "frame_of", "free_torques"]

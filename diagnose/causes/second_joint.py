"""The part moves in a second way: a worn hinge, a leaf that lifts, a drawer that rocks."""

import mujoco
import numpy as np

from diagnose.causes.place import PlaceCause, body_frame, number, vector


def is_slide(geometry):
    return not np.any(geometry.twist[3:])


def line(geometry):
    """Direction (3,) and a point (3,) of the second joint, world, with the part at its reference position."""
    u, w = geometry.twist[:3], geometry.twist[3:]
    if is_slide(geometry):
        return u, geometry.anchor
    return w, geometry.anchor + np.cross(w, u)  # |w| = 1 and u is across it


def edit(spec, joint, geometry, plant):
    turn, place = body_frame(spec, joint)
    direction, point = line(geometry)
    first = spec.joint(joint)
    new = first.parent.add_joint(name=f"{joint}_second", axis=turn.T @ direction, pos=turn.T @ (point - place))
    new.type = mujoco.mjtJoint.mjJNT_SLIDE if is_slide(geometry) else mujoco.mjtJoint.mjJNT_HINGE
    return new


def report(g):
    direction, point = line(g)
    out = vector("axis", direction, "1", g.twist_cov)
    if not is_slide(g):
        out |= vector("point", point, "m", np.zeros((3, 3)))
    s = np.concatenate(g.second)
    unit = "m" if is_slide(g) else "rad"
    return out | {"travel": number(float(np.ptp(s)), unit, 2 * g.second_std)}


CAUSE = PlaceCause(
    "second_joint", "Beside turning (or sliding) as modelled, the part moves along one more fixed path.",
    "hold the joint still and shake the part, with at least three points on it logged", edit, report,
)  # fmt: skip

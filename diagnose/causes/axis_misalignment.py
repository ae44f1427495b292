"""The axis points elsewhere than in the model."""

import numpy as np

from diagnose.causes.place import PlaceCause, body_frame, length, number, vector


def edit(spec, joint, geometry, plant):
    turn, _ = body_frame(spec, joint)
    spec.joint(joint).axis = turn.T @ geometry.axis


def report(g):
    tilt, std = length(g.tilt, g.cov[:2, :2])
    return {"tilt": number(np.arctan(tilt), "rad", std / (1 + tilt * tilt)),
            **vector("axis", g.axis, "1", g.across.T @ g.cov[:2, :2] @ g.across)}  # fmt: skip


CAUSE = PlaceCause(
    "axis_misalignment", "The axis is tilted against the model's: points on the part run on tilted paths.",
    "log points on the part far from the axis, over more of the range", edit, report,
)  # fmt: skip

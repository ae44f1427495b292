"""The axis passes elsewhere than in the model."""

from diagnose.causes.place import PlaceCause, body_frame, length, number, vector


def edit(spec, joint, geometry, plant):
    turn, place = body_frame(spec, joint)
    # What was fitted lies across the axis; along it the joint may stay where it is.
    spec.joint(joint).pos = turn.T @ (geometry.anchor - place)


def report(g):
    away, std = length(g.offset, g.cov[2:, 2:])
    return {"distance": number(away, "m", std),
            **vector("offset", g.offset @ g.across, "m", g.across.T @ g.cov[2:, 2:] @ g.across)}  # fmt: skip


CAUSE = PlaceCause(
    "pivot_offset", "The axis passes beside the model's: points on the part turn about another centre.",
    "log points on the part close to the hinge and far from it, over more of the range", edit, report, hinge_only=True,
)  # fmt: skip

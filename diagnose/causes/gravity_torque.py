"""Gravity acts otherwise than modelled: a tilted axis, a moved centre of mass."""

import numpy as np

from diagnose.causes.base import Cause, Parameter, add_wave


def edit(spec, joint, terms, plant, frame):
    # Position ripple of period one turn is exactly the torque of a weight; the inertia is left alone.
    add_wave(spec, joint, f"{joint}_gravity", terms["gravity_sin"], terms["gravity_cos"], 1.0)


def _p(term, name):
    return Parameter(term, name, "{t}", lambda m: (-10 * m.largest, 10 * m.largest), lambda m: m.torque,
                     "m g r times the sine of the tilt")  # fmt: skip


CAUSE = Cause(
    "gravity_torque", "A weight off the axis: a torque that goes with the sine and cosine of the angle.",
    (_p("gravity_sin", "sine"), _p("gravity_cos", "cosine")), ("gravity_sin", "gravity_cos"),
    features=lambda m, _: {"gravity_sin": -np.sin(m.q), "gravity_cos": -np.cos(m.q)}, edit=edit, hinge_only=True,
    experiment="hold it still at positions that span at least half a turn (or the whole range) and log the torque",
)  # fmt: skip

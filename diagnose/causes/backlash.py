"""Lost motion between the part and what is read: a gear, a loose coupling, a handle on a worn pin."""

import numpy as np

from diagnose.causes.base import Cause, Parameter

CAUSE = Cause(
    "backlash", "At each reversal the reading stands still until the part has crossed the play.",
    (Parameter("play", "play", "{q}", lambda m: (0.0, 0.5 * m.span), lambda m: 0.02 * m.span,
               "gears 0.002 to 0.05 rad"),), ("play",),
    measurement=True, reading=lambda m, _: {"play": -0.5 * np.sign(m.v)},
    experiment="move it to and fro by hand and log the position of the part itself as well",
)  # fmt: skip

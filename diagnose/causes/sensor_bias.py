"""The sensor's zero is off."""

import numpy as np

from diagnose.causes.base import Cause, Parameter

CAUSE = Cause(
    "sensor_bias", "A constant is added to the position.",
    (Parameter("bias", "bias", "{q}", lambda m: (-0.5 * m.span, 0.5 * m.span), lambda m: 0.05 * m.span,
               "a few degrees"),), ("bias",),
    measurement=True, reading=lambda m, _: {"bias": np.ones_like(m.q)},
    experiment="log the position at a known place (hanging at rest, or against the closed stop)",
)  # fmt: skip

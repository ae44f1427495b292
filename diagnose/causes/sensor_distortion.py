"""The sensor's scale varies over the range: a competitor that is never named, so that its torques are not named either.

A cam, a linkage or a lens between the part and its sensor bends the scale. What it does to a swing looks like a small
inertia, spring or damping; a search without it would name one of those.
"""

from diagnose.causes.base import Cause, Parameter

CAUSE = Cause(
    "sensor_distortion", "The position is bent: its scale changes over the range.",
    (Parameter("gain", "gain_error", "1", lambda m: (-0.5, 0.5), lambda m: 0.05),
     Parameter("bend", "bend", "1/{q}", lambda m: (-0.5 / m.span, 0.5 / m.span), lambda m: 0.05 / m.span),
     Parameter("twist", "twist", "1/{q}^2", lambda m: (-1 / m.span**2, 1 / m.span**2), lambda m: 0.1 / m.span**2)),
    ("bend", "twist"), measurement=True, contains=("sensor_gain",),
    experiment="log the position at five known places over the range",
)  # fmt: skip

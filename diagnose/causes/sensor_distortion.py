"""The sensor's scale varies over the range: a competitor that is never named, so that its torques are not named either.

A cam, a linkage or a lens between the part and its sensor bends the scale. What it does to a swing looks like a small
inertia, spring or damping; a search without it would name one of those.
"""

from diagnose.causes.base import Cause, Parameter


def _bend(order):
    return Parameter(f"bend{order}", f"bend{order}", f"1/{{q}}^{order - 1}",
                     lambda m: (-2 / m.span ** (order - 1), 2 / m.span ** (order - 1)),
                     lambda m: 0.2 / m.span ** (order - 1))  # fmt: skip


CAUSE = Cause(
    "sensor_distortion", "The position is bent: its scale changes over the range.",
    (Parameter("gain", "gain_error", "1", lambda m: (-0.5, 0.5), lambda m: 0.05), *map(_bend, (2, 3, 4, 5))),
    ("bend2", "bend3", "bend4", "bend5"), measurement=True, contains=("sensor_gain",),
    reading=lambda m, _: {"gain": m.q, **{f"bend{k}": (m.q - m.frame.middle) ** k for k in (2, 3, 4, 5)}},
    experiment="log the position at five known places over the range",
)  # fmt: skip

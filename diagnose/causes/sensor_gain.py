"""The sensor's scale is off."""

from diagnose.causes.base import Cause, Parameter

CAUSE = Cause(
    "sensor_gain", "The position is multiplied by a constant.",
    (Parameter("gain", "gain_error", "1", lambda m: (-0.5, 0.5), lambda m: 0.05, "a few per cent"),), ("gain",),
    measurement=True, reading=lambda m, _: {"gain": m.q},
    experiment="log the position at two places a known distance apart",
)  # fmt: skip

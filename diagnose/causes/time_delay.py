"""The recorded position is late against the recorded inputs."""

from diagnose.causes.base import Cause, Parameter

CAUSE = Cause(
    "time_delay", "The position column shows what was a moment ago.",
    (Parameter("delay", "delay", "s", lambda m: (-10 * m.dt, 20 * m.dt), lambda m: m.dt, "0 to 50 ms"),), ("delay",),
    measurement=True, reading=lambda m, _: {"delay": -m.v},
    experiment="tap the part with the logged force at known times, or log both on one clock",
)  # fmt: skip

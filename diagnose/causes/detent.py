"""A catch: a place that holds the part, and lets go beyond a peak torque."""

import numpy as np

from diagnose.causes.base import Cause, Parameter, add_wave


def torque(terms, q):
    x = (q - terms["detent_place"]) / terms["detent_width"]
    return -terms["detent_strength"] * x * np.exp(0.5 - 0.5 * x * x)


def waves(terms, frame):
    """Sines and cosines that add up to the catch within the motion's range: (rates, sine, cosine), each (K,)."""
    span = frame.q[1] - frame.q[0]
    grid = np.linspace(frame.q[0] - 0.2 * span, frame.q[1] + 0.2 * span, 2001)
    period = 1.5 * span
    count = int(np.clip(np.ceil(4.0 * period / (2 * np.pi * terms["detent_width"])), 4, 150))
    rates = 2 * np.pi * np.arange(1, count + 1) / period
    basis = np.concatenate([np.sin(grid[:, None] * rates), np.cos(grid[:, None] * rates)], axis=1)
    c = np.linalg.lstsq(basis, torque(terms, grid), rcond=1e-6)[0]
    return rates, c[:count], c[count:]


def edit(spec, joint, terms, plant, frame):
    for k, (rate, sine, cosine) in enumerate(zip(*waves(terms, frame), strict=True)):
        add_wave(spec, joint, f"{joint}_detent_{k}", sine, cosine, rate)


CAUSE = Cause(
    "detent", "A catch that pulls towards a place; its torque peaks one width away and fades beyond.",
    (Parameter("detent_place", "place", "{q}", lambda m: (m.frame.q[0] - 0.1 * m.span, m.frame.q[1] + 0.1 * m.span),
               lambda m: 0.1 * m.span),
     Parameter("detent_strength", "peak_torque", "{t}", lambda m: (-3 * m.largest, 3 * m.largest), lambda m: m.torque,
               "cabinets 1 to 4 N m, dishwasher catch 15 N m"),
     Parameter("detent_width", "width", "{q}", lambda m: (0.01 * m.span, 0.25 * m.span), lambda m: 0.05 * m.span,
               "0.02 to 0.2 rad")),
    ("detent_strength",), edit=edit,
    features=lambda m, s: {"detent_strength": -torque({**s, "detent_strength": 1.0}, m.q)},
    shapes=lambda m: [{"detent_place": m.frame.q[0] + p * m.span, "detent_width": w * m.span}
                      for w in (0.02, 0.05, 0.12) for p in np.linspace(0, 1, 34)],
    experiment="move slowly through the place in both directions and log the torque",
)  # fmt: skip

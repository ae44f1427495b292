"""A stop within the range: hard, soft, or damped."""

import numpy as np

from diagnose.causes.base import Cause, Parameter, angle


def edit(spec, joint, terms, plant, frame):
    j = spec.joint(joint)
    inertia = plant.inertia + terms.get("inertia", 0.0)
    far = 1e3 * (frame.q[1] - frame.q[0])
    low, high = plant.limits if plant.limits is not None else (frame.middle - far, frame.middle + far)
    if terms["stop_place"] >= frame.middle:
        high = terms["stop_place"]
    else:
        low = terms["stop_place"]
    j.range = [angle(spec, plant, low), angle(spec, plant, high)]
    j.limited = 1
    # With this little impedance MuJoCo's limit is a spring and a damper beside the other torques, not in their place.
    j.solimp_limit = [1e-3, 1e-3, 1e-3, 0.5, 2.0]
    j.solref_limit = [-terms["stop_stiffness"] / inertia, -max(terms["stop_damping"], 1e-9) / inertia]


def features(m, shape):
    side = 1.0 if shape["stop_place"] >= m.frame.middle else -1.0
    deep = side * (m.q - shape["stop_place"])
    inside = deep > 0
    return {"stop_stiffness": side * deep * inside, "stop_damping": m.v * inside}


def stiffest(m):
    return 0.1 * m.plant.inertia / min(m.dt, 2.5e-3) ** 2


CAUSE = Cause(
    "end_stop", "Beyond a place a stiff spring and a damper push back.",
    (Parameter("stop_place", "place", "{q}", lambda m: (m.frame.q[0], m.frame.q[1]), lambda m: 0.05 * m.span),
     Parameter("stop_stiffness", "stiffness", "{t}/{q}", lambda m: (0.0, stiffest(m)),
               lambda m: 2 * m.torque / (0.05 * m.span), "rubber buffers 1e2 to 1e4 N m/rad"),
     Parameter("stop_damping", "damping", "{t} s/{q}", lambda m: (0.0, 100 * m.largest / m.speed),
               lambda m: m.torque / m.speed)),
    ("stop_stiffness",), features=features, edit=edit,
    shapes=lambda m: [{"stop_place": m.frame.q[0] + s * m.span}
                      for s in (*np.linspace(0.01, 0.4, 27), *np.linspace(0.6, 0.99, 27))],
    experiment="run into the suspected stop at several speeds, and lean on it with several steady torques",
)  # fmt: skip

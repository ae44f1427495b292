"""Free torques over position and over velocity in plain MJCF: what nothing in the library explains.

Over position they are a sum of passive ripples (as a catch is); over velocity the joint's damping polynomial and dry
friction that come closest. They have no name and are no cause.
"""

import numpy as np

from diagnose.causes.base import add_constant, add_dry_friction, add_wave
from diagnose.kernel import KNOTS, hat

WAVES = 16  # over one and a half of the motion's range


def split(spline, frame):
    """(K,), (K,), (K,) rates, sines and cosines over position; (3,) damping of v, v|v|, v^3; friction; constant."""
    span = frame.q[1] - frame.q[0]
    q = np.linspace(frame.q[0], frame.q[1], 801)
    v = np.linspace(frame.v[0], frame.v[1], 801)
    over_q = np.array([hat(x, *frame.q, spline[:KNOTS]) for x in q])
    over_v = np.array([hat(x, *frame.v, spline[KNOTS:]) for x in v])
    basis = np.stack([-v, -v * np.abs(v), -(v**3), -np.sign(v), np.ones_like(v)], axis=1)
    size = np.abs(basis).max(axis=0)
    c = np.linalg.lstsq(basis / size, over_v, rcond=1e-6)[0] / size
    rates = 2 * np.pi * np.arange(1, WAVES + 1) / (1.5 * span)
    waves = np.concatenate([np.sin(q[:, None] * rates), np.cos(q[:, None] * rates), np.ones((len(q), 1))], axis=1)
    w = np.linalg.lstsq(np.concatenate([waves, 1e-3 * np.eye(waves.shape[1])]),
                        np.concatenate([over_q, np.zeros(waves.shape[1])]), rcond=None)[0]  # fmt: skip
    return rates, w[:WAVES], w[WAVES : 2 * WAVES], c[:3], float(c[3]), float(c[4] + w[-1])


def edit(spec, joint, spline, plant, frame):
    rates, sine, cosine, damping, friction, constant = split(spline, frame)
    for k, (rate, a, b) in enumerate(zip(rates, sine, cosine, strict=True)):
        add_wave(spec, joint, f"{joint}_free_{k}", a, b, rate)
    j = spec.joint(joint)
    j.damping = np.array(j.damping, float) + damping
    add_dry_friction(spec, joint, plant, max(friction, -float(j.frictionloss)))
    add_constant(spec, joint, plant, frame, constant)

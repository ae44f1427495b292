"""The compiled time loop of one joint.

A variant of the nominal joint is a row of numbers in the order of :data:`TERMS`. The scheme is leapfrog with damping at
the middle of the step and dry friction in the limit of hard constraints: what MuJoCo computes for one degree of
freedom, without its errors of first order in the time step.
"""

from __future__ import annotations

import numpy as np
from numba import njit

#: Terms that a variant may add to the nominal joint, all 0 by default.
TERMS = ("damping", "drag", "coulomb", "stiction", "stribeck_velocity", "stiffness", "spring_torque", "torque",
         "gravity_sin", "gravity_cos", "inertia", "stop_place", "stop_stiffness", "stop_damping",
         "detent_strength", "detent_place", "detent_width", "delay", "bias", "gain", "bend2", "bend3", "bend4", "bend5",
         "play", "wave_sin1", "wave_cos1", "wave_sin2", "wave_cos2")  # fmt: skip
INDEX = {name: i for i, name in enumerate(TERMS)}
(DAMPING, DRAG, COULOMB, STICTION, STRIBECK, STIFFNESS, SPRING, TORQUE, G_SIN, G_COS, INERTIA, STOP, STOP_K, STOP_D,
 DETENT, DETENT_AT, DETENT_W, DELAY, BIAS, GAIN, BEND2, BEND3, BEND4, BEND5, PLAY, WAVE_S1, WAVE_C1, WAVE_S2,
 WAVE_C2) = range(len(TERMS))  # fmt: skip
KNOTS = 9  # of a free torque over position, and of one over velocity

# The nominal joint as a row of numbers; see :meth:`diagnose.plant.Plant.row`.
(P_INERTIA, P_SIN, P_COS, P_CONST, P_K, P_REF, P_B1, P_B2, P_B3, P_DRY, P_LIMITED, P_LOW, P_HIGH, P_TABLE, P_T0,
 P_DT) = range(16)  # fmt: skip
# Where the motion lies: position from, to; velocity from, to; middle of the positions.
F_Q0, F_Q1, F_V0, F_V1, F_MID = range(5)


@njit(cache=True)
def hat(x, low, high, knots):
    """Piecewise-linear value at x of evenly spaced knots."""
    s = min(max((x - low) / (high - low), 0.0), 1.0) * (KNOTS - 1)
    i = min(int(s), KNOTS - 2)
    return knots[i] + (s - i) * (knots[i + 1] - knots[i])


@njit(cache=True)
def static(plant, table, q):
    """Static torque of the nominal joint at q."""
    if plant[P_TABLE] > 0:
        s = min(max((q - plant[P_T0]) / plant[P_DT], 0.0), len(table) - 1.0)
        i = min(int(s), len(table) - 2)
        return table[i] + (s - i) * (table[i + 1] - table[i])
    f = plant[P_CONST] - plant[P_K] * (q - plant[P_REF])
    if plant[P_SIN] != 0.0:
        f += plant[P_SIN] * np.sin(q)
    if plant[P_COS] != 0.0:
        f += plant[P_COS] * np.cos(q)
    return f


@njit(cache=True)
def catch(q, strength, place, width):
    """Torque of a detent."""
    x = q - place
    if x * x >= 80.0 * width * width:
        return 0.0
    x /= width
    return -strength * x * np.exp(0.5 - 0.5 * x * x)


@njit(cache=True)
def stopped(q, v, step, place, side, stiffness, damping):
    """Torque of an end stop on the given side of the motion, over a step."""
    deep = side * (q - place)
    # The share of the step spent beyond the stop: the damper sets in at once, wherever in a step that is.
    reach = 0.5 * abs(v) * step
    if deep <= -reach:
        return 0.0
    share = 1.0 if deep >= reach else 0.5 + 0.5 * deep / reach
    mean = deep if share >= 1.0 else share * reach  # depth, over that share
    return -share * side * max(stiffness * mean + damping * side * v, 0.0)


@njit(cache=True)
def added(p, frame, spline, q, v, step):
    """Torque of the terms that is a smooth function of q and v, damping left out."""
    f = p[TORQUE]
    if p[STIFFNESS] != 0.0 or p[SPRING] != 0.0:
        f += p[SPRING] - p[STIFFNESS] * (q - frame[F_MID])
    if p[G_SIN] != 0.0 or p[G_COS] != 0.0:
        f += p[G_SIN] * np.sin(q) + p[G_COS] * np.cos(q)
    if p[DETENT] != 0.0:
        f += catch(q, p[DETENT], p[DETENT_AT], p[DETENT_W])
    if p[STOP_K] != 0.0 or p[STOP_D] != 0.0:
        f += stopped(q, v, step, p[STOP], 1.0 if p[STOP] >= frame[F_MID] else -1.0, p[STOP_K], p[STOP_D])
    if len(spline) > 0:
        f += hat(q, frame[F_Q0], frame[F_Q1], spline[:KNOTS]) + hat(v, frame[F_V0], frame[F_V1], spline[KNOTS:])
    return f


@njit(cache=True)
def level(v, dry, stiction, stribeck):
    """Dry friction at speed |v|."""
    if stiction != 0.0 and v * v < 80.0 * stribeck * stribeck:
        x = v / stribeck
        return dry + stiction * np.exp(-x * x)
    return dry


@njit(cache=True)
def rubbed(v, push, rub):
    """Velocity after a push (of velocity) against a friction that takes up to rub (of velocity)."""
    if v == 0.0:
        return np.sign(push) * max(abs(push) - rub, 0.0)
    side = np.sign(v)
    after = v + push - side * rub
    if after * side >= 0:
        return after
    # It comes to rest within the step, and friction turns round for what is left of it.
    rest = 1.0 - abs(v) / (rub - side * push)
    return np.sign(push) * rest * max(abs(push) - rub, 0.0)


@njit(cache=True)
def needed(p, plant, table, frame, spline, q, v, a, out):
    """The input torque that a motion q, v, a (N,) takes, into out (N,)."""
    for i in range(len(q)):
        f = static(plant, table, q[i]) + added(p, frame, spline, q[i], v[i], 0.0)
        speed = abs(v[i])
        f -= (plant[P_B1] + p[DAMPING]) * v[i] + (plant[P_B2] + p[DRAG]) * v[i] * speed + plant[P_B3] * v[i] ** 3
        f -= level(v[i], plant[P_DRY] + p[COULOMB], p[STICTION], p[STRIBECK]) * np.sign(v[i])
        out[i] = (plant[P_INERTIA] + p[INERTIA]) * a[i] - f


@njit(cache=True)
def advance(p, plant, table, frame, spline, torque, step, q, v, Q, V):
    """States at the grid's times into Q, V (K + 1,) from the input over each step, torque (K,).

    A state that runs away is frozen where it is 1e3 of the motion's range off.
    """
    inertia = max(plant[P_INERTIA] + p[INERTIA], 1e-3 * plant[P_INERTIA])
    b1, b2, b3 = plant[P_B1] + p[DAMPING], plant[P_B2] + p[DRAG], plant[P_B3]
    rubbing = plant[P_DRY] != 0.0 or p[COULOMB] != 0.0 or p[STICTION] != 0.0
    span = frame[F_Q1] - frame[F_Q0]
    low, high = frame[F_MID] - 1e3 * span, frame[F_MID] + 1e3 * span
    fast = 1e4 * max(abs(frame[F_V0]), abs(frame[F_V1]))
    # The model's own joint limits with MuJoCo's default softness.
    soft, back, stiff = 0.95, 2 / (0.95 * 0.02), 1 / (0.95 * 0.95 * 0.02 * 0.02)
    # Second differences of positions hold h^2 / 12 of the fourth derivative (Numerov): with that of the motion under
    # weights and springs put in, the scheme is of fourth order for them.
    numerov = step * step / 12.0
    sine, cosine = plant[P_SIN] + p[G_SIN], plant[P_COS] + p[G_COS]
    stiffness = plant[P_K] + p[STIFFNESS]
    tabled = plant[P_TABLE] > 0
    # Weights and springs of the joint and of the terms together: one sine and one cosine a step.
    constant, swings = p[TORQUE] + p[SPRING] + p[STIFFNESS] * frame[F_MID], sine != 0.0 or cosine != 0.0
    own_sine, own_cosine = p[G_SIN], p[G_COS]
    if not tabled:
        constant += plant[P_CONST] + plant[P_K] * plant[P_REF]
        own_sine, own_cosine = sine, cosine
    pull = p[STIFFNESS] if tabled else stiffness
    curved = not tabled and (swings or stiffness != 0.0)
    catching, stops = p[DETENT] != 0.0, p[STOP_K] != 0.0 or p[STOP_D] != 0.0
    strength, catch_at, width, stop = p[DETENT], p[DETENT_AT], p[DETENT_W], p[STOP]
    stop_k, stop_d = p[STOP_K], p[STOP_D]
    dry, stiction, stribeck = plant[P_DRY] + p[COULOMB], p[STICTION], p[STRIBECK]
    braked = b1 != 0.0 or b2 != 0.0 or b3 != 0.0
    stop_side = 1.0 if p[STOP] >= frame[F_MID] else -1.0
    inverse = 1.0 / inertia
    over_q, over_v = spline[:KNOTS], spline[KNOTS:]
    Q[0], V[0] = q, v
    for k in range(len(torque)):
        f = torque[k] + constant - pull * q
        s, c = 0.0, 0.0
        if swings:
            s, c = np.sin(q), np.cos(q)
            f += own_sine * s + own_cosine * c
        if tabled:
            f += static(plant, table, q)
        if catching:
            f += catch(q, strength, catch_at, width)
        if stops:
            f += stopped(q, v, step, stop, stop_side, stop_k, stop_d)
        if len(spline) > 0:
            f += hat(q, frame[F_Q0], frame[F_Q1], over_q) + hat(v, frame[F_V0], frame[F_V1], over_v)
        if curved:
            slope_q = sine * c - cosine * s - stiffness
            f += numerov * (slope_q * f * inverse - (sine * s + cosine * c) * v * v)
        slope = 0.0
        if braked:
            speed = abs(v)
            f -= v * (b1 + speed * (b2 + b3 * speed))
            slope = b1 + speed * (2 * b2 + 3 * b3 * speed)
        if stop_d != 0.0 and (q - stop) * stop_side > 0:
            slope += stop_d
        if plant[P_LIMITED] > 0:
            for place, side in ((plant[P_HIGH], 1.0), (plant[P_LOW], -1.0)):
                deep = side * (q - place)
                if deep > 0:
                    push = soft * (f * side + inertia * (back * v * side + stiff * deep))
                    f -= side * max(push, 0.0)
        # Damping acts at the middle of the step; at its end (as MuJoCo has it) it would weigh as inertia b h / 2.
        gain = step / max(inertia + 0.5 * step * slope, 0.1 * inertia) if slope != 0.0 else step * inverse
        push = gain * f
        if rubbing:
            # Friction that depends on speed is that of the step's middle.
            middle = v + 0.5 * push
            if stiction != 0.0:
                middle = 0.5 * (v + rubbed(v, push, gain * level(middle, dry, stiction, stribeck)))
            v = rubbed(v, push, gain * level(middle, dry, stiction, stribeck))
        else:
            v = v + push
        v = min(max(v, -fast), fast)
        q = min(max(q + step * v, low), high)
        Q[k + 1], V[k + 1] = q, v


@njit(cache=True)
def read(p, frame, Q, V, t, step, out):
    """What the sensor shows at times t (N,) of the states on the grid, into out (N,).

    Cubic between the states; before the start the motion goes on backwards with its first acceleration. A reading with
    play stands still at a reversal until the part has crossed it.
    """
    play = 0.5 * p[PLAY]
    first = (V[1] - V[0]) / step
    held, done = Q[0] - np.sign(V[0]) * play, 0
    for i in range(len(t)):
        at = t[i] - p[DELAY]
        if at < 0:
            y = Q[0] + V[0] * at + 0.5 * first * at * at
        else:
            k = min(int(at / step), len(Q) - 2)
            s = min(at / step - k, 1.0)
            a, b = Q[k], Q[k + 1]
            # Velocities live between the positions; central ones make the cubic second-order exact.
            da = 0.5 * (V[k] + V[k + 1]) * step
            db = 0.5 * (V[k + 1] + V[min(k + 2, len(V) - 1)]) * step
            y = a + s * (da + s * (3 * (b - a) - 2 * da - db + s * (da + db - 2 * (b - a))))
        if play > 0:
            upto = min(max(int(at / step), 0), len(Q) - 1)
            while done <= upto:
                held = min(max(held, Q[done] - play), Q[done] + play)
                done += 1
            y = min(max(held, y - play), y + play)
        x = y - frame[F_MID]
        z = (1 + p[GAIN]) * y + p[BIAS]
        if p[BEND2] != 0.0 or p[BEND3] != 0.0 or p[BEND4] != 0.0 or p[BEND5] != 0.0:
            z += x * x * (p[BEND2] + x * (p[BEND3] + x * (p[BEND4] + x * p[BEND5])))
        if p[WAVE_S1] != 0.0 or p[WAVE_C1] != 0.0 or p[WAVE_S2] != 0.0 or p[WAVE_C2] != 0.0:
            z += p[WAVE_S1] * np.sin(y) + p[WAVE_C1] * np.cos(y)
            z += p[WAVE_S2] * np.sin(2 * y) + p[WAVE_C2] * np.cos(2 * y)
        out[i] = z


@njit(cache=True)
def columns(rows, plant, table, frame, splines, torques, which, step, q0, v0, t, out):
    """Readings (B, N) of B variants: rows (B, terms), splines (B, 2 KNOTS or 0), inputs torques[which[b]]."""
    Q, V = np.empty(torques.shape[1] + 1), np.empty(torques.shape[1] + 1)
    for b in range(len(rows)):
        advance(rows[b], plant, table, frame, splines[b], torques[which[b]], step, q0[b], v0[b], Q, V)
        read(rows[b], frame, Q, V, t, step, out[b])

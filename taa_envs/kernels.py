"""What surrounds MuJoCo's steps, compiled: an action becomes the hand's targets, and a step its results.

Every function goes through rows ``ids`` of arrays with a leading axis of simulations, one after the other. The single
environment and the batch run the same code on the same kinds of arrays, so that an episode is the same in both to the
last bit. :mod:`taa_envs.task` says what the arrays are.

Compiled once a machine and kept in Numba's cache, which notices changes of this file only: numbers that other modules
own come in as arguments.
"""

from __future__ import annotations

from math import sqrt, tanh

import numpy as np
from numba import njit, types

CORRECTIONS = 7  # of the hand: translation, rotation, closing
TIPS = (4, 8, 12, 16, 20)  # landmarks

# Columns of Task._numbers, what an episode changes: the reference's clock and MuJoCo's (s), stroke fractions at the
# start and driven so far, flags, frames in which the demonstrated hand drives (played, and played with contact), the
# joint as drawn, the hand's shift, what pushed in the last step, corrections as applied; q and clock before the step.
TIME, CLOCK, FIRST, DRIVEN, DIVERGED, SUCCEEDED, SEEN, HIT, Q_BEFORE, TIME_BEFORE = range(10)
AXIS, POINT, OFFSET, PUSH, CORRECTION = 10, 13, 16, 19, 24
NUMBERS = CORRECTION + CORRECTIONS

# Columns of Task._results; the last five are the reward's terms before their scales, in the order of reward.TERMS.
(PROGRESS, ERROR, IS_SUCCESS, SUCCESS_NOW, CONTACT, CONTACT_FRACTION, HAS_DIVERGED, WARNED, FRACTION, SHARE,
 TERMS) = range(11)  # fmt: skip
RESULTS = TERMS + 5

# Task._constants: the joint's states at start and end of the demonstration, its range; m of a translation; s by which
# targets lead; columns of q and its rate; of the least distance in sensordata; whether the joint turns, and m that it
# advances a radian; whether the finger tips' distance is wanted; whether actions are residual; columns of the
# observation; s of a step; rad of a rotation; the clock's and the corrections' speed; what makes a success; the
# reward's lengths, m.
(Q_START, Q_END, Q_RANGE, TRANSLATION, LEAD, Q_COLUMN, V_COLUMN, DEPTH_COLUMN, TURNS, PITCH, REACH, RESIDUAL, O_HAND,
 O_CONTACT, O_ERROR, O_GRIP, O_ACTION, PERIOD, ROTATION, PACE, SLEW, ENOUGH, DRIVEN_ENOUGH, REACH_LENGTH,
 FREE_DEPTH) = range(25)  # fmt: skip
CONSTANTS = FREE_DEPTH + 1

# Of the hand of spheres, PointsRows: N/m, N s/m, s ahead, N a sphere's axis, N in all, 1/s (0: targets jump).
STIFFNESS, DAMPING, AHEAD, SPHERE_FORCE, TOTAL_FORCE, RATE = range(6)
HELD = 1.0
"""N that pull a sphere which something holds back; landmarks that jitter pull free ones by 0.3 at a step's end."""
DRAWN = 10.0
"""By how many times its own a sphere's squared force counts more, at most, where the limit drew its target in."""
BAD = 3
"""Of the kinds of MuJoCo's warnings (mjtWarning), the first of three of a state that is not finite: it begins anew."""

# Of any strides; those that are only read are declared so, as the batch hands some of its arrays out read-only.
_f1, _f2, _f3 = (types.Array(types.float64, n, "A") for n in (1, 2, 3))
_r1, _r2, _r3 = (types.Array(types.float64, n, "A", readonly=True) for n in (1, 2, 3))
_ids, _action = types.Array(types.int64, 1, "C", readonly=True), types.Array(types.float32, 2, "C")
_flags, _driving = types.Array(types.boolean, 2, "C"), types.Array(types.boolean, 1, "C", readonly=True)
_counts, _warned = types.Array(types.int32, 2, "C"), types.Array(types.int32, 2, "A", readonly=True)
_surface = types.Array(types.float64, 2, "C", readonly=True)
_tips = np.array(TIPS)


def turn_and_shift(x, y, z, palm, shift):
    """The twelve numbers, row by row, of the (4, 3) matrix that takes points (..., 4), ones last, to points turned
    about the palm and shifted.

    Args:
        x, y, z: the turn: its axis times ``2 tan(angle / 2)`` (Cayley's formula needs no sine, whose last bit would
            depend on the library), rad for small turns; floats or arrays (n,).
        palm, shift: three of the same each, m.
    """
    x, y, z = 0.5 * x, 0.5 * y, 0.5 * z
    s = 2.0 / (1.0 + x * x + y * y + z * z)
    a, b, c = 1.0 - s * (y * y + z * z), s * (x * y - z), s * (x * z + y)
    d, e, f = s * (x * y + z), 1.0 - s * (x * x + z * z), s * (y * z - x)
    g, h, i = s * (x * z - y), s * (y * z + x), 1.0 - s * (x * x + y * y)
    p, q, r = palm
    return (a, d, g, b, e, h, c, f, i, p - (a * p + b * q + c * r) + shift[0], q - (d * p + e * q + f * r) + shift[1],
            r - (g * p + h * q + i * r) + shift[2])


_turn_and_shift = njit(turn_and_shift)


def _compiled(*arguments: types.Type):  # type: ignore[no-untyped-def]
    """Compiled for just these arguments: one machine code for one and for many simulations."""
    return njit([types.void(*arguments)], cache=True, error_model="numpy")


@njit
def _clip(x, low, high):
    return min(max(x, low), high)


@njit
def _before(times, t):
    """Index of the last time that is less than t, -1 where there is none."""
    low, high = 0, len(times)
    while low < high:
        middle = (low + high) // 2
        if times[middle] < t:
            low = middle + 1
        else:
            high = middle
    return low - 1


@njit
def _within(times, t):
    """Index of a row at times (T,) and the weight of the next one: the first before and the last after."""
    i = min(max(_before(times, t), 0), len(times) - 2)
    return i, _clip((t - times[i]) / (times[i + 1] - times[i]), 0.0, 1.0)


@_compiled(_ids, _action, _f2, _r2, _r1, _r2, _r1, _f3)
def aims(ids, action, numbers, qpos, times, table, constants, aim):
    """Clip actions (n, A) in place and set the clock; of residual ones write the corrections and targets (n, S, 3).

    table: (T, 8 S + 3) at times (T,), see :class:`taa_envs.motion.Motion`.
    """
    count = aim.shape[1]
    for row in ids:
        now = numbers[row]
        for k in range(action.shape[1]):
            action[row, k] = _clip(action[row, k], np.float32(-1.0), np.float32(1.0))
        now[Q_BEFORE], now[TIME_BEFORE] = qpos[row, int(constants[Q_COLUMN])], now[TIME]
        if constants[RESIDUAL] == 0.0:
            now[TIME] += constants[PERIOD]
            continue
        slew, turn = constants[SLEW], constants[ROTATION]
        for k in range(CORRECTIONS):
            now[CORRECTION + k] += _clip(action[row, k] - now[CORRECTION + k], -slew, slew)
        pace = 1.0 + constants[PACE] * action[row, CORRECTIONS]
        now[TIME] = max(now[TIME] + constants[PERIOD] * pace, times[0])
        i, w = _within(times, now[TIME] + constants[LEAD])
        below, above, half = table[i], table[i + 1], 4 * count
        palm = 2 * half
        c, scale = now[CORRECTION:], constants[TRANSLATION]
        m = _turn_and_shift(
            turn * c[3], turn * c[4], turn * c[5],
            (below[palm] + w * (above[palm] - below[palm]),
             below[palm + 1] + w * (above[palm + 1] - below[palm + 1]),
             below[palm + 2] + w * (above[palm + 2] - below[palm + 2])),
            (scale * c[0] + now[OFFSET], scale * c[1] + now[OFFSET + 1], scale * c[2] + now[OFFSET + 2]))  # fmt: skip
        close = c[6]
        for s in range(count):
            k = 4 * s
            x = below[k] + w * (above[k] - below[k])
            y = below[k + 1] + w * (above[k + 1] - below[k + 1])
            z = below[k + 2] + w * (above[k + 2] - below[k + 2])
            k += half
            x += close * (below[k] + w * (above[k] - below[k]))
            y += close * (below[k + 1] + w * (above[k + 1] - below[k + 1]))
            z += close * (below[k + 2] + w * (above[k + 2] - below[k + 2]))
            aim[row, s, 0] = x * m[0] + y * m[3] + z * m[6] + m[9]
            aim[row, s, 1] = x * m[1] + y * m[4] + z * m[7] + m[10]
            aim[row, s, 2] = x * m[2] + y * m[5] + z * m[8] + m[11]


@_compiled(_ids, _r3, _f3, _r3, _r3, _f3, _f3, _r1)
def drive(ids, aim, before, here, speed, target, velocity, hand):
    """Write velocities (n, S, 3) of the spheres' targets that take them to where they are aimed at, or (rate 0) the
    targets themselves, drawn in where the forces that can be foreseen would add up to too much; see the numbers of
    ``hand`` above.

    What is foreseen of a sphere is the force if it went on as fast as it goes. In a step of several substeps that
    counts only where something holds it back: it is pulled by HELD or more, or by a third of that while its target
    stands as far short of where it was aimed at before, ``before`` (n, S, 3) m, which is set to ``aim``. A free one is
    as fast as its target within a few milliseconds, and its force is gone before the step's end.
    """
    stiffness, limit, rate = hand[STIFFNESS], hand[SPHERE_FORCE], hand[RATE]
    lag = stiffness * hand[AHEAD] + hand[DAMPING]
    count = aim.shape[1]
    counts = np.empty(count)  # how much of a sphere's force counts, 0 to 1
    for row in ids:
        total = 0.0
        for s in range(count):
            square = now = short = 0.0
            for k in range(3):
                pull = (aim[row, s, k] - here[row, s, k]) * stiffness - lag * speed[row, s, k]
                pull = _clip(pull, -limit, limit)
                square += pull * pull
                pull = (target[row, s, k] - here[row, s, k]) * stiffness - hand[DAMPING] * speed[row, s, k]
                now += pull * pull
                pull = (before[row, s, k] - target[row, s, k]) * stiffness
                short += pull * pull
                before[row, s, k] = aim[row, s, k]
            held = (now + min(short, DRAWN * now)) / (HELD * HELD)
            counts[s] = 1.0 if rate == 0.0 else min(1.0, held * held)
            total += counts[s] * sqrt(square)
        share = hand[TOTAL_FORCE] / total if total > hand[TOTAL_FORCE] else 1.0
        for s in range(count):
            of_it = 1.0 - (1.0 - share) * counts[s]
            for k in range(3):
                to = aim[row, s, k]
                if share < 1.0:
                    drag = lag * speed[row, s, k]
                    pull = _clip((to - here[row, s, k]) * stiffness - drag, -limit, limit)
                    to = here[row, s, k] + (pull * of_it + drag) / stiffness
                if rate == 0.0:
                    target[row, s, k], velocity[row, s, k] = to, 0.0
                else:
                    velocity[row, s, k] = (to - target[row, s, k]) * rate


@njit
def _tip(here, row, f, link_pos, link_mat):
    """A finger tip in the moving link's frame."""
    x = here[row, _tips[f], 0] - link_pos[row, 0]
    y = here[row, _tips[f], 1] - link_pos[row, 1]
    z = here[row, _tips[f], 2] - link_pos[row, 2]
    m = link_mat[row]
    return (x * m[0, 0] + y * m[1, 0] + z * m[2, 0], x * m[0, 1] + y * m[1, 1] + z * m[2, 1],
            x * m[0, 2] + y * m[1, 2] + z * m[2, 2])  # fmt: skip


@njit(fastmath={"nnan", "nsz"})
def _nearest(surface, x, y, z):
    """Least of what the points of a surface (4, P) give; may go through them in any order, which changes no bit."""
    least = np.inf
    for p in range(surface.shape[1]):
        least = min(least, x * surface[0, p] + y * surface[1, p] + z * surface[2, p] + surface[3, p])
    return least


@njit
def _push(touches, now, turns, pitch):
    """Sum up the contact's readings (SUBSTEPS, 10) of a step: whether it pushed, the mean force on the link and that
    one's moment about the joint (along the slide)."""
    fx = fy = fz = tx = ty = tz = 0.0
    for k in range(touches.shape[0]):
        # MuJoCo gives the wrench from the link on the hand, about a place of its own.
        f, p = touches[k, 1:4], touches[k, 7:10]
        fx -= f[0]
        fy -= f[1]
        fz -= f[2]
        x, y, z = p[0] - now[POINT], p[1] - now[POINT + 1], p[2] - now[POINT + 2]
        tx -= touches[k, 4] + y * f[2] - z * f[1]
        ty -= touches[k, 5] + z * f[0] - x * f[2]
        tz -= touches[k, 6] + x * f[1] - y * f[0]
    if not fx * fx + fy * fy + fz * fz > 0.0:
        now[PUSH:PUSH + 5] = 0.0
        return False, 0.0
    a, b, c = now[AXIS], now[AXIS + 1], now[AXIS + 2]
    along = fx * a + fy * b + fz * c
    # A screw's link does work along its advance too.
    load = (tx * a + ty * b + tz * c + pitch * along if turns else along) / len(touches)
    now[PUSH], now[PUSH + 4] = 1.0, load
    now[PUSH + 1], now[PUSH + 2], now[PUSH + 3] = fx / len(touches), fy / len(touches), fz / len(touches)
    return True, load


@njit
def _play(now, times, driving, seen, hit, contact):
    """Note which of the reference's frames were played in the step, and in which of them the hand pushed."""
    begin, end = min(now[TIME_BEFORE], now[TIME]), max(now[TIME_BEFORE], now[TIME])
    first = _before(times, begin + 1e-9)
    last = max(_before(times, end - 1e-9), first)
    for frame in range(max(first, 0), last + 1):
        if driving[frame]:
            now[SEEN] += not seen[frame]
            now[HIT] += contact and not hit[frame]
        seen[frame] = True
        if contact:
            hit[frame] = True


@njit
def _status(row, q, numbers, constants, results):
    """The columns of results that follow from an episode's state."""
    now, out = numbers[row], results[row]
    fraction = (q - constants[Q_START]) / (constants[Q_END] - constants[Q_START])
    progress = _clip(fraction, 0.0, 1.0)
    made = progress - now[FIRST]
    share = min(now[DRIVEN] / made, 1.0) if made > 1e-9 else 0.0
    success = fraction >= constants[ENOUGH] and share >= constants[DRIVEN_ENOUGH] and now[DIVERGED] == 0.0
    out[PROGRESS], out[ERROR] = progress, abs(q - constants[Q_END]) / constants[Q_RANGE]
    out[FRACTION], out[SHARE], out[SUCCESS_NOW] = fraction, share, success
    out[IS_SUCCESS], out[HAS_DIVERGED] = now[SUCCEEDED], now[DIVERGED]
    out[CONTACT], out[CONTACT_FRACTION] = now[PUSH], now[HIT] / max(now[SEEN], 1.0)


@_compiled(_ids, _r2, _f2, _r1, _f2)
def status(ids, qpos, numbers, constants, results):
    """Results (n, RESULTS) of episodes that have just begun."""
    for row in ids:
        results[row] = 0.0
        _status(row, qpos[row, int(constants[Q_COLUMN])], numbers, constants, results)


@njit(cache=True)
def raw_terms(driven, moved, contact, distance, penetration, action, previous, success, reach, free, out):
    """The reward's terms before their scales, into out (5,), see :mod:`taa_envs.reward`.

    driven, moved: fractions of the stroke; distance, penetration, and the lengths reach and free that they are measured
    by: m; action, previous: (A,).
    """
    out[0] = driven + min(moved, 0.0)
    out[1] = 0.0 if contact else -tanh(distance / reach)
    change = 0.0
    for k in range(len(action)):
        difference = float(action[k]) - float(previous[k])
        change += difference * difference
    out[2] = -change / len(action)
    out[3] = -_clip((penetration - free) / free, 0.0, 1.0)
    out[4] = 1.0 if success else 0.0


@_compiled(_ids, _action, _action, _f2, _r2, _r1, _r3, _r2, _r3, _r2, _r3, _warned, _counts, _r1, _driving, _flags,
           _flags, _surface, _r1, _f2)  # fmt: skip
def read(ids, action, previous, numbers, qpos, clock, touches, sensordata, here, link_pos, link_mat, warnings, raised,
         times, driving, seen, hit, surface, constants, results):  # fmt: skip
    """Take in the step that was made: results (n, RESULTS); the episode's numbers, frames and last action follow.

    clock: (n,) s.  touches: (n, SUBSTEPS, 10).  here: (n, 21, 3) landmarks.  warnings, raised: (n, kinds) counts now
    and before.  driving: (T,), frames in which the demonstrated hand drives; seen, hit: (n, T).  surface: (4, P), for a
    point x of the link's surface -2 x and its square.
    """
    stroke = constants[Q_END] - constants[Q_START]
    for row in ids:
        now, out = numbers[row], results[row]
        q = qpos[row, int(constants[Q_COLUMN])]
        moved = (q - now[Q_BEFORE]) / stroke
        contact, load = _push(touches[row], now, constants[TURNS] != 0.0, constants[PITCH])
        driven = moved if moved > 0.0 and load * stroke > 0.0 else 0.0
        _play(now, times, driving, seen[row], hit[row], contact)
        warned, bad = 0, False
        for k in range(warnings.shape[1]):
            new = warnings[row, k] - raised[row, k]
            warned += new
            bad |= new > 0 and BAD <= k < BAD + 3
            raised[row, k] = warnings[row, k]
        # MuJoCo begins anew, its clock at zero, where a state is no longer finite, and warns.
        if bad or clock[row] < now[CLOCK] + 0.95 * constants[PERIOD]:
            now[DIVERGED] = 1.0
        now[CLOCK] = clock[row]
        now[DRIVEN] += driven
        _status(row, q, numbers, constants, results)
        if out[SUCCESS_NOW] != 0.0:
            now[SUCCEEDED] = out[IS_SUCCESS] = 1.0
        out[WARNED] = max(warned, 0)
        distance = 0.0
        if not contact and constants[REACH] != 0.0:
            distance = np.inf
            for f in range(len(_tips)):
                x, y, z = _tip(here, row, f, link_pos, link_mat)
                distance = min(distance, _nearest(surface, x, y, z) + (x * x + y * y + z * z))
            distance = sqrt(max(distance, 0.0))
        depth = max(-sensordata[row, int(constants[DEPTH_COLUMN])], 0.0)
        raw_terms(driven, moved, contact, distance, depth, action[row], previous[row], out[SUCCESS_NOW] != 0.0,
                  constants[REACH_LENGTH], constants[FREE_DEPTH], out[TERMS:])
        previous[row] = action[row]


@_compiled(_r2, _action, _r2, _r2, _r3, _r3, _r2, _r3, _r1, _r2, _r1, _r1, _f2, _action)
def observe(numbers, action, qpos, qvel, here, speed, link_pos, link_mat, times, shown, scale, constants, raw, out):
    """Observations (n, size) of all rows, see :class:`taa_envs.motion.Layout`; raw: (n, size), zero where nothing is
    written."""
    for row in range(len(out)):
        now, r = numbers[row], raw[row]
        r[0] = r[2] = (qpos[row, int(constants[Q_COLUMN])] - constants[Q_START]) / (constants[Q_END]
                                                                                    - constants[Q_START])
        r[1] = qvel[row, int(constants[V_COLUMN])]
        hand, error, grip = int(constants[O_HAND]), int(constants[O_ERROR]), int(constants[O_GRIP])
        for k in range(3):
            total = 0.0
            for j in range(21):
                place = here[row, j, k]
                r[hand + 3 * j + k], r[error + 3 * j + k] = place, place - now[OFFSET + k]
                total += speed[row, j, k]
            r[hand + 63 + k] = total / 21
        for k in range(5):
            r[int(constants[O_CONTACT]) + k] = now[PUSH + k]
        for f in range(len(_tips)):
            r[grip + 3 * f], r[grip + 3 * f + 1], r[grip + 3 * f + 2] = _tip(here, row, f, link_pos, link_mat)
        start = int(constants[O_ACTION])
        for k in range(action.shape[1]):
            corrected = constants[RESIDUAL] != 0.0 and k < CORRECTIONS
            r[start + k] = now[CORRECTION + k] if corrected else action[row, k]
        i, w = _within(times, now[TIME])
        below, above = shown[i], shown[i + 1]
        for k in range(len(r)):
            out[row, k] = _clip(r[k] * scale[k] + (below[k] + w * (above[k] - below[k])), -10.0, 10.0)

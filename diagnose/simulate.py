"""The joint under a log's own inputs, many variants of it at once.

One time loop advances all columns (variant x episode x perturbed parameter) together; a variant is the nominal joint
plus the terms of :data:`TERMS`. The scheme is leapfrog with damping at the middle of the step and dry friction in the
limit of hard constraints: what MuJoCo computes for one degree of freedom, without its errors of first order in the
time step. :func:`mujoco_rollout` is MuJoCo itself, for the numbers that are reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from diagnose.log import JointLog
from diagnose.plant import Plant

#: Terms a variant may add to the nominal joint, all 0 by default.
TERMS = ("damping", "drag", "coulomb", "stiction", "stribeck_velocity", "stiffness", "spring_torque", "torque",
         "gravity_sin", "gravity_cos", "inertia", "stop_place", "stop_stiffness", "stop_damping",
         "detent_strength", "detent_place", "detent_width", "delay", "bias", "gain", "bend", "twist")  # fmt: skip
KNOTS = 9
MAX_STEP = 5e-3  # s


@dataclass(frozen=True)
class Episode:
    """One log (or a window of one) ready to simulate.

    Attributes:
        log: the measurement.  t: (N,) s from its start.
        step: s.  torque: (K,) input over each step.
        q0, v0: a smoothed guess of the initial state.
        q, v, a: (N,) smoothed position, velocity, acceleration.  u: (N,) input at the samples.
    """

    log: JointLog
    t: np.ndarray
    step: float
    torque: np.ndarray
    q0: float
    v0: float
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    u: np.ndarray


def held(u: np.ndarray) -> bool:
    """True if the input is piecewise constant: then a sample holds until the next, else it is interpolated."""
    return bool(np.mean(np.diff(u) == 0) > 0.5)


def prepare(plant: Plant, log: JointLog, most: float = MAX_STEP) -> Episode:
    """Put a log's input on a fine even grid and smooth its motion.

    An input that is constant between most samples (a held torque, let go) acts from its row's time until the next
    row's; any other is interpolated, but a fall to exactly 0 (letting go) stays a jump.
    """
    t = log.time - log.time[0]
    step = log.dt / max(1, int(np.ceil(log.dt / most - 1e-9)))
    count = int(np.ceil(t[-1] / step - 1e-9)) + 1
    u = plant.input_torque(log)
    torque = sum(_input_at(t, u, (np.arange(count) + s) * step) for s in SPREAD) / len(SPREAD)
    q, v, a = smooth(t, log.q)
    return Episode(log, t, step, torque, float(q[0]), float(v[0]), q, v, a, u)


# A velocity step at time k h stands for the input from (k - 1/2) h to (k + 1/2) h: positions are then second-order
# exact. Taking the input at k h instead is the half-sample shift that reads as a false friction.
SPREAD = (-0.375, -0.125, 0.125, 0.375)


def _input_at(t: np.ndarray, u: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """The input between samples, at times ``middle``."""
    before = np.clip(np.searchsorted(t, middle, side="right") - 1, 0, len(t) - 1)
    after = np.minimum(before + 1, len(t) - 1)
    torque = u[before].copy()
    if not held(u):
        free = (u[after] == 0) & (u[before] != 0)
        share = np.clip((middle - t[before]) / np.maximum(t[after] - t[before], 1e-12), 0, 1)
        torque = np.where(free, u[before], u[before] + share * (u[after] - u[before]))
    return torque


def windows(episode: Episode, count: int) -> list[Episode]:
    """Cut an episode into pieces that are simulated each from its own state; (at most ``count``, 25 samples at least).

    Over a short piece a wrong model is wrong by little, so fits have no false minima there.
    """
    n = len(episode.t)
    edges = np.linspace(0, n, max(1, min(count, n // 25)) + 1).astype(int)
    out = []
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        k = int(round(episode.t[a] / episode.step))
        t = episode.t[a:b] - episode.t[a]
        last = k + int(np.ceil(t[-1] / episode.step - 1e-9)) + 1
        old = episode.log
        log = JointLog(old.name, old.time[a:b], old.q[a:b])
        out.append(Episode(log, t, episode.step, episode.torque[k:last], float(episode.q[a]), float(episode.v[a]),
                           episode.q[a:b], episode.v[a:b], episode.a[a:b], episode.u[a:b]))  # fmt: skip
    return out


def smooth(t: np.ndarray, q: np.ndarray, half: int = 6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Local cubic fits over 2 half + 1 samples: q, velocity, acceleration, each (N,); times may be uneven."""
    n = len(t)
    half = min(half, (n - 1) // 2)
    start = np.clip(np.arange(n) - half, 0, n - 2 * half - 1)
    index = start[:, None] + np.arange(2 * half + 1)
    x = t[index] - t[:, None]
    scale = np.abs(x).max(axis=1, keepdims=True)
    basis = (x / scale)[..., None] ** np.arange(4)
    c = np.linalg.pinv(basis) @ q[index][..., None]
    return c[:, 0, 0], c[:, 1, 0] / scale[:, 0], 2 * c[:, 2, 0] / scale[:, 0] ** 2


@dataclass(frozen=True)
class Job:
    """One column: terms by name, the episode's number, the initial state; splines are (KNOTS,) torques at knots."""

    terms: dict[str, float]
    episode: int
    q0: float
    v0: float
    spline_q: np.ndarray | None = None
    spline_v: np.ndarray | None = None


@dataclass(frozen=True)
class Frame:
    """Where the spline knots lie: (low, high) in q and in velocity; and the middle of the motion."""

    q: tuple[float, float]
    v: tuple[float, float]

    @property
    def middle(self) -> float:
        return 0.5 * (self.q[0] + self.q[1])


def extra_torque(terms: dict[str, np.ndarray], q: np.ndarray, v: np.ndarray, frame: Frame) -> np.ndarray | float:
    """Added torque that is a smooth function of q and v (no dry friction, no damping), shapes broadcast."""
    f: np.ndarray | float = 0.0
    if "stiffness" in terms:
        f = f - terms["stiffness"] * (q - frame.middle) + terms["spring_torque"]
    if "torque" in terms:
        f = f + terms["torque"]
    if "gravity_sin" in terms:
        f = f + terms["gravity_sin"] * np.sin(q) + terms["gravity_cos"] * np.cos(q)
    if "detent_strength" in terms:
        x = (q - terms["detent_place"]) / np.where(terms["detent_width"] > 0, terms["detent_width"], 1.0)
        f = f - terms["detent_strength"] * x * np.exp(0.5 - 0.5 * np.minimum(x * x, 80.0))
    if "stop_stiffness" in terms:
        side = np.where(terms["stop_place"] >= frame.middle, 1.0, -1.0)
        deep = side * (q - terms["stop_place"])
        push = terms["stop_stiffness"] * deep + terms["stop_damping"] * side * v
        f = f - side * np.where(deep > 0, np.maximum(push, 0.0), 0.0)
    return f


def hats(x: np.ndarray, low: float, high: float, knots: np.ndarray) -> np.ndarray:
    """Piecewise-linear value at x (B,) of the knots (B, KNOTS)."""
    s = np.clip((x - low) / (high - low), 0, 1) * (KNOTS - 1)
    i = np.minimum(s.astype(int), KNOTS - 2)
    rows = np.arange(len(x))
    return knots[rows, i] + (s - i) * (knots[rows, i + 1] - knots[rows, i])


def rollouts(plant: Plant, episodes: Sequence[Episode], jobs: Sequence[Job], frame: Frame) -> list[np.ndarray]:
    """What the sensor would read at the samples of each job's episode: a list of (N,).

    A column whose state runs away is frozen where it is 1e3 of the motion's range off.
    """
    step = episodes[0].step
    if any(abs(e.step - step) > 1e-9 for e in episodes):  # logs of several rates: each rate by itself
        out: list = [None] * len(jobs)
        for s in {e.step for e in episodes}:
            mine = [i for i, j in enumerate(jobs) if episodes[j.episode].step == s]
            same = [e for e in episodes if e.step == s]
            number = {id(e): k for k, e in enumerate(same)}
            moved = [Job(j.terms, number[id(episodes[j.episode])], j.q0, j.v0, j.spline_q, j.spline_v)
                     for j in (jobs[i] for i in mine)]  # fmt: skip
            for i, r in zip(mine, rollouts(plant, same, moved, frame) if moved else [], strict=True):
                out[i] = r
        return out
    which = np.array([j.episode for j in jobs])
    count = max(len(episodes[e].torque) for e in set(which))
    inputs = np.zeros((count, len(episodes)))
    for e, ep in enumerate(episodes):
        inputs[: len(ep.torque), e] = ep.torque[:count]
    names = sorted({n for j in jobs for n in j.terms})
    terms = {n: np.array([j.terms.get(n, 0.0) for j in jobs]) for n in names}
    inertia = plant.inertia + terms.get("inertia", 0.0)
    b1, b2, b3 = plant.damping
    b1 = b1 + terms.get("damping", 0.0)
    b2 = b2 + terms.get("drag", 0.0)
    quadratic = "drag" in terms or plant.damping[1] != 0
    dry = plant.frictionloss + terms.get("coulomb", 0.0)
    rubbing = "coulomb" in terms or "stiction" in terms or plant.frictionloss > 0
    if "stiction" in terms:
        slow = 1.0 / np.where(terms["stribeck_velocity"] > 0, terms["stribeck_velocity"], 1.0)
    kq = _stack([j.spline_q for j in jobs])
    kv = _stack([j.spline_v for j in jobs])
    limit = frame.middle + np.array([-1e3, 1e3]) * (frame.q[1] - frame.q[0])

    q = np.array([j.q0 for j in jobs])
    v = np.array([j.v0 for j in jobs])
    Q, V = np.empty((count + 1, len(jobs))), np.empty((count + 1, len(jobs)))
    Q[0], V[0] = q, v
    fast = 1e4 * max(abs(frame.v[0]), abs(frame.v[1]))
    stop = _nominal_stop(plant)
    plain = plant.static_table is None
    a, b, c = plant.gravity
    swings = plant.hinge and (a != 0 or b != 0)
    for k in range(count):
        f = inputs[k, which]
        if plain:
            if swings:
                f += a * np.sin(q) + b * np.cos(q)
            if c or plant.stiffness:
                f += c - plant.stiffness * (q - plant.springref)
        else:
            f += plant.static(q)
        f = f + extra_torque(terms, q, v, frame)
        if kq is not None:
            f = f + hats(q, *frame.q, kq)
        if kv is not None:
            f = f + hats(v, *frame.v, kv)
        slope = b1
        f = f - b1 * v
        if quadratic:
            speed = np.abs(v)
            f = f - b2 * v * speed
            slope = slope + 2 * b2 * speed
        if b3:
            f = f - b3 * v**3
            slope = slope + 3 * b3 * v * v
        if stop is not None:
            f = f + stop(q, v, f, inertia)
        # Damping acts at the middle of the step; at its end (as MuJoCo has it) it would weigh as inertia b h / 2.
        gain = step / (inertia + 0.5 * step * slope)
        v = v + gain * f
        if rubbing:
            level = dry
            if "stiction" in terms:
                level = dry + terms["stiction"] * np.exp(-np.minimum((v * slow) ** 2, 80.0))
            v = np.sign(v) * np.maximum(np.abs(v) - gain * level, 0.0)
        v = np.minimum(np.maximum(v, -fast), fast)
        q = np.minimum(np.maximum(q + step * v, limit[0]), limit[1])
        Q[k + 1], V[k + 1] = q, v
    zero = np.zeros(len(jobs))
    delay, bias, gain_error, bend, twist = (terms.get(n, zero) for n in ("delay", "bias", "gain", "bend", "twist"))
    read: list = [None] * len(jobs)
    for e in set(which):
        mine = np.flatnonzero(which == e)
        at = episodes[e].t / step
        if not delay[mine].any() and np.abs(at - np.round(at)).max() < 1e-6:  # samples lie on the grid
            values = Q[np.round(at).astype(int)][:, mine].T
        else:
            values = [_sample(Q[:, i], V[:, i], episodes[e].t - delay[i], step) for i in mine]
        for i, y in zip(mine, values, strict=True):
            read[i] = (1 + gain_error[i]) * y + bias[i]
            if bend[i] or twist[i]:
                x = y - frame.middle
                read[i] = read[i] + bend[i] * x * x + twist[i] * x * x * x
    return read


def _stack(values: list) -> np.ndarray | None:
    if all(v is None for v in values):
        return None
    return np.stack([np.zeros(KNOTS) if v is None else v for v in values])


def _sample(q: np.ndarray, v: np.ndarray, t: np.ndarray, step: float) -> np.ndarray:
    """Cubic between the grid's states; before the start the motion goes on backwards with its first acceleration."""
    k = np.clip((t / step).astype(int), 0, len(q) - 2)
    s = t / step - k
    s = np.clip(s, 0, 1)
    a, b = q[k], q[k + 1]
    da, db = v[k] * step, v[k + 1] * step
    out = a + s * (da + s * (3 * (b - a) - 2 * da - db + s * (da + db - 2 * (b - a))))
    early = t < 0
    if early.any():
        first = (v[1] - v[0]) / step
        out = np.where(early, q[0] + v[0] * t + 0.5 * first * t * t, out)
    return out


def _nominal_stop(plant: Plant):
    """Torque of the model's own joint limits, with MuJoCo's default softness; None if it has none."""
    if plant.limits is None:
        return None
    low, high = plant.limits
    d, b, k = 0.95, 2 / (0.95 * 0.02), 1 / (0.95 * 0.95 * 0.02 * 0.02)

    def torque(q: np.ndarray, v: np.ndarray, f: np.ndarray, inertia: np.ndarray | float) -> np.ndarray:
        out = np.zeros_like(q)
        for side, place in ((1.0, high), (-1.0, low)):
            deep = side * (q - place)
            push = d * (f * side + inertia * (b * v * side + k * deep))
            out -= side * np.where(deep > 0, np.maximum(push, 0.0), 0.0)
        return out

    return torque


def mujoco_rollout(model: mujoco.MjModel, episode: Episode, q0: float, v0: float) -> np.ndarray:
    """Positions (N,) at the episode's samples of a model from :func:`diagnose.plant.isolated`, by ``mj_step``.

    The input acts at the model's own time step; states are read before each step, at the time they belong to.
    """
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0] = q0, v0
    h = model.opt.timestep
    count = int(np.ceil(episode.t[-1] / h)) + 1
    inputs = sum(_input_at(episode.t, episode.u, (np.arange(count) + s) * h) for s in SPREAD) / len(SPREAD)
    q, v = np.empty(count + 1), np.empty(count + 1)
    for k in range(count):
        q[k], v[k] = data.qpos[0], data.qvel[0]
        data.qfrc_applied[0] = inputs[k]
        mujoco.mj_step(model, data)
    q[count], v[count] = data.qpos[0], data.qvel[0]
    return _sample(q, v, episode.t, h)

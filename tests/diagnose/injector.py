"""A blind injector: a mechanism of its own, with something hidden in it, and the logs it leaves.

Nothing here comes from ``diagnose``: own integrator (fourth-order Runge-Kutta at 0.25 ms, friction split off), own
friction law (a steep velocity ramp, no constraint), own noise. ``draw`` seals the answer; the analyser sees the MJCF
file and the CSVs.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numba import njit

STEP = 2.5e-4  # s
ROW = 40  # steps between rows: 100 Hz

# name -> (hinge, inertia, weight torque m g r (rad^-1 sine law), viscous, speed of a push rad/s or m/s, MJCF)
PLANTS = {
    "door": (True, 20 * 0.8**2 / 3 + 20 * 0.02**2 / 3, 0.0, 2.0, 1.2,
             '<body pos="0 0 1"><joint name="j" type="hinge" axis="0 0 1" damping="2.0"/>'
             '<geom type="box" size="0.4 0.02 1" pos="0.4 0 0" mass="20"/></body>'),
    "flap": (True, 2 * 0.3**2 / 3 + 2 * 0.01**2 / 3, 2 * 9.81 * 0.15, 0.02, 2.5,
             '<body pos="0 0 1"><joint name="j" type="hinge" axis="0 1 0" damping="0.02"/>'
             '<geom type="box" size="0.01 0.2 0.15" pos="0 0 -0.15" mass="2"/></body>'),
    "drawer": (False, 3.0, 0.0, 2.0, 0.5,
               '<body pos="0 0 1"><joint name="j" type="slide" axis="1 0 0" damping="2"/>'
               '<geom type="box" size="0.2 0.2 0.1" mass="3"/></body>'),
}  # fmt: skip
SINGLE = ("viscous_damping", "quadratic_drag", "coulomb_friction", "stribeck_friction", "spring", "constant_torque",
          "gravity_torque", "inertia", "backlash", "end_stop", "detent", "time_delay", "sensor_gain")  # fmt: skip
PAIRS = (("coulomb_friction", "spring"), ("viscous_damping", "constant_torque"), ("quadratic_drag", "inertia"),
         ("coulomb_friction", "detent"), ("time_delay", "viscous_damping"), ("end_stop", "spring"))  # fmt: skip
OUTSIDE = ("growing_friction", "quadrant_force", "slow_wave", "hysteresis")
NOISES = ("white", "ar", "quantised", "distorted", "uneven", "dropped", "repeated")
# Mechanisms on which an effect shows at all: a weight only turns hinges, a bias shows where a torque depends on place.
FITS = {"gravity_torque": ("door", "flap"), "sensor_bias": ("flap",)}
# What cannot be told apart: hidden, protocol, the plants, rivals, and what tells them apart.
CONFUSABLE = {
    "friction or torque": ("coulomb_friction", "one_way", ("door", "drawer"), "constant_torque", "other side"),
    "torque or friction": ("constant_torque", "one_way", ("door", "drawer"), "coulomb_friction", "other side"),
    "inertia or weight": ("inertia", "free_swing", ("flap",), "gravity_torque", "known torque"),
    "bias or weight": ("sensor_bias", "both_ways", ("flap",), "gravity_torque", "known place"),
}  # fmt: skip


@dataclass
class Case:
    """What is hidden: names and true parameters (contract names and those of the library's report)."""

    plant: str
    names: tuple[str, ...]
    truth: dict[str, float] = field(default_factory=dict)
    noise: str = "white"
    protocol: str = "both_ways"
    sigma: float = 1e-3

    def of(self, name: str, key: str) -> float:
        """A true parameter, 0 where the effect is not hidden."""
        return self.truth[f"{name}.{key}"] if name in self.names else 0.0


def fits(names: tuple[str, ...]) -> list[str]:
    """Mechanisms on which the effects show."""
    return [p for p in PLANTS if all(p in FITS.get(n, tuple(PLANTS)) for n in names)]


def draw(seed: int, plant: str, names: tuple[str, ...], noise: str = "white", protocol: str = "both_ways",
         strength: float = 1.0) -> Case:  # fmt: skip
    """Draw the sizes of the hidden effects; ``strength`` scales those that have one."""
    rng = np.random.default_rng([seed, 7])
    hinge, inertia, weight, viscous, speed, _ = PLANTS[plant]
    tau = inertia * speed / 0.8  # a torque that stops a push within 0.8 s
    length = 1.0 if hinge else 0.4
    u = rng.uniform(0.6, 1.4, 30)
    sign = rng.choice([-1.0, 1.0])
    if protocol == "one_way":
        sign = -1.0  # a torque along the only direction of motion is no friction: nothing would be confusable
    s = strength
    draws = {
        "viscous_damping": {"damping": s * 0.5 * u[0] * tau / speed},
        "quadratic_drag": {"drag": s * 0.6 * u[1] * tau / speed**2},
        "coulomb_friction": {"friction": s * 0.15 * u[2] * tau},
        "spring": {"stiffness": s * 0.8 * u[3] * tau / length, "rest": 0.2 * sign * length},
        "constant_torque": {"torque": s * 0.2 * sign * u[4] * tau},
        "gravity_torque": {"sine": -s * 0.3 * u[5] * tau, "cosine": s * 0.3 * sign * u[6] * tau},
        "inertia": {"added_inertia": s * 0.3 * u[7] * inertia},
        "end_stop": {"place": 0.3 * u[8] * length, "stiffness": s * inertia * (25 * u[9]) ** 2,
                     "damping": s * inertia * 6 * u[10]},
        "detent": {"place": 0.1 * sign * u[11] * length, "peak_torque": s * 0.6 * u[12] * tau,
                   "width": 0.08 * u[13] * length},
        "time_delay": {"delay": s * 0.02 * u[14]},
        "sensor_gain": {"gain_error": s * 0.06 * sign * u[15]},
        "growing_friction": {"rate": s * 0.15 * u[16] * tau},
        "quadrant_force": {"force": s * 0.5 * u[17] * tau},
        "slow_wave": {"force": s * 0.3 * u[18] * tau, "rate": 4.0 * u[19]},
        "stribeck_friction": {"sliding_friction": s * 0.08 * u[20] * tau, "static_minus_sliding": s * 0.2 * u[21] * tau,
                              "stribeck_velocity": 0.15 * u[22] * speed},
        "backlash": {"play": s * 0.03 * u[23] * length},
        "sensor_bias": {"bias": s * 0.06 * sign * u[24] * length},
        "hysteresis": {"force": s * 0.4 * u[25] * tau, "travel": 0.25 * u[26] * length},
    }  # fmt: skip
    truth = {f"{n}.{k}": v for n in names for k, v in draws[n].items()}
    return Case(plant, names, truth, noise, protocol, 1e-3 if hinge else 4e-4)


@njit(cache=True)
def _force(h, w, q, v, t):
    """Everything but dry friction and hysteresis."""
    f = -w[1] * np.sin(q) - (w[2] + h[0]) * v - h[1] * v * abs(v)
    f -= h[3] * (q - h[4])
    f += h[5] + h[6] * np.sin(q) + h[7] * np.cos(q)
    if h[10] > 0 and q > h[9]:
        f -= max(h[10] * (q - h[9]) + h[11] * v, 0.0)
    if h[13] != 0.0:
        x = (q - h[12]) / h[14]
        f -= h[13] * x * np.exp((1 - x * x) / 2)
    if q > 0 and v > 0:
        f -= h[16]
    return f + h[17] * np.sin(h[18] * t)


@njit(cache=True)
def _rub(h, mass, ramp, v, t, dt):
    """Dry friction for a time dt."""
    level = h[2] + h[15] * t
    if h[19] > 0:
        level += h[19] * np.exp(-((v / h[20]) ** 2))
    if level == 0.0:
        return v
    stiff = dt * level / (mass * ramp)
    if abs(v) <= ramp * (1 + stiff):
        return v / (1 + stiff)
    return v - np.sign(v) * dt * level / mass


@njit(cache=True)
def _run(h, w, push, q, v, ramp, out):
    """h: hidden numbers; w: mass, weight, viscous; push (K,) input; positions into out (K,)."""
    mass, dt = w[0] + h[8], STEP
    z = 0.0  # of the hysteresis, -1 to 1
    for k in range(len(push)):
        out[k] = q
        t = k * dt
        v = _rub(h, mass, ramp, v, t, 0.5 * dt)
        extra = push[k] - h[21] * z
        a1 = (_force(h, w, q, v, t) + extra) / mass
        v1 = v + 0.5 * dt * a1
        a2 = (_force(h, w, q + 0.5 * dt * v, v1, t + 0.5 * dt) + extra) / mass
        v2 = v + 0.5 * dt * a2
        a3 = (_force(h, w, q + 0.5 * dt * v1, v2, t + 0.5 * dt) + extra) / mass
        v3 = v + dt * a3
        a4 = (_force(h, w, q + dt * v2, v3, t + dt) + extra) / mass
        before = q
        q = q + dt * (v + 2 * v1 + 2 * v2 + v3) / 6
        v = v + dt * (a1 + 2 * a2 + 2 * a3 + a4) / 6
        v = _rub(h, mass, ramp, v, t + dt, 0.5 * dt)
        if h[22] > 0:  # Dahl's rule: the force follows the travel since the last reversal
            d = q - before
            z = z + d / h[22] * (1 - z * np.sign(d))


@njit(cache=True)
def _play(q, width, side):
    """What a pointer with play shows of positions q (K,)."""
    out = np.empty(len(q))
    y = q[0] - 0.5 * side * width
    for k in range(len(q)):
        if y > q[k] + 0.5 * width:
            y = q[k] + 0.5 * width
        elif y < q[k] - 0.5 * width:
            y = q[k] - 0.5 * width
        out[k] = y
    return out


def write(case: Case, seed: int, folder: Path, count: int = 6, seconds: float = 6.0) -> tuple[Path, list[Path]]:
    """The nominal model and the logs, as files."""
    rng = np.random.default_rng([seed, 11])
    hinge, inertia, weight, viscous, speed, body = PLANTS[case.plant]
    folder.mkdir(parents=True, exist_ok=True)
    model = folder / "model.xml"
    model.write_text('<mujoco><compiler angle="radian"/><option timestep="0.001" integrator="implicitfast"/>'
                     f'<worldbody>{body}</worldbody></mujoco>')  # fmt: skip
    if case.protocol == "one_way":
        seconds = min(seconds, 0.6)
    steps = round(seconds / STEP)
    t = np.arange(steps + 1) * STEP
    length = 1.0 if hinge else 0.4
    side = np.ones(count) if case.protocol == "one_way" else np.resize([1.0, -1.0], count)
    q = -side * length * rng.uniform(0.4, 0.8, count)
    v = side * speed * rng.uniform(0.5, 1.1, count)
    if "end_stop" in case.names:  # from this side of it, and fast enough to reach it
        q = np.minimum(q, case.of("end_stop", "place") - rng.uniform(0.3, 0.6, count) * length)
        v = np.abs(v) + 0.4 * speed
    tau = inertia * speed / 0.8
    of = case.of
    hidden = np.array([
        of("viscous_damping", "damping"), of("quadratic_drag", "drag"),
        of("coulomb_friction", "friction") + of("stribeck_friction", "sliding_friction"),
        of("spring", "stiffness"), of("spring", "rest"), of("constant_torque", "torque"),
        of("gravity_torque", "sine"), of("gravity_torque", "cosine"), of("inertia", "added_inertia"),
        of("end_stop", "place"), of("end_stop", "stiffness"), of("end_stop", "damping"),
        of("detent", "place"), of("detent", "peak_torque"), of("detent", "width"), of("growing_friction", "rate"),
        of("quadrant_force", "force"), of("slow_wave", "force"), of("slow_wave", "rate"),
        of("stribeck_friction", "static_minus_sliding"), of("stribeck_friction", "stribeck_velocity"),
        of("hysteresis", "force"), of("hysteresis", "travel"),
    ])  # fmt: skip
    files = []
    for i in range(count):
        push = np.zeros(steps + 1)
        if case.protocol == "both_ways" and i >= count // 3:  # held torques, then let go
            a = rng.uniform(0.1, 0.5) * seconds
            b, c = a + np.cumsum(rng.uniform(0.3, 0.8, 2))
            size = rng.uniform(0.3, 0.8, 2) * tau
            push[(t >= a) & (t < b)] = side[i] * size[0]
            push[(t >= b) & (t < c)] = -side[i] * size[1]
        push = push[(np.arange(steps + 1) // ROW) * ROW]  # the input is held over the rows of an even log
        Q = np.empty(steps + 1)
        _run(hidden, np.array([inertia, weight, viscous]), push, q[i], v[i], 2e-6 * speed, Q)
        at = np.arange(0, steps + 1, ROW)
        if case.noise == "uneven":
            at = np.unique(np.clip(at + rng.integers(-10, 11, len(at)), 0, steps))
        if case.noise == "dropped":
            at = at[rng.random(len(at)) > 0.1]
        time = t[at]
        late = time - of("time_delay", "delay")
        shown = _play(Q, of("backlash", "play"), np.sign(v[i])) if "backlash" in case.names else Q
        read = np.interp(late, t, shown)
        read[late < 0] = shown[0] + late[late < 0] * (shown[1] - shown[0]) / STEP
        read = read * (1 + of("sensor_gain", "gain_error")) + of("sensor_bias", "bias")
        if case.noise == "distorted":
            read = read + 0.03 * length * np.sin(2 * read / length) / 2
        e = rng.standard_normal(len(at)) * case.sigma
        if case.noise == "ar":
            for k in range(1, len(e)):
                e[k] = 0.9 * e[k - 1] + np.sqrt(1 - 0.81) * e[k]
        read = read + e
        if case.noise == "quantised":
            read = np.round((read - e) / (3 * case.sigma)) * 3 * case.sigma
        if case.noise == "repeated":
            for k in np.flatnonzero(rng.random(len(at)) < 0.1):
                read[k] = read[max(k - 1, 0)]
        file = folder / f"log{i}.csv"
        rows = np.stack([time, read, push[at]], axis=1)
        np.savetxt(file, rows, delimiter=",", header="time,q,torque", comments="", fmt="%.9g")
        files.append(file)
    return model, files

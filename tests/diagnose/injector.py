"""A blind injector: a mechanism of its own, with something hidden in it, and the logs it leaves.

Nothing here comes from ``diagnose``: own integrator (midpoint at 0.5 ms), own friction law (regularised by a stiff
velocity ramp, no constraint), own noise. ``draw`` seals the answer; the analyser sees the MJCF file and the CSVs.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

STEP = 5e-4  # s

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
SINGLE = ("viscous_damping", "quadratic_drag", "coulomb_friction", "spring", "constant_torque", "gravity_torque",
          "inertia", "end_stop", "detent", "time_delay", "sensor_gain")  # fmt: skip
OUTSIDE = ("growing_friction", "quadrant_force", "slow_wave")
NOISES = ("white", "ar", "distorted", "uneven", "dropped")


@dataclass
class Case:
    """What is hidden: names and true parameters (contract names and those of the library's report)."""

    plant: str
    names: tuple[str, ...]
    truth: dict[str, float] = field(default_factory=dict)
    noise: str = "white"
    reversal: bool = True
    sigma: float = 1e-3


def draw(seed: int, plant: str, names: tuple[str, ...], noise: str = "white", reversal: bool = True) -> Case:
    """Draw the sizes of the hidden effects."""
    rng = np.random.default_rng([seed, 7])
    hinge, inertia, weight, viscous, speed, _ = PLANTS[plant]
    tau = inertia * speed / 0.8  # a torque that stops a push within 0.8 s
    length = 1.0 if hinge else 0.4
    u = rng.uniform(0.6, 1.4, 20)
    sign = rng.choice([-1.0, 1.0])
    draws = {
        "viscous_damping": {"damping": 0.5 * u[0] * tau / speed},
        "quadratic_drag": {"drag": 0.6 * u[1] * tau / speed**2},
        "coulomb_friction": {"friction": 0.15 * u[2] * tau},
        "spring": {"stiffness": 0.8 * u[3] * tau / length, "rest": 0.2 * sign * length},
        "constant_torque": {"torque": 0.2 * sign * u[4] * tau},
        "gravity_torque": {"sine": -0.3 * u[5] * tau, "cosine": 0.3 * sign * u[6] * tau},
        "inertia": {"added_inertia": 0.3 * u[7] * inertia},
        "end_stop": {"place": 0.3 * u[8] * length, "stiffness": inertia * (25 * u[9]) ** 2,
                     "damping": inertia * 6 * u[10]},
        "detent": {"place": 0.1 * sign * u[11] * length, "peak_torque": 0.6 * u[12] * tau,
                   "width": 0.08 * u[13] * length},
        "time_delay": {"delay": 0.02 * u[14]},
        "sensor_gain": {"gain_error": 0.06 * sign * u[15]},
        "growing_friction": {"rate": 0.15 * u[16] * tau},
        "quadrant_force": {"force": 0.5 * u[17] * tau},
        "slow_wave": {"force": 0.3 * u[18] * tau, "rate": 4.0 * u[19]},
    }  # fmt: skip
    truth = {k: v for n in names for k, v in draws[n].items()} if len(names) < 2 else {
        f"{n}.{k}": v for n in names for k, v in draws[n].items()}  # fmt: skip
    return Case(plant, names, truth, noise, reversal, 1e-3 if hinge else 4e-4)


def write(case: Case, seed: int, folder: Path, count: int = 6, seconds: float = 6.0) -> tuple[Path, list[Path]]:
    """The nominal model and the logs, as files."""
    rng = np.random.default_rng([seed, 11])
    hinge, inertia, weight, viscous, speed, body = PLANTS[case.plant]
    folder.mkdir(parents=True, exist_ok=True)
    model = folder / "model.xml"
    model.write_text('<mujoco><compiler angle="radian"/><option timestep="0.001" integrator="implicitfast"/>'
                     f'<worldbody>{body}</worldbody></mujoco>')  # fmt: skip
    steps = round(seconds / STEP)
    t = np.arange(steps + 1) * STEP
    length = 1.0 if hinge else 0.4
    side = rng.choice([-1.0, 1.0], count) if not case.reversal else np.resize([1.0, -1.0], count)
    side = side if case.reversal else np.ones(count)
    q = -side * length * rng.uniform(0.4, 0.8, count)
    v = side * speed * rng.uniform(0.5, 1.1, count)
    tau = inertia * speed / 0.8
    push = np.zeros((steps + 1, count))
    for i in range(count):
        if case.reversal and i >= count // 3:  # held torques, then let go
            a = rng.uniform(0.1, 0.5) * seconds
            b, c = a + np.cumsum(rng.uniform(0.3, 0.8, 2))
            size = rng.uniform(0.3, 0.8, 2) * tau
            push[(t >= a) & (t < b), i] = side[i] * size[0]
            push[(t >= b) & (t < c), i] = -side[i] * size[1]
    # Inputs are held over the log's rows.
    push = push[(np.arange(steps + 1) // 20) * 20]
    v0 = 1e-3 * speed
    Q = np.empty((steps + 1, count))
    truth = {k.split(".")[-1] if len(case.names) < 2 else k: x for k, x in case.truth.items()}

    def value(name: str, key: str) -> float:
        return truth.get(key if len(case.names) < 2 else f"{name}.{key}", 0.0) if name in case.names else 0.0

    mass = inertia + value("inertia", "added_inertia")

    def force(q: np.ndarray, v: np.ndarray, time: float) -> np.ndarray:
        f = -weight * np.sin(q) - (viscous + value("viscous_damping", "damping")) * v
        f = f - value("quadratic_drag", "drag") * v * np.abs(v)
        if "spring" in case.names:
            f = f - value("spring", "stiffness") * (q - value("spring", "rest"))
        f = f + value("constant_torque", "torque")
        if "gravity_torque" in case.names:
            f = f + value("gravity_torque", "sine") * np.sin(q) + value("gravity_torque", "cosine") * np.cos(q)
        if "end_stop" in case.names:
            deep = q - value("end_stop", "place")
            back = value("end_stop", "stiffness") * deep + value("end_stop", "damping") * v
            f = f - np.where(deep > 0, np.maximum(back, 0), 0)
        if "detent" in case.names:
            x = (q - value("detent", "place")) / value("detent", "width")
            f = f - value("detent", "peak_torque") * x * np.exp((1 - x * x) / 2)
        if "quadrant_force" in case.names:
            f = f - value("quadrant_force", "force") * ((q > 0) & (v > 0))
        if "slow_wave" in case.names:
            f = f + value("slow_wave", "force") * np.sin(value("slow_wave", "rate") * time)
        return f

    for k in range(steps + 1):
        Q[k] = q
        rub = value("coulomb_friction", "friction") + value("growing_friction", "rate") * t[k]
        if rub:  # implicit ramp: exact for this law, stiff only near standstill
            f = force(q + 0.5 * STEP * v, v, t[k]) + push[k]
            free = v + STEP * f / mass
            stiff = STEP * rub / (mass * v0)
            v_new = np.where(np.abs(free) <= v0 * (1 + stiff), free / (1 + stiff),
                             free - np.sign(free) * STEP * rub / mass)  # fmt: skip
            q = q + 0.5 * STEP * (v + v_new)
            v = v_new
        else:
            mid = v + 0.5 * STEP * (force(q, v, t[k]) + push[k]) / mass
            v = v + STEP * (force(q + 0.5 * STEP * v, mid, t[k] + 0.5 * STEP) + push[k]) / mass
            q = q + STEP * mid
    files = []
    for i in range(count):
        at = np.arange(0, steps + 1, 20)
        if case.noise == "uneven":
            at = np.unique(np.clip(at + rng.integers(-5, 6, len(at)), 0, steps))
        if case.noise == "dropped":
            at = at[rng.random(len(at)) > 0.1]
        time = t[at]
        read = np.interp(time - value("time_delay", "delay"), t, Q[:, i])
        late = time < value("time_delay", "delay")
        read[late] = Q[0, i] + (time[late] - value("time_delay", "delay")) * (Q[1, i] - Q[0, i]) / STEP
        read = read * (1 + value("sensor_gain", "gain_error"))
        if case.noise == "distorted":
            read = read + 0.03 * length * np.sin(2 * read / length) / 2
        e = rng.standard_normal(len(at)) * case.sigma
        if case.noise == "ar":
            for k in range(1, len(e)):
                e[k] = 0.9 * e[k - 1] + np.sqrt(1 - 0.81) * e[k]
        file = folder / f"log{i}.csv"
        rows = np.stack([time, read + e, push[at, i]], axis=1)
        np.savetxt(file, rows, delimiter=",", header="time,q,torque", comments="", fmt="%.9g")
        files.append(file)
    return model, files

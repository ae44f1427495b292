"""A blind injector for the place of a joint: 3D points on a part whose hinge is not where the model has it.

Nothing here comes from ``diagnose``: the part is a box on an axis of its own, its inertia, weight and turning worked
out from the box; points are turned by Rodrigues' formula and shown with noise. ``write_points`` seals the answer; the
analyser sees the MJCF file and the CSVs.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

HALF = np.array([0.2, 0.01, 0.15])  # m, of the box
CENTRE = np.array([0.2, 0.0, 0.0])  # m, of the box from the model's hinge
PLACE = np.array([0.3, -0.1, 1.0])  # m, of the model's hinge in the world
MASS, DAMPING, GRAVITY = 4.0, 0.05, 9.81
STEP = 5e-4  # s
MODEL = """<mujoco><compiler angle="radian"/><option timestep="0.001" integrator="implicitfast"/><worldbody>
<body pos="0.3 -0.1 1" quat="0.8 0 0.6 0"><joint name="j" type="{kind}" axis="{axis}" damping="0.05"/>
<geom type="box" size="0.2 0.01 0.15" pos="0.2 0 0" quat="1 0 0 0" mass="4"/></body></worldbody></mujoco>"""
EFFECTS = ("axis_misalignment", "pivot_offset", "second_joint", "loose_point", "nothing")
# The body frame is turned against the world by 2 acos(0.8) about y.
_S, _C = np.sin(2 * np.arccos(0.8)), np.cos(2 * np.arccos(0.8))
TURN = np.array([[_C, 0.0, _S], [0.0, 1.0, 0.0], [-_S, 0.0, _C]])


@dataclass
class PlacedCase:
    """What is hidden. tilt: rad.  distance: m.  direction: of a second joint, (3,) world."""

    effect: str
    kind: str
    truth: dict[str, float] = field(default_factory=dict)
    direction: np.ndarray | None = None


def rodrigues(axis: np.ndarray, angle: float | np.ndarray, x: np.ndarray) -> np.ndarray:
    """x (..., 3) turned about an axis through 0."""
    a = np.asarray(angle)[..., None]
    return x * np.cos(a) + np.cross(axis, x) * np.sin(a) + axis * (x @ axis)[..., None] * (1 - np.cos(a))


def write_points(seed: int, effect: str, folder: Path, kind: str = "hinge", count: int = 6, seconds: float = 4.0,
                 sigma: float = 1e-3, memory: float = 0.0, size: float = 1.0
                 ) -> tuple[PlacedCase, Path, list[Path]]:  # fmt: skip
    """The nominal model and the logs with five points, as files. ``memory``: of the points' noise (AR(1))."""
    rng = np.random.default_rng([seed, 23])
    folder.mkdir(parents=True, exist_ok=True)
    model = folder / "model.xml"
    nominal = TURN @ np.array([0.0, 0.0, 1.0])
    model.write_text(MODEL.format(kind=kind, axis="0 0 1"))
    case = PlacedCase(effect, kind)
    one = TURN @ np.array([1.0, 0.0, 0.0])
    two = np.cross(nominal, one)
    way = rng.uniform(0, 2 * np.pi)
    side = np.cos(way) * one + np.sin(way) * two
    axis, pivot = nominal, PLACE.copy()
    if effect == "axis_misalignment":
        tilt = size * rng.uniform(0.03, 0.12)
        axis = nominal + np.tan(tilt) * side
        axis /= np.linalg.norm(axis)
        case.truth["tilt"] = tilt
    if effect == "pivot_offset":
        away = size * rng.uniform(0.01, 0.04)
        pivot = PLACE + away * side
        case.truth["distance"] = away
    # The box about its true axis.
    centre = PLACE + TURN @ CENTRE
    full = np.diag([HALF[1] ** 2 + HALF[2] ** 2, HALF[0] ** 2 + HALF[2] ** 2, HALF[0] ** 2 + HALF[1] ** 2]) * MASS / 3
    arm = centre - pivot
    across = arm - (arm @ axis) * axis
    inertia = axis @ TURN @ full @ TURN.T @ axis + MASS * across @ across
    if kind == "slide":
        inertia = MASS
    body = TURN @ (rng.uniform(-0.9, 0.9, (5, 3)) * HALF + CENTRE).T  # points from the model's hinge, world
    points = PLACE + body.T
    direction = None
    if effect == "second_joint":
        direction = nominal if kind == "hinge" else side
        case.direction = direction
        natural, ring = 2 * np.pi * rng.uniform(1.0, 2.0), 0.05
    files = []
    pull = GRAVITY * MASS * np.array([0.0, 0.0, -1.0])
    for i in range(count):
        steps = round(seconds / STEP)
        q = float(rng.uniform(0.5, 0.9)) * (1 if i % 2 else -1)
        if kind == "slide":
            q *= 0.3
        v, Q = 0.0, np.empty(steps + 1)
        push = np.zeros(steps + 1)
        level = 0.4 if kind == "hinge" else 1.0
        for a in range(3):
            on = (np.arange(steps + 1) * STEP >= a + 0.5) & (np.arange(steps + 1) * STEP < a + 0.9)
            push[on] = level * rng.uniform(-1, 1)
        hold = (pull @ axis) if kind == "slide" else 0.0  # a counterweight carries a slide; the log holds its force
        push = push - hold

        def bend(q: float, v: float, u: float) -> float:
            torque = pull @ axis if kind == "slide" else np.cross(rodrigues(axis, q, arm), pull) @ axis
            return float((torque + u - DAMPING * v) / inertia)

        for k in range(steps + 1):
            Q[k] = q
            u = push[k]
            a1 = bend(q, v, u)
            a2 = bend(q + 0.5 * STEP * v, v + 0.5 * STEP * a1, u)
            a3 = bend(q + 0.5 * STEP * (v + 0.5 * STEP * a1), v + 0.5 * STEP * a2, u)
            a4 = bend(q + STEP * (v + 0.5 * STEP * a2), v + STEP * a3, u)
            q = q + STEP * (v + STEP * (a1 + a2 + a3) / 6)
            v = v + STEP * (a1 + 2 * a2 + 2 * a3 + a4) / 6
        at = np.arange(0, steps + 1, 20)
        time, true = at * STEP, Q[at]
        shown = np.empty((len(at), 5, 3))
        for k in range(5):
            if kind == "hinge":
                shown[:, k] = pivot + rodrigues(axis, true, np.broadcast_to(points[k] - pivot, (len(at), 3)))
            else:
                shown[:, k] = points[k] + true[:, None] * axis
        if effect == "second_joint":
            travel = size * rng.uniform(0.01, 0.02) * np.exp(-ring * natural * time) * np.cos(
                natural * np.sqrt(1 - ring**2) * time + rng.uniform(0, 6))  # fmt: skip
            shown += travel[:, None, None] * (direction if kind == "slide" else axis)
        if effect == "loose_point":
            wobble = size * 0.02 * np.sin(2 * np.pi * rng.uniform(0.5, 1.5) * time + rng.uniform(0, 6))
            shown[:, 2] += wobble[:, None] * side
            shown[:, 4] -= wobble[:, None] * rodrigues(nominal, 0.7, side)
        e = rng.standard_normal(shown.shape)
        for k in range(1, len(e)):
            e[k] = memory * e[k - 1] + np.sqrt(1 - memory**2) * e[k]
        shown += sigma * e
        read = true + (1e-3 if kind == "hinge" else 2e-4) * rng.standard_normal(len(at))
        names = ["time", "q", "torque", *(f"marker{k}_{c}" for k in range(5) for c in "xyz")]
        rows = np.concatenate([np.stack([time, read, push[at]], axis=1), shown.reshape(len(at), 15)], axis=1)
        file = folder / f"log{i}.csv"
        np.savetxt(file, rows, delimiter=",", header=",".join(names), comments="", fmt="%.9g")
        files.append(file)
    return case, model, files

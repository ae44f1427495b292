"""Articulated objects that stand on a desk, world frame, at q = 0."""

from __future__ import annotations

import numpy as np

from reconstruct.synth import textures as tx
from reconstruct.synth.objects import Model, make_box, opened, room


def laptop(seed: int) -> Model:
    """A laptop seen from behind; its lid, opened by 100 deg, is pushed down to 10 deg (horizontal hinge)."""
    shell = tx.paint((0.42, 0.43, 0.46), 0.03)
    lid = tx.with_stickers(tx.paint((0.42, 0.43, 0.46), 0.03), 8, 0.055)
    w, d, base = 0.17, 0.24, 0.018
    boxes = room(seed, 1.35) + [make_box("static", (-w, 0.0, 0.004), (w, d, base), shell, shine=0.4)]
    boxes += [
        make_box(
            "static",
            (-w + 0.02, 0.03, base),
            (w - 0.02, 0.14, base + 0.002),
            tx.tiles((0.1, 0.1, 0.1), 0.018),
            density=1500,
        )
    ]
    boxes += [
        make_box("static", (sx - 0.01, sy - 0.01, 0.0), (sx + 0.01, sy + 0.01, 0.004), shell)
        for sx in (-0.15, 0.15)
        for sy in (0.02, 0.22)
    ]
    boxes.append(make_box("moving", (-w, 0.004, base + 0.004), (w, d, base + 0.012), lid, density=1500, shine=0.4))
    axis, point, start = np.array([1.0, 0, 0]), np.array([0.0, 0.0, base + 0.006]), np.radians(100.0)
    # Closing turns the lid about -x; q grows as it closes.
    return Model(
        tuple(opened(boxes, "revolute", axis, point, start)),
        "revolute",
        -axis,
        point,
        np.radians(90.0),
        (0.0, np.radians(98.0)),
    )


def parcel(seed: int) -> Model:
    """A parcel that stands on a table, not attached to anything."""
    carton = tx.with_stickers(tx.paint((0.66, 0.50, 0.33), 0.05), 3, 0.055)
    boxes = room(seed, 0.40) + [make_box("moving", (-0.055, -0.07, 0.0), (0.085, 0.05, 0.16), carton, density=1500)]
    crate = tx.with_stickers(tx.wood((0.5, 0.36, 0.25)), 4, 0.06)
    boxes.append(make_box("static", (-0.22, 0.12, 0.0), (0.24, 0.26, 0.11), crate))
    return Model(tuple(boxes), None, None, None, 1.0, (0.0, 1.0))


def monitor(seed: int) -> Model:
    """A monitor that leans forward by 4 deg and is tilted back by 26 deg at its upper edge (horizontal hinge)."""
    case = tx.paint((0.13, 0.13, 0.14), 0.03)
    metal = tx.paint((0.55, 0.56, 0.58), 0.03)
    picture = tx.with_stickers(tx.plaster((0.20, 0.33, 0.45)), 12, 0.075)
    c, half = 0.29, 0.145
    boxes = room(seed, 0.42) + [
        make_box("static", (-0.12, -0.04, 0.0), (0.12, 0.15, 0.012), metal, shine=0.4),
        make_box("static", (-0.03, 0.052, 0.012), (0.03, 0.075, c + 0.02), metal, shine=0.4),
    ]
    boxes.append(make_box("moving", (-0.235, -0.012, c - half), (0.235, 0.012, c + half), case, density=1200))
    inner = (-0.225, -0.0135, c - half + 0.016), (0.225, -0.012, c + half - 0.010)
    boxes.append(make_box("moving", *inner, picture, density=1300, shine=0.3))
    boxes.append(make_box("moving", (-0.028, 0.012, c - 0.020), (0.028, 0.032, c + 0.020), case))
    axis, point = np.array([-1.0, 0, 0]), np.array([0.0, 0.034, c])
    boxes = opened(boxes, "revolute", axis, point, np.radians(-4.0))
    return Model(tuple(boxes), "revolute", axis, point, np.radians(26.0), (0.0, np.radians(29.0)))


def stapler(seed: int) -> Model:
    """A large stapler seen from the side; its arm, raised by 52 deg, is pressed down to 4 deg (horizontal hinge)."""
    shell = tx.with_stickers(tx.paint((0.20, 0.28, 0.46), 0.05), 3, 0.026)
    dark, metal = tx.paint((0.15, 0.15, 0.16), 0.04), tx.paint((0.62, 0.63, 0.64), 0.04)
    cap = tx.with_stickers(tx.paint((0.72, 0.30, 0.18), 0.05), 2, 0.02)
    boxes = room(seed, 0.60) + [
        make_box("static", (-0.110, -0.026, 0.0), (0.110, 0.026, 0.014), dark, density=1600),
        make_box("static", (0.070, -0.014, 0.014), (0.096, 0.014, 0.016), metal, density=1600, shine=0.6),
        make_box("static", (-0.108, -0.025, 0.014), (-0.076, -0.020, 0.058), metal, density=1600, shine=0.4),
        make_box("static", (-0.108, 0.020, 0.014), (-0.076, 0.025, 0.058), metal, density=1600, shine=0.4),
    ]
    boxes += [
        make_box("moving", (-0.100, -0.0175, 0.032), (0.060, 0.0175, 0.062), shell, density=2400, shine=0.3),
        make_box("moving", (0.060, -0.0175, 0.032), (0.104, 0.0175, 0.062), cap, density=2400, shine=0.3),
        make_box("moving", (-0.095, -0.010, 0.024), (0.100, 0.010, 0.032), metal, density=1600, shine=0.6),
    ]
    # Pressing the free end at high x down turns the arm about +y.
    axis, point, start = np.array([0.0, 1, 0]), np.array([-0.092, 0.0, 0.046]), np.radians(-52.0)
    boxes = opened(boxes, "revolute", axis, point, start)
    return Model(tuple(boxes), "revolute", axis, point, np.radians(48.0), (0.0, np.radians(51.0)))


def puncher(seed: int) -> Model:
    """A paper punch whose broad lever, raised by 30 deg, is pressed down to 4 deg (horizontal hinge at the back)."""
    dark, metal = tx.paint((0.14, 0.14, 0.15), 0.04), tx.paint((0.58, 0.59, 0.60), 0.04)
    lever = tx.with_stickers(tx.paint((0.50, 0.20, 0.18), 0.05), 6, 0.026)
    boxes = room(seed, 0.60) + [
        make_box("static", (-0.075, -0.030, 0.0), (0.075, 0.120, 0.014), dark, density=1600),
        make_box("static", (-0.060, 0.045, 0.014), (-0.030, 0.105, 0.046), metal, density=1600, shine=0.5),
        make_box("static", (0.030, 0.045, 0.014), (0.060, 0.105, 0.046), metal, density=1600, shine=0.5),
    ]
    boxes.append(make_box("moving", (-0.066, -0.050, 0.052), (0.066, 0.092, 0.068), lever, density=2400, shine=0.3))
    # Pressing the front edge at low y down turns the lever about +x.
    axis, point, start = np.array([1.0, 0, 0]), np.array([0.0, 0.086, 0.060]), np.radians(-30.0)
    boxes = opened(boxes, "revolute", axis, point, start)
    return Model(tuple(boxes), "revolute", axis, point, np.radians(26.0), (0.0, np.radians(29.0)))

"""Articulated objects and rooms made of textured boxes, world frame, at q = 0."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from reconstruct.joint.models import joint_transform
from reconstruct.synth import textures as tx

LINKS = ("room", "static", "moving")


@dataclass(frozen=True)
class Box:
    """A textured box.

    Attributes:
        link: "room", "static" or "moving".
        centre, size: (3,) m, full edge lengths; rotation: (3, 3).
        paint: what covers its faces.  density: texture px per metre.
        shine: specular reflection in [0, 1].
    """

    link: str
    centre: np.ndarray
    size: np.ndarray
    paint: tx.Painter
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    density: float = 900.0
    shine: float = 0.15

    def moved(self, T: np.ndarray) -> Box:
        return Box(
            self.link,
            T[:3, :3] @ self.centre + T[:3, 3],
            self.size,
            self.paint,
            T[:3, :3] @ self.rotation,
            self.density,
            self.shine,
        )

    def corners(self) -> np.ndarray:
        """(8, 3) world."""
        signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) * 0.5
        return self.centre + (signs * self.size) @ self.rotation.T


@dataclass(frozen=True)
class Solid:
    """A textured mesh: what a :class:`Box` is, of any shape.

    Attributes:
        link: "room", "static" or "moving".
        vertices, faces: (V, 3) m world, (F, 3).
        paint: what covers it, laid on along the axis that each part of it looks along most.
        density: texture px per metre.  shine: specular reflection in [0, 1].
    """

    link: str
    vertices: np.ndarray
    faces: np.ndarray
    paint: tx.Painter
    density: float = 900.0
    shine: float = 0.15

    def moved(self, T: np.ndarray) -> Solid:
        return replace(self, vertices=self.vertices @ T[:3, :3].T + T[:3, 3])

    def corners(self) -> np.ndarray:
        """(V, 3) world."""
        return self.vertices


@dataclass(frozen=True)
class Model:
    """What is in the picture besides the hand.

    Attributes:
        boxes: all solids at q = 0.
        kind: "revolute", "prismatic" or None (no joint).
        axis, point: (3,) world, None as kind says.
        q_end: state when the hand lets go, rad or m.  q_range: the joint's stops.
    """

    boxes: tuple[Box | Solid, ...]
    kind: str | None
    axis: np.ndarray | None
    point: np.ndarray | None
    q_end: float
    q_range: tuple[float, float]

    def link_pose(self, q: np.ndarray | float) -> np.ndarray:
        """(..., 4, 4) moving link relative to q = 0; ValueError without a joint."""
        if self.kind is None or self.axis is None:
            raise ValueError("nothing is attached by a joint here")
        return joint_transform(self.kind, self.axis, self.point, q)

    @property
    def diagonal(self) -> float:
        """Diagonal of the box around both links at q = 0, m."""
        corners = np.concatenate([b.corners() for b in self.boxes if b.link != "room"])
        return float(np.linalg.norm(np.ptp(corners, axis=0)))


def make_box(link: str, low: tuple, high: tuple, paint: tx.Painter, **kw) -> Box:
    low, high = np.asarray(low, float), np.asarray(high, float)
    return Box(link, (low + high) / 2, high - low, paint, **kw)


def opened(boxes: list, kind: str, axis: np.ndarray, point: np.ndarray, q: float) -> list:
    """The moving solids turned by q: lets a model be written down in its closed state."""
    T = joint_transform(kind, axis, point, q)
    return [b.moved(T) if b.link == "moving" else b for b in boxes]


def room(seed: int, wall_y: float) -> list[Box]:
    """A table top at z = 0, a tiled and plastered wall behind, and a few things that stand about."""
    rng = np.random.default_rng(seed)
    wall = tx.with_stickers(tx.plaster((0.80, 0.77, 0.70)), 22, 0.22)
    out = [
        make_box("room", (-3.0, -1.2, -0.04), (3.0, wall_y, 0.0), tx.wood((0.50, 0.36, 0.24), 0.22), density=400),
        make_box("room", (-3.0, wall_y, -0.1), (3.0, wall_y + 0.05, 0.30), tx.tiles((0.70, 0.76, 0.78)), density=400),
        make_box("room", (-3.0, wall_y + 0.01, 0.30), (3.0, wall_y + 0.05, 1.9), wall, density=300),
    ]
    for x in (-0.62, 0.60):
        z = 0.0
        for _ in range(3):
            h, w, d = rng.uniform(0.03, 0.05), rng.uniform(0.13, 0.2), rng.uniform(0.14, 0.18)
            x0, y0 = x + rng.uniform(-0.02, 0.02) - w / 2, wall_y - 0.05 - d
            colour = tuple(rng.uniform(0.2, 0.75, 3))
            book = tx.with_stickers(tx.paint(colour, 0.04), 2, 0.05)
            out.append(make_box("room", (x0, y0, z), (x0 + w, y0 + d, z + h), book))
            z += h
    return out


def _cabinet(low: tuple, high: tuple, wall: float, paint: tx.Painter, shelves: int = 1) -> list[Box]:
    """An open-fronted cabinet (front at low y)."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    inner = tx.paint((0.74, 0.70, 0.62), 0.03)
    out = [
        make_box("static", (x0, y0, z0), (x0 + wall, y1, z1), paint),
        make_box("static", (x1 - wall, y0, z0), (x1, y1, z1), paint),
        make_box("static", (x0 + wall, y0, z0), (x1 - wall, y1, z0 + wall), paint),
        make_box("static", (x0 + wall, y0, z1 - wall), (x1 - wall, y1, z1), paint),
        make_box("static", (x0 + wall, y1 - wall, z0 + wall), (x1 - wall, y1, z1 - wall), inner),
    ]
    for k in range(shelves):
        z = z0 + (k + 1) * (z1 - z0) / (shelves + 1)
        low, high = (x0 + wall, y0 + 0.012, z - wall / 2), (x1 - wall, y1 - wall, z + wall / 2)
        out.append(make_box("static", low, high, paint))
    return out


def cupboard(seed: int) -> Model:
    """A wall cupboard whose door stands open by 75 deg and is pushed shut to 5 deg (vertical hinge)."""
    body = tx.wood((0.62, 0.45, 0.30), 0.15)
    front = tx.with_stickers(tx.wood((0.66, 0.50, 0.34), 0.22, upright=True), 7, 0.065)
    boxes = room(seed, 0.24) + _cabinet((-0.18, 0.0, 0.30), (0.18, 0.24, 0.72), 0.016, body)
    boxes.append(make_box("moving", (-0.18, -0.020, 0.302), (0.178, -0.002, 0.718), front, density=1400))
    knob = tx.paint((0.25, 0.25, 0.27))
    boxes.append(make_box("moving", (0.135, -0.036, 0.655), (0.15, -0.020, 0.695), knob, shine=0.6))
    for z in (0.42, 0.60):
        for k, colour in enumerate(((0.7, 0.3, 0.2), (0.3, 0.5, 0.35), (0.75, 0.65, 0.3))):
            x = -0.12 + 0.09 * k
            jar = tx.with_stickers(tx.paint(colour, 0.05), 1, 0.04)
            low = (x, 0.09, 0.316 if z < 0.5 else 0.518)
            boxes.append(make_box("static", low, (x + 0.06, 0.15, low[2] + 0.11), jar))
    axis, point, start = np.array([0.0, 0, 1]), np.array([-0.18, -0.002, 0.51]), np.radians(-75.0)
    return Model(
        tuple(opened(boxes, "revolute", axis, point, start)),
        "revolute",
        axis,
        point,
        np.radians(70.0),
        (0.0, np.radians(75.0)),
    )


def locker(seed: int) -> Model:
    """A tall wall cabinet, hinged at the right, whose door stands open by 80 deg and is pushed shut to 6 deg."""
    body = tx.paint((0.50, 0.56, 0.58), 0.04)
    front = tx.with_stickers(tx.wood((0.60, 0.52, 0.40), 0.20, upright=True), 8, 0.06)
    boxes = room(seed, 0.22) + _cabinet((-0.17, 0.0, 0.30), (0.17, 0.22, 0.78), 0.016, body, shelves=2)
    boxes.append(make_box("moving", (-0.168, -0.020, 0.302), (0.17, -0.002, 0.778), front, density=1400))
    knob = tx.paint((0.22, 0.22, 0.24))
    boxes.append(make_box("moving", (-0.145, -0.036, 0.70), (-0.13, -0.020, 0.74), knob, shine=0.6))
    for k, colour in enumerate(((0.70, 0.40, 0.25), (0.35, 0.45, 0.60), (0.75, 0.70, 0.40))):
        tin = tx.with_stickers(tx.paint(colour, 0.05), 1, 0.04)
        low = (-0.13 + 0.09 * k, 0.08, 0.316)
        boxes.append(make_box("static", low, (low[0] + 0.06, 0.14, low[2] + 0.10), tin))
    # Shutting a door that is hinged at the right turns it about -z.
    axis, point, start = np.array([0.0, 0, -1]), np.array([0.17, -0.002, 0.54]), np.radians(-80.0)
    boxes = opened(boxes, "revolute", axis, point, start)
    return Model(tuple(boxes), "revolute", axis, point, np.radians(74.0), (0.0, np.radians(80.0)))


def crate(seed: int) -> Model:
    """A crate whose lid slides away from the viewer by 16 cm, pushed at a rib near its front edge."""
    side = tx.with_stickers(tx.wood((0.50, 0.36, 0.22), 0.16), 3, 0.05)
    inner = tx.paint((0.60, 0.55, 0.46), 0.03)
    top = tx.with_stickers(tx.wood((0.62, 0.48, 0.32), 0.20), 8, 0.05)
    w, d, h, wall = 0.15, 0.28, 0.16, 0.012
    boxes = room(seed, 0.60) + [
        make_box("static", (-w, 0.0, 0.0), (w, wall, h), side),
        make_box("static", (-w, d - wall, 0.0), (w, d, h - 0.018), side),
        make_box("static", (-w, wall, 0.0), (-w + wall, d - wall, h), side),
        make_box("static", (w - wall, wall, 0.0), (w, d - wall, h), side),
        make_box("static", (-w + wall, wall, 0.0), (w - wall, d - wall, wall), inner),
    ]
    for k, colour in enumerate(((0.75, 0.35, 0.30), (0.30, 0.45, 0.60))):
        packet = tx.with_stickers(tx.paint(colour, 0.05), 2, 0.03)
        boxes.append(make_box("static", (-0.10 + 0.11 * k, 0.03, wall), (-0.01 + 0.11 * k, 0.12, 0.09), packet))
    x = w - wall - 0.001
    boxes.append(make_box("moving", (-x, wall + 0.002, h - 0.014), (x, d - 0.001, h - 0.002), top, density=1500))
    rib = tx.paint((0.26, 0.24, 0.22), 0.04)
    boxes.append(make_box("moving", (-0.07, 0.060, h - 0.002), (0.07, 0.074, h + 0.030), rib, shine=0.3))
    return Model(tuple(boxes), "prismatic", np.array([0.0, 1, 0]), None, 0.16, (0.0, 0.20))


def drawers(seed: int) -> Model:
    """A chest whose upper drawer is pulled out by 18 cm at its plate handle."""
    body = tx.wood((0.44, 0.30, 0.20), 0.16)
    front = tx.with_stickers(tx.wood((0.55, 0.40, 0.27), 0.18), 4, 0.05)
    plain, metal = tx.paint((0.70, 0.66, 0.58), 0.03), tx.paint((0.30, 0.30, 0.32))
    x, depth, height = 0.22, 0.30, 0.34
    boxes = room(seed, depth + 0.02) + _cabinet((-x, 0.0, 0.0), (x, depth, height), 0.016, body, shelves=1)
    boxes.append(
        make_box("static", (-x + 0.003, -0.018, 0.004), (x - 0.003, 0.0, 0.167), tx.wood((0.55, 0.40, 0.27), 0.18))
    )
    z0, z1 = 0.171, height - 0.004
    boxes.append(make_box("moving", (-x + 0.003, -0.018, z0), (x - 0.003, -0.001, z1), front, density=1300))
    inside = 0.024
    for s in (-1, 1):
        a, b = sorted((s * (x - inside), s * (x - inside - 0.01)))
        boxes.append(make_box("moving", (a, -0.001, z0 + 0.014), (b, 0.26, z1 - 0.03), plain))
    boxes.append(make_box("moving", (-x + inside, -0.001, z0 + 0.010), (x - inside, 0.26, z0 + 0.016), plain))
    boxes.append(make_box("moving", (-x + inside, 0.25, z0 + 0.014), (x - inside, 0.26, z1 - 0.03), plain))
    for k, colour in enumerate(((0.8, 0.75, 0.6), (0.35, 0.45, 0.6), (0.7, 0.35, 0.3))):
        u = -0.16 + 0.11 * k
        stuff = tx.with_stickers(tx.paint(colour, 0.05), 2, 0.05)
        boxes.append(make_box("moving", (u, 0.03, z0 + 0.016), (u + 0.09, 0.15, z0 + 0.075), stuff))
    z = 0.5 * (z0 + z1) + 0.01
    boxes.append(make_box("moving", (-0.085, -0.074, z - 0.016), (0.085, -0.064, z + 0.016), metal, shine=0.6))
    for s in (-1, 1):
        boxes.append(
            make_box("moving", (s * 0.078 - 0.006, -0.064, z - 0.006), (s * 0.078 + 0.006, -0.018, z + 0.006), metal)
        )
    return Model(tuple(boxes), "prismatic", np.array([0.0, -1, 0]), None, 0.18, (0.0, 0.22))


def oven(seed: int) -> Model:
    """A table oven whose door opens downwards by 55 deg at its plate handle (horizontal hinge)."""
    body, metal = tx.paint((0.66, 0.66, 0.64), 0.03), tx.paint((0.22, 0.22, 0.24))
    front = tx.with_stickers(tx.paint((0.60, 0.60, 0.59), 0.03), 5, 0.05)
    boxes = room(seed, 0.34) + _cabinet((-0.21, 0.0, 0.02), (0.21, 0.30, 0.36), 0.018, body, shelves=0)
    boxes += [
        make_box("static", (sx - 0.015, sy, 0.0), (sx + 0.015, sy + 0.03, 0.02), metal)
        for sx in (-0.18, 0.18)
        for sy in (0.02, 0.25)
    ]
    boxes.append(
        make_box("static", (-0.21, -0.02, 0.302), (0.21, 0.0, 0.36), tx.with_stickers(body, 5, 0.045), density=1400)
    )
    boxes.append(make_box("moving", (-0.208, -0.020, 0.024), (0.208, -0.001, 0.298), front, density=1300))
    boxes.append(
        make_box(
            "moving",
            (-0.15, -0.0215, 0.06),
            (0.15, -0.020, 0.215),
            tx.with_stickers(tx.paint((0.10, 0.10, 0.11), 0.05), 2, 0.05),
            density=1300,
            shine=0.6,
        )
    )
    z = 0.262
    boxes.append(make_box("moving", (-0.10, -0.076, z - 0.016), (0.10, -0.066, z + 0.016), metal, shine=0.6))
    for s in (-1, 1):
        boxes.append(
            make_box("moving", (s * 0.094 - 0.006, -0.066, z - 0.006), (s * 0.094 + 0.006, -0.020, z + 0.006), metal)
        )
    return Model(
        tuple(boxes),
        "revolute",
        np.array([1.0, 0, 0]),
        np.array([0.0, -0.010, 0.024]),
        np.radians(55.0),
        (0.0, np.radians(85.0)),
    )


def cabinet(seed: int) -> Model:
    """A wall cabinet whose door is pulled open by 60 deg at a plate handle near its lower edge (vertical hinge)."""
    body = tx.wood((0.52, 0.42, 0.30), 0.14)
    front = tx.with_stickers(tx.wood((0.58, 0.47, 0.34), 0.18, upright=True), 6, 0.06)
    metal = tx.paint((0.28, 0.28, 0.30))
    boxes = room(seed, 0.24) + _cabinet((-0.19, 0.0, 0.34), (0.19, 0.23, 0.74), 0.016, body)
    boxes.append(make_box("moving", (-0.19, -0.020, 0.342), (0.188, -0.002, 0.738), front, density=1400))
    x, z = 0.115, 0.382
    boxes.append(make_box("moving", (x - 0.062, -0.074, z - 0.014), (x + 0.062, -0.064, z + 0.014), metal, shine=0.6))
    for s in (-1, 1):
        low, high = (x + s * 0.056 - 0.006, -0.064, z - 0.006), (x + s * 0.056 + 0.006, -0.020, z + 0.006)
        boxes.append(make_box("moving", low, high, metal))
    for k, colour in enumerate(((0.65, 0.35, 0.25), (0.30, 0.45, 0.50), (0.70, 0.62, 0.35))):
        jar = tx.with_stickers(tx.paint(colour, 0.05), 1, 0.04)
        low = (-0.14 + 0.10 * k, 0.08, 0.548)
        boxes.append(make_box("static", low, (low[0] + 0.065, 0.15, low[2] + 0.12), jar))
    # Opening turns the free edge towards the viewer: about -z.
    axis, point = np.array([0.0, 0, -1]), np.array([-0.19, -0.002, 0.54])
    return Model(tuple(boxes), "revolute", axis, point, np.radians(60.0), (0.0, np.radians(95.0)))


def chest(seed: int) -> Model:
    """A box whose lid, hinged at the back, is lifted by 50 deg at the lip in front (horizontal hinge)."""
    side = tx.with_stickers(tx.wood((0.48, 0.33, 0.21), 0.16), 2, 0.05)
    inner = tx.paint((0.62, 0.56, 0.46), 0.03)
    top = tx.with_stickers(tx.wood((0.56, 0.40, 0.26), 0.20), 9, 0.055)
    w, d, h, wall = 0.15, 0.20, 0.13, 0.010
    boxes = room(seed, 0.55) + [
        make_box("static", (-w, 0.0, 0.0), (w, wall, h), side),
        make_box("static", (-w, d - wall, 0.0), (w, d, h), side),
        make_box("static", (-w, wall, 0.0), (-w + wall, d - wall, h), side),
        make_box("static", (w - wall, wall, 0.0), (w, d - wall, h), side),
        make_box("static", (-w + wall, wall, 0.0), (w - wall, d - wall, wall), inner),
    ]
    for k, colour in enumerate(((0.75, 0.30, 0.25), (0.30, 0.50, 0.60), (0.80, 0.70, 0.35))):
        x = -0.11 + 0.08 * k
        packet = tx.with_stickers(tx.paint(colour, 0.05), 2, 0.03)
        boxes.append(make_box("static", (x, 0.06, wall), (x + 0.055, 0.14, 0.07), packet))
    boxes.append(make_box("moving", (-w, -0.030, h + 0.002), (w, d, h + 0.018), top, density=1500))
    # Lifting the front edge turns the lid about -x.
    axis, point = np.array([-1.0, 0, 0]), np.array([0.0, d - 0.004, h + 0.008])
    return Model(tuple(boxes), "revolute", axis, point, np.radians(50.0), (0.0, np.radians(100.0)))

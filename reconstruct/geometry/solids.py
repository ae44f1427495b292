"""Closed solids: extruded outlines, swept volumes, the assumed static body (manifold3d throughout)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from reconstruct.geometry.outline import Shape, rings_of
from reconstruct.geometry.plane import LinkPlane
from reconstruct.joint.models import JointFit

if TYPE_CHECKING:
    from manifold3d import Manifold, OpType

SWEEP_STEPS = 24
"""Pairs of neighbouring states whose common hull is subtracted from the static body."""


def posed(solid: Manifold, T: np.ndarray) -> Manifold:
    """A solid moved by a (4, 4) transform."""
    return solid.transform(np.asarray(T, float)[:3])


def to_arrays(solid: Manifold) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float and faces (F, 3) int of a solid."""
    mesh = solid.to_mesh64()
    return np.asarray(mesh.vert_properties)[:, :3].astype(float), np.asarray(mesh.tri_verts).astype(int)


def from_arrays(vertices: np.ndarray, faces: np.ndarray) -> Manifold:
    """A solid from a watertight mesh."""
    from manifold3d import Manifold, Mesh64

    mesh = Mesh64(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.uint64))
    mesh.merge()
    return Manifold(mesh)


def hull(points: np.ndarray) -> Manifold:
    """Convex hull of (k, 3) points."""
    from manifold3d import Manifold

    return Manifold.hull_points(np.ascontiguousarray(points, float))


def extrude(shape: Shape, plane: LinkPlane) -> Manifold:
    """The moving link as a solid in the world at q = 0."""
    from manifold3d import CrossSection, FillRule, Manifold

    pieces = []
    for k, s in enumerate(shape.slices):
        section = CrossSection([r.astype(float) for r in rings_of(s.outline)], FillRule.EvenOdd)
        # Neighbouring slices overlap by a hair: faces that merely touch would stay apart.
        low = s.low - (1e-4 * (s.high - s.low) if k else 0.0)
        pieces.append(Manifold.extrude(section, s.high - low).translate([0.0, 0.0, low]))
    solid = largest_piece(united(pieces))
    size = shape.bounds[1] - shape.bounds[0]
    return posed(solid.simplify(1e-3 * float(np.linalg.norm(size))), plane.pose)


def united(solids: list[Manifold]) -> Manifold:
    """All of them as one."""
    from manifold3d import Manifold

    return Manifold.batch_boolean(solids, _add()) if len(solids) > 1 else solids[0]


def largest_piece(solid: Manifold, share: float = 0.0) -> Manifold:
    """The piece with the most volume, with those above ``share`` of it when share > 0."""
    pieces = solid.decompose()
    if len(pieces) <= 1:
        return solid
    most = max(p.volume() for p in pieces)
    keep = [p for p in pieces if p.volume() >= (share if share > 0 else 1.0) * most]
    return united(keep)


def _add() -> OpType:
    from manifold3d import OpType

    return OpType.Add


def sweep_range(fit: JointFit) -> tuple[float, float]:
    """(low, high) state with a margin of 2 % of the range on both sides."""
    low, high = float(np.min(fit.q)), float(np.max(fit.q))
    margin = 0.02 * max(high - low, 1e-9)
    return low - margin, high + margin


def swept_hulls(parts: tuple[tuple[np.ndarray, np.ndarray], ...], fit: JointFit, clearance: float,
                steps: int = SWEEP_STEPS) -> list[np.ndarray]:
    """Vertex clouds whose convex hulls together contain the link in every state, fattened by ``clearance``.

    Between two neighbouring states a point runs on an arc; the hull of both ends contains all but the
    arc's rise over its chord, which the fattening covers as long as clearance exceeds it.
    """
    states = np.linspace(*sweep_range(fit), steps + 1)
    poses = fit.link_pose(states)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    axes = np.vstack([np.eye(3), -np.eye(3)]) * np.sqrt(3)
    out = []
    for vertices, _ in parts:
        moved = np.einsum("tij,vj->tvi", poses[:, :3, :3], vertices) + poses[:, None, :3, 3]
        for a, b in zip(moved[:-1], moved[1:], strict=True):
            rise = 0.0
            if fit.type != "prismatic":
                step = abs(states[1] - states[0])
                lever = np.linalg.norm(np.cross(vertices - fit.point, fit.axis), axis=1).max()
                rise = lever * (1 - np.cos(step / 2))
            around = np.vstack([corners, axes]) * (clearance + rise)
            points = np.vstack([a, b])
            out.append((points[:, None] + around[None]).reshape(-1, 3))
    return out


def closing_direction(fit: JointFit, centre: np.ndarray, end: float) -> np.ndarray:
    """Unit direction, world, in which the link's centre moves when q arrives at ``end`` from inside the range.

    Args:
        centre: (3,) the link's centre at q = 0.
    """
    low, high = float(np.min(fit.q)), float(np.max(fit.q))
    inward = (low + high) / 2 - end
    step = 1e-3 * inward
    c = np.append(centre, 1.0)
    move = (fit.link_pose(end) @ c - fit.link_pose(end + step) @ c)[:3]
    length = np.linalg.norm(move)
    return move / length if length > 0 else fit.axis


def static_box(shape: Shape, plane: LinkPlane, fit: JointFit, end: float, clearance: float,
               widen: float = 0.0, beneath: bool = False) -> tuple[Manifold, dict]:
    """The assumed static body: what the link closes onto at state ``end``, as a block behind it.

    The block has the link's outline box across the closing direction and, along it, a depth in
    proportion: nothing in a still camera's view measures it. It reaches the hinge line where that lies
    close by.

    Args:
        widen: how much more room to give it across, on every side, in parts of the link's longest side.
        beneath: behind the link's face, away from the side that was seen, wherever the link comes from: what a lid or
            a door that slides along itself covers.
    """
    pose = fit.link_pose(end) @ plane.pose
    low, high = shape.bounds
    size = high - low
    centre = plane.to_world((low + high) / 2)
    direction = pose[:3, :3].T @ closing_direction(fit, centre, end)
    k = int(np.argmax(np.abs(direction)))
    sign = 1.0 if direction[k] > 0 else -1.0
    if beneath:
        k, sign = 2, -1.0
    across = np.delete(size, k)
    # Behind a face (door, lid): a body nearly as deep as the face is wide. Under an arm: one as thick as the arm.
    depth = 0.8 * float(across.min()) if k == 2 else float(size[k])
    if fit.type == "prismatic" and not beneath:
        depth = max(depth, 1.15 * float(np.ptp(fit.q)))
    box_low, box_high = low.copy(), high.copy()
    grow = 0.02 * float(np.linalg.norm(size)) + 2 * clearance + widen * float(size.max())
    for j in range(3):
        if j != k:
            box_low[j] -= grow
            box_high[j] += grow
    if fit.type != "prismatic":
        foot = (np.linalg.inv(pose) @ np.append(fit.point, 1.0))[:3]
        axis = pose[:3, :3].T @ fit.axis
        for j in range(3):
            near = max(box_low[j] - foot[j], foot[j] - box_high[j])
            if j != k and abs(axis[j]) < 0.7 and near < 0.3 * float(np.linalg.norm(size)):
                box_low[j] = min(box_low[j], foot[j] - 2 * clearance)
                box_high[j] = max(box_high[j], foot[j] + 2 * clearance)
    if sign > 0:
        box_low[k], box_high[k] = high[k] + clearance, high[k] + clearance + depth
    else:
        box_low[k], box_high[k] = low[k] - clearance - depth, low[k] - clearance
    corners = np.array([[x, y, z, 1.0] for x in (box_low[0], box_high[0]) for y in (box_low[1], box_high[1])
                        for z in (box_low[2], box_high[2])])
    return hull((corners @ pose.T)[:, :3]), {"depth": depth, "direction": (pose[:3, k] * sign).tolist()}


def carve(body: Manifold, clouds: list[np.ndarray]) -> Manifold:
    """Body minus the convex hulls of the clouds, the shards dropped."""
    from manifold3d import Manifold

    box = np.asarray(body.bounding_box()).reshape(2, 3)
    cutters = []
    for c in clouds:
        if (c.min(0) < box[1]).all() and (c.max(0) > box[0]).all():
            cutters.append(hull(c))
    if not cutters:
        return body
    rest = body - Manifold.batch_boolean(cutters, _add())
    size = float(np.linalg.norm(box[1] - box[0]))
    return largest_piece(rest.simplify(1e-3 * size), 0.1)

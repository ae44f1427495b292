"""Convex parts, and the proof that the two links stay clear of each other."""

from __future__ import annotations

import contextlib
import io
from dataclasses import replace

import numpy as np

from reconstruct.geometry import Geometry
from reconstruct.geometry.solids import hull, sweep_range, swept_hulls, to_arrays
from reconstruct.joint.models import JointFit

Part = tuple[np.ndarray, np.ndarray]
MAX_PARTS = 16


def convex_parts(vertices: np.ndarray, faces: np.ndarray, limit: int = MAX_PARTS,
                 concavity: float = 0.05) -> tuple[tuple[Part, ...], dict]:
    """Convex decomposition of a closed mesh.

    Args:
        vertices, faces: (V, 3), (F, 3).
        limit: most parts.
        concavity: CoACD's threshold (its own measure, relative to the mesh's size).

    Returns:
        The parts and {"parts", "concavity", "volume_error"}: the parts' summed volume over the mesh's, minus 1.
    """
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    volume = float(mesh.volume)
    whole = hull(vertices)
    if volume > 0.97 * whole.volume():
        parts: tuple[Part, ...] = (to_arrays(whole),)
    else:
        import coacd

        coacd.set_log_level("error")
        with contextlib.redirect_stdout(io.StringIO()):
            found = coacd.run_coacd(coacd.Mesh(vertices, faces), threshold=concavity, max_convex_hull=limit,
                                    preprocess_mode="off", mcts_iterations=60, mcts_nodes=12, mcts_max_depth=2,
                                    resolution=1000, seed=0)
        parts = tuple(to_arrays(hull(v)) for v, _ in found if len(v) >= 4)
        parts = tuple(p for p in parts if len(p[1]) >= 4)
    total = sum(float(trimesh.Trimesh(v, f, process=False).volume) for v, f in parts)
    return parts, {"parts": len(parts), "concavity": concavity, "volume_error": total / volume - 1 if volume else 0.0}


def trim_parts(parts: tuple[Part, ...], clouds: list[np.ndarray]) -> tuple[Part, ...]:
    """Cut every part back until it is outside the convex hull of every cloud.

    A decomposition bridges small concavities, so that a part may reach into the volume that the solid
    itself keeps free. Each cut is by one face plane of the obstacle, the one that loses the least.
    """
    from scipy.spatial import ConvexHull

    obstacles = []
    for cloud in clouds:
        eq = ConvexHull(cloud).equations
        obstacles.append((cloud.min(0), cloud.max(0), eq))
    out = []
    for vertices, _ in parts:
        solid = hull(vertices)
        first = solid.volume()
        for low, high, eq in obstacles:
            v, _ = to_arrays(solid)
            if len(v) < 4 or (v.min(0) >= high).any() or (v.max(0) <= low).any():
                continue
            height = v @ eq[:, :3].T + eq[:, 3]
            if (height.min(0) >= -1e-9).any():
                continue
            # The faces over which most of the part already lies are the candidates.
            order = np.argsort(-height.mean(0))[:12]
            cuts = [solid.trim_by_plane(eq[k, :3].tolist(), float(-eq[k, 3])) for k in order]
            solid = max(cuts, key=lambda s: s.volume())
            if solid.volume() < 0.01 * first:
                break
        if solid.volume() >= 0.01 * first:
            v, _ = to_arrays(solid)
            out.append(to_arrays(hull(v)))
    return tuple(out)


def contacts_over_range(moving: tuple[Part, ...], static: tuple[Part, ...], fit: JointFit,
                        states: int = 41) -> dict:
    """MuJoCo's own verdict: contacts between the links' convex parts over the joint's range.

    Returns:
        {"states", "contacts", "penetration"}: number of states, of contacts in them, and the deepest overlap.
    """
    import mujoco

    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    # Meshes may be in any unit: keep MuJoCo's lower bounds on inertia out of the way.
    spec.compiler.boundmass = 1e-6
    spec.compiler.boundinertia = 1e-9
    size = max(float(np.abs(np.vstack([v for v, _ in moving + static])).max()), 1e-9)
    bodies = {}
    for name, parts in (("moving", moving), ("static", static)):
        body = spec.worldbody.add_body(name=name, mocap=True)
        for k, (v, f) in enumerate(parts):
            mesh = spec.add_mesh(name=f"{name}{k}")
            mesh.uservert = (v / size).astype(np.float32).ravel()
            mesh.userface = f.astype(np.int32).ravel()
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"{name}{k}")
        bodies[name] = body
    # Two mocap bodies are both welded to the world, which MuJoCo never collides: let one float.
    bodies["moving"].mocap = False
    bodies["moving"].add_freejoint()
    model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY
    data = mujoco.MjData(model)
    count, depth = 0, 0.0
    quat = np.zeros(4)
    for T in fit.link_pose(np.linspace(*sweep_range(fit), states)):
        mujoco.mju_mat2Quat(quat, np.ascontiguousarray(T[:3, :3]).ravel())
        data.qpos[:3] = T[:3, 3] / size
        data.qpos[3:] = quat
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        for c in data.contact[: data.ncon]:
            ends = {int(model.geom_bodyid[c.geom1]), int(model.geom_bodyid[c.geom2])}
            if len(ends) == 2:
                count += 1
                depth = max(depth, -float(c.dist) * size)
    return {"states": states, "contacts": count, "penetration": depth}


def keep_clear(geometry: Geometry, fit: JointFit, clearance: float = 0.004) -> Geometry:
    """The same geometry, its static parts cut back where the moving link would meet them over the joint's range.

    Surfaces stay as they are: a mesh that somebody gave may overlap the other link by what its maker did not know, and
    only its collision parts decide whether the joint can move.

    Args:
        clearance: gap to leave, in parts of the moving link's extent.
    """
    before = contacts_over_range(geometry.moving.parts, geometry.static.parts, fit)
    if not before["contacts"]:
        return geometry
    extent = float(np.linalg.norm(np.ptp(np.concatenate([v for v, _ in geometry.moving.parts]), axis=0)))
    parts = trim_parts(geometry.static.parts, swept_hulls(geometry.moving.parts, fit, clearance * extent))
    after = contacts_over_range(geometry.moving.parts, parts, fit) if parts else {"contacts": 0}
    lost = len(geometry.static.parts) - len(parts)
    words = (f"the links overlapped by up to {before['penetration']:.3g} over the joint's range: the static link's "
             f"collision parts were cut back{f' and {lost} of them left out' if lost else ''}")  # fmt: skip
    entry = {"value": after["contacts"], "origin": "observed", "before_cutting": before["contacts"]}
    return replace(geometry, static=replace(geometry.static, parts=parts), notes=(*geometry.notes, words),
                   provenance={**geometry.provenance, "contacts_over_range": entry})  # fmt: skip

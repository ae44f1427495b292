"""Clips of furniture that others modelled (furniture_sim): its meshes and joints, our textures, hand and camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reconstruct.synth import textures as tx
from reconstruct.synth.hand_model import HandPose
from reconstruct.synth.objects import Model, Solid, make_box, opened, room
from reconstruct.synth.staging import Clip, place_hand

FOLDER = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "objects" / "furniture_sim"
EXTENT = 0.50
"""m: the body's largest extent once shrunk; the room and the hand keep their size."""
PLINTH = 0.18
"""m: it stands on a block of this height, so that an arm finds room below."""
FLAT = HandPose(
    flex=((14, 16, 10), (14, 16, 10), (14, 16, 10), (16, 18, 10)),
    spread=(12, 1, -9, -21),
    thumb=(50, 14, 12, 10),
    wrist=(48, 0),
)
ALL = tuple(range(21))
FRONT = np.array([0.0, -1, 0])


def list_furniture() -> list[str]:
    """Objects with one part on a hinge or slide that are present."""
    return [name for name in ("boxcabinet", "hingecabinet", "microwave", "dishwasher", "slidecabinet")
            if (FOLDER / f"{name}.xml").is_file()]  # fmt: skip


def load_solids(name: str, joint: str, turn: float) -> tuple[list, list, np.ndarray, np.ndarray, float]:
    """The visual geoms of an object's links at its joint's zero, shrunk, on the plinth, its front at low y.

    Args:
        joint: the joint that moves; all other parts are static.
        turn: about z, rad, so that the front looks along -y.

    Returns:
        Meshes of the static and of the moving link, the joint's axis and anchor, and the scale.
    """
    import mujoco
    import trimesh
    from scipy.spatial.transform import Rotation

    model = mujoco.MjModel.from_xml_path(str(FOLDER / f"{name}.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    j = model.joint(joint).id
    groups: dict[bool, list] = {False: [], True: []}
    for g in range(model.ngeom):
        if model.geom_group[g] != 1:
            continue
        size, kind = model.geom_size[g], mujoco.mjtGeom(int(model.geom_type[g]))
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            mesh = trimesh.creation.box(extents=2 * size)
        elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
            mesh = trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=24)
        elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            mesh = trimesh.creation.capsule(radius=size[0], height=2 * size[1], count=[12, 12])
        elif kind == mujoco.mjtGeom.mjGEOM_MESH:
            k = model.geom_dataid[g]
            v0, nv, f0, nf = (int(a[k]) for a in (model.mesh_vertadr, model.mesh_vertnum, model.mesh_faceadr,
                                                  model.mesh_facenum))  # fmt: skip
            mesh = trimesh.Trimesh(model.mesh_vert[v0 : v0 + nv], model.mesh_face[f0 : f0 + nf], process=True)
        else:
            raise ValueError(f"{name}: a geom of type {kind.name} is not read")
        mesh.apply_transform(np.block([[data.geom_xmat[g].reshape(3, 3), data.geom_xpos[g][:, None]],
                                       [np.zeros(3), 1]]))  # fmt: skip
        groups[int(model.geom_bodyid[g]) == int(model.jnt_bodyid[j])].append(mesh)
    R = Rotation.from_rotvec([0, 0, turn]).as_matrix()
    body = np.concatenate([m.vertices for m in groups[False]]) @ R.T
    scale = EXTENT / float(np.ptp(body, axis=0).max())
    shift = -np.array([(body[:, 0].min() + body[:, 0].max()) / 2, body[:, 1].min(), body[:, 2].min() - PLINTH / scale])
    out = []
    for moves in (False, True):
        out.append([((m.vertices @ R.T + shift) * scale, np.asarray(m.faces)) for m in groups[moves]])
    return out[0], out[1], R @ data.xaxis[j], (R @ data.xanchor[j] + shift) * scale, scale


def _model(name: str, seed: int, joint: str, start: float, end: float, limit: float, turn: float = 0.0) -> Model:
    """The object with the joint's q counted from ``start`` towards ``end``, both in the model's own numbers."""
    static, moving, axis, point, scale = load_solids(name, joint, turn)
    kind = "prismatic" if name == "slidecabinet" else "revolute"
    if kind == "prismatic":
        start, end, limit = start * scale, end * scale, limit * scale
    sign = 1.0 if end > start else -1.0
    body = tx.wood((0.50, 0.38, 0.27), 0.16) if "cabinet" in name else tx.paint((0.62, 0.62, 0.60), 0.03)
    front = tx.with_stickers(tx.wood((0.58, 0.44, 0.30), 0.2, upright=True) if "cabinet" in name
                             else tx.paint((0.55, 0.56, 0.57), 0.03), 6, 0.05)  # fmt: skip
    metal = tx.paint((0.26, 0.26, 0.28), 0.03)
    largest = max(range(len(moving)), key=lambda i: np.ptp(moving[i][0], axis=0).prod())
    boxes = room(seed, max(v[:, 1].max() for v, _ in static) + 0.03)
    corners = np.concatenate([v for v, _ in static])
    low, high = corners.min(0), corners.max(0)
    stone = tx.plaster((0.62, 0.60, 0.56))
    boxes.append(make_box("room", (low[0], low[1] + 0.02, 0.0), (high[0], high[1], PLINTH), stone))
    boxes += [Solid("static", v, f, body) for v, f in static]
    boxes += [Solid("moving", v, f, front if i == largest else metal, 1200.0) for i, (v, f) in enumerate(moving)]
    boxes = opened(boxes, kind, axis, point, start)
    return Model(tuple(boxes), kind, sign * axis, point if kind == "revolute" else None, abs(end - start),
                 (0.0, abs(limit - start)))  # fmt: skip


def build_furniture(name: str, seed: int = 0) -> Clip:
    """The clip of one of :func:`list_furniture`: doors are pushed shut, the dishwasher is opened, the slide pushed."""
    if name == "dishwasher":
        return _dishwasher(seed)
    if name == "slidecabinet":
        return _slide(seed)
    joint = {"boxcabinet": "boxdoorhinge", "hingecabinet": "leftdoorhinge", "microwave": "micro0joint"}[name]
    start, end = np.radians([-72.0, -4.0])
    model = _model(name, seed, joint, start, end, 0.0)
    shut = model.link_pose(-start)
    door = max((b for b in model.boxes if b.link == "moving"), key=lambda b: np.ptp(b.vertices, axis=0).prod())
    corners = door.vertices @ shut[:3, :3].T + shut[:3, 3]
    low, high = corners.min(0), corners.max(0)
    # Between the hinge and the handle, which stands in the way of a hand nearer to the free edge.
    share = 0.40 if name == "hingecabinet" else 0.52
    at = np.array([low[0] + share * (high[0] - low[0]), low[1], low[2] + 0.80 * (high[2] - low[2])])
    T = place_hand(FLAT, "right", -FRONT, np.array([-0.10, 0.14, 0.98]), at, (12,), (at, FRONT), ALL)
    back = np.linalg.inv(shut)
    far = back[:3, :3] @ np.array([0.06, -0.20, -0.10])
    return Clip(name, "a door is pushed shut", model, FLAT, "right", back @ T, far,
                back[:3, :3] @ np.array([0.0, -0.10, 0.0]), np.array([-0.52, -0.80, 0.68]),
                np.array([-0.04, -0.02, 0.30]))  # fmt: skip


def _dishwasher(seed: int) -> Clip:
    model = _model("dishwasher", seed, "door", np.radians(-35.0), np.radians(-80.0), np.radians(-86.0), np.pi)
    shut = model.link_pose(-np.radians(35.0))
    door = max((b for b in model.boxes if b.link == "moving"), key=lambda b: np.ptp(b.vertices, axis=0).prod())
    corners = door.vertices @ shut[:3, :3].T + shut[:3, 3]
    high = corners.max(0)
    high[1] = corners[corners[:, 2] > high[2] - 0.08, 1].max()  # its arms at the bottom reach farther in
    pose = HandPose(flex=((8, 12, 8),) * 4, spread=(10, 1, -8, -18), thumb=(58, 4, 8, 8), wrist=(20, 0))
    at = np.array([0.06, high[1], high[2] - 0.035])
    T = place_hand(pose, "right", FRONT, np.array([-0.25, 0.0, -1.0]), at, (12,), (at, -FRONT), ALL)
    back = np.linalg.inv(shut)
    return Clip("dishwasher", "a dishwasher's door is pushed open from inside", model, pose, "right", back @ T,
                np.array([0.10, 0.02, 0.22]), np.array([0.0, 0.06, 0.04]), np.array([-0.50, -0.86, 1.12]),
                np.array([0.02, -0.12, 0.38]))  # fmt: skip


def _slide(seed: int) -> Clip:
    model = _model("slidecabinet", seed, "slidedoor_joint", 0.0, 0.40, 0.44)
    bar = max((b for b in model.boxes if b.link == "moving"), key=lambda b: -b.vertices[:, 1].min())
    low, high = bar.vertices.min(0), bar.vertices.max(0)
    pose = HandPose(flex=((10, 12, 6),) * 4, spread=(8, 1, -7, -16), thumb=(60, -6, 8, 8), wrist=(10, 0))
    right = np.array([1.0, 0, 0])
    at = np.array([low[0], (low[1] + high[1]) / 2 - 0.004, (low[2] + high[2]) / 2 + 0.02])
    T = place_hand(pose, "left", right, np.array([0.0, 0.45, 0.89]), at, (10, 11), (at, -right), ALL)
    return Clip("slidecabinet", "a sliding door is pushed by its handle", model, pose, "left", T,
                np.array([-0.20, -0.14, -0.02]), np.array([-0.08, 0.0, 0.0]), np.array([-0.26, -0.78, 0.62]),
                np.array([-0.02, -0.02, 0.29]))  # fmt: skip

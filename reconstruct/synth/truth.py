"""Ground truth beside a clip: writing it, reading it, and handing it out as the cues of a scene folder."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reconstruct.joint.models import joint_transform
from reconstruct.synth.animation import Motion
from reconstruct.synth.hand_model import landmarks
from reconstruct.synth.objects import Model, Solid
from reconstruct.synth.render import LINK_CODE, Rendered
from reconstruct.synth.staging import Clip

DEPTH_STRIDE = 3
"""Stored depth is sampled at pixels (3 i + 1): the centre of each 3 x 3 block, so it is the picture at scale 1/3."""
TRACKS_A_FRAME = 160


@dataclass(frozen=True)
class SynthTruth:
    """What is known about a rendered clip.

    World frame: z up, metres. Pixels: centre of the top-left one is (0, 0). T frames, N tracks.

    Attributes:
        name, video: the clip and its file.  size: (width, height) px.
        type: "revolute", "prismatic" or None (no joint: the clip must be refused).
        axis: (3,) unit or None; q grows along it.  point: (3,) on the axis or None.
        q: (T,) rad or m from q[0] = 0 (NaN without a joint; zeros where nothing moves).  q_range: the joint's stops.
        time: (T,) s.  K: (3, 3) px.  T_camera_world: (T, 4, 4).
        T_world_moving: (T, 4, 4) moving link relative to frame 0.
        hand_joints: (T, 21, 3) world.  side: "right" or "left".  contact: (T,) bool.
        moving, static, hand, room: (T, H, W) bool; static is the object's fixed part, room all else.
        depth: (T, H/3, W/3) m along the optical axis, NaN where nothing is, at pixels (3 i + 1).
        diagonal: of the object's bounding box at q = 0, m.
        image_line: (2, 2) px of the axis in frame 0 (along the slide through the part's centre if prismatic), or None.
        centroid: (3,) of the moving link's box at q = 0, world.
        tracks: points on both links and the room: "uv" (N, T, 2) px, "visible" (N, T), "xyz_world" (N, T, 3),
            "link" (N,) of LINK_CODE.
        mjcf: path of the object alone.
    """

    name: str
    video: Path
    size: tuple[int, int]
    type: str | None
    axis: np.ndarray | None
    point: np.ndarray | None
    q: np.ndarray
    q_range: tuple[float, float]
    time: np.ndarray
    K: np.ndarray
    T_camera_world: np.ndarray
    T_world_moving: np.ndarray
    hand_joints: np.ndarray
    side: str
    contact: np.ndarray
    moving: np.ndarray
    static: np.ndarray
    hand: np.ndarray
    room: np.ndarray
    depth: np.ndarray
    diagonal: float
    image_line: np.ndarray | None
    centroid: np.ndarray
    tracks: dict[str, np.ndarray]
    mjcf: Path

    def project(self, xyz_world: np.ndarray, frame: int) -> np.ndarray:
        """(..., 3) world -> (..., 2) px in one frame."""
        return _project(self.K, self.T_camera_world[frame], xyz_world)[0]

    def link_pose(self, q: np.ndarray | float) -> np.ndarray:
        """(..., 4, 4) moving link at q relative to q = 0; ValueError without a joint."""
        if self.type is None or self.axis is None:
            raise ValueError(f"clip {self.name!r} shows no joint")
        return joint_transform(self.type, self.axis, self.point, q)


def _project(K: np.ndarray, T_camera_world: np.ndarray, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(..., 2) px and (...,) depth."""
    x = np.asarray(xyz) @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    uvw = x @ K.T
    return uvw[..., :2] / uvw[..., 2:], x[..., 2]


def _sample_tracks(motion: Motion, r: Rendered, seed: int) -> dict[str, np.ndarray]:
    """Points picked in the first, the middle and the last frame, carried by their link, visible by depth test."""
    rng = np.random.default_rng(seed)
    n, h, w = r.link.shape
    anchors, links = [], []
    for t in sorted({0, n // 2, n - 1}):
        T_world_camera = np.linalg.inv(motion.T_camera_world[t])
        for name in ("moving", "static", "room"):
            # A pixel next to another link or a depth step belongs half to what is behind it.
            near = r.depth[t].astype(np.float32)
            flat = np.zeros((h, w), bool)
            inner = near[1:-1, 1:-1]
            step = np.max(
                [
                    np.abs(inner - near[1 + a : h - 1 + a, 1 + b : w - 1 + b])
                    for a, b in ((0, 1), (0, -1), (1, 0), (-1, 0))
                ],
                axis=0,
            )
            flat[1:-1, 1:-1] = step < 0.02
            v, u = np.nonzero((r.link[t] == LINK_CODE[name]) & flat)
            if not len(v):
                continue
            pick = rng.choice(len(v), min(len(v), TRACKS_A_FRAME), replace=False)
            uv1 = np.stack([u[pick], v[pick], np.ones(len(pick))], axis=1).astype(float)
            x = uv1 @ np.linalg.inv(r.K).T * near[v[pick], u[pick]][:, None].astype(float)
            x = x @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
            if name == "moving":
                back = np.linalg.inv(motion.T_world_moving[t])
                x = x @ back[:3, :3].T + back[:3, 3]
            anchors.append(x)
            links.append(np.full(len(x), LINK_CODE[name], np.uint8))
    anchor, link = np.concatenate(anchors), np.concatenate(links)
    carried = link == LINK_CODE["moving"]
    xyz = np.repeat(anchor[:, None], n, axis=1)
    T = motion.T_world_moving
    xyz[carried] = np.einsum("tij,nj->nti", T[:, :3, :3], anchor[carried]) + T[:, :3, 3]
    uv, visible = np.empty((len(anchor), n, 2)), np.zeros((len(anchor), n), bool)
    for t in range(n):
        uv[:, t], z = _project(r.K, motion.T_camera_world[t], xyz[:, t])
        iu, iv = (np.round(np.nan_to_num(uv[:, t, m])).astype(int) for m in (0, 1))
        inside = (z > 0) & (iu >= 0) & (iv >= 0) & (iu < w) & (iv < h)
        iu, iv = np.clip(iu, 0, w - 1), np.clip(iv, 0, h - 1)
        visible[:, t] = inside & (r.link[t, iv, iu] == link) & (np.abs(r.depth[t, iv, iu] - z) < 0.008)
    return {"uv": uv.astype(np.float32), "visible": visible, "xyz_world": xyz.astype(np.float32), "link": link}


def _image_line(clip: Clip, motion: Motion, K: np.ndarray, centroid: np.ndarray) -> np.ndarray | None:
    model = clip.model
    if model.axis is None or not clip.touches:
        return None
    if model.kind == "prismatic":
        ends = np.stack([centroid, centroid + 0.1 * model.axis])
    else:
        corners = np.concatenate([b.corners() for b in model.boxes if b.link == "moving"])
        along = (corners - model.point) @ model.axis
        ends = model.point + np.array([[along.min()], [along.max()]]) * model.axis
    return _project(K, motion.T_camera_world[0], ends)[0]


def write_mjcf(model: Model, path: Path) -> None:
    """The object alone as boxes: bodies `static` and `moving`, passive joint `joint` (none if nothing is attached)."""
    import mujoco
    from scipy.spatial.transform import Rotation

    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.modelname = path.stem
    static = spec.worldbody.add_body(name="static")
    # The link's frame is the world's at q = 0, as in an asset.
    moving = (spec.worldbody if model.kind is None else static).add_body(name="moving")
    for i, box in enumerate(b for b in model.boxes if b.link != "room"):
        body = moving if box.link == "moving" else static
        if isinstance(box, Solid):
            mesh = spec.add_mesh(name=f"{box.link}_{i}", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
            mesh.uservert, mesh.userface = box.vertices.ravel(), box.faces.astype(np.int32).ravel()
            body.add_geom(name=mesh.name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, density=500)
            continue
        body.add_geom(
            name=f"{box.link}_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=box.centre,
            size=box.size / 2,
            density=500,
            quat=Rotation.from_matrix(box.rotation).as_quat()[[3, 0, 1, 2]],
            friction=[0.8, 0.005, 0.0001],
        )
    if model.kind is None:
        moving.add_freejoint(name="free")
    else:
        hinge = model.kind == "revolute"
        joint = moving.add_joint(name="joint", axis=model.axis, range=list(model.q_range), limited=True)
        joint.type = mujoco.mjtJoint.mjJNT_HINGE if hinge else mujoco.mjtJoint.mjJNT_SLIDE
        if hinge:
            joint.pos = model.point
        joint.damping[0], joint.frictionloss = (0.05, 0.02) if hinge else (2.0, 0.5)
        spec.add_exclude(bodyname1="static", bodyname2="moving")
    spec.compile()
    path.write_text(spec.to_xml())


def write_truth(folder: Path, clip: Clip, motion: Motion, r: Rendered, seed: int) -> None:
    """``truth.json``, ``truth.npz`` and ``object.xml`` into a clip's folder."""
    model = clip.model
    joints = landmarks(clip.pose, clip.side)
    T = motion.T_world_hand
    hand_joints = np.einsum("tij,kj->tki", T[:, :3, :3], joints) + T[:, None, :3, 3]
    corners = np.concatenate([b.corners() for b in model.boxes if b.link == "moving"])
    centroid = (corners.min(0) + corners.max(0)) / 2
    line = _image_line(clip, motion, r.K, centroid)
    jointed = model.kind is not None and clip.touches
    n, h, w = r.link.shape

    def listed(x: np.ndarray | None) -> list | None:
        return None if x is None or not jointed else np.asarray(x).tolist()

    write_mjcf(model, folder / "object.xml")
    facts = {
        "name": clip.name,
        "story": clip.story,
        "seed": seed,
        "video": "video.mp4",
        "size": [w, h],
        "frames": n,
        "type": model.kind if jointed else None,
        "axis": listed(model.axis),
        "point": listed(model.point),
        "q_end": float(motion.q[-1]) if jointed else None,
        "q_range": list(model.q_range),
        "unit": {"revolute": "rad", "prismatic": "m"}[str(model.kind)] if jointed else None,
        "K": r.K.tolist(),
        "T_camera_world": motion.T_camera_world[0].tolist(),
        "side": clip.side,
        "diagonal": model.diagonal,
        "centroid": centroid.tolist(),
        "image_line": listed(line),
        "mjcf": "object.xml",
        "camera": "handheld" if any(clip.drift) else "static",
    }
    s = DEPTH_STRIDE
    depth = r.depth[:, s // 2 :: s, s // 2 :: s].astype(np.float32)
    arrays = {
        "time": motion.time,
        "q": motion.q,
        "contact": motion.contact,
        "T_camera_world": motion.T_camera_world,
        "T_world_moving": motion.T_world_moving,
        "hand_joints": hand_joints,
        "link": r.link,
        "depth": depth.astype(np.float16),
    }
    arrays |= {f"tracks_{k}": v for k, v in _sample_tracks(motion, r, seed).items()}
    np.savez_compressed(folder / "truth.npz", **arrays)
    (folder / "truth.json").write_text(json.dumps(facts, indent=1))


def load_truth(folder: str | Path) -> SynthTruth:
    """Read a rendered clip's truth.

    Raises:
        FileNotFoundError: the folder holds no rendered clip.
    """
    folder = Path(folder)
    facts = json.loads((folder / "truth.json").read_text())
    with np.load(folder / "truth.npz") as z:
        a = {k: z[k] for k in z.files}
    link = a["link"]
    depth = a["depth"].astype(np.float32)

    def array(key: str) -> np.ndarray | None:
        return None if facts[key] is None else np.array(facts[key])

    return SynthTruth(
        name=facts["name"],
        video=folder / facts["video"],
        size=tuple(facts["size"]),
        type=facts["type"],
        axis=array("axis"),
        point=array("point"),
        q=a["q"],
        q_range=tuple(facts["q_range"]),
        time=a["time"],
        K=np.array(facts["K"]),
        T_camera_world=a["T_camera_world"],
        T_world_moving=a["T_world_moving"],
        hand_joints=a["hand_joints"],
        side=facts["side"],
        contact=a["contact"],
        moving=link == LINK_CODE["moving"],
        static=link == LINK_CODE["static"],
        hand=link == LINK_CODE["hand"],
        room=link == LINK_CODE["room"],
        depth=np.where(np.isfinite(depth), depth, np.nan),
        diagonal=facts["diagonal"],
        image_line=array("image_line"),
        centroid=np.array(facts["centroid"]),
        tracks={k[7:]: v for k, v in a.items() if k.startswith("tracks_")},
        mjcf=folder / facts["mjcf"],
    )


def write_cues(folder: str | Path, scene: str | Path) -> Path:
    """Write a clip's truth as the cue files of a scene folder, so that stages can be run on perfect cues.

    Args:
        folder: a rendered clip.
        scene: scene folder; the files go to ``scene/cues``.

    Returns:
        The cue folder. ``static`` masks are all that does not move (room and the object's fixed part).
    """
    truth = load_truth(folder)
    cues = Path(scene) / "cues"
    cues.mkdir(parents=True, exist_ok=True)
    hand_uv = np.stack([truth.project(truth.hand_joints[t], t) for t in range(len(truth.time))])
    w, h = truth.size
    inside = ((hand_uv >= 0) & (hand_uv <= (w - 1, h - 1))).all(-1).mean(1) > 0.5
    np.savez_compressed(cues / "frames.npz", time=truth.time)
    np.savez_compressed(cues / "camera.npz", K=truth.K, T_world_camera=np.linalg.inv(truth.T_camera_world), metric=True)
    np.savez_compressed(cues / "depth.npz", depth=truth.depth, metric=True)
    np.savez_compressed(cues / "masks.npz", static=truth.static | truth.room, moving=truth.moving, hand=truth.hand)
    np.savez_compressed(
        cues / "tracks.npz", uv=truth.tracks["uv"], visible=truth.tracks["visible"], xyz_world=truth.tracks["xyz_world"]
    )
    np.savez_compressed(
        cues / "hand.npz", joints_world=truth.hand_joints, joints_uv=hand_uv, valid=inside, side=truth.side
    )
    return cues

"""A rendered clip's truth as the released pipeline's scene folder, as its scripts would have left it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruct.providers.released import camera_to_glb_pose
from reconstruct.synth import SynthTruth
from reconstruct.synth.render import LINK_CODE

SCALE = 0.37
"""Its lengths are its own: everything is shrunk by this."""
TURN = Rotation.from_euler("xyz", [0.4, -0.9, 2.0]).as_matrix()
PLACE = np.array([0.3, -0.2, 0.6])
LABELS = {"moving": "door", "static": "body", "hand": "hand"}


def theirs() -> np.ndarray:
    """T_source_world (4, 4): our world to the scene's, a similarity."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = SCALE * TURN, PLACE
    return T


def source_cameras(truth: SynthTruth) -> np.ndarray:
    """T_source_camera (T, 4, 4), rigid, in the scene's units."""
    pose = np.linalg.inv(truth.T_camera_world)
    out = np.tile(np.eye(4), (len(pose), 1, 1))
    out[:, :3, :3] = TURN @ pose[:, :3, :3]
    out[:, :3, 3] = SCALE * pose[:, :3, 3] @ TURN.T + PLACE
    return out


def write_released(truth: SynthTruth, folder: Path, parts: tuple[str, ...] = (), first: int = 0) -> Path:
    """Write the parts asked for, all when none is named."""
    import cv2

    every = ("frames", "da3", "masks", "trackcraft", "hawor", "hawor_scaled", "meshes", "joints")
    parts = parts or every
    T, (w, h) = len(truth.time), truth.size
    folder.mkdir(parents=True, exist_ok=True)
    if "frames" in parts:
        (folder / "frames").mkdir()
        cap = cv2.VideoCapture(str(truth.video))
        for t in range(T):
            ok, image = cap.read()
            assert ok
            cv2.imwrite(str(folder / "frames" / f"{t + first:06d}.jpg"), image)
    pose = source_cameras(truth)
    if "da3" in parts:
        (folder / "da3" / "depth").mkdir(parents=True)
        K = np.tile(truth.K, (T, 1, 1)).astype(np.float32)
        quaternion = Rotation.from_matrix(pose[:, :3, :3]).as_quat()
        np.savez(folder / "da3" / "cameras.npz", frame_indices=np.arange(T), cam_quats_xyzw=quaternion,
                 cam_trans=pose[:, :3, 3], intrinsics=K)  # fmt: skip
        np.savez(folder / "da3" / "intrinsics.npz", frame_indices=np.arange(T), intrinsics=K)
        for t in range(T):
            z = cv2.resize(truth.depth[t], (w, h), interpolation=cv2.INTER_NEAREST) * SCALE
            np.save(folder / "da3" / "depth" / f"{t:06d}.npy", np.nan_to_num(z).astype(np.float32))
        config = {"source": "da3", "da3_model": "depth-anything/DA3-BASE"}
        (folder / "da3" / "config.json").write_text(json.dumps(config))
    if "masks" in parts:
        tracking = {}
        for part, label in LABELS.items():
            (folder / "masks" / label).mkdir(parents=True)
            mask = getattr(truth, part)
            for t in range(T):
                cv2.imwrite(str(folder / "masks" / label / f"{t + first:06d}.png"), mask[t].astype(np.uint8) * 255)
            motion = "moving" if part != "static" else "static"
            tracking[label] = {"motion": motion, "keyframe": first, "keyframe_candidates": [first, first + T // 2]}
        (folder / "masks" / "tracking.json").write_text(json.dumps(tracking))
    S = theirs()
    if "trackcraft" in parts:
        xyz = truth.tracks["xyz_world"] @ S[:3, :3].T + S[:3, 3]
        window = list(range(0, T, 2))
        for part in ("moving", "static"):
            own = (truth.tracks["link"] == LINK_CODE[part]) & truth.tracks["visible"][:, window[0]]
            target = folder / "trackcraft" / LABELS[part]
            (target / "scene_flow").mkdir(parents=True)
            np.save(target / "pts3d_ref.npy", xyz[own, window[0]].astype(np.float32))
            np.save(target / "pixel_ij.npy", np.zeros((int(own.sum()), 2), np.int16))
            for t in window[1:]:
                np.save(target / "scene_flow" / f"{t:06d}.npy", (xyz[own, t] - xyz[own, window[0]]).astype(np.float32))
        (folder / "trackcraft" / "config.json").write_text(json.dumps({"ref_frame": 0, "tracked_frames": window}))
    for name in ("hawor", "hawor_scaled"):
        if name in parts:
            _hands(truth, folder / name / "per_frame", first, scaled=name == "hawor_scaled")
    if "meshes" in parts:
        _meshes(truth, folder, pose, first)
    if "joints" in parts:
        (folder / "pointtrack_joint").mkdir()
        axis = TURN @ truth.axis
        point = None if truth.point is None else (S[:3, :3] @ truth.point + S[:3, 3]).tolist()
        joint = {"type": truth.type, "axis_direction": axis.tolist(), "axis_point": point, "reference_frame": 0}
        (folder / "pointtrack_joint" / "joints.json").write_text(json.dumps({"joints": {LABELS["moving"]: joint}}))
    return folder


def _hands(truth: SynthTruth, folder: Path, first: int, scaled: bool) -> None:
    """Camera frame; unscaled ones are twice too far and too large, with their own focal length."""
    folder.mkdir(parents=True)
    w, h = truth.size
    for t in range(len(truth.time)):
        T = truth.T_camera_world[t]
        x = truth.hand_joints[t] @ T[:3, :3].T + T[:3, 3]
        x = x * SCALE if scaled else 2 * x
        focal = truth.K[0, 0]
        np.savez(folder / f"{t + first:06d}.npz", verts=np.repeat(x[None, :1], 778, axis=1).astype(np.float32),
                 joints=x[None].astype(np.float32), is_right=np.array([truth.side == "right"]), valid=np.array([True]),
                 cam_t=x[None, 0].astype(np.float32), bbox=np.zeros((1, 4), np.float32),
                 focal_length=np.float32(focal), img_size_wh=np.array([w, h], np.int32),
                 frame_idx=np.int32(t + first))  # fmt: skip


def link_meshes(truth: SynthTruth) -> dict[str, object]:
    """Boxes of both links at q = 0, our world."""
    import mujoco
    import trimesh

    model = mujoco.MjModel.from_xml_path(str(truth.mjcf))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    out = {}
    for link in ("static", "moving"):
        boxes = []
        for g in range(model.ngeom):
            if model.geom(g).name.startswith(link):
                T = np.eye(4)
                T[:3, :3], T[:3, 3] = data.geom_xmat[g].reshape(3, 3), data.geom_xpos[g]
                boxes.append(trimesh.creation.box(2 * model.geom_size[g], transform=T))
        out[link] = trimesh.util.concatenate(boxes)
    return out


def _meshes(truth: SynthTruth, folder: Path, pose: np.ndarray, first: int) -> None:
    """sam3d_scaled/ and registered_static/ of two key frames, in the mesh frame of the first."""
    import trimesh

    T = len(truth.time)
    keys, links = (0, T // 2), link_meshes(truth)
    S = theirs()
    # Any mesh frame will do: a similarity to the camera that nobody would guess.
    G = np.eye(4)
    G[:3, :3], G[:3, 3] = 0.8 * Rotation.from_euler("xyz", [1.0, 0.3, -0.5]).as_matrix(), [0.1, 0.05, 1.2]
    scene = trimesh.Scene()
    records = []
    for n, key in enumerate(keys):
        out = folder / "sam3d_scaled" / "combined" / f"cand_{n:02d}_{key + first:06d}"
        out.mkdir(parents=True)
        to_glb = np.linalg.inv(G) @ np.linalg.inv(pose[key]) @ S
        moved = links["moving"].copy()
        moved.apply_transform(truth.T_world_moving[key])
        whole = trimesh.util.concatenate([links["static"].copy(), moved])
        whole.apply_transform(to_glb)
        whole.export(out / "mesh.glb")
        (out / "pose.json").write_text(json.dumps(camera_to_glb_pose(G)))
        (out / "keyframe.txt").write_text(f"{key + first:06d}\n")
        to_reference = np.linalg.inv(G) @ np.linalg.inv(pose[keys[0]]) @ S
        piece = moved.copy()
        piece.apply_transform(to_reference)
        name = f"moving_{LABELS['moving']}_{key + first:06d}"
        scene.add_geometry(piece, geom_name=name, node_name=name)
        records.append({"frame": key + first, "moving_meshes": [{"label": LABELS["moving"], "geometry": name}]})
    fixed = links["static"].copy()
    fixed.apply_transform(to_reference)
    name = f"static_reference_{keys[0] + first:06d}"
    scene.add_geometry(fixed, geom_name=name, node_name=name)
    (folder / "registered_static").mkdir()
    scene.export(folder / "registered_static" / "registered_meshes.glb")
    facts = {"reference_frame": keys[0] + first, "static_geometry": name, "frames": records}
    (folder / "registered_static" / "metadata.json").write_text(json.dumps(facts))

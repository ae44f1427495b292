"""The scene folder of the paper's released pipeline (track-articulate-act): reading it, writing what its scripts read.

What it holds and in which frames, as its scripts and documentation state it:

- ``da3/``: ``cameras.npz`` (camera-to-world, quaternions xyzw), ``intrinsics.npz``, ``depth/<n>.npy`` (along the
  optical axis), all counted by position in the sorted ``frames/``; cameras look right, down, forward.
- ``masks/<label>/<stem>.png``, ``masks/tracking.json`` (per label ``motion``, ``keyframe_candidates``),
  ``hawor*/per_frame/``, ``sam3d*/``, ``segvigen/``: counted by the frames' file names.
- ``trackcraft/<label>/``: ``pts3d_ref.npy`` and ``scene_flow/<n>.npy`` in the world of ``da3``, counted by position.
- ``sam3d*/<label>/cand_<i>_<stem>/``: ``mesh.glb`` and ``pose.json``; the mesh's frame goes to the camera by
  :func:`glb_to_camera`. ``registered_static/`` is in the mesh frame of its reference key frame.

Lengths share one scale, which need not be metres.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruct.errors import TaaError
from reconstruct.video import Video

MODEL_FROM_GLB = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
PYTORCH3D_TO_RDF = np.diag([-1.0, -1.0, 1.0])
HAND_WORDS = ("hand", "arm", "person", "finger", "human")


@dataclass(frozen=True)
class HandFrames:
    """A hand through the video; T counts all frames.

    Attributes:
        side: "left" or "right".  joints: (T, 21, 3) camera frame, NaN where there is none.
        vertices: (T, 778, 3) alike, or None.  detected: (T,) bool, False where filled in.
        focal: (T,) px, which the network placed the hand with; NaN where unknown.
    """

    side: str
    joints: np.ndarray
    vertices: np.ndarray | None
    detected: np.ndarray
    focal: np.ndarray


class ReleasedScene:
    """A scene folder, read piece by piece; every piece may be missing.

    Args:
        folder: the scene.

    Raises:
        TaaError: it is no folder, or holds nothing of such a scene.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise TaaError(f"no such folder: {folder}; give the scene folder of the released pipeline")
        self.stems = self._stems()
        if not self.stems:
            raise TaaError(f"{folder} holds no frames/, da3/ or masks/; give the scene folder of the released pipeline")
        self._place = {stem: n for n, stem in enumerate(self.stems)}
        self.tracking = self._json("masks/tracking.json")

    def __len__(self) -> int:
        return len(self.stems)

    def _stems(self) -> list[int]:
        names = [p.stem for p in (self.folder / "frames").glob("*.jpg")]
        if not names and (file := self.folder / "da3" / "cameras.npz").is_file():
            names = [str(n) for n in self._npz(file, "frame_indices")["frame_indices"]]
        if not names:
            names = [p.stem for p in (self.folder / "masks").glob("*/*.png")]
        if not names:
            names = [p.stem for p in (self.folder / "da3" / "depth").glob("*.npy")]
        return sorted({int(n) for n in names if n.isdigit()})

    def _npz(self, file: Path, *needed: str) -> dict[str, np.ndarray]:
        try:
            with np.load(file, allow_pickle=False) as data:
                arrays = {key: data[key] for key in data.files}
        except (OSError, ValueError, EOFError) as error:
            raise TaaError(f"cannot read {file} ({str(error)[:80]}); make it again or remove it") from None
        for key in needed:
            if key not in arrays:
                raise TaaError(f"{file} has no array {key!r}; make it again or remove it")
        return arrays

    def _npy(self, file: Path) -> np.ndarray:
        try:
            return np.load(file, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise TaaError(f"cannot read {file} ({str(error)[:80]}); make it again or remove it") from None

    def _json(self, name: str) -> dict[str, Any]:
        file = self.folder / name
        if not file.is_file():
            return {}
        try:
            data = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise TaaError(f"cannot read {file} ({str(error)[:80]}); make it again or remove it") from None
        if not isinstance(data, dict):
            raise TaaError(f"{file} must hold a JSON object; make it again or remove it")
        return data

    def size(self) -> tuple[int, int]:
        """(width, height) of the frames, px."""
        import cv2

        for pattern in ("frames/*.jpg", "masks/*/*.png"):
            for file in sorted(self.folder.glob(pattern))[:1]:
                image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
                if image is not None:
                    return int(image.shape[1]), int(image.shape[0])
        for file in sorted((self.folder / "da3" / "depth").glob("*.npy"))[:1]:
            shape = self._npy(file).shape
            return int(shape[1]), int(shape[0])
        config = self._json("da3/config.json").get("full_resolution_wh")
        if isinstance(config, list) and len(config) == 2:
            return int(config[0]), int(config[1])
        raise TaaError(f"the picture's size is unknown; {self.folder} has no frame, mask or depth map")

    def da3_model(self) -> str:
        """Which Depth Anything 3 made ``da3/``, or ""."""
        return str(self._json("da3/config.json").get("da3_model", ""))

    def cameras(self) -> tuple[np.ndarray, np.ndarray] | None:
        """K (T, 3, 3) full px and T_world_camera (T, 4, 4); None where ``da3/`` has none.

        Frames that it skips take the nearest one's.
        """
        file = self.folder / "da3" / "cameras.npz"
        if not file.is_file():
            return None
        data = self._npz(file, "frame_indices", "cam_quats_xyzw", "cam_trans")
        n = len(data["frame_indices"])
        quaternion, shift = np.asarray(data["cam_quats_xyzw"], float), np.asarray(data["cam_trans"], float)
        if quaternion.shape != (n, 4) or shift.shape != (n, 3) or not n:
            raise TaaError(f"{file}: cam_quats_xyzw {quaternion.shape} and cam_trans {shift.shape} do not fit {n} "
                           "frames; make it again")  # fmt: skip
        T = np.tile(np.eye(4), (n, 1, 1))
        T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(quaternion).as_matrix(), shift
        intrinsics = data.get("intrinsics")
        if intrinsics is None:
            intrinsics = self._npz(self.folder / "da3" / "intrinsics.npz", "intrinsics")["intrinsics"]
        K = np.asarray(intrinsics, float)
        if K.shape != (n, 3, 3):
            raise TaaError(f"{file}: intrinsics have shape {K.shape}, expected ({n}, 3, 3)")
        row = self._nearest(np.asarray(data["frame_indices"], int))
        return K[row], T[row]

    def _nearest(self, positions: np.ndarray) -> np.ndarray:
        """(T,) row of the nearest known position."""
        return np.array([int(np.argmin(np.abs(positions - t))) for t in range(len(self))])

    def depth(self, long_side: int = 480) -> np.ndarray | None:
        """(T, h, w) float32, NaN where unknown, shrunk by picking the pixel nearest to each cell's centre; or None."""
        files = {int(p.stem): p for p in (self.folder / "da3" / "depth").glob("*.npy") if p.stem.isdigit()}
        files = {n: p for n, p in files.items() if n < len(self)}
        if not files:
            return None
        out = None
        for n, file in files.items():
            z = self._npy(file).astype(np.float32)
            if z.ndim != 2:
                raise TaaError(f"{file} has shape {z.shape}, expected (height, width); make it again")
            if out is None:
                s = min(1.0, long_side / max(z.shape))
                shape = (max(1, round(z.shape[0] * s)), max(1, round(z.shape[1] * s)))
                out = np.full((len(self), *shape), np.nan, np.float32)
            rows = np.floor((np.arange(out.shape[1]) + 0.5) * z.shape[0] / out.shape[1]).astype(int)
            columns = np.floor((np.arange(out.shape[2]) + 0.5) * z.shape[1] / out.shape[2]).astype(int)
            z = z[np.ix_(rows, columns)]
            out[n] = np.where(np.isfinite(z) & (z > 0), z, np.nan)
        return out

    def labels(self) -> dict[str, str]:
        """Label -> "moving", "static" or "hand"."""
        found = {}
        folders = [p.name for p in (self.folder / "masks").glob("*") if p.is_dir()]
        tracked = [p.name for p in (self.folder / "trackcraft").glob("*") if p.is_dir()]
        for label in sorted({*self.tracking, *folders, *tracked}):
            entry = self.tracking.get(label)
            motion = entry.get("motion", "static") if isinstance(entry, dict) else "static"
            words = re.split(r"[^a-z]+", label.lower())
            found[label] = "hand" if any(w.rstrip("s") in HAND_WORDS for w in words) else str(motion)
        return found

    def masks(self, label: str, shape: tuple[int, int]) -> np.ndarray | None:
        """(T, h, w) bool of one label, False where it has no file; None where it has none at all."""
        import cv2

        files = [p for p in (self.folder / "masks" / label).glob("*.png") if p.stem.isdigit()]
        if not files:
            return None
        out = np.zeros((len(self), *shape), bool)
        for file in files:
            n = self._place.get(int(file.stem))
            image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            if image is None:
                raise TaaError(f"cannot read the mask {file}; make it again or remove it")
            if n is not None:
                image = image[..., -1] if image.ndim == 3 else image
                out[n] = cv2.resize((image > 0).astype(np.uint8), shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
        return out

    def tracks(self, label: str, most: int = 600) -> np.ndarray | None:
        """(N, T, 3) places of one label's points in the world of ``da3``, NaN outside the tracked window; or None."""
        folder = self.folder / "trackcraft" / label
        if not (folder / "pts3d_ref.npy").is_file():
            return None
        reference = self._json("trackcraft/config.json").get("ref_frame", 0)
        start = np.asarray(self._npy(folder / "pts3d_ref.npy"), float)
        if start.ndim != 2 or start.shape[1] != 3:
            raise TaaError(f"{folder / 'pts3d_ref.npy'} has shape {start.shape}, expected (points, 3); make it again")
        # Every k-th pixel of a dense field: neighbours say the same.
        pick = np.unique(np.linspace(0, len(start) - 1, min(most, len(start))).round().astype(int))
        out = np.full((len(pick), len(self), 3), np.nan)
        if isinstance(reference, int) and 0 <= reference < len(self):
            out[:, reference] = start[pick]
        for file in (folder / "scene_flow").glob("*.npy"):
            if not file.stem.isdigit() or int(file.stem) >= len(self):
                continue
            flow = np.asarray(self._npy(file), float)
            if flow.shape != start.shape:
                raise TaaError(f"{file} has shape {flow.shape}, expected {start.shape}; make it again")
            out[:, int(file.stem)] = start[pick] + flow[pick]
        good = np.isfinite(out).all(-1).sum(1) >= 2
        return out[good] if good.any() else None

    def hand(self, name: str | None = None) -> tuple[HandFrames, str] | None:
        """The hand seen in most frames, and its folder: ``hawor_scaled`` before ``hawor`` before ``wilor``."""
        for folder in (name,) if name else ("hawor_scaled", "hawor", "wilor"):
            files = sorted((self.folder / folder / "per_frame").glob("*.npz"))
            if files:
                return self._hand(files), folder
        return None

    def _hand(self, files: list[Path]) -> HandFrames:
        T = len(self)
        joints = {side: np.full((T, 21, 3), np.nan) for side in (False, True)}
        vertices = {side: np.full((T, 778, 3), np.nan) for side in (False, True)}
        detected = {side: np.zeros(T, bool) for side in (False, True)}
        focal = np.full(T, np.nan)
        for file in files:
            n = self._place.get(int(file.stem)) if file.stem.isdigit() else None
            if n is None:
                continue
            data = self._npz(file, "joints", "is_right")
            xyz, right = np.asarray(data["joints"], float), np.asarray(data["is_right"], bool).ravel()
            if xyz.shape != (len(right), 21, 3):
                raise TaaError(f"{file}: joints have shape {xyz.shape}, expected ({len(right)}, 21, 3); make it again")
            valid = np.asarray(data.get("valid", np.ones(len(right))), bool).ravel()
            sure = np.asarray(data.get("yolo_conf", np.ones(len(right))), float).ravel()
            if "focal_length" in data:
                focal[n] = float(data["focal_length"])
            for k in np.argsort(sure):  # the surest of one side stays
                joints[right[k]][n], detected[right[k]][n] = xyz[k], valid[k]
                if "verts" in data and np.shape(data["verts"])[1:] == (778, 3):
                    vertices[right[k]][n] = data["verts"][k]
        side = bool(detected[True].sum() >= detected[False].sum())
        mesh = vertices[side] if np.isfinite(vertices[side]).any() else None
        return HandFrames("right" if side else "left", joints[side], mesh, detected[side], focal)

    def key_meshes(self, root: str = "sam3d_scaled", label: str = "combined") -> dict[int, tuple[Path, np.ndarray]]:
        """Frame -> mesh file and T_camera_glb (4, 4) of each candidate; ``sam3d`` where nothing was scaled."""
        found: dict[int, tuple[Path, np.ndarray]] = {}
        for name in dict.fromkeys((root, "sam3d")):
            top = self.folder / name / label
            for pose in sorted([*top.glob("cand_*_*/pose.json"), *top.glob("pose.json")]):
                mesh, key = pose.parent / "mesh.glb", pose.parent / "keyframe.txt"
                match = re.fullmatch(r"cand_\d+_(\d+)", pose.parent.name)
                stem = key.read_text().strip() if key.is_file() else match.group(1) if match else ""
                if mesh.is_file() and stem.isdigit() and int(stem) in self._place:
                    found.setdefault(self._place[int(stem)], (mesh, glb_to_camera(self._json_file(pose), pose)))
            if found:
                return found
        return found

    def pieces(self, frame: int) -> dict[str, Path]:
        """Label -> mesh of SegviGen's pieces at one frame, in the frame of that frame's own mesh."""
        folder = self.folder / "segvigen" / "combined" / f"{self.stems[frame]:06d}" / "pieces"
        return {p.stem: p for p in sorted(folder.glob("*.glb"))}

    def registered(self) -> tuple[int, Any, dict[tuple[str, int], Any]] | None:
        """``registered_static/``: reference frame, static mesh, (label, frame) -> moving mesh; meshes of trimesh.

        All in the reference frame's mesh coordinates; see :meth:`key_meshes` for the way to its camera.
        """
        import trimesh

        facts = self._json("registered_static/metadata.json")
        file = self.folder / "registered_static" / "registered_meshes.glb"
        if not facts or not file.is_file():
            return None
        try:
            scene: Any = trimesh.load(file, force="scene", process=False)
        except Exception as error:  # trimesh raises whatever its readers raise
            raise TaaError(f"cannot read the mesh {file} ({str(error)[:80]}); make it again") from error

        def mesh(name: str) -> Any:
            parts = []
            for node in scene.graph.nodes_geometry:
                transform, geometry = scene.graph[node]
                if geometry == name:
                    part = scene.geometry[geometry].copy()
                    part.apply_transform(transform)
                    parts.append(part)
            if not parts:
                raise TaaError(f"{file} has no geometry {name!r}, which its metadata names; make it again")
            return trimesh.util.concatenate(parts)

        reference = self._place.get(int(facts.get("reference_frame", -1)))
        if reference is None or not facts.get("static_geometry"):
            raise TaaError(f"{file.parent}/metadata.json names no static geometry or no frame that is there; "
                           "make it again")  # fmt: skip
        moving = {}
        for record in facts.get("frames", []):
            for part in record.get("moving_meshes") or []:
                if record["frame"] in self._place:
                    moving[str(part["label"]), self._place[record["frame"]]] = mesh(part["geometry"])
        return reference, mesh(facts["static_geometry"]), moving

    def joints(self) -> dict[str, dict]:
        """``"<folder>/<label>"`` -> the pipeline's own joints, in its own frames: to compare with, never as a cue."""
        found = {}
        for folder in ("pointtrack_joint", "simple_joint", "joints"):
            for label, joint in (self._json(f"{folder}/joints.json").get("joints") or {}).items():
                if isinstance(joint, dict):
                    keys = ("type", "axis_direction", "axis_point", "reference_frame", "state_unit")
                    found[f"{folder}/{label}"] = {key: joint.get(key) for key in keys}
        return found

    def _json_file(self, file: Path) -> dict:
        return self._json(str(file.relative_to(self.folder)))


def glb_to_camera(pose: Mapping[str, Any], where: object = "pose.json") -> np.ndarray:
    """T_camera_glb (4, 4) of SAM 3D Objects' pose: mesh (y up), model (z up), PyTorch3D camera, right-down-forward.

    Args:
        pose: ``rotation_quat_wxyz`` (PyTorch3D's, for row vectors), ``translation``, ``scale`` (one or three).

    Raises:
        TaaError: something is missing or not finite.
    """
    try:
        w, x, y, z = np.asarray(pose["rotation_quat_wxyz"], float).reshape(4)
        shift = np.asarray(pose["translation"], float).reshape(3)
        scale = np.asarray(pose["scale"], float).reshape(-1)
        rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
    except (KeyError, TypeError, ValueError) as error:
        raise TaaError(f"{where} holds no rotation, translation and scale ({error}); make it again") from None
    if scale.size not in (1, 3) or not np.isfinite([*shift, *scale]).all() or (scale <= 0).any():
        raise TaaError(f"{where} holds no possible translation or scale; make it again")
    T = np.eye(4)
    T[:3, :3] = PYTORCH3D_TO_RDF @ rotation.T @ np.diag(np.broadcast_to(scale, 3)) @ MODEL_FROM_GLB
    T[:3, 3] = PYTORCH3D_TO_RDF @ shift
    return T


def camera_to_glb_pose(T_camera_glb: np.ndarray) -> dict[str, list[float]]:
    """The inverse of :func:`glb_to_camera` for a similarity with one scale: what ``pose.json`` holds."""
    linear = PYTORCH3D_TO_RDF @ np.asarray(T_camera_glb, float)[:3, :3] @ MODEL_FROM_GLB.T
    scale = float(np.cbrt(np.linalg.det(linear)))
    x, y, z, w = Rotation.from_matrix((linear / scale).T).as_quat()
    shift = PYTORCH3D_TO_RDF @ np.asarray(T_camera_glb, float)[:3, 3]
    return {"rotation_quat_wxyz": [w, x, y, z], "translation": shift.tolist(), "scale": [scale]}


class ReleasedWriter:
    """Writes what the released pipeline's scripts read, frames named ``NNNNNN`` from 0 without a gap.

    Args:
        folder: the scene; what is there of an earlier run is removed.
    """

    def __init__(self, folder: Path) -> None:
        import shutil

        self.folder = Path(folder)
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)

    def frames(self, video: Video) -> None:
        """``frames/<n>.jpg`` of the working frames; all else refers to their pixels."""
        import cv2

        (self.folder / "frames").mkdir()
        for t, frame in enumerate(video.frames):
            cv2.imwrite(str(self.folder / "frames" / f"{t:06d}.jpg"), np.asarray(frame), [cv2.IMWRITE_JPEG_QUALITY, 95])

    def da3(self, video: Video, K: np.ndarray, T_world_camera: np.ndarray, depth: np.ndarray | None = None) -> None:
        """``da3/`` from our cues, at working size.

        Args:
            K: (3, 3) or (T, 3, 3) full px.  T_world_camera: (T, 4, 4).
            depth: (T, h, w) of any size, NaN where unknown.
        """
        import cv2

        T, (h, w) = len(video), video.frames.shape[1:3]
        small = np.array(np.broadcast_to(np.asarray(K, float), (T, 3, 3)))
        for axis, s in ((0, w / video.size[0]), (1, h / video.size[1])):
            small[:, axis, axis] *= s
            small[:, axis, 2] = (small[:, axis, 2] + 0.5) * s - 0.5
        folder = self.folder / "da3"
        (folder / "depth").mkdir(parents=True)
        index = np.arange(T, dtype=np.int32)
        quaternion = Rotation.from_matrix(np.asarray(T_world_camera, float)[:, :3, :3]).as_quat()
        np.savez(folder / "intrinsics.npz", frame_indices=index, intrinsics=small.astype(np.float32))
        np.savez(folder / "cameras.npz", frame_indices=index, cam_quats_xyzw=quaternion.astype(np.float32),
                 cam_trans=np.asarray(T_world_camera, float)[:, :3, 3].astype(np.float32),
                 intrinsics=small.astype(np.float32))  # fmt: skip
        for t in range(T if depth is not None else 0):
            z = cv2.resize(np.asarray(depth[t], np.float32), (w, h), interpolation=cv2.INTER_NEAREST)
            np.save(folder / "depth" / f"{t:06d}.npy", np.nan_to_num(z, nan=0.0))
        facts = {"source": "taa", "ref_frame": 0, "start_idx": 0, "end_idx": T, "full_resolution_wh": [w, h]}
        (folder / "config.json").write_text(json.dumps(facts), encoding="utf-8")

    def masks(self, masks: Mapping[str, np.ndarray], motion: Mapping[str, str], keys: list[int]) -> None:
        """``masks/``: label -> (T, h, w) bool; label -> "moving" or "static"; frames to reconstruct."""
        import cv2

        tracking = {}
        for label, mask in masks.items():
            (self.folder / "masks" / label).mkdir(parents=True)
            for t, m in enumerate(mask):
                cv2.imwrite(str(self.folder / "masks" / label / f"{t:06d}.png"), m.astype(np.uint8) * 255)
            tracking[label] = {"motion": motion[label], "keyframe": keys[0], "keyframe_candidates": keys}
        (self.folder / "masks" / "tracking.json").write_text(json.dumps(tracking), encoding="utf-8")

"""Stand-ins for models in environments of their own: scripts that read and write the files that the real ones document.

Each script is run by the interpreter that the settings name, checks its input as the real one would, and answers from
``truth.npz`` in its repository. ``mood`` in that folder makes it misbehave.
"""

from __future__ import annotations

import importlib.machinery
import stat
import sys
import types
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

COMMON = '''
import argparse, sys, time
from pathlib import Path
import numpy as np

def mood(repository):
    """What the test asks for: fine, fail, sleep, nothing, shapes, broken."""
    file = Path(repository) / "mood"
    word = file.read_text() if file.is_file() else "fine"
    print("loading weights ...")
    if word == "fail":
        print("RuntimeError: CUDA error: no kernel image is available", file=sys.stderr)
        sys.exit(3)
    if word == "sleep":
        time.sleep(60)
    return word
'''

TRACKCRAFT = COMMON + '''
p = argparse.ArgumentParser()
for name in ("--checkpoint_path", "--input_npz", "--output_npz"):
    p.add_argument(name, required=True)
p.add_argument("--num_frames", type=int, default=12)
p.add_argument("--frame_stride", type=int, default=5)
a = p.parse_args()
repository = Path(__file__).resolve().parents[1]
word = mood(repository)
assert Path(a.checkpoint_path).is_file()
data = np.load(a.input_npz, allow_pickle=True)
T = data["images_jpeg_bytes"].shape[0]
span = a.num_frames * a.frame_stride
if span > T:
    sys.exit(f"need {span} frames but the NPZ only has {T}.")
assert all(bytes(j[:2]) == b"\\xff\\xd8" for j in data["images_jpeg_bytes"])
z, w2c, (fx, fy, cx, cy) = data["depth_map"], data["extrinsics_w2c"], data["fx_fy_cx_cy"]
assert z.shape[0] == T and w2c.shape == (T, 4, 4) and np.allclose(w2c[0], np.eye(4), atol=1e-5)
# Every pixel of the first frame: back-projected, then carried by its link as the simulator moves it.
truth = np.load(repository / "truth.npz")
h, w = 60, 104  # the network's own grid, stretched
rows = ((np.arange(h) + 0.5) * z.shape[1] / h).astype(int)
columns = ((np.arange(w) + 0.5) * z.shape[2] / w).astype(int)
zz = z[0][np.ix_(rows, columns)]
x = np.stack([(columns[None] - cx) / fx * zz, (rows[:, None] - cy) / fy * zz, zz], -1)
reverse = "-1" in Path(a.input_npz).stem
frames = np.minimum(np.arange(a.num_frames) * a.frame_stride, len(truth["T_camera_world"]) - 1)[:: -1 if reverse else 1]
first = frames[0]
link = truth["moving"][first]
link = link[((np.arange(h) + 0.5) * link.shape[0] / h).astype(int)]
link = link[:, ((np.arange(w) + 0.5) * link.shape[1] / w).astype(int)]
camera, body = truth["T_camera_world"], truth["T_world_moving"]
to_world = np.linalg.inv(camera[first])
unit = float(truth["unit"]) if "unit" in truth else 1.0  # of the depth it was given, in the simulator's metres
x = x / unit
world = x @ to_world[:3, :3].T + to_world[:3, 3]
out = []
for t in frames:
    M = camera[first] @ body[t] @ np.linalg.inv(body[first]) @ to_world
    out.append(np.where(link[..., None], x @ M[:3, :3].T + M[:3, 3], x))
out = (unit * np.stack(out)).astype(np.float32)
if word == "shapes":
    out = out[:-1]
if word == "broken":
    Path(a.output_npz).write_bytes(b"PK nonsense")
elif word != "nothing":
    np.savez_compressed(a.output_npz, track_map=out, recon_map=out, rgb=np.zeros(out.shape, np.uint8))
'''

HANDS = COMMON + '''
p = argparse.ArgumentParser()
p.add_argument("--scene-dir", type=Path, required=True)
p.add_argument("--hawor-repo", "--wilor-repo", dest="repo", type=Path, required=True)
p.add_argument("--no-overlay", action="store_true")
p.add_argument("--overwrite", action="store_true")
a = p.parse_args()
word = mood(a.repo)
name = NAME
geometry = a.scene_dir / ("da3/intrinsics.npz" if name == "hawor" else "any4d/moge/intrinsics.npz")
frames = sorted((a.scene_dir / "frames").glob("*.jpg"))
K = np.load(geometry)
cameras = np.load(geometry.parents[0 if name == "hawor" else 1] / "cameras.npz")
assert len(frames) == len(K["frame_indices"]) == len(cameras["cam_trans"])
truth = np.load(a.repo / "truth.npz")
out = a.scene_dir / name / "per_frame"
out.mkdir(parents=True)
for n, file in enumerate(frames):
    if word == "nothing":
        break
    T = truth["T_camera_world"][n]
    x = truth["hand_joints"][n] @ T[:3, :3].T + T[:3, 3]
    x = 2.5 * x  # a monocular guess: too far and too large by the same factor
    joints = x[None, :20] if word == "shapes" else x[None]
    np.savez(out / f"{int(file.stem):06d}.npz", verts=np.repeat(x[None, :1], 778, axis=1), joints=joints,
             is_right=np.array([str(truth["side"]) == "right"]), valid=np.array([n % 5 != 4]),
             focal_length=np.float32(K["intrinsics"][n][0, 0]), frame_idx=np.int32(n))
'''


def environment(folder: Path, name: str, script: str, text: str, truth: dict[str, np.ndarray]) -> dict:
    """A repository with one script, an interpreter and a checkpoint; its section of the settings."""
    repository = folder / name
    file = repository / script
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    np.savez(repository / "truth.npz", **truth)
    python = folder / f"python-{name}"
    python.write_text(f'#!/bin/sh\nexec "{sys.executable}" -s "$@"\n')
    python.chmod(python.stat().st_mode | stat.S_IXUSR)
    (repository / "weights.safetensors").write_text("weights")
    return {"python": str(python), "repository": str(repository), "checkpoint": str(repository / "weights.safetensors"),
            "pipeline": str(repository)}  # fmt: skip


SAM3D = COMMON + '''
import json
import trimesh
p = argparse.ArgumentParser()
p.add_argument("--scene-dir", type=Path, required=True)
p.add_argument("--sam3d-repo", type=Path, required=True)
p.add_argument("--combined", action="store_true")
p.add_argument("--overwrite", action="store_true")
p.add_argument("--pointmap-source", choices=["moge", "da3"], default="moge")
p.add_argument("--checkpoint-tag", default="hf")
a = p.parse_args()
word = mood(a.sam3d_repo)
tracking = json.loads((a.scene_dir / "masks" / "tracking.json").read_text())
assert a.combined and {e["motion"] for e in tracking.values()} == {"static", "moving"}
keys = sorted({k for e in tracking.values() for k in e["keyframe_candidates"]})
truth = np.load(a.sam3d_repo / "truth.npz")
out = a.scene_dir / "sam3d" / "combined"
if word == "nothing":
    sys.exit(0)
for n, k in enumerate(keys):
    for label in tracking:
        assert (a.scene_dir / "masks" / label / f"{k:06d}.png").is_file()
    assert (a.scene_dir / "frames" / f"{k:06d}.jpg").is_file()
    M = truth["T_world_moving"][k]
    v = np.concatenate([truth["static_v"], truth["moving_v"] @ M[:3, :3].T + M[:3, 3]])
    f = np.concatenate([truth["static_f"], truth["moving_f"] + len(truth["static_v"])])
    C = truth["T_camera_world"][k]
    v = (v @ C[:3, :3].T + C[:3, 3]) * (0.5 + 0.3 * n)  # right outline, its own distance in every frame
    pose = json.loads((a.sam3d_repo / "pose.json").read_text())
    G = np.asarray(json.loads((a.sam3d_repo / "matrix.json").read_text()))
    there = (v - G[:3, 3]) @ np.linalg.inv(G[:3, :3]).T
    folder = out / f"cand_{n:02d}_{k:06d}"
    folder.mkdir(parents=True)
    trimesh.Trimesh(there, f, process=False).export(folder / "mesh.glb")
    (folder / "pose.json").write_text(json.dumps({} if word == "shapes" else pose))
    (folder / "keyframe.txt").write_text(f"{k:06d}\\n")
    (folder / "mask_labels.txt").write_text("\\n".join(tracking))
'''

SEGVIGEN = COMMON + '''
import trimesh
p = argparse.ArgumentParser()
p.add_argument("--scene-dir", type=Path, required=True)
p.add_argument("--segvigen-root", type=Path, required=True)
p.add_argument("--ckpt-path", type=Path, required=True)
p.add_argument("--overwrite", action="store_true")
a = p.parse_args()
word = mood(a.segvigen_root)
assert a.ckpt_path.is_file() and (a.segvigen_root / "inference_full.py").is_file()
count = len(np.load(a.segvigen_root / "truth.npz")["static_f"])
for folder in sorted((a.scene_dir / "sam3d_scaled" / "combined").glob("cand_*")):
    mesh = trimesh.load(folder / "mesh.glb", force="mesh", process=False)
    out = a.scene_dir / "segvigen" / "combined" / folder.joinpath("keyframe.txt").read_text().strip() / "pieces"
    out.mkdir(parents=True)
    for label, faces in (("static", mesh.faces[:count]), ("moving", mesh.faces[count:])):
        if word == "nothing" and label == "moving":
            continue
        trimesh.Trimesh(mesh.vertices, faces, process=False).export(out / f"{label}.glb")
'''


class Frames:
    """Which frame a picture is, by its pixels."""

    def __init__(self, video) -> None:
        self.known = {np.ascontiguousarray(f[..., ::-1]).tobytes(): t for t, f in enumerate(video.frames)}

    def __getitem__(self, image) -> int:
        return self.known[np.ascontiguousarray(image).tobytes()]


@dataclass
class Prediction:
    """What ``DepthAnything3.inference`` returns."""

    depth: np.ndarray
    conf: np.ndarray
    extrinsics: np.ndarray
    intrinsics: np.ndarray


def install_depth_anything(monkeypatch, truth, video, scale: float) -> list[list[int]]:
    """``depth_anything_3.api`` with the documented calls, answering from the simulator's truth for this video's frames.

    Its scale and world are its own in every run; the list that is returned gets the frames of each run.
    """
    frames = Frames(video)
    runs: list[list[int]] = []

    class DepthAnything3:
        def __init__(self, model_name: str = "da3-large") -> None:
            self.model_name = model_name

        @classmethod
        def from_pretrained(cls, name):
            if "missing" in name:
                raise OSError(f"{name} is not a local folder and is not a valid model identifier")
            return cls(name)

        def to(self, device):
            return self

        def eval(self):
            return self

        def inference(self, image, extrinsics=None, intrinsics=None, process_res=504,
                      process_res_method="upper_bound_resize", export_dir=None):  # fmt: skip
            ids = [frames[i] for i in image]
            runs.append(ids)
            h0, w0 = image[0].shape[:2]
            # Shrunk to the longer side, then both sides rounded to whole patches: slightly anisotropic.
            w = round(process_res / max(h0, w0) * w0 / 14) * 14
            h = round(process_res / max(h0, w0) * h0 / 14) * 14
            s = scale * (1 + 0.3 * len(runs))
            z = np.stack([cv2.resize(np.nan_to_num(truth.depth[t], nan=9.0), (w, h)) for t in ids]) * s
            K = truth.K.copy()
            K[:2, 2] += 0.5  # principal point from the corner
            K[0] *= w / truth.size[0]
            K[1] *= h / truth.size[1]
            first = truth.T_camera_world[ids[0]]
            relative = truth.T_camera_world[ids] @ np.linalg.inv(first)  # its world is its first camera
            relative[:, :3, 3] *= s
            return Prediction(z.astype(np.float32), np.ones_like(z), relative[:, :3], np.stack([K] * len(ids)))

    package, api = types.ModuleType("depth_anything_3"), types.ModuleType("depth_anything_3.api")
    package.__spec__ = importlib.machinery.ModuleSpec("depth_anything_3", None)  # it counts as installed
    api.DepthAnything3 = DepthAnything3
    monkeypatch.setitem(sys.modules, "depth_anything_3", package)
    monkeypatch.setitem(sys.modules, "depth_anything_3.api", api)
    return runs

"""Whole meshes of both links by SAM 3D Objects, from key frames, labelled, registered and fused.

SAM 3D Objects and SegviGen run in environments of their own by the released pipeline's scripts
(``scripts/03_sam3d_reconstruct.py``, ``scripts/05_segvigen_segment.py``) on a scene folder written for them. Each key
frame gives one mesh of the whole object, hidden sides included, with the right outline at an unknown distance; the
joint's own points say how far it is. Which surface is which link comes from the masks of all key frames (``votes``) or
from SegviGen's pieces. The fusion is :mod:`reconstruct.geometry.fusion`.

Source: SAM 3D Team, SAM 3D Objects, 2025; SegviGen, 2026.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reconstruct.cues import LinkMasks
from reconstruct.cues_io import MESHES, read_mesh
from reconstruct.depth import sample_depth
from reconstruct.errors import TaaError
from reconstruct.geometry import LinkMesh
from reconstruct.joint.models import JointFit
from reconstruct.providers.grounding import scale_to
from reconstruct.providers.make import Made, Request
from reconstruct.providers.outside import pipeline_script, run_script, setting
from reconstruct.providers.released import ReleasedScene, ReleasedWriter
from reconstruct.video import Video

KEYS = 5
AROUND = 0.35
"""How far round the moving part the static link may reach, as a share of the part's own extent in the picture."""


def meshes(request: Request) -> Made:
    """``meshes/static.glb`` and ``meshes/moving.glb`` at q = 0, in the joint's world.

    Raises:
        TaaError: no joint or masks, a script failed, or its meshes do not fit the joint.
    """
    from reconstruct.geometry.fusion import fuse_meshes

    video, fit, masks = request.video, request.fit, request.masks
    if fit is None or masks is None or fit.points is None or fit.q is None:
        raise TaaError("SAM 3D Objects needs the joint and the masks, which come before it; report this")
    section, name = request.settings.section("sam3d"), "sam3d"
    frames = key_frames(fit, masks)
    scene = request.work / name / "scene"
    writer = ReleasedWriter(scene)
    writer.frames(video)
    parts = {"static": near_part(masks.static, masks.moving), "moving": masks.moving}
    writer.masks(parts, {"static": "static", "moving": "moving"}, frames)
    more = ["--combined", "--overwrite"]
    depth = _depth(request, fit, video)
    if depth is not None:
        pose = np.linalg.inv(np.asarray(fit.T_camera_world, float))
        writer.da3(video, fit.K, np.tile(pose, (len(video), 1, 1)), depth)
        more += ["--pointmap-source", "da3"]
    if section.get("checkpoint"):
        more += ["--checkpoint-tag", str(section["checkpoint"])]
    run_script(name, section, pipeline_script(name, request.settings, "scripts/03_sam3d_reconstruct.py"),
               ["--scene-dir", scene, "--sam3d-repo", setting(section, name, "repository"), *more],
               request.work / name / "log.txt", [scene / "sam3d" / "combined"], request.tell)  # fmt: skip
    segvigen = request.chosen.get("labels") == "segvigen"
    if segvigen:
        _run_segvigen(request, scene)
    keys, notes, labels = key_meshes(ReleasedScene(scene), fit, video, segvigen)
    fused = fuse_meshes(keys, fit, masks, video.size, depth, **({"labels": labels} if segvigen else {}))
    out = {MESHES[0]: _glb(fused.static), MESHES[1]: _glb(fused.moving)}
    version = "SAM 3D Objects through the released pipeline of track-articulate-act"
    if segvigen:
        version += ", labels by SegviGen"
    return Made(out, version, notes=tuple(notes))


def key_frames(fit: JointFit, masks: LinkMasks, count: int = KEYS) -> list[int]:
    """Frames spread over the joint's range in which most of the part is seen and least is behind the hand."""
    q = np.asarray(fit.q, float)
    seen = masks.moving.mean((1, 2)) - 0.5 * masks.hand.mean((1, 2))
    seen[~masks.moving.any((1, 2)) | ~masks.static.any((1, 2))] = -np.inf
    edges = np.linspace(q.min(), q.max() + 1e-9, count + 1)
    frames = []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        inside = np.flatnonzero((q >= low) & (q < high) & np.isfinite(seen))
        if len(inside):
            frames.append(int(inside[np.argmax(seen[inside])]))
    if not frames:
        raise TaaError("no frame shows both links, so there is nothing to reconstruct; choose --mesh hull")
    return sorted(frames)


def near_part(static: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """The static mask around the part: where it is all that does not move, the room is not meant.

    Args:
        static, moving: (T, h, w) bool.
    """
    ever = moving.any(0)
    if not ever.any():
        return static
    rows, columns = np.flatnonzero(ever.any(1)), np.flatnonzero(ever.any(0))
    grow = round(AROUND * max(np.ptp(rows), np.ptp(columns)))
    box = np.zeros(ever.shape, bool)
    box[max(0, rows[0] - grow) : rows[-1] + grow + 1, max(0, columns[0] - grow) : columns[-1] + grow + 1] = True
    return static & box


def _depth(request: Request, fit: JointFit, video: Video) -> np.ndarray | None:
    """The depth cue in the joint's own unit, or None."""
    if "depth" not in request.folder.given():
        return None
    depth = request.folder.read("depth", "depth")["depth"].astype(np.float32)
    uv, z = points_in_picture(fit, np.arange(len(video)))
    known = sample_depth(depth, uv, video.size)
    both = np.isfinite(known) & (known > 0) & (z > 0)
    if both.sum() < 20:
        return None
    return depth * np.float32(np.exp(np.median(np.log(z[both] / known[both]))))


def points_in_picture(fit: JointFit, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(M, n, 2) full px and (M, n) depth of the joint's points in each frame."""
    pose = np.asarray(fit.T_camera_world, float) @ fit.link_pose(np.asarray(fit.q, float)[frames])
    x = np.einsum("tij,mj->mti", pose[:, :3, :3], fit.points) + pose[:, :3, 3]
    uvw = x @ np.asarray(fit.K, float).T
    return uvw[..., :2] / uvw[..., 2:], x[..., 2]


def key_meshes(scene: ReleasedScene, fit: JointFit, video: Video, pieces: bool) -> tuple[list, list[str], list]:
    """Key frame meshes in their cameras and the joint's unit, notes, and with ``pieces`` each face's link.

    Raises:
        TaaError: no mesh meets the joint's points.
    """
    from reconstruct.geometry.fusion import KeyMesh

    keys, notes, labels = [], [], []
    for frame, (file, T_camera_glb) in sorted(scene.key_meshes("sam3d").items()):
        if pieces:
            parts = scene.pieces(frame)
            if set(parts) < {"static", "moving"}:
                notes.append(f"SegviGen gave no pieces of both links in frame {frame}; left out")
                continue
            read = {link: read_mesh(parts[link]) for link in ("static", "moving")}
            shift = len(read["static"][0])
            vertices = np.concatenate([read["static"][0], read["moving"][0]])
            faces = np.concatenate([read["static"][1], read["moving"][1] + shift])
            colours = np.concatenate([read["static"][2], read["moving"][2]])
            label = np.r_[np.zeros(len(read["static"][1]), bool), np.ones(len(read["moving"][1]), bool)]
        else:
            vertices, faces, colours = read_mesh(Path(file))
            label = np.zeros(len(faces), bool)
        there = vertices @ T_camera_glb[:3, :3].T + T_camera_glb[:3, 3]
        uv, z = points_in_picture(fit, np.array([frame]))
        s = scale_to(there, faces, np.asarray(fit.K, float), uv[:, 0], z[:, 0])
        if s is None:
            notes.append(f"SAM 3D's mesh of frame {frame} does not lie where the part is; left out")
            continue
        keys.append(KeyMesh(frame, s * there, faces, colours))
        labels.append(label)
    if not keys:
        raise TaaError("no mesh of SAM 3D Objects lies where the part is; look at the masks, or choose --mesh hull")
    return keys, notes, labels


def _run_segvigen(request: Request, scene: Path) -> None:
    """SegviGen on every key frame's mesh; its script looks for them under ``sam3d_scaled``."""
    import shutil

    section, name = request.settings.section("segvigen"), "segvigen"
    shutil.copytree(scene / "sam3d", scene / "sam3d_scaled", dirs_exist_ok=True)
    run_script(name, section, pipeline_script(name, request.settings, "scripts/05_segvigen_segment.py"),
               ["--scene-dir", scene, "--segvigen-root", setting(section, name, "repository"), "--ckpt-path",
                setting(section, name, "checkpoint"), "--overwrite"],
               request.work / name / "log.txt", [scene / "segvigen" / "combined"], request.tell)  # fmt: skip


def _glb(link: LinkMesh) -> bytes:
    import trimesh

    mesh = trimesh.Trimesh(link.vertices, link.faces, vertex_colors=link.colors, process=False)
    return mesh.export(file_type="glb")

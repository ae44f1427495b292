"""``taa import-scene``: the scene folder of the paper's released pipeline, whole or partial, as our cues."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from reconstruct.cues import ProviderInfo
from reconstruct.cues_io import CueFolder, read_mesh
from reconstruct.depth import sample_depth
from reconstruct.errors import TaaError
from reconstruct.providers.grounding import ground_tracks
from reconstruct.providers.released import HandFrames, ReleasedScene
from reconstruct.providers.table import find
from reconstruct.providers.world import upright
from reconstruct.video import WORK_LONG_SIDE
from taa_envs.files import written_whole

NEAR = 0.03
"""Share of its depth by which a tracked point may lie behind the depth map and still count as seen."""


def import_scene(source: str | Path, scene: str | Path, label: str | None = None, rate: float = 30.0,
                 ground: bool = False) -> dict:  # fmt: skip
    """Read a released scene folder into ``scene/cues``.

    Args:
        source: the released pipeline's scene folder; any part of it may be missing.
        scene: our scene folder, made where it is not there.
        label: which moving part; needed where several move.
        rate: frames a second of ``frames/``, which the folder does not say.
        ground: put the tracks onto the key frames' meshes (``sam3d_scaled/``): the first meeting of a pixel's ray
            with the mesh takes the place of the lifted depth.

    Returns:
        {"scene", "frames", "size", "label", "cues": {name: what it was made from}, "missing": [..], "joints": {..},
        "metric", "notes"}. ``joints`` are the pipeline's own answers, to compare with.

    Raises:
        TaaError: the folder is not such a scene, holds nothing to make a cue of, or a file in it is damaged.
    """
    if not 0.1 <= rate <= 1000:
        raise TaaError(f"{rate:g} frames a second is not possible; give the rate at which frames/ was extracted")
    found, folder = ReleasedScene(Path(source)), CueFolder(Path(scene))
    size = found.size()
    moving = _moving_label(found, label)
    cues: dict[str, str] = {}
    notes: list[str] = []

    def put(name: str, content: Any, info: ProviderInfo, made_from: str) -> None:
        folder.put(name, content, info)
        cues[name] = made_from

    model = found.da3_model()
    metric = "NESTED" in model.upper()
    times = {"time": np.arange(len(found)) / rate}
    put("frames", times, _info("none", "scene folder", "frames"), "the frames' count")
    cameras = found.cameras()
    world = np.eye(4)
    if cameras is not None:
        K, T_any_camera = cameras
        world = upright(T_any_camera)
        put("camera", {"K": K, "T_world_camera": world @ T_any_camera, "metric": np.array(metric)},
            _info("da3", model, "camera"), "da3/cameras.npz")  # fmt: skip
        notes.append("which way is up is assumed from how a camera is held: the scene does not say")
    depth = found.depth()
    if depth is not None:
        put("depth", {"depth": depth, "metric": np.array(metric)}, _info("da3", model, "depth"), "da3/depth")
    _masks(found, size, moving, put)
    if cameras is not None:
        _tracks(found, size, moving, cameras, world, depth, put, notes, ground)
        _hand(found, size, cameras, world, put, notes)
        _meshes(found, moving, cameras[1], world, put, notes)
    elif (found.folder / "trackcraft").is_dir() or found.hand() is not None:
        notes.append("da3/cameras.npz is missing; tracks, hands and meshes have no world without it and were left out")
    if set(cues) == {"frames"}:
        raise TaaError(f"{source} holds none of da3/, masks/, trackcraft/, hawor/ and registered_static/; run the "
                       "released pipeline further, or give its scene folder")  # fmt: skip
    wanted = ("camera", "depth", "masks", "tracks", "hand", "meshes/static.glb", "meshes/moving.glb")
    video = _video(found, Path(scene), rate)
    if video is None:
        notes.append("frames/ is missing or incomplete; `taa fit` works from the cues, `taa reconstruct` needs a video")
    _facts(found, Path(scene), size, video)
    facts = {
        "scene": str(scene), "video": str(video) if video else None, "source": str(Path(source).name),
        "frames": len(found), "size": list(size),
        "label": moving, "cues": cues, "missing": [name for name in wanted if name not in cues],
        "joints": found.joints(), "metric": metric, "notes": notes,
        "T_world_source": world.tolist(),
    }  # fmt: skip
    with written_whole(Path(scene) / "imported.json") as partial:
        partial.write_text(json.dumps(facts, indent=1), encoding="utf-8")
    return facts


def _info(name: str, version: str, stage: str) -> ProviderInfo:
    """Who made a piece, through the released pipeline."""
    how = "through the released pipeline of track-articulate-act"
    kinds = {"camera": "camera", "depth": "depth", "tracks": "track", "hand": "hand", "masks": "segment",
             "meshes": "mesh"}  # fmt: skip
    if stage not in kinds:
        return ProviderInfo("released", how, "-", stage)
    licence = find(kinds[stage], name).licence
    if name == "da3":
        from reconstruct.providers.da3 import _licence

        licence = _licence(version) if version else licence
    return ProviderInfo(name, f"{version or 'unknown weights'}, {how}", licence, kinds[stage])


def _moving_label(found: ReleasedScene, label: str | None) -> str | None:
    moving = [name for name, motion in found.labels().items() if motion == "moving"]
    if label is not None:
        if label not in found.labels():
            raise TaaError(f"no label is named {label!r}; this scene has {', '.join(found.labels()) or 'none'}")
        return label
    if len(moving) > 1:
        raise TaaError(f"several parts move: {', '.join(moving)}; choose one with --label")
    return moving[0] if moving else None


def _masks(found: ReleasedScene, size: tuple[int, int], moving: str | None, put: Any) -> None:
    s = min(1.0, WORK_LONG_SIDE / max(size))
    shape = (round(size[1] * s), round(size[0] * s))
    out = {name: np.zeros((len(found), *shape), bool) for name in ("static", "moving", "hand")}
    seen = set()
    for label, motion in found.labels().items():
        mask = found.masks(label, shape)
        if mask is None:
            continue
        kind = "hand" if motion == "hand" else "moving" if label == moving else "static" if motion == "static" else ""
        if kind:
            out[kind] |= mask
            seen.add(kind)
    if "moving" in seen:
        out["moving"] &= ~out["hand"]
        out["static"] &= ~out["moving"] & ~out["hand"]
        put("masks", out, _info("sam3", "", "masks"), "masks/")


def _tracks(found: ReleasedScene, size: tuple[int, int], moving: str | None, cameras: tuple[np.ndarray, np.ndarray],
            world: np.ndarray, depth: np.ndarray | None, put: Any, notes: list[str], ground: bool) -> None:  # fmt: skip
    parts = [(label, found.tracks(label)) for label, motion in found.labels().items()
             if label == moving or motion == "static"]  # fmt: skip
    parts = [(label, xyz) for label, xyz in parts if xyz is not None]
    if not any(label == moving for label, _ in parts):
        return
    xyz = np.concatenate([xyz for _, xyz in parts])
    uv, z = project(xyz, *cameras)
    visible = np.isfinite(z) & (z > 0) & (uv > -0.5).all(-1) & (uv < np.array(size) - 0.5).all(-1)
    if depth is not None:
        surface = sample_depth(depth, uv, size)
        visible &= ~(z > surface * (1 + NEAR))
    uv = np.where(visible[..., None], uv, np.nan)
    if ground:
        keys = {}
        for frame, (file, T_camera_glb) in found.key_meshes().items():
            vertices, faces, _ = read_mesh(file)
            keys[frame] = vertices @ T_camera_glb[:3, :3].T + T_camera_glb[:3, 3], faces
        xyz, count = ground_tracks(xyz, uv, visible, keys, *cameras)
        notes.append(f"{count} places of tracks in {len(keys)} key frames were put onto the meshes")
    arrays = {"uv": uv.astype(np.float32), "visible": visible,
              "xyz_world": (xyz @ world[:3, :3].T + world[:3, 3]).astype(np.float32)}  # fmt: skip
    put("tracks", arrays, _info("trackcraft3r", "", "tracks"), "trackcraft/")


def project(xyz: np.ndarray, K: np.ndarray, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, T, 2) px and (N, T) depth of points in each frame's camera.

    Args:
        xyz: (N, T, 3) world.  K: (T, 3, 3).  T_world_camera: (T, 4, 4).
    """
    T_camera_world = np.linalg.inv(T_world_camera)
    x = np.einsum("tij,ntj->nti", T_camera_world[:, :3, :3], xyz) + T_camera_world[:, :3, 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        uvw = np.einsum("tij,ntj->nti", K, x)
        return uvw[..., :2] / uvw[..., 2:], x[..., 2]


def _hand(found: ReleasedScene, size: tuple[int, int], cameras: tuple[np.ndarray, np.ndarray], world: np.ndarray,
          put: Any, notes: list[str]) -> None:  # fmt: skip
    got = found.hand()
    if got is None:
        return
    hand, folder = got
    scaled = folder == "hawor_scaled"
    if not scaled:
        notes.append(f"{folder}/ places the hand at its own depth; only its shape and its place in the picture count")
    put("hand", hand_arrays(hand, size, cameras[0], world @ cameras[1], scaled),
        _info("wilor" if folder == "wilor" else "hawor", folder, "hand"), f"{folder}/per_frame")  # fmt: skip


def hand_arrays(hand: HandFrames, size: tuple[int, int], K: np.ndarray, T_world_camera: np.ndarray,
                scene_camera: bool) -> dict[str, np.ndarray]:  # fmt: skip
    """``hand.npz`` of a network's hand.

    Args:
        hand: camera frame.  size: (width, height) full px.  K: (T, 3, 3) of the scene's camera.
        scene_camera: True if the joints project with the scene's K; else with the network's own focal length and the
            picture's centre, as far as it says one.
    """
    T = len(hand.joints)
    own = np.array(K, float)
    if not scene_camera:
        f = np.where(np.isfinite(hand.focal), hand.focal, own[:, 0, 0])
        own[:, 0, 0] = own[:, 1, 1] = f
        own[:, 0, 2], own[:, 1, 2] = size[0] / 2 - 0.5, size[1] / 2 - 0.5
    with np.errstate(invalid="ignore", divide="ignore"):
        uvw = np.einsum("tij,tkj->tki", own, hand.joints)
        uv = uvw[..., :2] / uvw[..., 2:]
    seen = np.isfinite(hand.joints).all((1, 2)) & (np.nan_to_num(hand.joints[..., 2], nan=-1) > 0).all(1)

    def to_world(x: np.ndarray) -> np.ndarray:
        return np.einsum("tij,tkj->tki", T_world_camera[:, :3, :3], x) + T_world_camera[:, None, :3, 3]

    arrays = {"joints_world": to_world(hand.joints), "joints_uv": uv, "valid": seen & hand.detected,
              "side": np.array(hand.side)}  # fmt: skip
    if hand.vertices is not None:
        arrays["vertices"] = to_world(hand.vertices).astype(np.float32)
    assert arrays["joints_uv"].shape == (T, 21, 2)
    return arrays


def _meshes(found: ReleasedScene, moving: str | None, T_any_camera: np.ndarray, world: np.ndarray, put: Any,
            notes: list[str]) -> None:  # fmt: skip
    registered = found.registered()
    if registered is None:
        return
    reference, static, pieces = registered
    poses = found.key_meshes()
    if reference not in poses:
        notes.append("registered_static/ has no pose of its reference frame beside it; its meshes were left out")
        return
    T = world @ T_any_camera[reference] @ poses[reference][1]
    mine = {frame: mesh for (label, frame), mesh in pieces.items() if label == moving}
    if not mine:
        notes.append("registered_static/ has no mesh of the moving part; its meshes were left out")
        return
    frame = reference if reference in mine else min(mine)
    info = _info("sam3d", "", "meshes")
    for name, mesh in (("meshes/static.glb", static), ("meshes/moving.glb", mine[frame])):
        placed = mesh.copy()
        placed.apply_transform(T)
        put(name, placed.export(file_type="glb"), info, "registered_static/")
    put_frame(put, frame)
    if len(mine) > 1:
        notes.append(f"the moving part's mesh of frame {frame} was taken; {len(mine) - 1} more are in the source")


def put_frame(put: Any, frame: int) -> None:
    """Remember in which frame the moving mesh is as it stands in its file."""
    put("meshes/frame", {"reference_frame": np.array(frame)}, _info("none", "", "frames"), "registered_static/")


def _video(found: ReleasedScene, scene: Path, rate: float) -> Path | None:
    """``video.mp4`` of all frames, so that the pipeline can go on from the cues; None where a frame is missing."""
    import cv2
    import imageio_ffmpeg

    files = [found.folder / "frames" / f"{stem:06d}.jpg" for stem in found.stems]
    if not all(file.is_file() for file in files):
        return None
    first = cv2.imread(str(files[0]))
    if first is None or first.shape[0] % 2 or first.shape[1] % 2:
        return None
    with written_whole(scene / "video.mp4") as partial:
        writer = imageio_ffmpeg.write_frames(
            str(partial), first.shape[1::-1], fps=rate, codec="libx264", pix_fmt_in="bgr24", pix_fmt_out="yuv420p",
            macro_block_size=2, output_params=["-crf", "16", "-preset", "veryfast", "-f", "mp4"],
        )  # fmt: skip
        writer.send(None)
        for file in files:
            image = cv2.imread(str(file))
            if image is None or image.shape != first.shape:
                writer.close()
                raise TaaError(f"{file} cannot be read or is of another size; extract the frames again")
            writer.send(np.ascontiguousarray(image))
        writer.close()
    return scene / "video.mp4"


def _facts(found: ReleasedScene, scene: Path, size: tuple[int, int], video: Path | None) -> None:
    """``scene.json``, as a run of the pipeline would leave it."""
    s = min(1.0, WORK_LONG_SIDE / max(size))
    facts = {"video": video.name if video else found.folder.name, "sha256": "", "size": list(size),
             "work_size": [round(size[0] * s), round(size[1] * s)], "decoded": len(found),
             "index": list(range(len(found))), "focal_px": None}  # fmt: skip
    with written_whole(scene / "scene.json") as partial:
        partial.write_text(json.dumps(facts), encoding="utf-8")

"""The scene folder's ``cues/``: files that other programs may write and read, in the contract's format.

The pipeline writes its own cues there and remembers their digests in ``cues/written.json``; those of chosen
providers and of an imported scene are remembered in ``cues/made.json`` with who made them. A file that is in neither
as it was written was put there by somebody, and is used as if a provider had made it.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from reconstruct.container import MAX_SIDE, MIN_SIDE
from reconstruct.cues import HandReference, Hands, HandTrack, LinkMasks, ProviderInfo, Tracks
from reconstruct.errors import TaaError
from reconstruct.geometry import Geometry, LinkMesh
from reconstruct.joint.models import JointFit, placed_std
from reconstruct.store import file_digest, save_npz
from reconstruct.video import WORK_LONG_SIDE, Video
from taa_envs.arrays import ArrayFileError, read_npz
from taa_envs.files import written_whole

GIVEN = ProviderInfo("given", "scene folder", "the user's")
NAMES = ("frames", "camera", "depth", "masks", "tracks", "hand")
MESHES = ("meshes/static.glb", "meshes/moving.glb")

MAX_CUE_BYTES = 4 << 30
"""Of one cue once unpacked: depth of 900 frames at 960 x 540 takes 1.9 GB, as many masks of three kinds 1.4 GB."""
MAX_MESH_BYTES = 128 << 20
MAX_FACES = 2_000_000
MAX_DEPTH = 1e4
"""m; other depths, like those that are not positive, are taken as unknown."""
MAX_PX = 1e5
"""Farther out no point of a picture is tracked: a track is taken as not visible there."""

HAND_ARRAYS = ("joints_world", "joints_uv", "valid", "side")
PLACED_STD = 0.01  # m, of a user's joints in space that state nothing: a good motion capture glove

Arrays = Mapping[str, np.ndarray]


class CueFolder:
    """``scene/cues``: which files are the user's, reading and writing them.

    Args:
        scene: the scene folder; it may not exist yet.
        chosen: stage -> provider of this run. A cue that another provider made earlier is then not used; None uses all.
    """

    def __init__(self, scene: Path, chosen: Mapping[str, str] | None = None) -> None:
        self.folder = Path(scene) / "cues"
        self._ledger_file, self._made_file = self.folder / "written.json", self.folder / "made.json"
        self._written: dict[str, str] = _read_ledger(self._ledger_file)
        self._made: dict[str, dict] = _read_ledger(self._made_file)
        self._chosen = chosen

    def given(self) -> dict[str, str]:
        """Name (``"tracks"``, ``"meshes/moving.glb"``) -> sha256 of every cue the pipeline did not write itself."""
        found = {}
        for name in (*NAMES, *MESHES):
            file = self._file(name)
            if file.is_file() and (digest := file_digest(file)) != self._written.get(name):
                made = self._made.get(name, {})
                if made.get("sha256") != digest or self._wanted(made):
                    found[name] = digest
        return found

    def users(self, name: str) -> bool:
        """True if this file is there and neither the pipeline nor a provider made it."""
        file = self._file(name)
        known = (self._written.get(name), self._made.get(name, {}).get("sha256"))
        return file.is_file() and (self.imported(name) or file_digest(file) not in known)

    def imported(self, name: str) -> bool:
        """True if the file came with an imported scene."""
        made = self._made.get(name, {})
        file = self._file(name)
        return bool(made) and not made.get("stage") and file.is_file() and file_digest(file) == made["sha256"]

    def fresh(self, name: str, key: str) -> bool:
        """True if the file is as a provider made it under this key."""
        made = self._made.get(name, {})
        file = self._file(name)
        return made.get("key") == key and file.is_file() and file_digest(file) == made.get("sha256")

    def maker(self, name: str) -> ProviderInfo:
        """Who made a cue; the user where nobody is known."""
        made = self._made.get(name, {})
        file = self._file(name)
        if not made or not file.is_file() or file_digest(file) != made.get("sha256"):
            return replace(GIVEN, stage=name)
        return ProviderInfo(made["name"], made["version"], made["licence"], made.get("stage") or name)

    def put(self, name: str, content: Arrays | bytes, maker: ProviderInfo, key: str = "") -> None:
        """Write a cue that a provider made, or that was imported (no key), and remember who made it."""
        file = self._file(name)
        file.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, bytes):
            with written_whole(file) as partial:
                partial.write_bytes(content)
        else:
            save_npz(file, content)
        self._written.pop(name, None)
        self._made[name] = {"sha256": file_digest(file), "key": key, "stage": maker.stage if key else "",
                            "name": maker.name, "version": maker.version, "licence": maker.licence}  # fmt: skip
        for ledger, content in ((self._made_file, self._made), (self._ledger_file, self._written)):
            with written_whole(ledger) as partial:
                partial.write_text(json.dumps(content, indent=1), encoding="utf-8")

    def path(self, name: str) -> Path:
        """The file of a cue."""
        return self._file(name)

    def _wanted(self, made: Mapping[str, str]) -> bool:
        stage = made.get("stage")
        return not stage or self._chosen is None or self._chosen.get(stage) == made["name"]

    def _ours(self, name: str) -> bool:
        """True if the pipeline may write over the file: nothing is there, or what it or an unused provider wrote."""
        file = self._file(name)
        if not file.is_file():
            return True
        digest, made = file_digest(file), self._made.get(name, {})
        return digest == self._written.get(name) or (digest == made.get("sha256") and not self._wanted(made))

    def read(self, name: str, *required: str) -> dict[str, np.ndarray]:
        """All arrays of a cue.

        Raises:
            TaaError: the file is not an ``.npz`` of plain arrays, or lacks one that is required.
        """
        file = self._file(name)
        try:
            arrays = read_npz(file, max_bytes=MAX_CUE_BYTES)
        except (OSError, ArrayFileError) as error:
            reason = str(error).replace(f"{file}", "").strip(" ,")[:120]
            raise TaaError(f"cannot read {file} ({reason}); write it with numpy.savez or remove it") from None
        missing = [key for key in required if key not in arrays]
        if missing:
            raise TaaError(f"{file} has no array {missing[0]!r}; it needs {', '.join(required)}")
        return arrays

    def write(self, name: str, arrays: Arrays) -> None:
        """Write one of the pipeline's own cues; a user's file of that name is left alone."""
        if self._ours(name):
            save_npz(self._file(name), arrays)
            self._remember(name)

    def write_meshes(self, geometry: Geometry) -> None:
        """Both links as binary glTF, world frame, moving at q = 0."""
        import trimesh

        for name, link in zip(MESHES, (geometry.static, geometry.moving), strict=True):
            file = self._file(name)
            if not self._ours(name):
                continue
            file.parent.mkdir(parents=True, exist_ok=True)
            mesh = trimesh.Trimesh(link.vertices, link.faces, vertex_colors=link.colors, process=False)
            with written_whole(file) as partial:
                partial.write_bytes(mesh.export(file_type="glb"))
            self._remember(name)

    def _file(self, name: str) -> Path:
        return self.folder / (name if name in MESHES else f"{name}.npz")

    def _remember(self, name: str) -> None:
        self._written[name] = file_digest(self._file(name))
        with written_whole(self._ledger_file) as partial:
            partial.write_text(json.dumps(self._written, indent=1), encoding="utf-8")


def _read_ledger(file: Path) -> dict:
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def expect_shape(array: np.ndarray, shape: tuple[int | None, ...], what: str) -> np.ndarray:
    """The array itself; None in ``shape`` stands for any length.

    Raises:
        TaaError: the shape is another one.
    """
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        raise TaaError(f"{what} has shape {array.shape}, expected {wanted}; T counts the frames in cues/frames.npz")
    return array


def numbers(array: np.ndarray, shape: tuple[int | None, ...], what: str, finite: bool = False) -> np.ndarray:
    """The array as floats, of that shape; with ``finite`` without NaN or infinity.

    Raises:
        TaaError: it is not so.
    """
    if array.dtype.kind not in "biuf":
        raise TaaError(f"{what} does not hold numbers; write it as an array of floats")
    array = expect_shape(np.asarray(array, float), shape, what)
    if finite and not np.isfinite(array).all():
        raise TaaError(f"{what} holds numbers that are not finite; mend or remove the file")
    return array


def poses(array: np.ndarray, shape: tuple[int | None, ...], what: str) -> np.ndarray:
    """Rigid transforms (..., 4, 4).

    Raises:
        TaaError: not numbers, of another shape, or not a rotation and a shift.
    """
    array = numbers(array, shape, what, finite=True)
    if (np.abs(array) > 1e6).any():
        raise TaaError(f"{what} lies farther away than a million units; give metres")
    R = array[..., :3, :3]
    if (np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)) > 1e-3).any() or (np.linalg.det(R) < 0).any():
        raise TaaError(f"{what} is not a rotation and a shift; give camera-to-world poses, right, down, forward")
    return array


def booleans(array: np.ndarray, shape: tuple[int | None, ...], what: str) -> np.ndarray:
    """The array as truth values.

    Raises:
        TaaError: it does not hold numbers or is of another shape.
    """
    if array.dtype.kind not in "biuf":
        raise TaaError(f"{what} does not hold truth values; write it as an array of bool")
    return expect_shape(np.asarray(array, bool), shape, what)


def tracks_from_cue(cue: Arrays, frames: int, maker: ProviderInfo = GIVEN) -> Tracks:
    """Tracks of ``tracks.npz`` (uv (N, T, 2) full px, visible (N, T), optional slip (N, T, 2), shade (N,) and
    cast (N,) as in :class:`Tracks`); seeded where first visible."""
    uv = numbers(cue["uv"], (None, frames, 2), "uv of cues/tracks.npz")
    if not len(uv):
        raise TaaError("cues/tracks.npz holds no track; remove it and the pipeline tracks points itself")
    visible = booleans(cue["visible"], uv.shape[:2], "visible of cues/tracks.npz")
    visible = visible & (np.abs(np.nan_to_num(uv, nan=np.inf)) < MAX_PX).all(-1)
    uv = np.where(visible[..., None], uv, np.nan)
    slip = None
    if "slip" in cue:
        slip = np.nan_to_num(numbers(cue["slip"], uv.shape, "slip of cues/tracks.npz")).astype(np.float32)
        if (np.linalg.norm(slip, axis=-1) > 1 + 1e-3).any():
            raise TaaError("slip of cues/tracks.npz is longer than 1; its square is the share that is not held")
    flags = [booleans(cue[k], uv.shape[:1], f"{k} of cues/tracks.npz") if k in cue else None for k in ("shade", "cast")]
    return Tracks(uv.astype(np.float32), visible, visible.argmax(1), maker, slip, *flags)


def hands_from_cue(cue: Arrays, camera: Arrays | None, video: Video, mask: np.ndarray | None,
                   maker: ProviderInfo = GIVEN) -> Hands:  # fmt: skip
    """The hand of ``hand.npz``, its joints turned from the world to each frame's camera axes.

    Args:
        cue: joints_world (T, 21, 3) m, joints_uv (T, 21, 2) full px, valid (T,), side; optional std, m, of each
            coordinate of joints_world.
        camera: T_world_camera (T, 4, 4) of ``camera.npz``, which joints_world refer to, and ``metric``.
        mask: (T, h, w) hand pixels at working size; drawn from the landmarks when None.
        maker: who made the cue. Where the camera is metric, a user's joints are taken as measured in space, and
            anybody's who states ``std``; of a network's otherwise only their shape is used, and where they are in the
            picture.

    Raises:
        TaaError: a shape is wrong, or there is no camera.
    """
    T = len(video)
    if camera is None or "T_world_camera" not in camera:
        raise TaaError("cues/hand.npz is in the world frame; put the camera's poses into cues/camera.npz too")
    pose = poses(camera["T_world_camera"], (T, 4, 4), "T_world_camera of cues/camera.npz")
    joints = numbers(cue["joints_world"], (T, 21, 3), "joints_world of cues/hand.npz")
    uv = numbers(cue["joints_uv"], (T, 21, 2), "joints_uv of cues/hand.npz")
    valid = booleans(cue["valid"], (T,), "valid of cues/hand.npz")
    valid = valid & (np.abs(np.nan_to_num(joints, nan=np.inf)) < 1e6).all((1, 2))
    valid &= (np.abs(np.nan_to_num(uv, nan=np.inf)) < MAX_PX).all((1, 2))
    if cue["side"].ndim or str(cue["side"]) not in ("left", "right"):
        raise TaaError('side of cues/hand.npz must be "left" or "right"')
    joints = np.where(valid[:, None, None], joints, 0.0)
    centred = joints - joints.mean(axis=1, keepdims=True)
    metric = np.einsum("tji,tkj->tki", pose[:, :3, :3], centred)
    nan = np.where(valid, 1.0, np.nan)[:, None, None]
    placed, std = None, None
    if booleans(camera.get("metric", np.array(True)), (), "metric of cues/camera.npz"):
        if "std" in cue:
            std = float(numbers(cue["std"], (), "std of cues/hand.npz"))
            if not (np.isfinite(std) and std >= 0):
                raise TaaError("std of cues/hand.npz must be one standard deviation of joints_world in metres")
        elif maker.name == GIVEN.name:
            std = PLACED_STD
        if std is not None:
            placed = np.einsum("tji,tkj->tki", pose[:, :3, :3], joints - pose[:, None, :3, 3]) * nan
    track = HandTrack(str(cue["side"]), uv * nan, metric * nan, valid.astype(float), valid, placed, std)
    if mask is None:
        from reconstruct.providers.skin import hand_mask

        mask = hand_mask(video, (track,))
    return Hands((track,), mask, maker)


def masks_from_cue(cue: Arrays, video: Video) -> LinkMasks:
    """Link and hand pixels of ``masks.npz``, any size, brought to working size."""
    moving, static, hand = (mask_at_work_size(cue[name], video, name) for name in ("moving", "static", "hand"))
    return LinkMasks(moving, static, hand, moving.any((1, 2)).astype(float))


def mask_at_work_size(mask: np.ndarray, video: Video, name: str) -> np.ndarray:
    """(T, H, W) bool of any size -> (T, h, w) at working size, nearest pixel."""
    import cv2

    T, h, w = video.frames.shape[:3]
    mask = booleans(mask, (T, None, None), f"{name} of cues/masks.npz")
    if not mask.size:
        raise TaaError(f"{name} of cues/masks.npz has no pixels; give masks of the video's shape")
    if mask.shape == (T, h, w):
        return mask
    return np.stack([cv2.resize(m.astype(np.uint8), (w, h), interpolation=cv2.INTER_NEAREST) > 0 for m in mask])


def metric_depth_from_cue(cue: Arrays, frames: int) -> np.ndarray | None:
    """(T, H, W) float32 m, NaN where unknown, of ``depth.npz``; None where it is not metric.

    Raises:
        TaaError: not numbers, or of another shape.
    """
    if not booleans(cue.get("metric", np.array(True)), (), "metric of cues/depth.npz"):
        return None
    if cue["depth"].dtype.kind not in "iuf" or not cue["depth"].size:
        raise TaaError("depth of cues/depth.npz does not hold numbers; write metres as float32")
    with np.errstate(invalid="ignore", over="ignore"):
        depth = expect_shape(np.asarray(cue["depth"], np.float32), (frames, None, None), "depth of cues/depth.npz")
        return np.where((depth > 0) & (depth < MAX_DEPTH), depth, np.float32(np.nan))


def meshes_from_cue(folder: Path, names: Iterable[str] = MESHES) -> dict[str, LinkMesh]:
    """Those of ``meshes/static.glb`` and ``meshes/moving.glb`` that are there, with collision parts.

    A heap of pieces becomes the one surface round them all, which has a volume and hence a mass; an open surface stays
    as it is and only its collision parts are closed.

    Raises:
        TaaError: a file is not a mesh.
    """
    from reconstruct.geometry.given import bounded_solid, nearest_colours

    links = {}
    for name in names:
        vertices, faces, colours = read_mesh(folder / name)
        solid = bounded_solid(vertices, faces)
        if solid.pieces > 1 and not solid.wrapped:
            colours = nearest_colours(solid.vertices, vertices, colours)
            vertices, faces = solid.vertices, solid.faces
        links[Path(name).stem] = LinkMesh(vertices, faces, colours, np.zeros(len(faces), bool), solid.parts)
    return links


def scaled_link(link: LinkMesh, factor: float) -> LinkMesh:
    """The link with all lengths about the world's origin multiplied."""
    return replace(link, vertices=link.vertices * factor, parts=tuple((v * factor, f) for v, f in link.parts))


def moving_at_rest(link: LinkMesh, folder: CueFolder, fit: JointFit, unit: float = 1.0) -> LinkMesh:
    """The moving link at q = 0; it stands in its file as in ``reference_frame`` of ``meshes/frame.npz`` (else frame 0).

    Args:
        unit: of the file's world in the joint's lengths; a provider's own mesh is in the joint's.

    Raises:
        TaaError: there is no such frame.
    """
    if folder.users(MESHES[1]):
        link = scaled_link(link, unit) if unit != 1.0 else link
    if not folder.path("meshes/frame").is_file() or not folder.users(MESHES[1]):
        return link
    frame = folder.read("meshes/frame", "reference_frame")["reference_frame"]
    q = np.asarray(fit.q, float)
    if frame.ndim or not 0 <= int(frame) < len(q):
        raise TaaError(f"reference_frame of cues/meshes/frame.npz must be one of the {len(q)} frames")
    back = np.linalg.inv(fit.link_pose(q[int(frame)]))

    def moved(points: np.ndarray) -> np.ndarray:
        return points @ back[:3, :3].T + back[:3, 3]

    return replace(link, vertices=moved(link.vertices), parts=tuple((moved(v), f) for v, f in link.parts))


def read_mesh(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3), faces (F, 3) and colours (V, 4) uint8 of a binary glTF file; reads no other file.

    Raises:
        TaaError: it is not a mesh, or one of impossible size.
    """
    import trimesh

    try:
        if file.stat().st_size > MAX_MESH_BYTES:
            raise ValueError(f"larger than {MAX_MESH_BYTES >> 20} MiB")
        # From bytes: a mesh that names pictures or buffers in other files gets none of them.
        raw = io.BytesIO(file.read_bytes())
        mesh: Any = trimesh.load(raw, file_type="glb", force="mesh", process=False)
        visual = mesh.visual
        colours = np.asarray((visual.to_color() if visual.kind == "texture" else visual).vertex_colors, np.uint8)
        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    except Exception as error:  # trimesh raises whatever its readers raise
        raise TaaError(f"cannot read the mesh {file} ({str(error)[:80]}); export it as binary glTF") from error
    if not len(faces):
        raise TaaError(f"{file} holds no faces; export a surface")
    if len(faces) > MAX_FACES or faces.min() < 0 or faces.max() >= len(vertices):
        raise TaaError(f"{file} has more than {MAX_FACES} faces or faces without corners; export a smaller surface")
    if not (np.isfinite(vertices).all() and np.abs(vertices).max() < 1e6):
        raise TaaError(f"{file} has corners that are not finite or too far away; export it in metres")
    if not np.ptp(vertices[faces.ravel()], axis=0).min() > 0:
        raise TaaError(f"{file} is flat; export a surface with a thickness")
    if colours.shape != (len(vertices), 4):
        colours = np.tile(np.uint8([160, 160, 160, 255]), (len(vertices), 1))
    return vertices, faces, colours


def focal_of(camera: Arrays) -> float:
    """Focal length in full px of ``camera.npz``: the mean of both axes in the first frame."""
    focal = float(np.diag(_first_K(camera))[:2].mean())
    if not 1.0 <= focal <= 1e6:
        raise TaaError(f"K of cues/camera.npz has a focal length of {focal:.4g} px; give pixels of the full-size frame")
    return focal


def _first_K(camera: Arrays) -> np.ndarray:
    K = camera["K"]
    return numbers(K, (3, 3) if K.ndim == 2 else (None, 3, 3), "K of cues/camera.npz", finite=True).reshape(-1, 3, 3)[0]


def in_world_of(fit: JointFit, camera: Arrays) -> JointFit:
    """The same joint in the world in which the user's camera (its first frame) stands."""
    T = camera["T_world_camera"]
    shape = (4, 4) if T.ndim == 2 else (None, 4, 4)
    T_world_camera = poses(T, shape, "T_world_camera of cues/camera.npz").reshape(-1, 4, 4)[0]
    T_new_old = T_world_camera @ np.asarray(fit.T_camera_world, float)
    R, t = T_new_old[:3, :3], T_new_old[:3, 3]
    return replace(
        fit,
        axis=R @ fit.axis,
        point=None if fit.point is None else R @ fit.point + t,
        points=None if fit.points is None else fit.points @ R.T + t,
        T_camera_world=np.linalg.inv(T_world_camera),
        std=placed_std(fit.std, R, 1.0, False),
    )


def save_facts(scene: Path, video: Video) -> None:
    """``scene.json``: which video the cues belong to and how its frames were chosen."""
    facts = {
        "video": video.path.name,
        "sha256": video.sha256,
        "size": list(video.size),
        "work_size": [video.frames.shape[2], video.frames.shape[1]],
        "decoded": video.decoded,
        "index": video.index.tolist(),
        "focal_px": video.focal_px,
    }
    scene.mkdir(parents=True, exist_ok=True)
    with written_whole(scene / "scene.json") as partial:
        partial.write_text(json.dumps(facts), encoding="utf-8")


def video_of_cues(scene: Path) -> Video:
    """A video without pixels (they read as black): sizes, times and frame numbers of a scene folder.

    Without ``scene.json`` the times are those of ``frames.npz`` (else 30 a second) and the size is that of
    the masks, or twice the principal point of ``camera.npz``.

    Raises:
        TaaError: the size is nowhere to be found, or the times do not fit the tracks.
    """
    folder = CueFolder(scene)
    count = expect_shape(folder.read("tracks", "uv")["uv"], (None, None, 2), "uv of cues/tracks.npz").shape[1]
    if count < 2:
        raise TaaError(f"{folder.folder}/tracks.npz holds {count} frames; tracks need at least two")
    time = np.arange(count) / 30.0
    if (folder.folder / "frames.npz").is_file():
        time = numbers(folder.read("frames", "time")["time"], (count,), "time of cues/frames.npz", finite=True)
        if not (np.diff(time) > 0).all():
            raise TaaError("time of cues/frames.npz does not increase; give the time of every frame, s")
    try:
        facts = json.loads((scene / "scene.json").read_text(encoding="utf-8"))
        width, height = facts["size"]
        size, index = (int(width), int(height)), np.asarray(facts["index"], int)
        name, sha, decoded = str(facts["video"]), str(facts["sha256"]), int(facts["decoded"])
        focal = None if facts["focal_px"] is None else float(facts["focal_px"])
    except FileNotFoundError:
        size, index = _size_of_cues(folder), np.arange(count)
        name, sha, decoded, focal = "cues", "", count, None
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise TaaError(f"{scene}/scene.json cannot be used ({str(error)[:80]}); remove it") from None
    if not (MIN_SIDE <= min(size) and max(size) <= MAX_SIDE):
        raise TaaError(f"a picture of {size[0]} x {size[1]} px is not possible; mend scene.json, masks or camera")
    if focal is not None and not 1.0 <= focal <= 1e6:
        raise TaaError(f"{scene}/scene.json has a focal length of {focal:.4g} px; remove it")
    if index.shape != (count,):
        raise TaaError(f"{scene}/scene.json has {index.size} frames, cues/tracks.npz {count}; remove scene.json")
    scale = min(1.0, WORK_LONG_SIDE / max(size))
    black = np.broadcast_to(np.uint8(0), (count, round(size[1] * scale), round(size[0] * scale), 3))
    return Video(Path(name), sha, (int(size[0]), int(size[1])), time, index, decoded, black, scale, focal)


def _size_of_cues(folder: CueFolder) -> tuple[int, int]:
    if (folder.folder / "masks.npz").is_file():
        masks = expect_shape(folder.read("masks", "moving")["moving"], (None, None, None), "moving of cues/masks.npz")
        return masks.shape[2], masks.shape[1]
    if (folder.folder / "camera.npz").is_file():
        K = _first_K(folder.read("camera", "K"))
        return round(2 * K[0, 2] + 1), round(2 * K[1, 2] + 1)
    raise TaaError(f"the picture's size is unknown; put masks.npz or camera.npz into {folder.folder}")


def camera_arrays(fit: JointFit, frames: int) -> dict[str, np.ndarray]:
    """``camera.npz`` of a fitted joint: the stabilised view's one camera, repeated."""
    pose = np.linalg.inv(np.asarray(fit.T_camera_world, float))
    return {
        "K": np.asarray(fit.K, float),
        "T_world_camera": np.tile(pose, (frames, 1, 1)),
        "metric": np.array(fit.metric),
    }


def hand_arrays(reference: HandReference, hands: Hands) -> dict[str, np.ndarray]:
    """``hand.npz`` of an aligned hand; joints_uv are the detector's, NaN where it saw none."""
    T = len(reference.time)
    uv = next((t.uv for t in hands.tracks if t.side == reference.side), np.full((T, 21, 2), np.nan))
    return {"joints_world": reference.hand_joints, "joints_uv": uv, "valid": reference.hand_valid,
            "side": np.array(reference.side)}  # fmt: skip


def mask_arrays(masks: LinkMasks) -> dict[str, np.ndarray]:
    """``masks.npz``."""
    return {"static": masks.static, "moving": masks.moving, "hand": masks.hand}


def track_arrays(tracks: Tracks) -> dict[str, np.ndarray]:
    """``tracks.npz``."""
    more = {"slip": tracks.slip, "shade": tracks.shade, "cast": tracks.cast}
    return {"uv": tracks.uv, "visible": tracks.visible, **{k: v for k, v in more.items() if v is not None}}

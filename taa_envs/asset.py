"""The asset folder: what it holds, reading it with suspicion, writing it atomically.

An asset is data from strangers: :func:`load_asset` follows no link, unpickles nothing, bounds what it reads and
checks shapes and names before anything else in the package sees them.
"""

from __future__ import annotations

import json
import math
import os
import re
import stat
import zipfile
from dataclasses import dataclass, field, fields
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree import ElementTree

import numpy as np

from taa_envs.errors import AssetError, AssetExists, TaaEnvsError

__all__ = ["ID_PATTERN", "ORIGINS", "SCHEMA", "Asset", "AssetError", "AssetExists", "Reference", "TaaEnvsError",
           "check_id", "demonstration", "load_asset", "read_metadata", "save_asset"]

SCHEMA = "taa-asset/1"
ID_PATTERN = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")
ORIGINS = ("observed", "fitted", "assumed", "given")
JOINT_TYPES = ("revolute", "prismatic")

MAX_JSON_BYTES = 8 << 20
MAX_XML_BYTES = 16 << 20
MAX_FILE_BYTES = 256 << 20
MAX_ARRAY_BYTES = 256 << 20
MAX_FILES = 4096
MAX_FRAMES = 200_000


@dataclass(frozen=True)
class Reference:
    """The demonstration, as ``reference.npz`` holds it (asset frame, metres).

    Attributes:
        time: (T,) s, increasing.  q: (T,) joint state, rad or m.
        hand_joints: (T, 21, 3) landmarks (0 wrist, 4/8/12/16/20 finger tips).
        hand_valid: (T,) bool, False where the hand was filled in.
        contact: (T,) bool, the frames in which the hand drives the part.
    """

    time: np.ndarray
    q: np.ndarray
    hand_joints: np.ndarray
    hand_valid: np.ndarray
    contact: np.ndarray

    @classmethod
    def from_arrays(cls, source: object) -> Reference:
        """Copy of anything with the five fields (attributes or keys), checked.

        Raises:
            AssetError: an array is missing, of a wrong shape, or not finite.
        """
        values = {}
        for f in fields(cls):
            try:
                raw = source[f.name] if isinstance(source, dict) else getattr(source, f.name)
            except (KeyError, AttributeError):
                raise AssetError(f"reference has no array {f.name!r}; write all of time, q, hand_joints, hand_valid, "
                                 "contact") from None
            kind = bool if f.name in ("hand_valid", "contact") else float
            try:
                values[f.name] = np.array(raw, dtype=kind)
            except (TypeError, ValueError) as error:
                raise AssetError(f"reference array {f.name!r} does not hold numbers ({error})") from None
        n = values["time"].shape[0] if values["time"].ndim == 1 else -1
        if not 2 <= n <= MAX_FRAMES:
            raise AssetError(f"reference needs 2 to {MAX_FRAMES} frames, time has shape {values['time'].shape}")
        for name, value in values.items():
            shape = (n, 21, 3) if name == "hand_joints" else (n,)
            if value.shape != shape:
                raise AssetError(f"reference array {name!r} has shape {value.shape}, expected {shape}")
            if not np.isfinite(value).all():
                raise AssetError(f"reference array {name!r} is not finite; fill gaps and mark them in hand_valid")
        if not (np.diff(values["time"]) > 0).all():
            raise AssetError("reference time does not increase; sort the frames and drop doubles")
        return cls(**values)


def demonstration(q: np.ndarray) -> dict:
    """Start, end and range of the demonstration's main stroke.

    A demonstration that ends where it was farthest from its start ends at its last frame. One that comes back
    (its last state is less than half as far from the start as its farthest) is cut where it first reaches 98 % of
    its farthest state: what follows is another stroke.

    Args:
        q: (T,) joint state.

    Returns:
        q_start, q_demo_end, q_min, q_max (of the frames up to the end) and demo_end_frame.

    Raises:
        AssetError: the joint does not move.
    """
    away = np.abs(q - q[0])
    farthest = float(away.max())
    if not farthest > 1e-6:
        raise AssetError("the reference joint does not move; an asset needs a demonstration that moves it")
    end = len(q) - 1 if away[-1] >= 0.5 * farthest else int(np.argmax(away >= 0.98 * farthest))
    return {"q_start": float(q[0]), "q_demo_end": float(q[end]), "demo_end_frame": end,
            "q_min": float(q[:end + 1].min()), "q_max": float(q[:end + 1].max())}


@dataclass(frozen=True)
class Asset:
    """One articulated object with the demonstration that made it.

    Attributes:
        id: name under which it is registered as ``TAA/<id>``.
        path: its folder.  schema: format version.
        joint: the joint result of the contract (type, axis, point, q, std ...).
        provenance: name -> {"value", "unit"?, "origin", "std"?} for every number.
        demo: see :func:`demonstration`.
        reference: the demonstration's arrays.
        camera: {"K", "T_camera_world", "width", "height"} in full px, or None.
        metadata: all of ``asset.json`` (source, providers, mujoco_version, notes ...).
    """

    id: str
    path: Path
    schema: str
    joint: dict
    provenance: dict
    demo: dict
    reference: Reference
    camera: dict | None = None
    metadata: dict = field(default_factory=dict)

    @property
    def model_path(self) -> Path:
        return self.path / "model.xml"

    @property
    def joint_type(self) -> str:
        return self.joint["type"]

    @property
    def unit(self) -> str:
        return "m" if self.joint_type == "prismatic" else "rad"

    @property
    def end_time(self) -> float:
        """Reference time at which the demonstration's main stroke ends, s."""
        return float(self.reference.time[self.demo["demo_end_frame"]])

    def progress(self, q: np.ndarray | float) -> np.ndarray:
        """``clip((q - q_start) / (q_demo_end - q_start), 0, 1)``, shape of q."""
        return np.clip(self.stroke_fraction(q), 0.0, 1.0)

    def stroke_fraction(self, q: np.ndarray | float) -> np.ndarray:
        """Unclipped progress: negative where the joint moved against the demonstration."""
        return (np.asarray(q, float) - self.demo["q_start"]) / (self.demo["q_demo_end"] - self.demo["q_start"])

    def final_q_error(self, q: float) -> float:
        """``|q - q_demo_end| / (max q_demo - min q_demo)``."""
        return abs(float(q) - self.demo["q_demo_end"]) / (self.demo["q_max"] - self.demo["q_min"])


def check_id(asset_id: object) -> str:
    """The id itself if it is one.

    Raises:
        AssetError: it does not match ``[a-z0-9][a-z0-9_-]{0,63}``.
    """
    if not isinstance(asset_id, str) or not ID_PATTERN.fullmatch(asset_id):
        raise AssetError(f"id {str(asset_id)[:80]!r} is not valid; use 1 to 64 of a-z 0-9 _ -, beginning with a letter "
                         "or a digit")
    return asset_id


def _regular_files(folder: Path) -> dict[str, Path]:
    """Relative posix name -> path of every file below folder; refuses links and special files."""
    if folder.is_symlink():
        raise AssetError(f"{folder} is a symbolic link; name the folder itself")
    if not folder.is_dir():
        raise AssetError(f"{folder} is not a folder")
    found: dict[str, Path] = {}
    for root, dirs, files in os.walk(folder, followlinks=False):
        for name in (*dirs, *files):
            path = Path(root) / name
            mode = path.lstat().st_mode
            if stat.S_ISDIR(mode):
                continue
            relative = path.relative_to(folder).as_posix()
            if not stat.S_ISREG(mode):
                raise AssetError(f"{relative} in {folder} is a link or a special file; replace it by a plain file")
            if path.lstat().st_size > MAX_FILE_BYTES:
                raise AssetError(f"{relative} in {folder} is larger than {MAX_FILE_BYTES >> 20} MiB")
            found[relative] = path
            if len(found) > MAX_FILES:
                raise AssetError(f"{folder} holds more than {MAX_FILES} files")
    return found


def _finite_numbers(value: object) -> bool:
    if isinstance(value, bool) or value is None:
        return True
    if isinstance(value, (int, float)):
        return math.isfinite(value)
    if isinstance(value, dict):
        return all(_finite_numbers(v) for v in value.values())
    if isinstance(value, list):
        return all(_finite_numbers(v) for v in value)
    return True


def _vector(value: object, shape: tuple[int, ...], what: str) -> np.ndarray:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise AssetError(f"{what} does not hold numbers") from None
    if array.shape != shape or not np.isfinite(array).all():
        raise AssetError(f"{what} must be {shape} finite numbers, has shape {array.shape}")
    return array


def read_metadata(folder: Path) -> dict:
    """``asset.json`` of a folder, checked, without touching model or arrays.

    Raises:
        AssetError: what is wrong with it.
    """
    path = Path(folder) / "asset.json"
    if Path(folder).is_symlink() or path.is_symlink() or not path.is_file():
        raise AssetError(f"{folder} has no plain file asset.json")
    if path.stat().st_size > MAX_JSON_BYTES:
        raise AssetError(f"{path} is larger than {MAX_JSON_BYTES >> 20} MiB")
    try:
        data = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise AssetError(f"{path} is not JSON ({str(error)[:80]})") from None
    if not isinstance(data, dict):
        raise AssetError(f"{path} does not hold an object")
    if data.get("schema") != SCHEMA:
        raise AssetError(f"{path} has schema {str(data.get('schema'))[:40]!r}; this version reads {SCHEMA!r}")
    check_id(data.get("id"))
    if data["id"] != Path(folder).resolve().name:
        raise AssetError(f"{path} has id {data['id']!r}, which is not its folder's name")
    if not _finite_numbers(data):
        raise AssetError(f"{path} holds a number that is not finite; write null where a number is unknown")
    for key in ("joint", "provenance", "demo"):
        if not isinstance(data.get(key), dict):
            raise AssetError(f"{path} has no object {key!r}")
    _check_joint(data["joint"])
    _check_provenance(data["provenance"])
    _check_demo(data["demo"])
    if data.get("camera") is not None:
        _check_camera(data["camera"])
    return data


def _check_joint(joint: dict) -> None:
    if joint.get("type") not in JOINT_TYPES:
        raise AssetError(f"joint type {str(joint.get('type'))[:40]!r} is not simulated; known: "
                         + ", ".join(JOINT_TYPES))
    axis = _vector(joint.get("axis"), (3,), "joint axis")
    if abs(np.linalg.norm(axis) - 1) > 1e-3:
        raise AssetError(f"joint axis has length {np.linalg.norm(axis):.4g}; normalise it")
    if joint["type"] == "revolute":
        _vector(joint.get("point"), (3,), "joint point")


def _check_provenance(provenance: dict) -> None:
    for name, entry in provenance.items():
        if not isinstance(entry, dict) or "value" not in entry or entry.get("origin") not in ORIGINS:
            raise AssetError(f"provenance of {str(name)[:60]!r} needs value and origin, one of {', '.join(ORIGINS)}")
        std = entry.get("std")
        if std is not None and not isinstance(std, list) and not (isinstance(std, (int, float)) and std >= 0):
            raise AssetError(f"provenance of {str(name)[:60]!r} has a std that is not a number >= 0")


def _check_demo(demo: dict) -> None:
    for key in ("q_start", "q_demo_end", "q_min", "q_max", "duration"):
        if not isinstance(demo.get(key), (int, float)) or isinstance(demo[key], bool):
            raise AssetError(f"demo has no number {key!r}")
    if not isinstance(demo.get("demo_end_frame"), int) or demo["demo_end_frame"] < 1:
        raise AssetError("demo_end_frame must be a frame after the first")
    if not abs(demo["q_demo_end"] - demo["q_start"]) > 1e-6 or not demo["q_max"] > demo["q_min"]:
        raise AssetError("the demonstration does not move the joint")
    if not 0 < demo["duration"] <= 3600:
        raise AssetError("demo duration must lie between 0 and 3600 s")


def _check_camera(camera: object) -> None:
    if not isinstance(camera, dict):
        raise AssetError("camera must be an object with K, T_camera_world, width, height")
    _vector(camera.get("K"), (3, 3), "camera K")
    _vector(camera.get("T_camera_world"), (4, 4), "camera T_camera_world")
    for key in ("width", "height"):
        if not isinstance(camera.get(key), int) or not 1 <= camera[key] <= 32768:
            raise AssetError(f"camera {key} must be a whole number of pixels")


def _read_reference(path: Path) -> Reference:
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(info.file_size for info in archive.infolist()) > MAX_ARRAY_BYTES:
                raise AssetError(f"{path} unpacks to more than {MAX_ARRAY_BYTES >> 20} MiB")
        with np.load(path, allow_pickle=False) as arrays:
            names = {f.name for f in fields(Reference)}
            return Reference.from_arrays({name: arrays[name] for name in names & set(arrays.files)})
    except (zipfile.BadZipFile, ValueError, OSError, EOFError) as error:
        raise AssetError(f"{path} is not an archive of plain arrays ({str(error)[:80]})") from None


def _inside(name: str) -> bool:
    pure = PurePosixPath(name)
    return not (pure.is_absolute() or ".." in pure.parts or "\\" in name or ":" in name or "\0" in name)


def _check_xml(path: Path, files: dict[str, Path]) -> None:
    """Only references to plain files inside the folder, nothing that loads code or other XML."""
    if path.stat().st_size > MAX_XML_BYTES:
        raise AssetError(f"{path} is larger than {MAX_XML_BYTES >> 20} MiB")
    raw = path.read_bytes()
    if b"<!" in re.sub(rb"<!--.*?-->", b"", raw, flags=re.DOTALL):
        raise AssetError(f"{path} has a document type or an entity; plain MJCF needs neither")
    try:
        root = ElementTree.fromstring(raw)
    except ElementTree.ParseError as error:
        raise AssetError(f"{path} is not XML ({error})") from None
    for element in root.iter():
        if element.tag in ("include", "plugin", "extension", "attach", "model"):
            raise AssetError(f"{path} uses <{element.tag}>; an asset's model is one self-contained file")
        for key in ("meshdir", "texturedir", "assetdir"):
            if not _inside(element.get(key, "")):
                raise AssetError(f"{path}: {key} leaves the folder")
        for key, value in element.attrib.items():
            if key.startswith("file") and value:
                if not _inside(value):
                    raise AssetError(f"{path} names {value[:80]!r}, which leaves the folder")
                if not any(name == value or name.endswith("/" + value) for name in files):
                    raise AssetError(f"{path} names {value[:80]!r}, which is not in the folder")


def _check_model(path: Path, joint: dict) -> None:
    import mujoco

    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise AssetError(f"{path} does not load in MuJoCo {mujoco.__version__}: {str(error)[:200]}") from None
    bodies = {model.body(i).name for i in range(model.nbody)}
    if not {"static", "moving"} <= bodies:
        raise AssetError(f"{path} has bodies {sorted(bodies - {'world'})}; it needs static and moving")
    if model.nu or model.neq or model.nv != 1 or model.njnt != 1 or model.joint(0).name != "joint":
        raise AssetError(f"{path} must have one joint named 'joint', no actuator and no equality")
    kind = {int(mujoco.mjtJoint.mjJNT_HINGE): "revolute", int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic"}
    if kind.get(int(model.jnt_type[0])) != joint["type"]:
        raise AssetError(f"{path}: the joint's type is not asset.json's {joint['type']!r}")
    if int(model.jnt_bodyid[0]) != model.body("moving").id:
        raise AssetError(f"{path}: the joint does not belong to the body 'moving'")


def load_asset(path: str | os.PathLike, *, check_model: bool = True) -> Asset:
    """Read and validate an asset folder.

    Args:
        path: the folder.
        check_model: also compile ``model.xml`` (tens of ms); the scene builder compiles it anyway.

    Raises:
        AssetError: what is wrong with the folder.
    """
    folder = Path(path)
    files = _regular_files(folder)
    for name in ("asset.json", "model.xml", "reference.npz"):
        if name not in files:
            raise AssetError(f"{folder} has no {name}")
    data = read_metadata(folder)
    reference = _read_reference(files["reference.npz"])
    if data["demo"]["demo_end_frame"] >= len(reference.time):
        raise AssetError(f"{folder}: demo_end_frame lies after the reference's last frame")
    _check_xml(files["model.xml"], files)
    if check_model:
        _check_model(files["model.xml"], data["joint"])
    return Asset(id=data["id"], path=folder, schema=data["schema"], joint=data["joint"],
                 provenance=data["provenance"], demo=data["demo"], reference=reference, camera=data.get("camera"),
                 metadata=data)


def save_asset(root: str | os.PathLike, asset_id: str, **kwargs: Any) -> Asset:
    """Write ``root/<asset_id>/`` atomically; see :func:`taa_envs.authoring.save_asset` for the arguments."""
    from taa_envs.authoring import save_asset as write

    return write(root, asset_id, **kwargs)

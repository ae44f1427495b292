"""The asset folder: what it holds, reading it with suspicion, writing it atomically.

An asset is data from strangers: :func:`load_asset` follows no link, unpickles nothing, bounds what it reads and
checks shapes and names before anything else in the package sees them.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from taa_envs.arrays import ArrayFileError, read_npz
from taa_envs.checks import (
    ID_PATTERN,
    JOINT_TYPES,
    MAX_LENGTH,
    ORIGINS,
    SCHEMA,
    check_compiled,
    check_id,
    check_xml,
    further_joints,
    numbered,
    read_metadata,
)
from taa_envs.errors import AssetError, AssetExists, TaaEnvsError

__all__ = ["ID_PATTERN", "JOINT_TYPES", "ORIGINS", "SCHEMA", "Asset", "AssetError", "AssetExists", "Reference",
           "TaaEnvsError", "check_id", "demonstration", "load_asset", "read_metadata", "save_asset"]

MAX_FILE_BYTES = 256 << 20
MAX_ARRAY_BYTES = 256 << 20
MAX_FILES = 4096
MAX_DEPTH = 8  # folders below folders
MAX_FRAMES = 200_000
ARRAYS = ("time", "q", "hand_joints", "hand_valid", "contact")
"""Of ``reference.npz``; an object with further joints has their states beside them, ``q_2`` and so on."""


@dataclass(frozen=True)
class Reference:
    """The demonstration, as ``reference.npz`` holds it (asset frame, metres).

    Attributes:
        time: (T,) s, increasing.  q: (T,) joint state, rad or m.
        hand_joints: (T, 21, 3) landmarks (0 wrist, 4/8/12/16/20 finger tips).
        hand_valid: (T,) bool, False where the hand was filled in.
        contact: (T,) bool, the frames in which the hand drives the part.
        further: (T,) states of ``joint_2``, ``joint_3`` ...; empty for an object with one joint.
    """

    time: np.ndarray
    q: np.ndarray
    hand_joints: np.ndarray
    hand_valid: np.ndarray
    contact: np.ndarray
    further: tuple[np.ndarray, ...] = ()

    @classmethod
    def from_arrays(cls, source: object, further: Sequence[np.ndarray] = ()) -> Reference:
        """Copy of anything with the five arrays (attributes or keys), checked, and of the further joints' states.

        Raises:
            AssetError: an array is missing, of a wrong shape, or not finite.
        """
        raw = {numbered("q", k): array for k, array in enumerate(further, 2)}
        for name in ARRAYS:
            try:
                raw[name] = source[name] if isinstance(source, dict) else getattr(source, name)
            except (KeyError, AttributeError):
                raise AssetError(f"reference has no array {name!r}; write all of {', '.join(ARRAYS)}") from None
        values = {}
        for name, array in raw.items():
            try:
                values[name] = np.array(array, dtype=bool if name in ("hand_valid", "contact") else float)
            except (TypeError, ValueError) as error:
                raise AssetError(f"reference array {name!r} does not hold numbers ({error})") from None
        n = values["time"].shape[0] if values["time"].ndim == 1 else -1
        if not 2 <= n <= MAX_FRAMES:
            raise AssetError(f"reference needs 2 to {MAX_FRAMES} frames, time has shape {values['time'].shape}")
        for name, value in values.items():
            shape = (n, 21, 3) if name == "hand_joints" else (n,)
            if value.shape != shape:
                raise AssetError(f"reference array {name!r} has shape {value.shape}, expected {shape}")
            if not np.isfinite(value).all():
                raise AssetError(f"reference array {name!r} is not finite; fill gaps and mark them in hand_valid")
            if np.abs(value).max() > MAX_LENGTH:
                raise AssetError(f"reference array {name!r} holds numbers beyond {MAX_LENGTH:g}; give s, rad and m")
        if not (np.diff(values["time"]) > 0).all():
            raise AssetError("reference time does not increase; sort the frames and drop doubles")
        return cls(*(values[name] for name in ARRAYS),
                   further=tuple(values[numbered("q", k + 2)] for k in range(len(further))))

    def arrays(self) -> dict[str, np.ndarray]:
        """Name -> array, as ``reference.npz`` names them."""
        return {**{name: getattr(self, name) for name in ARRAYS},
                **{numbered("q", k): q for k, q in enumerate(self.further, 2)}}


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
        further: the joints ``joint_2``, ``joint_3`` ... of an object with several moving links, like ``joint``.
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
    further: tuple[dict, ...] = ()

    @property
    def model_path(self) -> Path:
        return self.path / "model.xml"

    @property
    def joint_type(self) -> str:
        return self.joint["type"]

    @property
    def pitch(self) -> float:
        """Of a screw, m that the link advances in a radian; 0 for a hinge or a slide."""
        return float(self.joint["pitch"]) if self.joint_type == "screw" else 0.0

    @property
    def links(self) -> tuple[str, ...]:
        """Bodies that move, the one of the task's joint first."""
        return tuple(numbered("moving", k + 1) for k in range(1 + len(self.further)))

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


def _regular_files(folder: Path) -> dict[str, Path]:
    """Relative posix name -> path of every file below folder; refuses links and special files."""
    if folder.is_symlink():
        raise AssetError(f"{folder} is a symbolic link; name the folder itself")
    if not folder.is_dir():
        raise AssetError(f"{folder} is not a folder")
    found: dict[str, Path] = {}
    for root, dirs, files in os.walk(folder, followlinks=False):
        if len(Path(root).relative_to(folder).parts) > MAX_DEPTH:
            raise AssetError(f"{folder} holds folders more than {MAX_DEPTH} deep")
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


def _read_reference(path: Path, further: int) -> Reference:
    more = [numbered("q", k + 2) for k in range(further)]
    try:
        arrays = read_npz(path, [*ARRAYS, *more], MAX_ARRAY_BYTES)
        if missing := [name for name in more if name not in arrays]:
            raise AssetError(f"{path} has no array {missing[0]!r}, the states of asset.json's further joint")
        return Reference.from_arrays(arrays, [arrays[name] for name in more])
    except ArrayFileError as error:
        raise AssetError(str(error)) from None
    except OSError as error:
        raise AssetError(f"{path} cannot be read ({error.strerror})") from None


def _check_model(path: Path, joint: dict, further: Sequence[dict]) -> None:
    import mujoco

    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, MemoryError, mujoco.FatalError, mujoco.UnexpectedError) as error:
        raise AssetError(f"{path} does not load in MuJoCo {mujoco.__version__}: {' '.join(str(error).split())[:200]}"
                         ) from None
    check_compiled(model, path, joint, further)


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
    further = further_joints(data)
    reference = _read_reference(files["reference.npz"], len(further))
    if data["demo"]["demo_end_frame"] >= len(reference.time):
        raise AssetError(f"{folder}: demo_end_frame lies after the reference's last frame")
    check_xml(files["model.xml"], files)
    if check_model:
        _check_model(files["model.xml"], data["joint"], further)
    return Asset(id=data["id"], path=folder, schema=data["schema"], joint=data["joint"],
                 provenance=data["provenance"], demo=data["demo"], reference=reference, camera=data.get("camera"),
                 metadata=data, further=tuple(further))


def save_asset(root: str | os.PathLike, asset_id: str, **kwargs: Any) -> Asset:
    """Write ``root/<asset_id>/`` atomically; see :func:`taa_envs.authoring.save_asset` for the arguments."""
    from taa_envs.authoring import save_asset as write

    return write(root, asset_id, **kwargs)

"""What an asset from a stranger may hold: the checks of ``asset.json`` and ``model.xml`` before anything uses them.

The model is MJCF, and MuJoCo's compiler does what MJCF says: it opens the files that are named, loads plugins, and
makes as many bodies, pixels or bytes as a number asks for. So only elements that describe one object are let through,
their numbers are bounded, and files must be plain meshes and pictures of the folder.
"""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree import ElementTree

import numpy as np

from taa_envs.errors import AssetError

ID_PATTERN = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")
ORIGINS = ("observed", "fitted", "assumed", "given")
JOINT_TYPES = ("revolute", "prismatic", "screw")
MAX_LINKS = 9  # moving ones of one object

SCHEMA = "taa-asset/1"
MAX_JSON_BYTES = 8 << 20
MAX_JSON_DEPTH = 32
MAX_TEXT = 20_000  # characters of one string
MAX_XML_BYTES = 16 << 20
MAX_ELEMENTS = 20_000
MAX_XML_DEPTH = 64  # MuJoCo's own reader goes down by recursion
MAX_MESH_BYTES = 128 << 20  # of all files that the model names
MAX_PICTURE_SIDE = 8192
MAX_LENGTH = 1e4  # m, of any coordinate
MAX_MASS = 1e6  # kg

SECTIONS = frozenset("mujoco compiler option flag visual global quality headlight map scale rgba statistic default "
                     "asset worldbody contact equality actuator sensor custom".split())
ASSETS = frozenset("mesh texture material layer".split())
TREE = frozenset("body inertial joint geom site camera light pair exclude numeric text".split())
# A passive joint may carry passive actuators (nu stays 0); whatever has a control is refused after compiling.
ACTUATORS = frozenset("general motor position velocity intvelocity damper dcmotor".split())
SENSORS = frozenset("jointpos jointvel jointlimitpos jointlimitvel jointlimitfrc framepos framequat framelinvel "
                    "frameangvel contact touch force torque".split())
ELEMENTS = SECTIONS | ASSETS | TREE | ACTUATORS | SENSORS
FILES = (".obj", ".stl", ".msh", ".png")
BOUNDS = {"nsample": 1000, "width": 4096, "height": 4096, "nchannel": 4, "resolution": 32768, "iterations": 1000,
          "ls_iterations": 1000, "noslip_iterations": 1000, "ccd_iterations": 1000, "sdf_iterations": 1000,
          "sdf_initpoints": 1000, "shadowsize": 16384, "offsamples": 64, "numslices": 256, "numstacks": 256,
          "numquads": 256, "offwidth": 16384, "offheight": 16384, "maxhullvert": 100_000, "size": MAX_LENGTH}
"""Attribute -> largest number it may hold: what MuJoCo or a renderer allocates or repeats by it."""


def numbered(name: str, link: int) -> str:
    """What belongs to a moving link, counted from 1: ``joint``, ``joint_2``, ``joint_3`` ..."""
    return name if link == 1 else f"{name}_{link}"


def further_joints(data: Mapping) -> list[dict]:
    """``joint_2``, ``joint_3`` ... of an ``asset.json``, in order; empty for an object with one joint."""
    out: list[dict] = []
    while isinstance(data.get(numbered("joint", len(out) + 2)), dict) and len(out) + 1 < MAX_LINKS:
        out.append(data[numbered("joint", len(out) + 2)])
    return out


def check_id(asset_id: object) -> str:
    """The id itself if it is one.

    Raises:
        AssetError: it does not match ``[a-z0-9][a-z0-9_-]{0,63}``.
    """
    if not isinstance(asset_id, str) or not ID_PATTERN.fullmatch(asset_id):
        raise AssetError(f"id {str(asset_id)[:80]!r} is not valid; use 1 to 64 of a-z 0-9 _ -, beginning with a letter "
                         "or a digit")
    return asset_id


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
    data = parse_metadata(path.read_bytes(), str(path))
    if data["id"] != Path(folder).resolve().name:
        raise AssetError(f"{path} has id {data['id']!r}, which is not its folder's name")
    return data


def parse_metadata(raw: bytes, path: str) -> dict:
    """The object of an ``asset.json``, checked.

    Args:
        raw: the file's bytes.  path: what to call it.

    Raises:
        AssetError: what is wrong with it.
    """
    try:
        data = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise AssetError(f"{path} is not JSON ({str(error)[:80]})") from None
    if not isinstance(data, dict):
        raise AssetError(f"{path} does not hold an object")
    if data.get("schema") != SCHEMA:
        raise AssetError(f"{path} has schema {str(data.get('schema'))[:40]!r}; this version reads {SCHEMA!r}")
    _check_values(data, path)
    check_id(data.get("id"))
    for key in ("joint", "provenance", "demo"):
        if not isinstance(data.get(key), dict):
            raise AssetError(f"{path} has no object {key!r}")
    for joint in (data["joint"], *further_joints(data)):
        _check_joint(joint)
    _check_provenance(data["provenance"])
    _check_demo(data["demo"])
    if data.get("camera") is not None:
        _check_camera(data["camera"])
    _check_words(data, path)
    return data


def _check_values(data: dict, path: str) -> None:
    """Every number finite, every string printable, nothing nested deeply; by a loop, as depth is the stranger's."""
    level: list[Any] = [data]
    for _ in range(MAX_JSON_DEPTH):
        below: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                below += value.keys()
                below += value.values()
            elif isinstance(value, list):
                below += value
            elif isinstance(value, str):
                # Escape sequences would reach the terminal of `taa show`.
                if len(value) > MAX_TEXT or not all(c.isprintable() or c in "\n\t" for c in value):
                    raise AssetError(f"{path} holds a text that is too long or not printable: {value[:40]!r}")
            elif isinstance(value, (int, float)) and not abs(value) <= 1e300:  # whole numbers may exceed any float
                raise AssetError(f"{path} holds a number that is not finite; write null where a number is unknown")
        if not below:
            return
        level = below
    raise AssetError(f"{path} is nested more than {MAX_JSON_DEPTH} deep")


def _vector(value: object, shape: tuple[int, ...], what: str) -> np.ndarray:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise AssetError(f"{what} does not hold numbers") from None
    if array.shape != shape or not np.isfinite(array).all():
        raise AssetError(f"{what} must be {shape} finite numbers, has shape {array.shape}")
    return array


def _check_joint(joint: dict) -> None:
    if joint.get("type") not in JOINT_TYPES:
        raise AssetError(f"joint type {str(joint.get('type'))[:40]!r} is not simulated; known: "
                         + ", ".join(JOINT_TYPES))
    axis = _vector(joint.get("axis"), (3,), "joint axis")
    if abs(np.linalg.norm(axis) - 1) > 1e-3:
        raise AssetError(f"joint axis has length {np.linalg.norm(axis):.4g}; normalise it")
    if joint["type"] != "prismatic":
        point = _vector(joint.get("point"), (3,), "joint point")
        if np.abs(point).max() > MAX_LENGTH:
            raise AssetError(f"joint point lies more than {MAX_LENGTH:g} m away")
    if joint["type"] == "screw" and not 0 < abs(float(_vector(joint.get("pitch"), (), "joint pitch"))) <= MAX_LENGTH:
        raise AssetError("a screw's pitch must be a number of m/rad other than 0")
    for key, kinds in _JOINT_KINDS.items():
        if joint.get(key) is not None and not (isinstance(joint[key], kinds) and _plain_members(joint[key])):
            raise AssetError(f"joint {key} must be {' or '.join(k.__name__ for k in kinds)} of numbers or null")


_JOINT_KINDS: Mapping[str, tuple[type, ...]] = {
    "verdict": (str,), "reason": (str,), "scale_source": (str,), "type_probability": (dict,), "std": (dict,),
    "q": (list,), "frames": (list,), "residual_px": (int, float), "inliers": (int,), "tracks": (int,),
    "metric": (bool,)}


def _plain_members(value: object) -> bool:
    """No list of anything but numbers and null; other members may be what they like."""
    return not isinstance(value, list) or all(v is None or isinstance(v, (int, float)) for v in value)


def _check_provenance(provenance: dict) -> None:
    for name, entry in provenance.items():
        if not isinstance(entry, dict) or "value" not in entry or entry.get("origin") not in ORIGINS:
            raise AssetError(f"provenance of {str(name)[:60]!r} needs value and origin, one of {', '.join(ORIGINS)}")
        std = entry.get("std")
        if std is not None and not isinstance(std, list) and not (isinstance(std, (int, float)) and std >= 0):
            raise AssetError(f"provenance of {str(name)[:60]!r} has a std that is not a number >= 0")
        for key in ("unit", "note"):
            if not isinstance(entry.get(key, ""), str):
                raise AssetError(f"provenance of {str(name)[:60]!r} has a {key} that is no text")


def _check_demo(demo: dict) -> None:
    for key in ("q_start", "q_demo_end", "q_min", "q_max", "duration"):
        if not isinstance(demo.get(key), (int, float)) or isinstance(demo[key], bool):
            raise AssetError(f"demo has no number {key!r}")
    end = demo.get("demo_end_frame")
    if not isinstance(end, int) or isinstance(end, bool) or end < 1:
        raise AssetError("demo_end_frame must be a frame after the first")
    if not abs(demo["q_demo_end"] - demo["q_start"]) > 1e-6 or not demo["q_max"] > demo["q_min"]:
        raise AssetError("the demonstration does not move the joint")
    if max(abs(demo[key]) for key in ("q_start", "q_demo_end", "q_min", "q_max")) > MAX_LENGTH:
        raise AssetError("the demonstration moves the joint farther than any mechanism does")
    if not 0 < demo["duration"] <= 3600:
        raise AssetError("demo duration must lie between 0 and 3600 s")


def _check_camera(camera: object) -> None:
    if not isinstance(camera, dict):
        raise AssetError("camera must be an object with K, T_camera_world, width, height")
    K = _vector(camera.get("K"), (3, 3), "camera K")
    if not (1e-3 < K[0, 0] < 1e7 and 1e-3 < K[1, 1] < 1e7 and np.abs(K).max() < 1e7):
        raise AssetError("camera K has no possible focal length")
    T = _vector(camera.get("T_camera_world"), (4, 4), "camera T_camera_world")
    R = T[:3, :3]
    if np.abs(T).max() > MAX_LENGTH or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise AssetError("camera T_camera_world is not a rotation and a shift")
    for key in ("width", "height"):
        if not isinstance(camera.get(key), int) or not 1 <= camera[key] <= 32768:
            raise AssetError(f"camera {key} must be a whole number of pixels")
    if max(camera["width"], camera["height"]) > 64 * min(camera["width"], camera["height"]):
        raise AssetError("camera has a picture of impossible shape")


def _check_words(data: dict, path: str) -> None:
    """The parts that are only shown to people."""
    notes, providers = data.get("notes") or [], data.get("providers") or []
    if not (isinstance(notes, list) and all(isinstance(n, str) for n in notes)):
        raise AssetError(f"{path}: notes must be a list of texts")
    if not (isinstance(providers, list) and all(isinstance(p, dict) and isinstance(p.get("name"), str)
                                                for p in providers)):
        raise AssetError(f"{path}: providers must be a list of objects with a name")
    if not isinstance(data.get("source") or {}, dict):
        raise AssetError(f"{path}: source must be an object")


def _inside(name: str) -> bool:
    pure = PurePosixPath(name)
    return not (pure.is_absolute() or ".." in pure.parts or "\\" in name or ":" in name or "\0" in name)


def check_xml(path: Path, files: Mapping[str, Path]) -> None:
    """Only what describes one object, bounded, and only references to plain files inside the folder.

    Args:
        path: of ``model.xml``.
        files: relative posix name -> path of every file of the asset's folder.

    Raises:
        AssetError: what is wrong with it.
    """
    if path.stat().st_size > MAX_XML_BYTES:
        raise AssetError(f"{path} is larger than {MAX_XML_BYTES >> 20} MiB")
    named = parse_model(path.read_bytes(), str(path), lambda value: [n for n in files if _is_called(n, value)])
    if sum(files[name].stat().st_size for name in named) > MAX_MESH_BYTES:
        raise AssetError(f"{path} names files of more than {MAX_MESH_BYTES >> 20} MiB together")
    for name in named:
        if name.endswith(".png"):
            _check_picture(files[name])


def _is_called(name: str, value: str) -> bool:
    return name == value or name.endswith("/" + value)


def parse_model(raw: bytes, path: str, find: Callable[[str], list[str]]) -> set[str]:
    """Names of the files that a ``model.xml`` names.

    Args:
        raw: the file's bytes.  path: what to call it.
        find: the folder's files that a name may mean.

    Raises:
        AssetError: see :func:`check_xml`.
    """
    if b"<!" in re.sub(rb"<!--.*?-->", b"", raw, flags=re.DOTALL) or b"\0" in raw:
        raise AssetError(f"{path} has a document type or an entity; plain MJCF needs neither")
    declared = re.match(rb"\s*<\?xml[^>]*encoding\s*=\s*[\"']([^\"']*)", raw)
    if declared and declared[1].lower() not in (b"utf-8", b"us-ascii", b"ascii"):  # MuJoCo reads UTF-8 whatever it says
        raise AssetError(f"{path} is not in UTF-8; write it anew in that encoding")
    _check_depth(raw, path)
    try:
        root = ElementTree.fromstring(raw)
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # the latter: an unknown encoding
        raise AssetError(f"{path} is not XML ({str(error)[:80]})") from None
    if root.tag != "mujoco":
        raise AssetError(f"{path} is not MJCF; its outermost element must be <mujoco>")
    named: set[str] = set()
    for element in root.iter():
        if element.tag not in ELEMENTS:
            raise AssetError(f"{path} uses <{element.tag[:40]}>; an asset's model is one self-contained file that "
                             "describes one object")
        named |= _check_attributes(element, path, find)
    return named


def _check_depth(raw: bytes, path: str) -> None:
    """Depth and number of elements, counted while parsing: a tree of a million levels is never built."""
    parser = ElementTree.XMLPullParser(("start", "end"))
    depth = count = 0
    try:
        for start in range(0, len(raw), 1 << 16):
            parser.feed(raw[start:start + (1 << 16)])
            for event, _ in parser.read_events():
                depth += 1 if event == "start" else -1
                count += event == "start"
                if depth > MAX_XML_DEPTH or count > MAX_ELEMENTS:
                    raise AssetError(f"{path} has more than {MAX_ELEMENTS} elements or {MAX_XML_DEPTH} levels")
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise AssetError(f"{path} is not XML ({str(error)[:80]})") from None


def _check_attributes(element: ElementTree.Element, path: str, find: Callable[[str], list[str]]) -> set[str]:
    named: set[str] = set()
    for key, value in element.attrib.items():
        if key in ("meshdir", "texturedir", "assetdir") and not _inside(value):
            raise AssetError(f"{path}: {key} leaves the folder")
        if key in ("plugin", "octree_maxdepth") or (key == "builtin" and element.tag == "mesh"):
            raise AssetError(f"{path}: <{element.tag}> uses {key}, which an asset must not")
        if key.startswith("file") and value:
            if not _inside(value):
                raise AssetError(f"{path} names {value[:80]!r}, which leaves the folder")
            found = find(value)
            if not found:
                raise AssetError(f"{path} names {value[:80]!r}, which is not in the folder")
            if not value.lower().endswith(FILES):
                raise AssetError(f"{path} names {value[:80]!r}; meshes and pictures are {', '.join(FILES)}")
            named |= set(found)
        elif key in BOUNDS:
            for word in value.split():
                if not _at_most(word, BOUNDS[key]):
                    raise AssetError(f"{path}: {key}={value[:40]!r} of <{element.tag}> is beyond {BOUNDS[key]:g}")
    return named


def _at_most(word: str, bound: float) -> bool:
    try:
        return abs(float(word)) <= bound
    except ValueError:
        return False


def _check_picture(path: Path) -> None:
    """A PNG's size by its header, before anybody unpacks it."""
    with path.open("rb") as f:
        head = f.read(24)
    if len(head) < 24 or head[:8] != b"\x89PNG\r\n\x1a\n" or head[12:16] != b"IHDR":
        raise AssetError(f"{path} is not a PNG picture")
    if max(struct.unpack(">II", head[16:24])) > MAX_PICTURE_SIDE:
        raise AssetError(f"{path} has more than {MAX_PICTURE_SIDE} pixels a side")


def check_compiled(model: Any, path: Path, joint: Mapping, further: Sequence[Mapping] = ()) -> None:
    """That a compiled model is an asset's: its bodies, their passive joints, finite numbers of a sane size.

    Args:
        joint: the joint of ``moving`` as ``asset.json`` has it.  further: those of ``moving_2`` and so on.

    Raises:
        AssetError: what is wrong with it.
    """
    bodies = {model.body(i).name for i in range(model.nbody)}
    wanted = ["static", *(numbered("moving", k + 1) for k in range(1 + len(further)))]
    if not set(wanted) <= bodies:
        raise AssetError(f"{path} has bodies {str(sorted(bodies - {'world'}))[:200]}; it needs {' and '.join(wanted)}")
    names = [model.joint(i).name for i in range(model.njnt)]
    screws = [k for k, j in enumerate((joint, *further), 1) if j["type"] == "screw"]
    expected = [n for k in range(1, 2 + len(further))
                for n in (numbered("joint", k), *([numbered("advance", k)] if k in screws else []))]
    if model.nu or names != expected or model.nv != len(names) or model.neq != len(screws):
        also = f" and {len(screws)} equality of a screw's turn and advance" if screws else " and no equality"
        raise AssetError(f"{path} must have {'one joint named' if len(expected) == 1 else 'the joints'} "
                         f"{', '.join(map(repr, expected))}, no actuator{also}")
    for k, one in enumerate((joint, *further), 1):
        _check_compiled_joint(model, path, k, one)
    for name, bound in (("body_pos", MAX_LENGTH), ("body_ipos", MAX_LENGTH), ("geom_pos", MAX_LENGTH),
                        ("geom_size", MAX_LENGTH), ("mesh_vert", MAX_LENGTH), ("jnt_pos", MAX_LENGTH),
                        ("jnt_range", MAX_LENGTH), ("body_mass", MAX_MASS), ("body_inertia", math.inf),
                        ("dof_damping", math.inf), ("dof_frictionloss", math.inf), ("dof_armature", math.inf)):
        values = getattr(model, name)
        if values.size and not (np.isfinite(values).all() and np.abs(values).max() <= bound):
            raise AssetError(f"{path}: {name} is not finite or beyond {bound:g}")


def _check_compiled_joint(model: Any, path: Path, link: int, joint: Mapping) -> None:
    """That the joint of a moving link is what ``asset.json`` says, and belongs to it."""
    import mujoco

    found = model.joint(numbered("joint", link))
    slide = int(model.jnt_type[found.id]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
    hinge = int(model.jnt_type[found.id]) == int(mujoco.mjtJoint.mjJNT_HINGE)
    if not (slide if joint["type"] == "prismatic" else hinge):
        raise AssetError(f"{path}: the type of {found.name} is not asset.json's {joint['type']!r}")
    body = model.body(numbered("moving", link))
    if int(model.jnt_bodyid[found.id]) != body.id:
        raise AssetError(f"{path}: {found.name} does not belong to the body {body.name!r}")
    if joint["type"] != "screw":
        return
    advance = model.joint(numbered("advance", link))
    ties = [e for e in range(model.neq) if (int(model.eq_obj1id[e]), int(model.eq_obj2id[e])) == (advance.id, found.id)]
    if int(model.jnt_type[advance.id]) != int(mujoco.mjtJoint.mjJNT_SLIDE) or len(ties) != 1 or (
            int(model.jnt_bodyid[advance.id]) != body.id
            or int(model.eq_type[ties[0]]) != int(mujoco.mjtEq.mjEQ_JOINT)):
        raise AssetError(f"{path}: {advance.name} must be a slide of {body.name!r} tied to {found.name} by an equality")
    if np.abs(model.eq_data[ties[0], :5] - [0.0, joint["pitch"], 0.0, 0.0, 0.0]).max() > 1e-4 * abs(joint["pitch"]):
        raise AssetError(f"{path}: {advance.name} does not advance by asset.json's pitch")

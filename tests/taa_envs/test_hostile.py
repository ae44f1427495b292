"""Assets, arrays and logs from strangers: read within bounds and without a look outside, or one error."""

from __future__ import annotations

import io
import json
import re
import shutil
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taa_envs import checks
from taa_envs.arrays import MAX_BYTES, ArrayFileError, read_npy, read_npz
from taa_envs.asset import Asset, AssetError, Reference, load_asset
from taa_envs.checks import SCHEMA, parse_metadata, parse_model
from taa_envs.cli_commands import read_joint_log
from taa_envs.errors import TaaEnvsError

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def copy(door: Asset, tmp_path: Path) -> Path:
    return Path(shutil.copytree(door.path, tmp_path / "door"))


def edit(folder: Path, **changes: object) -> None:
    path = folder / "asset.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


# --- asset.json ----------------------------------------------------------------------------------------------------

BASE = {
    "schema": SCHEMA,
    "id": "door",
    "provenance": {"a": {"value": 1, "origin": "given"}},
    "joint": {"type": "revolute", "axis": [0, 0, 1], "point": [0, 0, 0]},
    "demo": {"q_start": 0, "q_demo_end": 1, "q_min": 0, "q_max": 1, "duration": 2, "demo_end_frame": 5},
}


def nested(depth: int) -> str:
    return json.dumps(BASE)[:-1] + ', "notes": ' + "[" * depth + "]" * depth + "}"


@pytest.mark.parametrize(
    "raw, words",
    [
        (nested(40), "nested"),
        (nested(400), "nested"),
        (nested(900), "nested|JSON"),
        (nested(100_000), "JSON"),
        (json.dumps({**BASE, "x": 10**400}), "finite"),
        (json.dumps({**BASE, "x": float("inf")}), "finite"),
        (json.dumps({**BASE, "notes": ["\x1b[2J\x1b]0;owned\x07"]}), "printable"),
        (json.dumps({**BASE, "notes": "one text"}), "notes"),
        (json.dumps({**BASE, "notes": [3]}), "notes"),
        (json.dumps({**BASE, "providers": ["x"]}), "providers"),
        (json.dumps({**BASE, "source": [1]}), "source"),
        (json.dumps({**BASE, "joint": {**BASE["joint"], "verdict": ["ok"]}}), "verdict"),
        (json.dumps({**BASE, "joint": {**BASE["joint"], "q": ["a"]}}), "joint q"),
        (json.dumps({**BASE, "joint": {**BASE["joint"], "std": 3}}), "joint std"),
        (json.dumps({**BASE, "joint": {**BASE["joint"], "axis": [0, 0, 10**400]}}), "finite"),
        (json.dumps({**BASE, "joint": {**BASE["joint"], "point": [0, 0, 1e9]}}), "away"),
        (json.dumps({**BASE, "demo": {**BASE["demo"], "demo_end_frame": True}}), "demo_end_frame"),
        (json.dumps({**BASE, "demo": {**BASE["demo"], "q_demo_end": 1e200, "q_max": 1e200}}), "farther"),
        (json.dumps({**BASE, "provenance": {"a": {"value": 1, "origin": "given", "unit": 3}}}), "unit"),
        (
            json.dumps(
                {
                    **BASE,
                    "camera": {
                        "K": np.zeros((3, 3)).tolist(),
                        "T_camera_world": np.eye(4).tolist(),
                        "width": 640,
                        "height": 480,
                    },
                }
            ),
            "focal",
        ),
        (
            json.dumps(
                {
                    **BASE,
                    "camera": {
                        "K": np.diag([500, 500, 1]).tolist(),
                        "T_camera_world": np.ones((4, 4)).tolist(),
                        "width": 640,
                        "height": 480,
                    },
                }
            ),
            "rotation",
        ),
        ('{"schema": "taa-asset/1", "id": ' + "1" * 5000 + "}", "JSON"),
        ("\ud800".encode("utf-8", "surrogatepass"), "JSON"),
    ],
    ids=str,
)
def test_metadata_of_a_stranger(raw: str | bytes, words: str) -> None:
    with pytest.raises(AssetError, match=words):
        parse_metadata(raw if isinstance(raw, bytes) else raw.encode(), "asset.json")


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
)


@settings(max_examples=300, deadline=None)
@given(
    st.sampled_from(sorted(BASE) + ["camera", "notes", "providers", "source"]),
    json_values,
    st.sampled_from([None, "type", "axis", "q", "std", "a", "q_start", "duration", "K"]),
)
def test_any_value_in_metadata_is_taken_or_refused(key: str, value: object, inner: str | None) -> None:
    document = json.loads(json.dumps(BASE))
    if inner is not None and isinstance(document.get(key), dict):
        document[key][inner] = value
    else:
        document[key] = value
    try:
        parse_metadata(json.dumps(document).encode(), "asset.json")
    except AssetError as error:
        assert "\n" not in str(error) and len(str(error)) < 400


# --- model.xml -----------------------------------------------------------------------------------------------------


def deep(levels: int) -> str:
    return "<mujoco><worldbody>" + "<body>" * levels + "</body>" * levels + "</worldbody></mujoco>"


@pytest.mark.parametrize(
    "xml, words",
    [
        (deep(100), "levels"),
        (deep(200_000), "levels"),
        ("<mujoco><worldbody>" + "<geom/>" * 30_000 + "</worldbody></mujoco>", "elements"),
        ('<!DOCTYPE m [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]><mujoco>&b;</mujoco>', "entity"),
        ('<!-- --><!DOCTYPE m SYSTEM "file:///etc/passwd"><mujoco/>', "document type"),
        ("<mujoco><![CDATA[<include/>]]></mujoco>", "document type"),
        (
            '<mujoco><worldbody><replicate count="1000000000"><geom size="1"/></replicate></worldbody></mujoco>',
            "replicate",
        ),
        (
            '<mujoco><worldbody><body><composite type="grid" count="9999 9999 1"/></body></worldbody></mujoco>',
            "composite",
        ),
        ('<mujoco><worldbody><flexcomp name="f" count="999 999 999"/></worldbody></mujoco>', "flexcomp"),
        ('<mujoco><asset><hfield name="h" nrow="100000" ncol="100000"/></asset></mujoco>', "hfield"),
        ('<mujoco><size memory="1000G"/></mujoco>', "size"),
        ('<mujoco><asset><mesh file="moving.obj" plugin="p"/></asset></mujoco>', "plugin"),
        ('<mujoco><asset><model file="moving.obj"/></asset></mujoco>', "model"),
        ('<mujoco><worldbody><attach model="m"/></worldbody></mujoco>', "attach"),
        ('<mujoco><asset><mesh name="s" builtin="sphere" params="30"/></asset></mujoco>', "builtin"),
        (
            '<mujoco><asset><texture name="t" builtin="flat" width="1000000" height="1000000"/></asset></mujoco>',
            "width",
        ),
        ('<mujoco><option iterations="1000000000"/></mujoco>', "iterations"),
        ('<mujoco><visual><quality numslices="100000"/></visual></mujoco>', "numslices"),
        ('<mujoco><visual><quality shadowsize="nan"/></visual></mujoco>', "shadowsize"),
        ('<mujoco><asset><mesh file="moving.obj/../../x.obj"/></asset></mujoco>', "leaves"),
        ('<mujoco><asset><mesh file="file://moving.obj"/></asset></mujoco>', "leaves"),
        ('<mujoco><asset><mesh file="C:\\moving.obj"/></asset></mujoco>', "leaves"),
        ('<mujoco><compiler meshdir="/etc"/></mujoco>', "leaves"),
        ('<mujoco><asset><mesh file="asset.json"/></asset></mujoco>', "meshes and pictures"),
        ('<?xml version="1.0" encoding="utf-7"?><mujoco/>', "UTF-8"),
        ("<html><body/></html>", "MJCF"),
        ("<mujoco/>\0<include/>", "entity"),
        ("", "XML"),
        ("<mujoco>" * 3, "XML"),
    ],
    ids=lambda v: str(v)[:40],
)
def test_model_of_a_stranger(xml: str, words: str) -> None:
    with pytest.raises(AssetError, match=words):
        parse_model(xml.encode(), "model.xml", lambda name: [name] if name in ("moving.obj", "asset.json") else [])


@settings(max_examples=300, deadline=None)
@given(
    st.sampled_from(sorted(checks.ELEMENTS) + ["include", "plugin", "replicate", "frame", "skin"]),
    st.sampled_from(["file", "fileright", "name", "meshdir", "width", "nsample", "iterations", "pos"]),
    st.text(st.characters(blacklist_categories=("Cs", "Cc"), blacklist_characters='<>&"'), max_size=30),
)
def test_no_name_of_a_file_leads_outside(tag: str, key: str, value: str) -> None:
    try:
        named = parse_model(f'<mujoco><{tag} {key}="{value}"/></mujoco>'.encode(), "model.xml", lambda name: [name])
    except AssetError:
        return
    inside = Path("/somewhere/asset").resolve()
    assert all((inside / name).resolve().is_relative_to(inside) for name in named)


@pytest.mark.parametrize(
    "old, new, words",
    [
        ('pos="0 -0.01 0.3"', 'pos="nan 0 0"', "finite|NaN|nan"),
        ('mass="2.4006"', 'mass="1e300"', "body_mass|load"),
        ('range="0 1.05"', 'range="0 1e300"', "jnt_range|load"),
        ("</worldbody>", "<body/></worldbody>" * 2, "XML|load"),
    ],
)
def test_absurd_numbers_in_a_model(copy: Path, old: str, new: str, words: str) -> None:
    text = (copy / "model.xml").read_text()
    assert old in text
    (copy / "model.xml").write_text(text.replace(old, new, 1))
    with pytest.raises(AssetError, match=words):
        load_asset(copy)


@pytest.mark.parametrize(
    "raw",
    [
        b"",
        b"f 1 2 3\n",
        b"v 1e400 0 0\n" * 4 + b"f 1 2 3\n",
        b"v nan nan nan\n" * 4 + b"f 1 2 3\n",
        b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 99999999\n",
        b"\0" * 1000,
        b"v " + b"1" * 5000,
    ],
)
def test_broken_meshes(copy: Path, raw: bytes) -> None:
    (copy / "meshes" / "moving_part0.obj").write_bytes(raw)
    with pytest.raises(AssetError):
        load_asset(copy)


def png(width: int, height: int) -> bytes:
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))


@pytest.mark.parametrize(
    "raw, words",
    [
        (png(100_000, 100_000), "pixels a side"),
        (b"GIF89a" + bytes(30), "not a PNG"),
        (png(8, 8), "load"),
        (b"", "not a PNG"),
    ],
)
def test_pictures_of_a_stranger(copy: Path, raw: bytes, words: str) -> None:
    (copy / "meshes" / "moving.png").write_bytes(raw)
    with pytest.raises(AssetError, match=words):
        load_asset(copy)


def test_files_that_are_too_large_or_too_deep(copy: Path) -> None:
    with (copy / "meshes" / "moving.obj").open("ab") as f:
        f.truncate(checks.MAX_MESH_BYTES + 1)
    with pytest.raises(AssetError, match="MiB"):
        load_asset(copy)
    (copy / "meshes" / "moving.obj").unlink()
    (copy / Path(*"abcdefghijkl")).mkdir(parents=True)
    with pytest.raises(AssetError, match="deep"):
        load_asset(copy)


def test_a_folder_that_is_a_link_and_a_pipe_inside(copy: Path, tmp_path: Path) -> None:
    import os

    (tmp_path / "window").symlink_to(copy)
    with pytest.raises(AssetError, match="symbolic link"):
        load_asset(tmp_path / "window")
    os.mkfifo(copy / "preview.png")
    with pytest.raises(AssetError, match="special file"):
        load_asset(copy)


WATCHED = """
import sys
from pathlib import Path
from taa_envs.asset import load_asset
load_asset(sys.argv[2])  # whatever is imported late is there now
folder, outside = Path(sys.argv[1]).resolve(), []
def watch(event, arguments):
    if event == "open" and isinstance(arguments[0], (str, bytes)):
        path = Path(arguments[0] if isinstance(arguments[0], str) else arguments[0].decode()).resolve()
        if not path.is_relative_to(folder) or (arguments[2] or 0) & 3:
            outside.append(f"open {path} {arguments[2]}")
    elif event.split(".")[0] in ("socket", "subprocess", "os", "pickle", "shutil", "exec", "import"):
        if event not in ("os.listdir", "os.scandir", "os.walk", "os.fwalk"):
            outside.append(event)
sys.addaudithook(watch)
try:
    load_asset(folder)
    print("loaded", end=" ")
except Exception as error:
    print(type(error).__name__, end=" ")
print(outside)
"""


@pytest.mark.parametrize("case", ["whole", "pickle", "html", "model"])
def test_loading_opens_nothing_outside_and_runs_nothing(door: Asset, copy: Path, case: str) -> None:
    if case == "pickle":
        np.savez(copy / "reference.npz", time=np.array([print], dtype=object), q=np.zeros(3))
    elif case == "html":
        edit(copy, notes=["<script>fetch('http://127.0.0.1:9/')</script>"])
    elif case == "model":
        text = (copy / "model.xml").read_text()
        (copy / "model.xml").write_text(text.replace("<worldbody>", '<include file="/etc/hostname"/><worldbody>'))
    done = subprocess.run(
        [sys.executable, "-c", WATCHED, str(copy), str(door.path)], cwd=ROOT, capture_output=True, text=True
    )
    expected = "loaded" if case in ("whole", "html") else "AssetError"
    assert done.stdout.strip() == f"{expected} []", done.stdout + done.stderr


# --- arrays --------------------------------------------------------------------------------------------------------


def npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def forged(header: str, body: bytes = b"") -> bytes:
    text = header.encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body


def archive(path: Path, raw: bytes, name: str = "uv.npy", how: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", how) as z:
        z.writestr(name, raw)
    return path


@pytest.mark.parametrize(
    "raw",
    [
        forged("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }"),
        forged("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }"),
        forged("{'descr': '<f8', 'fortran_order': False, 'shape': (" + "2," * 40 + "), }"),
        forged("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }", b"\x80\x04N."),
        forged("{'descr': '<M8[s]', 'fortran_order': False, 'shape': (1,), }", bytes(8)),
        forged("{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,), }", bytes(8)),
        forged("(" * 900),
        forged("-" * 900 + "1"),
        forged("__import__('os').system('true')"),
        forged("{'descr': '<U1', 'fortran_order': False, 'shape': (1,), }", b"\xff\xff\xff\xff"),
        b"\x93NUMPY\x09\x09",
        b"\x93NUMPY\x01\x00\xff\xff",
        b"\x80\x04N.",
        b"",
        npy(np.ones(5))[:-3],
        npy(np.ones(5)) + b"x",
    ],
)
def test_forged_arrays(tmp_path: Path, raw: bytes) -> None:
    (tmp_path / "a.npy").write_bytes(raw)
    with pytest.raises(ArrayFileError):
        read_npy(tmp_path / "a.npy")
    with pytest.raises(ArrayFileError):
        read_npz(archive(tmp_path / "a.npz", raw))


def test_broken_archives(tmp_path: Path) -> None:
    whole = archive(tmp_path / "a.npz", npy(np.arange(1000.0))).read_bytes()
    for cut in (0, 4, 30, len(whole) // 2, len(whole) - 5):
        (tmp_path / "b.npz").write_bytes(whole[:cut])
        with pytest.raises(ArrayFileError):
            read_npz(tmp_path / "b.npz")
    middle = bytearray(whole)
    middle[60:90] = bytes(30)  # zlib.error or a bad checksum
    (tmp_path / "b.npz").write_bytes(middle)
    with pytest.raises(ArrayFileError, match="plain arrays"):
        read_npz(tmp_path / "b.npz")
    displaced = bytearray(whole)
    at = displaced.index(b"PK\x05\x06") + 16
    displaced[at : at + 4] = b"\xff\xff\xff\xff"  # the fuzzer's: an offset before the file's beginning
    (tmp_path / "b.npz").write_bytes(displaced)
    with pytest.raises(ArrayFileError):
        read_npz(tmp_path / "b.npz")
    locked = bytearray(whole)
    for signature in (b"PK\x03\x04", b"PK\x01\x02"):
        at = locked.index(signature) + (6 if signature == b"PK\x03\x04" else 8)
        locked[at] |= 1  # encrypted
    (tmp_path / "b.npz").write_bytes(locked)
    with pytest.raises(ArrayFileError):
        read_npz(tmp_path / "b.npz")
    with zipfile.ZipFile(tmp_path / "many.npz", "w") as z:
        for i in range(300):
            z.writestr(f"{i}.npy", npy(np.zeros(1)))
    with pytest.raises(ArrayFileError, match="300 arrays"):
        read_npz(tmp_path / "many.npz")


def test_bombs_are_not_unpacked(tmp_path: Path) -> None:
    archive(tmp_path / "bomb.npz", npy(np.zeros((MAX_BYTES >> 3) + 1)))
    assert (tmp_path / "bomb.npz").stat().st_size < 1 << 20
    with pytest.raises(ArrayFileError, match="MiB"):
        read_npz(tmp_path / "bomb.npz")


plain = st.sampled_from(["f8", "f4", "i4", "u1", "?", ">f8", "U4", "S3"])


@settings(max_examples=100, deadline=None)
@given(plain, st.lists(st.integers(0, 4), max_size=4), st.booleans())
def test_plain_arrays_come_back_as_numpy_reads_them(kind: str, shape: list[int], by_columns: bool) -> None:
    import tempfile

    array = np.array(np.arange(int(np.prod(shape))).reshape(shape) % 2, order="F" if by_columns else "C").astype(kind)
    with tempfile.TemporaryDirectory() as folder:
        np.savez_compressed(Path(folder) / "a.npz", x=array, y=array)
        mine = read_npz(Path(folder) / "a.npz", ["x"])
        np.save(Path(folder) / "a.npy", array)
        assert list(mine) == ["x"] and mine["x"].dtype.kind == array.dtype.kind
        for got in (mine["x"], read_npy(Path(folder) / "a.npy")):
            np.testing.assert_array_equal(got, array)
            assert got.flags.writeable and got.flags.c_contiguous


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=300))
def test_any_bytes_are_an_array_or_one_error(raw: bytes) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        for content in (raw, b"\x93NUMPY\x01\x00" + raw, npy(np.ones(4))[: len(raw)] + raw):
            (Path(folder) / "a.npy").write_bytes(content)
            try:
                read_npy(Path(folder) / "a.npy")
            except ArrayFileError as error:
                assert "\n" not in str(error)


@settings(max_examples=200, deadline=None)
@given(
    st.dictionaries(
        st.sampled_from(["time", "q", "hand_joints", "hand_valid", "contact"]),
        st.sampled_from(
            [
                np.zeros(5),
                np.arange(5.0),
                np.full(5, np.nan),
                np.zeros((5, 21, 3)),
                np.array("x"),
                np.full(5, 1e300),
                np.ones(5, bool),
                np.zeros(0),
                np.array([None] * 5, object),
            ]
        ),
    )
)
def test_any_reference_is_checked(arrays: dict) -> None:
    try:
        made = Reference.from_arrays(arrays)
    except AssetError:
        return
    assert made.hand_joints.shape == (len(made.time), 21, 3) and np.isfinite(made.q).all()


# --- logs ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "raw",
    [
        b"",
        b"\xff\xfe\x00",
        b"time,q\n" + b"1" * 200_000 + b",2\n",
        b'time,q\n"unclosed',
        b"time,q\n1\n",
        b"time,q\n,\n",
        b"q,q\n1,1\n",
        b"time,q\n\0,1\n",
    ],
)
def test_joint_logs_to_score(tmp_path: Path, raw: bytes) -> None:
    (tmp_path / "log.csv").write_bytes(raw)
    with pytest.raises(TaaEnvsError):
        read_joint_log(tmp_path / "log.csv")


def test_html_in_every_name_stays_text(door: Asset, copy: Path) -> None:
    """What a stranger writes into asset.json never becomes markup where the package shows it as HTML."""
    from jinja2 import Environment, FileSystemLoader

    hostile = "<img src=x onerror=alert(1)>"
    folder = ROOT / "reconstruct" / "report"
    for page in folder.glob("*.html"):
        # Everything unescaped on purpose must be our own: plots, film bytes and code.
        raw = set(re.findall(r"\{\{\s*([\w.]+)[^}]*\|\s*safe", page.read_text()))
        assert raw <= {"plot", "script", "packed"}, f"{page.name} does not escape {raw}"
    text = Environment(autoescape=True, loader=FileSystemLoader(folder)).from_string("{{ x }}").render(x=hostile)
    assert "<img" not in text

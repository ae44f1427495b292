"""The interactive viewer: both links, the joint's axis, and the demonstrated hand through time, in a browser."""

from __future__ import annotations

import io
import threading
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import numpy as np

from taa_envs.asset import Asset
from taa_envs.checks import numbered
from taa_envs.scene import follow_screws

if TYPE_CHECKING:
    import mujoco
    import viser

BONES = ((0, 1), (1, 2), (2, 3), (3, 4), (0, 5), (5, 6), (6, 7), (7, 8), (5, 9), (9, 10), (10, 11), (11, 12), (9, 13),
         (13, 14), (14, 15), (15, 16), (13, 17), (17, 18), (18, 19), (19, 20), (0, 17))  # fmt: skip

FRAME_RATE = 25.0
"""Frames a second while it plays."""


@dataclass(frozen=True)
class Viewer:
    """A viewer that runs.

    Attributes:
        url: where a browser on this machine finds it.
        end: tells the thread that plays to leave.  server: of the page.
    """

    url: str
    end: threading.Event
    player: threading.Thread
    server: viser.ViserServer

    def stop(self) -> None:
        """End the player, then the server."""
        self.end.set()
        self.player.join()
        self.server.stop()


def serve(asset: Asset, port: int = 8080) -> Viewer:
    """Start the viewer of one asset in threads of its own, for browsers on this machine only.

    Args:
        asset: as loaded.
        port: to serve on; the next free one is taken where it is in use.

    Raises:
        ImportError: viser is not installed.
    """
    import mujoco
    import viser

    spec = mujoco.MjSpec.from_file(str(asset.model_path))
    model = spec.compile()
    data = mujoco.MjData(model)
    server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    server.scene.set_up_direction("+z")
    frames = {}
    for name in ("static", *asset.links):
        frames[name] = server.scene.add_frame(f"/{name}", show_axes=False)
    corners = []
    for geom in spec.geoms:
        if not geom.meshname or geom.contype:
            continue  # collision parts are inside what is shown
        mesh = _mesh(spec, geom, asset.path)
        corners.append(mesh.bounds)
        server.scene.add_mesh_trimesh(f"/{geom.parent.name}/{geom.name}", mesh)
    low, high = np.min(corners, axis=(0, 1)), np.max(corners, axis=(0, 1))
    centre, size = (low + high) / 2, float(np.linalg.norm(high - low))
    axis = np.asarray(asset.joint["axis"], float)
    middle = np.asarray(asset.joint["point"] if asset.joint.get("point") is not None else centre, float)
    middle = middle + ((centre - middle) @ axis) * axis
    ends = np.stack([middle - 0.5 * size * axis, middle + 0.5 * size * axis])
    server.scene.add_line_segments("/axis", ends[None], colors=(255, 59, 72), line_width=4.0)
    server.initial_camera.position = tuple(centre + size * np.array([0.4, -0.9, 0.5]))
    server.initial_camera.look_at = tuple(centre)

    reference = asset.reference
    time = server.gui.add_slider("time, s", float(reference.time[0]), float(reference.time[-1]), 0.01,
                                 float(reference.time[0]))  # fmt: skip
    play = server.gui.add_button("play")
    low, high = asset.demo["q_min"], asset.demo["q_max"]
    q = server.gui.add_slider(f"joint, {asset.unit}", low, high, (high - low) / 200, float(np.clip(0.0, low, high)))

    def pose() -> None:
        data.qpos[0] = q.value
        for k, states in enumerate(reference.further, 2):  # where the demonstration has them at that time
            here = model.joint(numbered("joint", k)).qposadr[0]
            data.qpos[here] = float(np.interp(time.value, reference.time, states))
        follow_screws(model, data.qpos)
        mujoco.mj_kinematics(model, data)
        for name, frame in frames.items():
            body = model.body(name).id
            frame.wxyz, frame.position = data.xquat[body].copy(), data.xpos[body].copy()

    def hand(row: int) -> None:
        joints = reference.hand_joints[row]
        seen = bool(reference.hand_valid[row])
        colour = (255, 150, 30) if reference.contact[row] else (200, 170, 140) if seen else (120, 120, 120)
        bones = np.stack([[joints[a], joints[b]] for a, b in BONES])
        server.scene.add_line_segments("/hand", bones, colors=colour, line_width=5.0)

    @q.on_update
    def _(_: object) -> None:
        pose()

    @time.on_update
    def _(_: object) -> None:
        row = int(np.abs(reference.time - time.value).argmin())
        q.value = float(np.clip(reference.q[row], low, high))
        pose()
        hand(row)

    playing, end = threading.Event(), threading.Event()

    def run() -> None:
        first, last = float(reference.time[0]), float(reference.time[-1])
        while not end.is_set():
            begin = monotonic()
            if playing.is_set():
                later = time.value + 1 / FRAME_RATE
                time.value = first if later > last else later  # its callback moves joint and hand
            end.wait(max(0.0, 1 / FRAME_RATE - (monotonic() - begin)))

    @play.on_click
    def _(_: object) -> None:
        (playing.clear if playing.is_set() else playing.set)()
        play.label = "pause" if playing.is_set() else "play"

    pose()
    hand(0)
    player = threading.Thread(target=run, daemon=True)
    player.start()
    return Viewer(f"http://localhost:{server.get_port()}", end, player, server)


def _mesh(spec: mujoco.MjSpec, geom: mujoco.MjsGeom, folder: Path) -> Any:
    """The mesh file of a visual geom, with its material's picture."""
    import trimesh
    from PIL import Image

    file = folder / spec.meshdir / spec.mesh(geom.meshname).file
    # From bytes: materials that a mesh names in other files are not looked for.
    mesh: Any = trimesh.load(io.BytesIO(file.read_bytes()), file_type=file.suffix[1:], force="mesh", process=False)
    material = spec.material(geom.material) if geom.material else None
    textures = [spec.texture(name).file for name in material.textures if name] if material is not None else []
    uv = getattr(mesh.visual, "uv", None)
    if textures and uv is not None:
        with Image.open(folder / spec.texturedir / textures[0]) as picture:
            paper = trimesh.visual.material.PBRMaterial(
                baseColorTexture=picture.convert("RGB"), metallicFactor=0.0, roughnessFactor=1.0
            )
        mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=paper)
    return mesh

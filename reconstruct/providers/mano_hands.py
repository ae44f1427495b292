"""Hands as MANO meshes by HaWoR (whole video) or WiLoR (frame by frame), each in its own environment.

Both are run by the released pipeline's scripts (``scripts/12_hawor_hands.py``, ``60_wilor_hands.py``) on a scene folder
that is written for them; they leave ``per_frame/<n>.npz`` in the camera's frame. The network's own distance is a guess
that depends on the focal length it was told; what is used is where the hand is in the picture, and its shape.

Sources: Zhang et al., HaWoR, CVPR 2025; Potamias et al., WiLoR, CVPR 2025.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reconstruct.errors import TaaError
from reconstruct.import_scene import hand_arrays
from reconstruct.providers.make import Made, Request
from reconstruct.providers.outside import pipeline_script, run_script, setting
from reconstruct.providers.released import ReleasedScene, ReleasedWriter


def hawor(request: Request) -> Made:
    """``hand.npz`` by HaWoR."""
    return _hand(request, "hawor", "scripts/12_hawor_hands.py", "--hawor-repo", ["--no-overlay"], "da3")


def wilor(request: Request) -> Made:
    """``hand.npz`` by WiLoR."""
    return _hand(request, "wilor", "60_wilor_hands.py", "--wilor-repo", [], "any4d")


def _hand(request: Request, name: str, script: str, option: str, more: list[str], geometry: str) -> Made:
    video, section = request.video, request.settings.section(name)
    camera = request.cue("camera", f"the hand provider {name}")
    scene = request.work / name / "scene"
    writer = ReleasedWriter(scene)
    writer.frames(video)
    writer.da3(video, camera["K"], camera["T_world_camera"])
    if geometry == "any4d":  # the older layout: the same files under other names
        (scene / "any4d" / "moge").mkdir(parents=True)
        (scene / "any4d" / "cameras.npz").write_bytes((scene / "da3" / "cameras.npz").read_bytes())
        (scene / "any4d" / "moge" / "intrinsics.npz").write_bytes((scene / "da3" / "intrinsics.npz").read_bytes())
    run_script(name, section, pipeline_script(name, request.settings, script),
               ["--scene-dir", scene, option, setting(section, name, "repository"), *more, "--overwrite"],
               request.work / name / "log.txt", [scene / name / "per_frame"], request.tell)  # fmt: skip
    found = ReleasedScene(scene).hand(name)
    if found is None or not found[0].detected.any():
        raise TaaError(f"{name} saw no hand in this video; choose --hand mediapipe")
    hand, w = found[0], video.frames.shape[2]  # the network was told the working focal length
    K = np.array(np.broadcast_to(np.asarray(camera["K"], float), (len(video), 3, 3)))
    hand = replace(hand, focal=hand.focal * video.size[0] / w)
    arrays = hand_arrays(hand, video.size, K, np.asarray(camera["T_world_camera"], float), False)
    return Made({"hand": arrays}, f"{name} through the released pipeline of track-articulate-act")

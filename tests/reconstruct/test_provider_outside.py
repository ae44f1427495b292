"""Models in environments of their own, played by stand-ins that honour the documented files; and what can go wrong."""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np
import pytest

from reconstruct import cues_io
from reconstruct.errors import TaaError
from reconstruct.providers.make import provide
from reconstruct.providers.outside import run_script
from reconstruct.synth import load_truth, render_clip, write_cues
from reconstruct.video import load_video
from tests.reconstruct import standins
from tests.reconstruct.joint_of_tracks import axis_error, joint_between
from tests.reconstruct.provider_scenes import small_request

FRAMES = 16


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    return load_truth(render_clip("oven", tmp_path_factory.mktemp("clips"), frames=FRAMES, size=(480, 270)))


@pytest.fixture(scope="module")
def clip(truth, tmp_path_factory):
    """The clip as the pipeline sees it, at half its size."""
    video = load_video(truth.video, tmp_path_factory.mktemp("frames"), long_side=240)
    assert len(video) == FRAMES
    return video


@pytest.fixture
def scene(truth, tmp_path):
    """True camera and depth, as if a provider had made them."""
    cues = write_cues(truth.video.parent, tmp_path / "scene")
    for name in ("tracks", "hand", "masks"):
        (cues / f"{name}.npz").unlink()
    return tmp_path / "scene"


def facts(truth) -> dict:
    return {"T_camera_world": truth.T_camera_world, "T_world_moving": truth.T_world_moving, "moving": truth.moving,
            "hand_joints": truth.hand_joints, "side": np.array(truth.side)}  # fmt: skip


@pytest.fixture
def trackcraft(truth, clip, scene, tmp_path):
    section = standins.environment(tmp_path, "trackcraft3r", "scripts/inference_user_video.py", standins.TRACKCRAFT,
                                   facts(truth))  # fmt: skip
    del section["pipeline"]
    return small_request(scene, {"trackcraft3r": section}, {"track": "trackcraft3r"}, clip), Path(section["repository"])


def hands(name, script, truth, clip, scene, tmp_path):
    text = standins.HANDS.replace("NAME", repr(name), 1)
    section = standins.environment(tmp_path, name, script, text, facts(truth))
    return small_request(scene, {name: section}, {"hand": name}, clip), Path(section["repository"])


def test_trackcraft_tracks_hold_the_simulators_joint(trackcraft, truth):
    request, _ = trackcraft
    provide("track", "tracks", request)
    cue = request.folder.read("tracks", "uv", "visible", "xyz_world")
    xyz, visible = cue["xyz_world"].astype(float), cue["visible"]
    assert xyz.shape == (*visible.shape, 3) and cue["uv"].shape == (*visible.shape, 2) and visible.shape[1] == FRAMES
    pairs = [(a, b) for a in range(FRAMES) for b in range(a + 1, FRAMES) if (visible[:, a] & visible[:, b]).sum() > 60]
    a, b = max(pairs, key=lambda p: p[1] - p[0])
    assert b - a > FRAMES // 2
    both = visible[:, a] & visible[:, b]
    moved = np.linalg.norm(xyz[:, b] - xyz[:, a], axis=1)
    part = both & (moved > 0.3 * moved[both].max())
    assert part.sum() >= 8
    kind, axis, point, _ = joint_between(xyz[part, a], xyz[part, b])
    turned, away = axis_error(axis, point, truth.axis, truth.point, truth.centroid)
    assert kind == truth.type and turned < 0.05 and away < 1e-4 * truth.diagonal
    n, t = np.argwhere(visible)[7]
    assert np.allclose(truth.project(xyz[n, t], t), cue["uv"][n, t], atol=0.6), "full px of the source video"
    tracks = cues_io.tracks_from_cue(cue, FRAMES, request.folder.maker("tracks"))
    assert tracks.provider.name == "trackcraft3r" and "weights.safetensors" in tracks.provider.version


@pytest.mark.parametrize(("name", "script"), [("hawor", "scripts/12_hawor_hands.py"), ("wilor", "60_wilor_hands.py")])
def test_hands_arrive_where_the_simulator_has_them(name, script, truth, clip, scene, tmp_path):
    request, _ = hands(name, script, truth, clip, scene, tmp_path)
    provide("hand", "hand", request)
    cue = request.folder.read("hand", *cues_io.HAND_ARRAYS)
    expected = np.stack([truth.project(truth.hand_joints[t], t) for t in range(FRAMES)])
    assert np.abs(cue["joints_uv"] - expected).max() < 0.8, "full px, whatever the size the network saw"
    assert str(cue["side"]) == truth.side and list(np.flatnonzero(~cue["valid"])) == [4, 9, 14], "filled in, not seen"
    assert cue["vertices"].shape == (FRAMES, 778, 3)
    maker = request.folder.maker("hand")
    assert maker.name == name and "non-commercial" in maker.licence
    got = cues_io.hands_from_cue(cue, request.folder.read("camera"), clip, np.zeros(clip.frames.shape[:3], bool), maker)
    shape = np.linalg.norm(got.tracks[0].metric[0, 9] - got.tracks[0].metric[0, 0])
    true = np.linalg.norm(truth.hand_joints[0, 9] - truth.hand_joints[0, 0])
    assert shape == pytest.approx(2.5 * true, rel=1e-3), "its size is the network's; the pipeline scales it"


def test_hands_need_a_camera(truth, clip, scene, tmp_path):
    request, _ = hands("hawor", "scripts/12_hawor_hands.py", truth, clip, scene, tmp_path)
    (scene / "cues" / "camera.npz").unlink()
    with pytest.raises(TaaError, match="hawor needs the cue camera.*--camera da3 or colmap"):
        provide("hand", "hand", request)


@pytest.mark.parametrize(
    ("mood", "words"),
    [
        ("fail", r"trackcraft3r failed with exit code 3 \(RuntimeError: CUDA error: no kernel image.*log"),
        ("nothing", r"ended without an error but wrote no dense\+1.npz"),
        ("shapes", r"track_map has shape \(11, 60, 104, 3\), expected \(12, height, width, 3\)"),
        ("broken", r"cannot read TrackCraft3R's output"),
        ("sleep", r"did not end within 2 s; set timeout of \[trackcraft3r\]"),
    ],
)
def test_what_goes_wrong_is_one_clear_line(trackcraft, mood, words):
    request, repository = trackcraft
    (repository / "mood").write_text(mood)
    limit = {"timeout": 2} if mood == "sleep" else {}
    sections = {"trackcraft3r": {**request.settings.section("trackcraft3r"), **limit}}
    request = replace(request, settings=replace(request.settings, sections=sections))
    with pytest.raises(TaaError, match=words) as error:
        provide("track", "tracks", request)
    assert "\n" not in str(error.value)
    assert not request.folder.path("tracks").exists(), "nothing half-made is left"
    log = request.work / "trackcraft3r" / "log+1.txt"
    assert "loading weights" in log.read_text() or mood == "sleep"


@pytest.mark.parametrize(
    ("mood", "words"),
    [("nothing", "wrote no per_frame"), ("shapes", r"joints have shape \(1, 20, 3\)"), ("fail", "exit code 3")],
)
def test_hand_networks_may_fail_too(mood, words, truth, clip, scene, tmp_path):
    request, repository = hands("hawor", "scripts/12_hawor_hands.py", truth, clip, scene, tmp_path)
    (repository / "mood").write_text(mood)
    with pytest.raises(TaaError, match=words):
        provide("hand", "hand", request)


def test_an_interpreter_that_cannot_start_and_one_that_leaves_children(tmp_path):
    script = tmp_path / "repository" / "run.py"
    script.parent.mkdir()
    script.write_text("")
    with pytest.raises(TaaError, match="cannot be started"):
        run_script("x", {"python": str(tmp_path / "none")}, script, [], tmp_path / "log.txt")
    with pytest.raises(TaaError, match=r"python of \[x\] is not set"):
        run_script("x", {}, script, [], tmp_path / "log.txt")
    mark = tmp_path / "alive"
    script.write_text(
        "import subprocess, sys, time\n"
        f"subprocess.Popen([sys.executable, '-c', \"import time; time.sleep(4); open({str(mark)!r}, 'w')\"])\n"
        "time.sleep(60)\n"
    )
    with pytest.raises(TaaError, match="did not end within"):
        run_script("x", {"python": sys.executable, "timeout": 1.5}, script, [], tmp_path / "log.txt")
    time.sleep(4)
    assert not mark.exists(), "what it started ends with it"


def test_the_other_environment_sees_nothing_of_this_one(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "/somewhere/of/ours")
    script = tmp_path / "repository" / "run.py"
    script.parent.mkdir()
    seen = tmp_path / "seen.json"
    script.write_text(
        f"import json, os, sys\njson.dump(['PYTHONPATH' in os.environ, sys.argv[1:]], open({str(seen)!r}, 'w'))\n"
    )
    run_script("x", {"python": sys.executable, "args": ["b c"]}, script, ["a"], tmp_path / "log.txt")
    assert json.loads(seen.read_text()) == [False, ["a", "b c"]]

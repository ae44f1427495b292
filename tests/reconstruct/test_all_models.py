"""The paper's flow with every model chosen by name, each played by a stand-in that keeps to its documented files."""

from __future__ import annotations

import json
import os
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np
import pytest

from reconstruct.providers import da3
from reconstruct.providers.released import camera_to_glb_pose
from reconstruct.synth import load_truth, render_clip
from reconstruct.video import load_video
from tests.reconstruct import standins
from tests.reconstruct.released_scenes import link_meshes

pytestmark = pytest.mark.slow
CHOSEN = {"camera": "da3", "depth": "da3", "track": "trackcraft3r", "hand": "hawor", "mesh": "sam3d",
          "labels": "segvigen"}  # fmt: skip
FRAMES = 40


@pytest.fixture
def truth(tmp_path):
    return load_truth(render_clip("oven", tmp_path / "clips", frames=FRAMES, size=(480, 270)))


@pytest.fixture
def models(truth, tmp_path, monkeypatch):
    """Stand-ins for all of them, and the settings that name them."""
    links = link_meshes(truth)
    facts = {"T_camera_world": truth.T_camera_world, "T_world_moving": truth.T_world_moving, "moving": truth.moving,
             "hand_joints": truth.hand_joints, "side": np.array(truth.side), "unit": np.array(1.3 * 1.7)}  # fmt: skip
    for name in ("static", "moving"):
        mesh = links[name].subdivide().subdivide()
        facts |= {f"{name}_v": np.asarray(mesh.vertices), f"{name}_f": np.asarray(mesh.faces)}
    scripts = {
        "trackcraft3r": ("scripts/inference_user_video.py", standins.TRACKCRAFT),
        "hawor": ("scripts/12_hawor_hands.py", standins.HANDS.replace("NAME", "'hawor'", 1)),
        "sam3d": ("scripts/03_sam3d_reconstruct.py", standins.SAM3D),
        "segvigen": ("scripts/05_segvigen_segment.py", standins.SEGVIGEN),
    }
    sections = {name: standins.environment(tmp_path / "models", name, *at, facts) for name, at in scripts.items()}
    sections["sam3d"]["checkpoint"] = "hf"
    repository = Path(sections["segvigen"]["repository"])
    (repository / "inference_full.py").touch()
    pose = np.eye(4)
    (Path(sections["sam3d"]["repository"]) / "pose.json").write_text(json.dumps(camera_to_glb_pose(pose)))
    (Path(sections["sam3d"]["repository"]) / "matrix.json").write_text(json.dumps(pose.tolist()))
    del sections["trackcraft3r"]["pipeline"]
    sections["da3"] = {"model": str(tmp_path / "models"), "device": "cpu", "process_res": 448}
    lines = [f"[{name}]\n" + "".join(f"{k} = {json.dumps(v)}\n" for k, v in s.items()) for name, s in sections.items()]
    (tmp_path / "taa.toml").write_text("\n".join(lines))
    monkeypatch.setenv("TAA_CONFIG", str(tmp_path / "taa.toml"))
    video = load_video(truth.video, tmp_path / "frames")
    standins.install_depth_anything(monkeypatch, truth, video, 1.7)  # 1.3 x 1.7 in its first run
    monkeypatch.setattr(da3, "_last", {})
    return sections


def test_a_video_becomes_an_environment_with_every_model(truth, models, tmp_path, capfd, monkeypatch):
    from taa_envs import cli

    command = ["reconstruct", str(truth.video), "--id", "all", "--scene", str(tmp_path / "scene"), "--out",
               str(tmp_path / "assets"), "--json"]  # fmt: skip
    for stage, name in CHOSEN.items():
        command += [f"--{stage}", name]
    code = cli.main(command)
    out, err = capfd.readouterr()
    assert code == 0, err
    result = json.loads(out)
    joint, asset = result["joint"], json.loads((tmp_path / "assets" / "all" / "asset.json").read_text())
    # In the first camera's frame, which both worlds share.
    axis = np.array(joint["T_camera_world"])[:3, :3] @ joint["axis"]
    true = truth.T_camera_world[0][:3, :3] @ truth.axis
    assert joint["type"] == truth.type and joint["verdict"] == "ok"
    assert np.degrees(np.arccos(min(1.0, abs(axis @ true)))) < 0.1
    assert np.ptp(joint["q"]) == pytest.approx(np.ptp(truth.q), rel=0.02)
    # Tracks of every fourth frame: the states between them are known as well as a hand's smoothness says.
    assert np.abs(np.abs(joint["q"]) - np.abs(truth.q)).max() < 0.06 * np.ptp(truth.q)
    assert np.max(joint["std"]["q"]) < 0.2 * np.ptp(truth.q)
    made = {(p.get("stage"), p["name"]) for p in asset["providers"]}
    assert {(s, n) for s, n in CHOSEN.items() if s != "labels"} <= made
    assert all(p["licence"] for p in asset["providers"])
    assert "SegviGen" in next(p["version"] for p in asset["providers"] if p["name"] == "sam3d")
    assert result["replay"]["joint_progress"] > 0.8 and max(result["replay"]["controls"].values()) < 0.05
    import gymnasium

    from taa_envs import register_assets

    monkeypatch.setenv("TAA_ASSETS", str(tmp_path / "assets"))
    register_assets()
    env = gymnasium.make("TAA/all")
    observation, _ = env.reset(seed=0)
    assert np.isfinite(observation).all()
    env.close()

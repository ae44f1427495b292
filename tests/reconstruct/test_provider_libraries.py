"""Libraries that no package index has, played by modules of their documented signatures that answer with a simulator's
truth in the library's own format: a wrong axis convention, scale or resolution shows as a wrong joint."""

from __future__ import annotations

import os
import sys
import types

os.environ.setdefault("MUJOCO_GL", "egl")

import cv2
import numpy as np
import pytest

from reconstruct import cues_io
from reconstruct.depth import sample_depth
from reconstruct.errors import TaaError
from reconstruct.import_scene import project
from reconstruct.providers import da3
from reconstruct.providers.make import provide
from reconstruct.synth import load_truth, render_clip
from reconstruct.synth.render import LINK_CODE
from reconstruct.video import load_video
from tests.reconstruct import standins
from tests.reconstruct.joint_of_tracks import axis_error, joint_between
from tests.reconstruct.provider_scenes import small_request

FRAMES, SCALE = 12, 1.7


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    return load_truth(render_clip("demo_handheld", tmp_path_factory.mktemp("clips"), frames=FRAMES, size=(480, 270)))


@pytest.fixture(scope="module")
def clip(truth, tmp_path_factory):
    return load_video(truth.video, tmp_path_factory.mktemp("frames"), long_side=240)


@pytest.fixture
def depth_anything(truth, clip, monkeypatch):
    """``depth_anything_3.api`` with the documented calls; its scale and world are its own in every run."""
    runs = standins.install_depth_anything(monkeypatch, truth, clip, SCALE)
    monkeypatch.setattr(da3, "_last", {})
    return runs


def joint_error(truth, cue_depth, camera):
    """The simulator's joint from tracks lifted by the cues, against the truth in units of the object's diagonal."""
    uv, visible = truth.tracks["uv"].astype(float), truth.tracks["visible"]
    z = sample_depth(cue_depth, uv, truth.size)
    K = np.broadcast_to(camera["K"], (len(truth.time), 3, 3))
    rays = np.einsum("tij,ntj->nti", np.linalg.inv(K), np.concatenate([uv, np.ones((*uv.shape[:2], 1))], -1))
    T = camera["T_world_camera"]
    xyz = np.einsum("tij,ntj->nti", T[:, :3, :3], rays * z[..., None]) + T[:, :3, 3]
    last = FRAMES - 1
    moving = (truth.tracks["link"] == LINK_CODE["moving"]) & visible[:, 0] & visible[:, last]
    moving &= np.isfinite(xyz[:, [0, last]]).all((1, 2))
    kind, axis, point, angle = joint_between(xyz[moving, 0], xyz[moving, last])
    # The cue's world to the simulator's: by the first camera, and the cue's unit.
    unit = float(np.nanmedian(z[moving, 0] / project(truth.tracks["xyz_world"].astype(float), np.broadcast_to(
        truth.K, K.shape), np.linalg.inv(truth.T_camera_world))[1][moving, 0]))  # fmt: skip
    S = T[0] @ np.diag([unit, unit, unit, 1.0]) @ truth.T_camera_world[0]
    R = S[:3, :3] / unit
    where, centre = (S[:3, :3] @ p + S[:3, 3] for p in (truth.point, truth.centroid))
    turned, away = axis_error(axis, point, R @ truth.axis, where, centre)
    return kind, turned, away / (unit * truth.diagonal), angle, unit


@pytest.mark.parametrize("size", [0, 7])
def test_da3_depth_and_camera_hold_the_simulators_joint(tmp_path, truth, clip, depth_anything, size):
    """In one run, and in overlapping runs each with its own scale and world."""
    section = {"model": "depth-anything/DA3-BASE", "device": "cpu", "process_res": 224, "batch": size}
    request = small_request(tmp_path, {"da3": section}, {"depth": "da3", "camera": "da3"}, clip)
    provide("camera", "camera", request)
    provide("depth", "depth", request)
    assert len(depth_anything) == (1 if not size else 2 + (FRAMES > 12)), "depth and camera come from the same runs"
    camera, depth = request.folder.read("camera"), request.folder.read("depth")
    assert camera["K"].shape == (FRAMES, 3, 3) and np.allclose(camera["K"], truth.K, rtol=2e-3, atol=0.6), "full px"
    assert camera["T_world_camera"].shape == (FRAMES, 4, 4) and not bool(depth["metric"])
    up = np.linalg.inv(camera["T_world_camera"][0])[:3, :3] @ [0, 0, 1]
    assert up[1] < -0.9
    kind, turned, away, angle, unit = joint_error(truth, depth["depth"], camera)
    assert kind == truth.type and turned < 0.05 and away < 1e-4
    assert angle == pytest.approx(abs(truth.q[-1]), rel=0.02) and unit == pytest.approx(SCALE * 1.3, rel=0.02)
    assert request.folder.maker("camera").licence == "Apache-2.0"


def test_da3_says_what_it_cannot_do(tmp_path, truth, clip, depth_anything):
    def request(model, chosen, folder="x", **more):
        section = {"da3": {"model": model, "device": "cpu", "process_res": 224, **more}}
        return small_request(tmp_path / folder, section, chosen, clip)

    with pytest.raises(TaaError, match="cannot load missing/DA3-BASE"):
        provide("depth", "depth", request("missing/DA3-BASE", {"depth": "da3"}))
    with pytest.raises(TaaError, match="DA3MONO-LARGE predicts no camera"):
        provide("camera", "camera", request("depth-anything/DA3MONO-LARGE", {"camera": "da3"}))
    with pytest.raises(TaaError, match="needs the focal length"):
        provide("depth", "depth", request("depth-anything/DA3METRIC-LARGE", {"depth": "da3"}))
    nested = request("depth-anything/DA3NESTED-GIANT-LARGE", {"depth": "da3"}, "nested")
    provide("depth", "depth", nested)
    assert bool(nested.folder.read("depth")["metric"]) and "non-commercial" in nested.folder.maker("depth").licence
    metric = request("depth-anything/DA3METRIC-LARGE", {"depth": "da3"}, "metric")
    metric.folder.put("camera", {"K": truth.K}, cues_io.GIVEN)
    provide("depth", "depth", metric)
    wide = metric.folder.read("depth")["depth"]
    expected = truth.K[0, 0] * wide.shape[2] / truth.size[0] / 300
    plain = request("depth-anything/DA3-BASE", {"depth": "da3"}, "plain")
    provide("depth", "depth", plain)
    ratio = wide / plain.folder.read("depth")["depth"]
    runs = len(depth_anything)
    assert np.nanmedian(ratio) == pytest.approx(expected * (1 + 0.3 * (runs - 1)) / (1 + 0.3 * runs), rel=1e-3)


@pytest.mark.parametrize("known", [False, True])
def test_moge_depth_is_metres_at_working_size(tmp_path, truth, clip, monkeypatch, known):
    frames, asked = standins.Frames(clip), []

    class MoGeModel:
        @classmethod
        def from_pretrained(cls, name):
            return cls()

        def to(self, device):
            return self

        def eval(self):
            return self

        def infer(self, image, num_tokens=None, resolution_level=9, force_projection=True, apply_mask=True, fov_x=None,
                  use_fp16=True):  # fmt: skip
            import torch

            assert image.shape[0] == 3 and 0 <= float(image.min()) and float(image.max()) <= 1
            t = frames[(image.numpy().transpose(1, 2, 0) * 255).round().astype(np.uint8)]
            asked.append(fov_x)
            z = cv2.resize(truth.depth[t], image.shape[:0:-1], interpolation=cv2.INTER_NEAREST)
            mask = np.isfinite(z)
            return {"depth": torch.from_numpy(np.where(mask, z, np.inf)), "mask": torch.from_numpy(mask),
                    "intrinsics": torch.eye(3), "points": None}  # fmt: skip

    for name in ("moge", "moge.model", "moge.model.v2"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    sys.modules["moge.model.v2"].MoGeModel = MoGeModel
    request = small_request(tmp_path, {"moge": {"device": "cpu"}}, {"depth": "moge"}, clip)
    if known:
        request.folder.put("camera", {"K": truth.K}, cues_io.GIVEN)
    provide("depth", "depth", request)
    depth = request.folder.read("depth")
    assert depth["depth"].shape == clip.frames.shape[:3] and bool(depth["metric"])
    xyz = truth.tracks["xyz_world"].astype(float)
    pose = np.linalg.inv(truth.T_camera_world)
    uv, z = project(xyz, np.broadcast_to(truth.K, (FRAMES, 3, 3)), pose)
    surface = sample_depth(depth["depth"], uv, truth.size)
    seen = truth.tracks["visible"] & np.isfinite(surface)
    assert seen.mean() > 0.3 and np.median(np.abs(surface[seen] / z[seen] - 1)) < 0.01
    wanted = np.degrees(2 * np.arctan(truth.size[0] / (2 * truth.K[0, 0]))) if known else None
    assert asked == [None] * FRAMES if not known else asked[0] == pytest.approx(wanted)
    assert request.folder.maker("depth").licence == "MIT"


def test_cotracker_tracks_arrive_in_full_px(tmp_path, truth, clip, monkeypatch):
    weights = tmp_path / "scaled_offline.pth"
    weights.write_text("weights")

    class CoTrackerPredictor:
        def __init__(self, checkpoint=None, offline=True, v2=False, window_len=60):
            assert checkpoint == str(weights) and offline

        def to(self, device):
            return self

        def __call__(self, video, queries=None, segm_mask=None, grid_size=0, grid_query_frame=0,
                     backward_tracking=False):  # fmt: skip
            import torch

            assert video.shape == (1, FRAMES, 3, *clip.frames.shape[1:3]) and backward_tracking
            assert 2 < float(video.max()) <= 255
            # Each query follows the nearest true track of its frame, at the same offset.
            uv = clip.to_work(truth.tracks["uv"])
            out, seen = [], []
            for t, x, y in queries[0].numpy():
                gap = np.linalg.norm(uv[:, int(t)] - (x, y), axis=1)
                gap[~truth.tracks["visible"][:, int(t)]] = np.inf
                n = int(np.argmin(gap))
                out.append(uv[n])
                seen.append(truth.tracks["visible"][n])
            return (torch.from_numpy(np.stack(out, 1)[None].astype(np.float32)),
                    torch.from_numpy(np.stack(seen, 1)[None]))  # fmt: skip

    for name in ("cotracker", "cotracker.predictor"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    sys.modules["cotracker.predictor"].CoTrackerPredictor = CoTrackerPredictor
    section = {"cotracker3": {"model": str(weights), "device": "cpu"}}
    request = small_request(tmp_path, section, {"track": "cotracker3"}, clip)
    provide("track", "tracks", request)
    cue = request.folder.read("tracks", "uv", "visible")
    assert cue["uv"].shape == (*cue["visible"].shape, 2) and cue["visible"].shape[1] == FRAMES and len(cue["uv"]) > 50
    gap = np.linalg.norm(cue["uv"][:, None, 0] - truth.tracks["uv"][None, :, 0], axis=-1)
    nearest = gap.argmin(1)
    first = cue["visible"][:, 0]
    assert np.nanmax(gap[first].min(1)) < 0.01, "the very pixels of the full-size video"
    both = cue["visible"] & truth.tracks["visible"][nearest]
    assert np.abs(cue["uv"] - truth.tracks["uv"][nearest])[both & first[:, None]].max() < 0.01
    assert "non-commercial" in request.folder.maker("tracks").licence
    assert "scaled_offline.pth" in request.folder.maker("tracks").version

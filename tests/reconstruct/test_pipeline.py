"""Video to asset: the rendered demo clip end to end, what is refused, resuming, and the page that results."""

from __future__ import annotations

import base64
import json
import os
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import cv2
import gymnasium
import numpy as np
import pytest

import taa_envs
from reconstruct.cues import Hands, ProviderInfo
from reconstruct.errors import Refused, TaaError
from reconstruct.joint.fit import fit_joint
from reconstruct.joint.models import JointFit
from reconstruct.pipeline import Seen, Silent, Stages, _up_to_hands, fit_scene, reconstruct, with_advice
from reconstruct.providers.lk_tracks import CLOSE_PX
from reconstruct.report import refusal_report, short
from reconstruct.synth import load_truth, render_clip, write_cues
from taa_envs.errors import AssetExists, GateFailed
from tests.reconstruct.joint_scenes import make_scene


class Log:
    """Remembers the stages and what was said of them."""

    def __init__(self) -> None:
        self.stages: dict[str, str] = {}
        self._name = ""

    def start(self, stage: str) -> None:
        self._name = stage

    def update(self, share: float) -> None:
        assert 0.0 <= share <= 1.0

    def finish(self, seconds: float, note: str = "") -> None:
        assert seconds >= 0
        self.stages[self._name] = note


def axis_errors(truth, axis: np.ndarray, point: np.ndarray, T_camera_world: np.ndarray) -> tuple[float, float]:
    """Angle in degrees and distance in m at the part's centroid of two axes, compared in the camera's frame."""
    R, t = truth.T_camera_world[0, :3, :3], truth.T_camera_world[0, :3, 3]
    a, c, centre = R @ truth.axis, R @ truth.point + t, R @ truth.centroid + t
    b = T_camera_world[:3, :3] @ axis
    d = T_camera_world[:3, :3] @ point + T_camera_world[:3, 3]
    angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b)))
    # Feet of the centroid's perpendiculars on both axes.
    foot_a = c + ((centre - c) @ a) * a
    foot_b = d + ((centre - d) @ b) * b
    return float(angle), float(np.linalg.norm(foot_a - foot_b))


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The published demo clip, reconstructed from its pixels alone."""
    folder = tmp_path_factory.mktemp("demo")
    clip = render_clip("demo", folder / "clips")
    log = Log()
    result = reconstruct(clip / "video.mp4", "demo", scene=folder / "scene", out=folder / "assets", progress=log)
    return folder, clip, result, log


@pytest.mark.slow
def test_the_demo_clip_is_reconstructed_and_replays(demo):
    folder, clip, result, _ = demo
    truth = load_truth(clip)
    joint = result.joint
    assert joint["verdict"] == "ok" and joint["type"] == "revolute" and joint["metric"]
    pose = np.array(joint["T_camera_world"])
    angle, _ = axis_errors(truth, np.array(joint["axis"]), np.array(joint["point"]), pose)
    assert angle < 2.0
    line = np.array(joint["image_line"])
    true = np.array(truth.image_line)
    normal = np.array([-(line[1] - line[0])[1], (line[1] - line[0])[0]])
    away = np.abs((true - line[0]) @ normal) / np.linalg.norm(normal)
    assert away.mean() < 0.02 * np.hypot(*truth.size)
    assert result.replay["joint_progress"] >= 0.9
    assert max(result.replay["controls"].values()) < 0.1
    assert result.asset.path == folder / "assets" / "demo"


@pytest.mark.slow
def test_the_asset_becomes_an_environment(demo, monkeypatch):
    monkeypatch.setenv("TAA_ASSETS", str(demo[0] / "assets"))
    assert "TAA/demo" in taa_envs.register_assets()
    env = gymnasium.make("TAA/demo")
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    env.close()
    monkeypatch.delenv("TAA_ASSETS")
    taa_envs.register_assets()


@pytest.mark.slow
def test_the_result_is_json(demo):
    _, _, result, _ = demo
    data = json.loads(json.dumps(result.as_dict(), allow_nan=False))
    assert {"id", "asset", "joint", "replay", "seconds"} <= set(data)
    assert len(data["joint"]["q"]) == len(data["joint"]["frames"])
    assert set(data["seconds"]) >= {"video", "camera", "hands", "tracks", "joint", "scale", "masks", "geometry", "hand",
                                    "asset", "replay", "report"}  # fmt: skip


@pytest.mark.slow
def test_a_second_run_resumes_and_gives_the_same(demo):
    folder, clip, result, log = demo
    assert set(log.stages.values()) == {""}
    with pytest.raises(AssetExists, match="--overwrite"):
        reconstruct(clip / "video.mp4", "demo", scene=folder / "scene", out=folder / "assets")
    again = Log()
    second = reconstruct(clip / "video.mp4", "demo", scene=folder / "scene", out=folder / "assets", overwrite=True,
                         progress=again)  # fmt: skip
    resumed = {name for name, note in again.stages.items() if note == "from the scene folder"}
    assert resumed == {"hands", "tracks", "joint", "scale", "masks", "geometry", "hand"}
    assert second.joint == result.joint and second.replay == result.replay
    assert sorted(p.name for p in (folder / "assets").iterdir()) == ["demo"]


@pytest.mark.slow
def test_the_scene_folder_has_every_cue_of_the_contract(demo):
    folder = demo[0] / "scene" / "cues"
    names = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert names == {"frames.npz", "camera.npz", "masks.npz", "tracks.npz", "hand.npz", "meshes/static.glb",
                     "meshes/moving.glb", "written.json"}  # fmt: skip
    with np.load(folder / "masks.npz") as masks, np.load(folder / "frames.npz") as frames:
        assert masks["moving"].dtype == bool and len(masks["moving"]) == len(frames["time"])


class Page(HTMLParser):
    """Tags of a page that would load something, and all its text."""

    def __init__(self) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.sources += [value for name, value in attrs if name in ("src", "href", "xlink:href", "poster") and value]

    def handle_data(self, data):
        self.text.append(data)


@pytest.mark.slow
def test_the_report_is_one_file_with_playable_films_and_every_number(demo, tmp_path):
    asset = demo[2].asset
    page = Page()
    html = (asset.path / "report.html").read_text(encoding="utf-8")
    page.feed(html)
    films = [s for s in page.sources if s.startswith("data:video/mp4")]
    assert len(films) == 2  # what was found, and the replay beside the video
    # The object that one can turn travels in the page as packed arrays.
    assert len(re.search(r'id="packed">([^<]*)<', html).group(1)) > 10_000
    assert all(s.startswith(("data:", "#")) for s in page.sources)
    assert not re.search(r"https?://(?!www\.w3\.org|purl\.org|creativecommons\.org|matplotlib\.org)", html)
    counts = []
    for n, source in enumerate(films):
        (tmp_path / f"{n}.mp4").write_bytes(base64.b64decode(source.split(",", 1)[1]))
        cap = cv2.VideoCapture(str(tmp_path / f"{n}.mp4"))
        count = 0
        while cap.grab():
            count += 1
        counts.append(count)
    assert counts[0] == 120 and min(counts) > 20
    text = " ".join(page.text)
    for name, number in asset.provenance.items():
        assert name in text and number["origin"] in text
    # What randomisation shifts the hand by holds what is not known along the ray and across it.
    std = {name: asset.provenance[f"hand.{name}"]["std"] for name in ("offset", "depth", "across")}
    assert std["offset"] > max(std["depth"], std["across"]) > 0
    picture = cv2.imread(str(asset.path / "preview.png"))
    assert picture is not None and picture.std() > 20


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """A small clip in which nothing but a hand moves."""
    return render_clip("still", tmp_path_factory.mktemp("still"), frames=30, size=(480, 270))


@pytest.mark.slow
def test_a_video_without_motion_is_refused_with_a_page(still, tmp_path):
    result = reconstruct(still / "video.mp4", "still", scene=tmp_path / "scene", out=tmp_path / "assets")
    data = result.as_dict()
    assert data["asset"] is None and data["replay"] is None
    assert data["joint"]["verdict"] == "refused" and data["joint"]["reason"]
    assert "; " in result.error
    assert not (tmp_path / "assets" / "still").exists()
    assert "Why there is no asset" in (tmp_path / "scene" / "report.html").read_text(encoding="utf-8")


def test_a_doubtful_joint_whose_body_misbehaves_is_refused(tmp_path, monkeypatch):
    """With a sure one it is an error: what is wrong then is the body, not the answer."""
    scene = make_scene("revolute", [0.0, 1.0, 0.2], [-0.2, 0.0, 1.6], [[0.05, 0.5], [-0.3, 0.3], [-0.05, 0.05]], 0.9)
    nobody = Hands((), np.zeros(scene.video.frames.shape[:3], bool), ProviderInfo("none", "0", "Apache-2.0"))
    fit = fit_joint(scene.video, scene.tracks, focal_px=768.0)
    verdict = "ok"

    def look(*_):
        return Seen(scene.video, nobody, scene.tracks, replace(fit, verdict=verdict, reason="two fit"), (), (), True)

    def build(*_):
        raise GateFailed("it does not pass the gate: it does not come to rest")

    monkeypatch.setattr("reconstruct.pipeline.load_video", lambda *_, **__: scene.video)
    monkeypatch.setattr("reconstruct.pipeline.look", look)
    monkeypatch.setattr("reconstruct.pipeline._build", build)
    folders = dict(scene=tmp_path / "scene", out=tmp_path / "assets")
    with pytest.raises(GateFailed):
        reconstruct("any.mp4", "doubtful", **folders)
    verdict = "ambiguous"
    result = reconstruct("any.mp4", "doubtful", **folders)
    assert result.as_dict()["asset"] is None and result.joint["verdict"] == "refused"
    assert result.error == "two fit; it does not pass the gate: it does not come to rest"
    assert "come to rest" in (tmp_path / "scene" / "report.html").read_text(encoding="utf-8")
    assert not (tmp_path / "assets").exists()


def test_the_tracks_up_to_hands_take_the_place_of_the_others_and_are_kept_in_the_scene_folder(tmp_path, monkeypatch):
    scene = make_scene("revolute", [0.0, 1.0, 0.2], [-0.2, 0.0, 1.6], [[0.05, 0.5], [-0.3, 0.3], [-0.05, 0.05]], 0.9)
    fit, few = fit_joint(scene.video, scene.tracks, focal_px=768.0), scene.tracks.of(np.arange(30))
    hands = Hands((), np.ones(scene.video.frames.shape[:3], bool), ProviderInfo("made", "0", "Apache-2.0"))
    calls = []

    def follow(video, hands, **options):
        calls.append(options["margin_px"])
        return scene.tracks

    def joint(video, tracks, *rest):
        assert len(tracks.uv) == len(scene.tracks.uv) and rest[-1] == CLOSE_PX
        calls.append("joint")
        return fit

    monkeypatch.setattr("reconstruct.providers.lk_tracks.track_points", follow)
    monkeypatch.setattr("reconstruct.pipeline.joint_off_the_arm", joint)
    for _ in range(2):
        stages = Stages(tmp_path, Silent())
        tracks, found = _up_to_hands(JointFit("refused", "too few"), scene.video, few, hands, None, 0, stages)
        assert len(tracks.uv) == len(scene.tracks.uv) and found.verdict == "ambiguous" and found.type == "revolute"
        np.testing.assert_array_equal(found.point_track, fit.point_track)
    assert calls == [CLOSE_PX, "joint"]
    known = replace(fit, verdict="ok")
    assert _up_to_hands(known, scene.video, few, hands, None, 0, Stages(None, Silent())) == (few, known)


def test_a_camera_cut_is_refused(tmp_path):
    rng = np.random.default_rng(0)
    shots = [cv2.resize(rng.integers(0, 255, (12, 20, 3), np.uint8), (320, 180)) for _ in range(2)]
    writer = cv2.VideoWriter(str(tmp_path / "cut.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 30, (320, 180))
    for i in range(60):
        frame = shots[i // 30].copy()
        cv2.circle(frame, (20 + 4 * i, 60), 12, (255, 255, 255), -1)
        writer.write(frame)
    writer.release()
    result = reconstruct(tmp_path / "cut.mp4", "cut", scene=tmp_path / "scene", out=tmp_path / "assets")
    assert result.joint["verdict"] == "refused" and "cuts at 1.00 s" in result.error
    assert (tmp_path / "scene" / "report.html").is_file() and not (tmp_path / "assets").exists()


def test_requests_that_cannot_be_met_leave_nothing(tmp_path):
    for arguments, words in (
        ({"id": "Bad Id"}, "not valid"),
        ({"id": "x", "providers": {"hand": "oracle"}}, "known: mediapipe"),
        ({"id": "x", "providers": {"taste": "oracle"}}, "known: camera"),
        ({"id": "x", "focal": 0.0}, "focal length"),
        ({"id": "x"}, "no such file"),
    ):
        with pytest.raises((TaaError, taa_envs.TaaEnvsError), match=words):
            reconstruct(tmp_path / "none.mp4", out=tmp_path / "assets", scene=tmp_path / "scene", **arguments)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_joint_alone_from_cues_somebody_made(tmp_path):
    """True tracks, camera and depth in a scene folder without a video: the joint is in the cues' own world."""
    clip = render_clip("demo", tmp_path / "clips", frames=40, size=(480, 270))
    write_cues(clip, tmp_path / "scene")
    joint = fit_scene(tmp_path / "scene")
    truth = load_truth(clip)
    assert joint["verdict"] == "ok" and joint["type"] == "revolute" and joint["scale_source"] == "depth"
    np.testing.assert_allclose(joint["T_camera_world"], truth.T_camera_world[0], atol=1e-9)
    pose = np.array(joint["T_camera_world"])
    angle, away = axis_errors(truth, np.array(joint["axis"]), np.array(joint["point"]), pose)
    assert angle < 2.0 and away < 0.02 * truth.diagonal


def test_fit_scene_says_what_is_missing(tmp_path):
    with pytest.raises(TaaError, match="no such folder"):
        fit_scene(tmp_path / "none")
    with pytest.raises(TaaError, match="tracks.npz"):
        fit_scene(tmp_path)


def test_a_stage_runs_again_when_anything_before_it_changed(tmp_path):
    runs: list[str] = []

    def stages(video: str) -> Stages:
        return Stages(tmp_path, Log(), {"video": video})

    def once(s: Stages, a: int) -> None:
        s.run("a", lambda: runs.append("a") or {"x": np.arange(3)}, options={"a": a})
        s.run("b", lambda: runs.append("b") or {"x": 1.5})

    for video, option, expected in (("v", 1, "ab"), ("v", 1, ""), ("v", 2, "ab"), ("w", 2, "ab")):
        runs.clear()
        once(stages(video), option)
        assert "".join(runs) == expected
    runs.clear()
    s = stages("w")
    s.run("a", lambda: runs.append("a") or {"x": np.arange(3)}, options={"a": 2}, given="digest of a cue")
    s.run("b", lambda: runs.append("b") or {"x": 1.5})
    assert runs == ["a", "b"], "what follows a user's cue is made again"


def test_a_refusals_page_escapes_what_it_is_told(tmp_path):
    evil = '<script>alert("x")</script>'
    page = refusal_report(evil, Path(f"{evil}.mp4"), None, None, None, None, evil, [evil], {evil: 1.0})
    assert evil not in page and page.count("&lt;script&gt;") >= 4


def test_refusals_say_what_to_do():
    assert with_advice("nothing moves").startswith("nothing moves; ")
    assert with_advice("a; b") == "a; b"
    assert issubclass(Refused, TaaError)


def test_numbers_are_short():
    assert short(1e-17) == "0" and short(0.123456) == "0.1235" and short(None) == ""
    assert short([1.0, 2.0]) == "(1, 2)" and short(np.eye(4).tolist()) == "16 numbers" and short(True) == "yes"

"""The joint from tracks alone: geometries, impostors, reversals, refusals, determinism."""

from dataclasses import replace

import numpy as np
import pytest

from reconstruct.cues import ProviderInfo, Tracks
from reconstruct.joint import fit as fit_module
from reconstruct.joint.bundle import Observations, State, refine, solve_depths
from reconstruct.joint.finish import finish
from reconstruct.joint.fit import fit_joint
from reconstruct.joint.models import JointFit, joint_transform
from reconstruct.joint.paths import Paths
from reconstruct.joint.result import FREELY
from reconstruct.joint.select import _tilted_back, explained, key_frames, observations, search_regions, worth
from reconstruct.joint.view import View
from tests.reconstruct.joint_scenes import H, W, make_scene, make_video, project

SLAB = [[-0.3, 0.3], [-0.4, 0.0], [-0.02, 0.02]]
SCENES = {
    "door that opens downwards": dict(kind="revolute", axis=[1, 0, 0.05], point=[0, 0.25, 1.6], size=SLAB, q_end=1.3),
    "cupboard door": dict(kind="revolute", axis=[0, 1, 0.1], point=[-0.3, 0.1, 1.5], q_end=1.1,
                          size=[[0.02, 0.4], [-0.3, 0.3], [-0.02, 0.02]]),
    "axis towards the camera": dict(kind="revolute", axis=[0.1, -0.2, 1], point=[0, 0.1, 1.2], q_end=1.2,
                                    size=[[0, 0.05], [-0.35, 0], [-0.05, 0.05]]),
    "lid that opens and closes": dict(kind="revolute", axis=[1, 0.1, 0.3], point=[0, 0.05, 1.4], q_end=1.2, back=True,
                                      size=[[-0.2, 0.2], [-0.04, 0.0], [-0.25, 0.0]]),
    "drawer": dict(kind="prismatic", axis=[0.3, 0.3, -1], point=[0, 0.1, 1.6], q_end=0.35,
                   size=[[-0.25, 0.25], [-0.1, 0.1], [-0.02, 0.02]]),
    "handle that slides in the image plane": dict(kind="prismatic", axis=[-0.1, 1, 0], point=[0, -0.2, 1.5], q_end=0.35,
                                                  size=[[-0.15, 0.15], [-0.05, 0.05], [-0.03, 0.03]]),
}  # fmt: skip


def axis_error_deg(fit, scene):
    axis = fit.T_camera_world[:3, :3] @ fit.axis
    return np.degrees(np.arccos(min(1.0, abs(axis @ scene.axis))))


def location_error(fit, scene):
    """Distance of the true axis from the fitted point at the true scale, over the true pivot's depth."""
    c = fit.T_camera_world[:3, :3] @ fit.point + fit.T_camera_world[:3, 3]
    a = scene.axis
    across = lambda v: v - (v @ a) * a  # noqa: E731
    true, found = across(scene.point), across(c)
    found = found * np.linalg.norm(true) / np.linalg.norm(found)
    return np.linalg.norm(found - true) / scene.point[2]


@pytest.mark.parametrize("name", SCENES)
def test_joint_is_found_among_impostors(name):
    scene = make_scene(**SCENES[name])
    fit = fit_joint(scene.video, scene.tracks, focal_px=768.0)
    assert fit.verdict == "ok", fit.reason
    assert fit.type == scene.kind
    # Where the data hold the axis badly (it points at the camera) the fit has to say so.
    assert axis_error_deg(fit, scene) < max(2.0, 3 * fit.std["axis_deg"])
    assert axis_error_deg(fit, scene) < 6.0
    if scene.kind == "revolute":
        assert location_error(fit, scene) < 0.01
        assert np.ptp(fit.q) == pytest.approx(abs(scene.q).max(), rel=0.06)
    assert fit.q[0] == 0
    assert abs(np.corrcoef(fit.q, scene.q)[0, 1]) > 0.995
    # The consensus set is the moving link: its first 90 tracks, and few impostors.
    assert (fit.point_track < 90).mean() > 0.9
    assert fit.inliers > 45
    assert fit.std["axis_deg"] > 0 and np.isfinite(fit.std["q"]).all()


def test_of_several_hinges_the_one_that_fits_is_taken():
    """Hinges that lean to either side of the viewing ray both lie at the bottom of a valley."""
    scene = make_scene(kind="revolute", axis=[0.82, -0.36, 0.45], point=[-0.09, 0.08, 1.34], q_end=0.75, impostors=0,
                       size=[[-0.25, 0.25], [-0.3, 0], [-0.02, 0.02]], noise=0.15)  # fmt: skip
    uv = np.asarray(scene.tracks.uv, float)[:90] - [(W - 1) / 2, (H - 1) / 2]
    frames = key_frames(uv)
    obs, ids = observations(Paths(uv), 768.0, np.zeros(2), frames, 90, np.random.default_rng(0), float(np.hypot(W, H)))
    foot = scene.point - scene.axis * (scene.axis @ scene.point)
    start = State("revolute", scene.axis, foot / np.linalg.norm(foot), scene.q[frames] - scene.q[frames[0]],
                  np.ones(len(obs.ref)))  # fmt: skip
    right = refine(solve_depths(start, obs), obs, scales=(4.0, 2.0), iterations=10)
    twin = refine(_tilted_back(right, obs), obs, scales=(4.0, 2.0), iterations=20)

    def error_deg(*starts):
        done = finish({"revolute": [(s, obs) for s in starts]}, Paths(uv), ids, View(768.0))
        return np.degrees(np.arccos(min(1.0, abs(done.bundle.twist.axis @ scene.axis))))

    assert error_deg(twin) > 10
    assert error_deg(twin, right) < 0.5


def test_image_line_lies_on_the_projected_axis():
    scene = make_scene(**SCENES["door that opens downwards"])
    fit = fit_joint(scene.video, scene.tracks, focal_px=768.0)
    a, b = project(scene.point - 0.2 * scene.axis), project(scene.point + 0.2 * scene.axis)
    normal = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a)
    assert np.abs((fit.image_line - a) @ normal).max() < 0.01 * np.hypot(W, H)


def test_same_seed_same_answer():
    scene = make_scene(**{**SCENES["cupboard door"], "frames": 30, "points": 40, "impostors": 10, "noise": 0.2})
    one, two = (fit_joint(scene.video, scene.tracks, seed=3) for _ in range(2))
    np.testing.assert_array_equal(one.axis, two.axis)
    np.testing.assert_array_equal(one.q, two.q)


def test_wrong_focal_length_stays_within_its_uncertainty():
    scene = make_scene(**SCENES["door that opens downwards"])
    fit = fit_joint(scene.video, scene.tracks, focal_px=700.0)
    assert fit.type == "revolute"
    assert axis_error_deg(fit, scene) < 4.0


def free_tracks(seed=0, frames=60):
    """A plate that is lifted, carried sideways and tilted about several axes: no joint."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(seed)
    s = np.clip((np.arange(frames) - 8) / (frames - 16), 0, 1)
    X = rng.uniform([-0.2, -0.15, -0.03], [0.2, 0.15, 0.03], (90, 3))
    turn = Rotation.from_rotvec(np.stack([0.9 * s**2, 0.8 * np.sin(np.pi * s), 0.7 * s], axis=-1)).as_matrix()
    shift = np.stack([0.25 * np.sin(1.5 * np.pi * s), -0.25 * s, 1.4 - 0.3 * s**3], axis=-1)
    uv = project(np.einsum("tij,nj->nti", turn, X) + shift) + rng.normal(scale=0.5, size=(90, frames, 2))
    visible = np.ones(uv.shape[:2], bool)
    return Tracks(uv.astype(np.float32), visible, np.zeros(90, int), ProviderInfo("made", "0", "Apache-2.0"))


def test_free_body_is_refused_with_a_reason():
    fit = fit_joint(make_video(60), free_tracks(), focal_px=768.0)
    assert fit.verdict == "refused"
    assert "free body" in fit.reason or "no joint" in fit.reason


def test_a_search_that_is_out_of_luck_is_drawn_again(monkeypatch):
    """Each draw is asked for until one holds that explains more; where none does the first one's reason counts."""
    scene, real, asked = make_scene(**SCENES["drawer"]), fit_module._consensus, []

    def unlucky(times, explained=0.5):
        def consensus(uv, camera, rng, tell, regions):
            asked.append(float(rng.random()))
            found = real(uv, camera, rng, tell, regions)
            less = replace(found, refusal=f"draw {len(asked)}", explained=explained * found.explained)
            return less if len(asked) <= times else found

        asked.clear()
        monkeypatch.setattr(fit_module, "_consensus", consensus)
        return fit_joint(scene.video, scene.tracks, focal_px=768.0)

    fit = unlucky(2)
    assert fit.verdict == "ok" and axis_error_deg(fit, scene) < 1.0
    assert len(asked) == 3 and len(set(asked)) == 3
    fit = unlucky(9)
    assert (fit.verdict, fit.reason, len(asked)) == ("refused", "draw 1", fit_module.TRIES + len(fit_module.PARTS))
    fit = unlucky(1, explained=1.0)
    assert (fit.verdict, fit.reason) == ("refused", "draw 1")


@pytest.mark.parametrize(("explained", "sigma", "verdict"), [
    (1.05, 0.1, "ok"),  # no less, and far more exactly
    (1.05, 0.2, "refused"),
    (0.95, 0.1, "refused"),
    (1.15, 0.5, "ok"),  # what the first one missed
])  # fmt: skip
def test_a_later_draw_is_believed_if_it_explains_more_or_far_more_exactly(monkeypatch, explained, sigma, verdict):
    scene = make_scene(**SCENES["drawer"])
    first = fit_module._Draw(JointFit("refused", "a free body", inliers=50), 1.0, 0.5)
    second = fit_module._Draw(JointFit("ok", "made"), explained, sigma)
    draws = iter([first, second, *[first] * 9])
    monkeypatch.setattr(fit_module, "_one_draw", lambda *_: next(draws))
    assert fit_joint(scene.video, scene.tracks, focal_px=768.0).verdict == verdict


def test_nothing_moving_is_refused():
    rng = np.random.default_rng(0)
    uv = np.repeat(rng.uniform(50, 500, (80, 1, 2)), 40, axis=1) + rng.normal(scale=0.3, size=(80, 40, 2))
    tracks = Tracks(uv, np.ones((80, 40), bool), np.zeros(80, int), ProviderInfo("made", "0", "Apache-2.0"))
    fit = fit_joint(make_video(40), tracks)
    assert fit.verdict == "refused"
    assert "nothing moves" in fit.reason


def test_short_motion_is_not_called_certain():
    """Five degrees of a hinge and a short slide look alike: the type must not be certain and wrong."""
    scene = make_scene(**{**SCENES["cupboard door"], "q_end": 0.09})
    fit = fit_joint(scene.video, scene.tracks, focal_px=768.0)
    assert fit.verdict in ("ambiguous", "refused") or fit.type == "revolute"


@pytest.mark.parametrize("aside", [0.0, 0.03], ids=["on its hinge", "carried a little aside"])
def test_exact_tracks_tell_a_hinge_from_a_body_that_is_carried_nearly_so(aside):
    """Shares of motion cannot: a part that is carried 3 cm beside its arc of 60 cm follows the hinge to 5 %."""
    rng = np.random.default_rng(3)
    scene = make_scene(**SCENES["cupboard door"], impostors=0, noise=0.0, points=4)
    size = np.array(SCENES["cupboard door"]["size"])
    X = scene.point + rng.uniform(size[:, 0], size[:, 1], (120, 3))
    T = joint_transform("revolute", scene.axis, scene.point, scene.q)
    u = np.clip(scene.q / scene.q.max(), 0, 1)
    shift = aside * np.sin(2 * np.pi * u)[:, None] * scene.axis
    moving = project(np.einsum("tij,nj->nti", T[:, :3, :3], X) + T[:, :3, 3] + shift)
    still = np.repeat(rng.uniform([20, 20], [W - 20, H - 20], (60, 1, 2)), len(u), axis=1)
    uv = np.concatenate([moving, still]) + rng.normal(scale=0.1, size=(180, len(u), 2))
    tracks = Tracks(uv.astype(np.float32), np.ones(uv.shape[:2], bool), np.zeros(180, int), scene.tracks.provider)
    fit = fit_joint(scene.video, tracks, focal_px=768.0)
    if aside:
        assert fit.verdict == "refused" and "free body" in fit.reason
    else:
        assert fit.verdict == "ok" and axis_error_deg(fit, scene) < 0.3


def test_one_body_met_exactly_is_worth_more_than_two_met_half():
    # Twenty points go 40 px to the right, twenty others 40 px nearly so: 3 px apart in the end.
    px, K, rng = 1 / 768, 10, np.random.default_rng(0)
    turn = np.repeat([0.0, 3 / 40], 20)
    way = np.stack([np.cos(turn), np.sin(turn)], axis=-1)[:, None] * np.linspace(0, 40 * px, K)[:, None]
    xy = rng.uniform(-0.3, 0.3, (40, 1, 2)) + way
    obs = Observations(xy, np.ones((40, K), bool), np.zeros(40, int), np.ones(40), px, np.arange(K))

    def slide(angle):
        axis = np.array([np.cos(angle), np.sin(angle), 0.0])
        return solve_depths(State("prismatic", axis, np.zeros(3), np.linspace(0, 40 * px, K), np.ones(40)), obs)

    exact, between = slide(0.0), slide(turn.max() / 2)
    assert explained(between, obs)[0] > explained(exact, obs)[0]
    assert worth(exact, obs) > 1.1 * worth(between, obs)


def test_another_stretch_has_to_explain_clearly_more():
    """Two drawers of one chest explain the same to a hundredth: the one that moves more, which comes first, counts."""
    from reconstruct.joint.fit import _Consensus, _dominant

    several = [_Consensus(explained=x) for x in (154.7, 157.4, 96.3)]
    assert _dominant(several) is several[0]
    assert _dominant([*several, clear := _Consensus(explained=190.0)]) is clear


def test_a_region_of_the_picture_shows_the_part_beside_what_moves_otherwise():
    """The first of its joints, judged on all tracks, is the part's though most of what moves is elsewhere."""
    scene = make_scene(**SCENES["drawer"])
    tracks = scene.tracks
    rng = np.random.default_rng(4)
    uv = scene.video.to_work(tracks.uv)
    moving = np.linalg.norm(np.nanmax(uv, axis=1) - np.nanmin(uv, axis=1), axis=1) > 0.05 * W
    uv = uv[moving & tracks.visible.any(1)]
    keys = key_frames(uv)
    obs, _ = observations(Paths(uv, None), 768.0 * scene.video.scale, np.array([(W - 1) / 2, (H - 1) / 2]), keys, 260,
                          rng, float(np.hypot(H, W)))  # fmt: skip
    found = search_regions(obs, np.random.default_rng(0), 3)
    assert found and worth(found[0], obs) == max(worth(s, obs) for s in found)
    assert all(len(s.depth) == len(obs.ref) for s in found)
    off = np.degrees(np.arccos(min(1.0, abs(float(found[0].axis @ scene.axis)))))
    assert found[0].kind == "prismatic" and off < 3
    assert search_regions(obs.of(np.arange(9)), np.random.default_rng(0), 2) == []


@pytest.mark.parametrize("hinge_believed", [True, False])
def test_a_slide_that_is_none_is_a_hinge_if_that_is_believed(monkeypatch, hinge_believed):
    """There is no joint only if every type is refuted."""
    scene, asked = make_scene(**SCENES["drawer"]), []

    def why(done, *_):
        asked.append(done.bundle.kind)
        return None if done.bundle.kind == "revolute" and hinge_believed else f"{FREELY}: made"

    monkeypatch.setattr(fit_module, "why_not_believed", why)
    monkeypatch.setattr(fit_module, "TRIES", 1)
    monkeypatch.setattr(fit_module, "_slight", lambda *_: None)
    fit = fit_joint(scene.video, scene.tracks, focal_px=768.0)
    assert asked[:2] == ["prismatic", "revolute"]
    if hinge_believed:
        assert (fit.verdict, fit.type) == ("ambiguous", "revolute") and fit.reason.startswith(fit_module.NO_SLIDE)
        assert 0.1 < fit.type_probability["prismatic"] < fit.type_probability["revolute"]
    else:
        assert fit.verdict == "refused" and FREELY in fit.reason

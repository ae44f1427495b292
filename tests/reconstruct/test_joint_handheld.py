"""A camera in a hand: its path from what rests, and the joint before it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reconstruct.joint.handheld as handheld
from reconstruct.cues import ProviderInfo, Tracks
from reconstruct.joint.finish import _hinge_of_screw
from reconstruct.joint.fit import fit_joint
from reconstruct.joint.handheld import at_rest, filmed, path_from_rest
from reconstruct.joint.models import joint_transform
from reconstruct.joint.paths import Paths
from reconstruct.joint.polish import Bundle, Sightings, polish, residuals
from reconstruct.joint.select import key_frames, observations
from reconstruct.joint.shape import NEARBY, Nearby, Reach
from reconstruct.joint.sweep import sweep
from reconstruct.joint.twist import Twist, twist_of_joint
from reconstruct.joint.view import Still, View
from reconstruct.joint.weigh import calmer, costs_of_both, turn_deg
from tests.reconstruct.joint_scenes import FOCAL, H, W, make_video, project

CENTRE = np.array([(W - 1) / 2, (H - 1) / 2])
AXIS, POINT = np.array([0.1, 0.98, 0.15]) / np.linalg.norm([0.1, 0.98, 0.15]), np.array([-0.15, 0.0, 0.95])
FRAMES = 36


def camera_path(frames, rng):
    """A hand that sways by about a centimetre and a degree: world to camera."""
    t = np.linspace(0, 1, frames)
    sway = sum(rng.normal(size=6) * np.sin(2 * np.pi * k * t[:, None] + rng.uniform(0, 6, 6)) / k
               for k in (0.7, 1.6, 3))  # fmt: skip
    sway = (sway - sway[0]) * np.repeat([0.006, 0.008], 3)
    R = Rotation.from_rotvec(sway[:, 3:]).as_matrix()
    return R, -np.einsum("tij,tj->ti", R, sway[:, :3])


def poses(body, q):
    """(T, 4, 4) of a door on its hinge at these angles, or of one that is carried away."""
    if body == "hinge":
        return joint_transform("revolute", AXIS, POINT, -q)
    pose = joint_transform("revolute", AXIS, POINT, -0.5 * q)
    pose[:, :3, 3] += np.column_stack([0.1 * q, -0.15 * np.sin(2.5 * q), 0.1 * q**2])
    return pose


def scene(noise=0.1, rest=160, link=45, body="hinge", link_noise=None, seed=0, turn=0.9, slant=(0.0, 0.0),
          held=True):  # fmt: skip
    """Tracks of a door before a desk and a wall, in the picture that the wall's homographies take to its first view.

    turn: of the door, rad.  slant: of the wall, depth over what is beside and above.  held: else the camera rests."""
    rng = np.random.default_rng(seed)
    R, t = camera_path(FRAMES, rng) if held else (np.tile(np.eye(3), (FRAMES, 1, 1)), np.zeros((FRAMES, 3)))
    half = rest // 2
    wall = np.column_stack([rng.uniform(-1.2, 1.2, half), rng.uniform(-0.7, 0.5, half), np.full(half, 2.2)])
    wall[:, 2] += wall[:, :2] @ slant
    desk = np.column_stack([rng.uniform(-0.5, 0.5, half), np.full(half, 0.25), rng.uniform(0.9, 1.8, half)])
    still = np.concatenate([wall, desk])
    door = POINT + rng.uniform([0.02, -0.2, -0.02], [0.3, 0.2, 0.0], (link, 3))
    s = np.clip((np.arange(FRAMES) - 6) / (FRAMES - 12), 0, 1)
    q = turn * (3 * s**2 - 2 * s**3)
    pose = poses(body, q)
    moving = np.einsum("tij,nj->nti", pose[:, :3, :3], door) + pose[:, :3, 3]
    world = np.concatenate([np.repeat(still[:, None], FRAMES, axis=1), moving])
    uv = project(np.einsum("tij,ntj->nti", R, world) + t)
    scale = np.r_[np.full(rest, noise), np.full(link, noise if link_noise is None else link_noise)]
    uv += rng.normal(size=uv.shape) * scale[:, None, None]
    warp = np.stack([cv2.findHomography(uv[:half, k], uv[:half, 0])[0] for k in range(FRAMES)])
    flat = np.stack([cv2.perspectiveTransform(uv[None, :, k].copy(), warp[k])[0] for k in range(FRAMES)], axis=1)
    visible = ((uv > 0) & (uv < [W, H])).all(-1)
    tracks = Tracks(flat.astype(np.float32), visible, np.zeros(len(uv), int), ProviderInfo("made", "0", "Apache-2.0"))
    return tracks, warp, (R, t), q


def beside_its_shadow(count, held, body="hinge", seed=0):
    """The door of `scene` beside so many more tracks on the wall, where a lamp throws the shadow of its points.

    Returns:
        The video of a camera in a hand, or of one at rest, and the tracks; the door's are 160 to 204.
    """
    tracks, warp, (R, t), q = scene(noise=0.05, body=body, seed=seed, held=held)
    rng, lamp = np.random.default_rng(seed + 7), np.array([-1.0, -0.6, -0.3])
    door = POINT + rng.uniform([0.02, -0.2, -0.02], [0.3, 0.2, 0.0], (count, 3))
    pose = poses(body, q)
    ray = np.einsum("tij,nj->nti", pose[:, :3, :3], door) + pose[:, :3, 3] - lamp
    shadow = lamp + ray * (2.2 - lamp[2]) / ray[..., 2:]
    uv = project(np.einsum("tij,ntj->nti", R, shadow) + t) + rng.normal(0, 0.05, (count, FRAMES, 2))
    flat = np.stack([cv2.perspectiveTransform(uv[None, :, k].copy(), warp[k])[0] for k in range(FRAMES)], axis=1)
    visible = np.concatenate([tracks.visible, ((uv > 0) & (uv < [W, H])).all(-1)])
    uv = np.concatenate([tracks.uv, flat.astype(np.float32)])
    both = replace(tracks, uv=uv, visible=visible, reference=np.zeros(len(uv), int))
    return replace(make_video(FRAMES), warp=warp if held else None), both


@pytest.mark.parametrize(("held", "count"), [(True, 250), (False, 120)])
def test_a_door_is_found_beside_its_shadow_that_has_more_tracks(held, count):
    """Nothing says which are the shadow's: these follow a hinge to a quarter of a pixel, the door's to their noise."""
    video, tracks = beside_its_shadow(count, held)
    fit = fit_joint(video, tracks, FOCAL, camera_moving=False)
    assert fit.type == "revolute" and fit.verdict == "ok", fit.reason
    assert held or "beside it" in fit.reason
    assert np.isin(fit.point_track, np.arange(160, 205)).mean() > 0.95
    assert angle(fit) < 0.3


def test_a_door_that_is_carried_away_beside_its_shadow_is_refused():
    video, tracks = beside_its_shadow(120, held=False, body="carried")
    assert fit_joint(video, tracks, FOCAL, camera_moving=False).verdict == "refused"


def angle(fit):
    a = fit.T_camera_world[:3, :3] @ fit.axis
    return np.degrees(np.arccos(min(1.0, abs(a @ AXIS))))


def test_the_path_is_known_from_what_rests():
    tracks, warp, (R, t), _ = scene()
    flat = np.where(tracks.visible[..., None], tracks.uv, np.nan).astype(float)
    path = path_from_rest(Paths(filmed(flat, warp) - CENTRE), flat - CENTRE, np.arange(160), FOCAL)
    assert path is not None and len(path.ids) > 140
    assert path.sigma == pytest.approx(0.1, rel=0.15)
    assert_path(path, R, t)


def assert_path(path, R, t):
    centre = lambda R, t: -np.einsum("tji,tj->ti", R, t)  # noqa: E731
    found, true = centre(path.R, path.t), centre(R, t)
    found *= np.sum(found * true) / np.sum(found**2)  # the scale is free
    assert np.linalg.norm(found - true, axis=1).max() < 0.1 * np.linalg.norm(true, axis=1).max()
    assert np.degrees(Rotation.from_matrix(path.R @ np.swapaxes(R, 1, 2)).magnitude()).max() < 0.1


@pytest.mark.parametrize("slant", [(0.8, 0.0), (-0.8, 0.6), (0.0, -0.8)])
def test_a_wall_that_is_seen_aslant_tells_the_path_too(slant):
    """Of the wall alone, and from the tracks of all that is followed it is known which of the starts is right."""
    tracks, warp, (R, t), _ = scene(slant=slant, noise=0.05)
    flat = np.where(tracks.visible[..., None], tracks.uv, np.nan).astype(float)
    paths = Paths(filmed(flat, warp) - CENTRE)
    path = path_from_rest(paths, flat - CENTRE, np.arange(80), FOCAL)
    assert path is not None
    path = path_from_rest(paths, flat - CENTRE, at_rest(path, paths, flat - CENTRE, FOCAL), FOCAL, path)
    assert path is not None
    assert_path(path, R, t)


def test_points_that_slide_along_edges_hold_the_path_across_them():
    """Half of what rests slides by up to 5 px along its edge, which the tracks say."""
    tracks, warp, (R, t), _ = scene(noise=0.05)
    flat = np.where(tracks.visible[..., None], tracks.uv, np.nan).astype(float)
    rng = np.random.default_rng(1)
    edge = rng.normal(size=(len(flat), 1, 2))
    edge /= np.linalg.norm(edge, axis=-1, keepdims=True)
    edge[::2] = 0.0
    uv = filmed(flat, warp) - CENTRE + edge * rng.uniform(-5, 5, (*flat.shape[:2], 1))
    slides = Paths(uv, np.broadcast_to(0.999 * edge, uv.shape))
    path = path_from_rest(slides, flat - CENTRE, np.arange(160), FOCAL)
    assert path is not None and len(path.ids) > 140 and path.sigma < 0.1
    assert_path(path, R, t)
    path = path_from_rest(Paths(uv), flat - CENTRE, np.arange(160), FOCAL)
    assert path is None or len(path.ids) < 120 or path.sigma > 0.5


def test_short_tracks_hold_a_path_that_no_long_ones_do():
    """Every point is followed for five of 36 frames only, as where hands and fast motion cut tracks."""
    tracks, warp, (R, t), _ = scene(noise=0.03, rest=600)
    flat = np.where(tracks.visible[..., None], tracks.uv, np.nan).astype(float)
    begin = np.random.default_rng(2).integers(0, FRAMES - 4, len(flat))
    flat[(np.arange(FRAMES) < begin[:, None]) | (np.arange(FRAMES) > begin[:, None] + 4)] = np.nan
    path = path_from_rest(Paths(filmed(flat, warp) - CENTRE), flat - CENTRE, np.arange(600), FOCAL)
    assert path is not None
    assert np.degrees(Rotation.from_matrix(path.R @ np.swapaxes(R, 1, 2)).magnitude()).max() < 0.3


def test_what_drifts_by_parallax_rests_and_a_door_does_not():
    """The wall tells the path; the desk is up to twice as near and leaves its place in the picture by pixels."""
    tracks, warp, _, _ = scene()
    flat = np.where(tracks.visible[..., None], tracks.uv, np.nan).astype(float)
    uv, still = Paths(filmed(flat, warp) - CENTRE), flat - CENTRE
    path = path_from_rest(uv, still, np.arange(80), FOCAL)
    assert path is not None
    drift = np.nanmax(np.linalg.norm(still - still[:, :1], axis=-1), axis=1)
    assert np.median(drift[80:160]) > 2 > 8 * path.sigma
    rest = at_rest(path, uv, still, FOCAL)
    # What is nearer than half of the scene's depth is known to rest only when more of the desk is.
    assert np.isin(np.arange(160), rest).mean() > 0.8
    assert not (rest >= 160).any()
    path = path_from_rest(uv, still, rest, FOCAL)
    assert path is not None
    np.testing.assert_array_equal(at_rest(path, uv, still, FOCAL), np.arange(160))


def test_what_is_off_by_more_than_noise_joins_no_path():
    """A third of the desk goes to and fro by half a pixel, less than its parallax does."""
    tracks, warp, _, _ = scene(noise=0.03)
    flat = np.where(tracks.visible[..., None], tracks.uv, np.nan).astype(float)
    flat[80:106, :, 0] += 0.6 * np.sin(np.linspace(0, 9, FRAMES))
    paths, still = Paths(filmed(flat, warp) - CENTRE), flat - CENTRE
    path = path_from_rest(paths, still, np.r_[:80, 106:160], FOCAL)
    assert path is not None
    goes = np.arange(80, 106)
    assert np.isin(goes, at_rest(path, paths, still, FOCAL, missed=0.8)).mean() > 0.8
    exact = at_rest(path, paths, still, FOCAL, missed=0.0)
    assert np.isin(goes, exact).mean() < 0.2 and np.isin(np.r_[:80, 106:160], exact).mean() > 0.9


def test_tracks_of_hardly_any_frame_tell_no_path():
    tracks, warp, _, _ = scene()
    flat = np.where(tracks.visible[..., None], tracks.uv, np.nan).astype(float)
    flat[:, 3:] = np.nan
    assert path_from_rest(Paths(filmed(flat, warp) - CENTRE), flat - CENTRE, np.arange(160), FOCAL) is None


def test_a_part_that_hardly_moves_among_what_rests_bends_the_path_less(monkeypatch):
    """A door by 3 deg, more than a third of all tracks, which err slowly, each by its own size."""

    def off(seed):
        tracks, warp, (R, t), _ = scene(turn=0.05, noise=0.03, link=90, seed=seed)
        rng = np.random.default_rng(seed + 10)
        flat = np.where(tracks.visible[..., None], tracks.uv, np.nan).astype(float)
        size = 0.6 * rng.exponential(size=(len(flat), 1, 1)) / np.sqrt(FRAMES)
        flat += np.cumsum(rng.normal(size=flat.shape) * size, axis=1)
        rays = handheld._Rays(Paths(filmed(flat, warp) - CENTRE), FOCAL)
        done = rays.settled((R, t, rays.points(R, t)), 3)
        return np.degrees(Rotation.from_matrix(done.start[0] @ np.swapaxes(R, 1, 2)).magnitude()).max()

    by_best = np.mean([off(seed) for seed in range(4)])
    assert by_best < 0.05
    monkeypatch.setattr(handheld, "CORE", 1.0)
    assert by_best < 0.8 * np.mean([off(seed) for seed in range(4)])


def test_a_scene_keeps_to_the_scale_of_the_path():
    tracks, warp, _, _ = scene()
    flat = np.where(tracks.visible[..., None], tracks.uv, np.nan).astype(float)
    uv = filmed(flat, warp) - CENTRE
    path = path_from_rest(Paths(uv), flat - CENTRE, np.arange(160), FOCAL)
    assert path is not None
    longer = Still(path.ids, path.X).before(View(FOCAL, 0.0, path.R, 2.5 * path.t), Paths(uv), 0.0)
    np.testing.assert_array_equal(longer.ids, path.ids)
    there = np.einsum("tij,nj->nti", path.R, longer.X) + 2.5 * path.t
    off = np.linalg.norm(FOCAL * there[..., :2] / there[..., 2:] - uv[path.ids], axis=-1)
    assert np.nanmedian(off) < 2 * path.sigma
    assert np.median(longer.X[:, 2] / path.X[:, 2]) == pytest.approx(2.5, rel=0.05)


def test_tracks_go_back_to_the_picture_as_filmed():
    tracks, warp, _, _ = scene(rest=60, link=10)
    back = filmed(tracks.uv.astype(float), warp)
    again = np.stack([cv2.perspectiveTransform(back[None, :, k], warp[k])[0] for k in range(FRAMES)], axis=1)
    np.testing.assert_allclose(again, tracks.uv, atol=1e-3)
    assert np.isnan(filmed(np.full((2, FRAMES, 2), np.nan), warp)).all()


def test_a_door_before_a_hand_held_camera_is_as_exact_as_its_tracks():
    tracks, warp, _, q = scene()
    fit = fit_joint(replace(make_video(FRAMES), warp=warp), tracks, FOCAL, camera_moving=False)
    assert fit.type == "revolute" and fit.verdict == "ok", fit.reason
    assert "its path is fitted" in fit.reason
    assert angle(fit) < min(0.3, 3 * fit.std["axis_deg"])
    assert np.abs(fit.q - q).max() < 0.01


def test_a_door_that_opens_a_little_is_found_before_a_path_without_any_guess():
    """Tracks of the desk drift by half of what the door goes; before a camera at rest no joint is found."""
    tracks, warp, (R, t), _ = scene(turn=0.12, noise=0.06, link=80)
    flat = np.where(tracks.visible[..., None], tracks.uv, np.nan).astype(float)
    paths, moving = Paths(filmed(flat, warp) - CENTRE), np.r_[80:100, 160:240]
    keys = key_frames(flat[moving])
    rng, diagonal = np.random.default_rng(0), float(np.hypot(W, H))
    obs = observations(Paths(flat[moving]), FOCAL, CENTRE, keys, 260, rng, diagonal)[0]

    def errs(view, depths):
        found = sweep(paths, moving, obs, moving, [], view, depths)
        if found is None:
            return np.zeros(0, int), np.inf, np.inf
        b = polish(found.starts["revolute"][0], view.sightings(paths[found.ids], np.arange(FRAMES)))
        return found.ids, b.sigma, np.degrees(np.arccos(min(1.0, abs(b.twist.axis @ AXIS))))

    ids, sigma, off = errs(View(FOCAL, 0.0, R, t), (0.5, 1.0, 1.8))
    assert (ids >= 160).mean() > 0.9 and len(ids) > 60
    assert sigma < 0.08 and off < 2
    ids, sigma, off = errs(View(FOCAL), (1.0,))
    assert len(ids) < 60 or sigma > 0.15 or off > 10


def test_a_door_that_opens_a_little_before_a_hand_held_camera_is_a_sure_hinge():
    tracks, warp, _, q = scene(turn=0.12, noise=0.06, link=80)
    fit = fit_joint(replace(make_video(FRAMES), warp=warp), tracks, FOCAL, camera_moving=False)
    assert fit.type == "revolute" and fit.verdict == "ok", fit.reason
    assert angle(fit) < min(6, 3 * fit.std["axis_deg"])
    assert np.abs(fit.q - q).max() < 0.02


def test_from_the_first_place_points_at_one_depth_do_not_drift():
    rng = np.random.default_rng(0)
    R, t = camera_path(FRAMES, rng)
    view = View(FOCAL, 0.0, R, t)
    # Points that are 1.5 before each camera as it goes: where they are in the world the first one sees.
    uv = rng.uniform(-200, 200, (30, FRAMES, 2))
    X = np.concatenate([uv / FOCAL, np.ones((30, FRAMES, 1))], axis=-1) * 1.5
    world = np.einsum("tji,ntj->nti", R, X - t)
    seen = view.at_first(Paths(uv), 1.5)
    np.testing.assert_allclose(seen.uv, FOCAL * world[..., :2] / world[..., 2:], atol=1e-6)
    resting = Paths(uv)
    assert View(FOCAL).at_first(resting, 2.0) is resting


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_joint_in_another_unit_is_the_same_in_the_picture(kind):
    R, t = camera_path(FRAMES, np.random.default_rng(0))
    curvature = np.array([0.0, 2.0, 0]) if kind == "revolute" else np.zeros(3)
    X = np.random.default_rng(1).uniform([-0.2, -0.2, 0.9], [0.2, 0.2, 1.1], (20, 3))
    b = Bundle(kind, Twist(np.array([0, 0, 1.0]), np.array([1.0, 0, 0]), curvature), np.linspace(0, 0.2, FRAMES), X)
    s = Sightings(np.zeros((20, FRAMES, 2)), np.ones((20, FRAMES), bool), np.ones(20), FOCAL, R=R, t=t)
    far = b.scaled(2.5)
    np.testing.assert_allclose(residuals(far, replace(s, t=2.5 * t)), residuals(b, s), atol=1e-9)
    assert turn_deg(far) == pytest.approx(turn_deg(b))
    np.testing.assert_allclose(replace(b, R=R, t=t).scaled(2.5).t, 2.5 * t)


def test_a_hinge_that_lost_its_path_is_the_screws_own():
    """Before a camera that is fitted too a hinge and a screw of the same motion may end on different paths."""
    _, _, (R, t), q = scene(noise=0.05, link=60)
    link = np.arange(220) >= 160
    rng = np.random.default_rng(0)
    pose = joint_transform("revolute", AXIS, POINT, -q)
    half = 80
    wall = np.column_stack([rng.uniform(-1.2, 1.2, half), rng.uniform(-0.7, 0.5, half), np.full(half, 2.2)])
    desk = np.column_stack([rng.uniform(-0.5, 0.5, half), np.full(half, 0.25), rng.uniform(0.9, 1.8, half)])
    door = POINT + rng.uniform([0.02, -0.2, -0.02], [0.3, 0.2, 0.0], (60, 3))
    X = np.concatenate([wall, desk, door])
    moving = np.einsum("tij,nj->nti", pose[:, :3, :3], door) + pose[:, :3, 3]
    world = np.concatenate([np.repeat(X[:160, None], FRAMES, axis=1), moving])
    uv = project(np.einsum("tij,ntj->nti", R, world) + t) - CENTRE + rng.normal(0, 0.05, (len(X), FRAMES, 2))
    twist, speed = twist_of_joint("revolute", -AXIS, POINT, door.mean(0))
    s = Sightings(uv, np.ones(uv.shape[:2], bool), np.ones(len(uv)), FOCAL, R=R, t=t, link=link, free=True)
    right = polish(Bundle("screw", twist, q * speed, X, R=R, t=t), s)
    bent = replace(twist, curvature=-0.5 * twist.curvature)
    lost = replace(right, kind="revolute", twist=bent, q=right.q[::-1] * 0.5 - right.q[-1] * 0.5, cost=1e6, sigma=20.0)
    found = _hinge_of_screw({"revolute": lost, "screw": right}, s)["revolute"]
    assert found.kind == "revolute" and found.sigma < 0.07
    assert np.degrees(np.arccos(min(1, abs(found.twist.axis @ AXIS)))) < 0.5
    same = {"revolute": found, "screw": replace(right, cost=2 * found.cost)}
    assert _hinge_of_screw(same, s) is same


def test_points_out_of_all_proportion_explain_nothing_before_a_moving_camera_either():
    """A slide that puts a third of its points behind the camera, beside a scene that may be as far away as it likes."""
    T, link = 20, np.arange(60) < 30
    X = np.random.default_rng(0).uniform([-0.2, -0.2, 0.9], [0.2, 0.2, 1.1], (60, 3))
    X[~link, 2] += 8.0
    wide = X.copy()
    wide[:10, 2] = -0.5
    s = Sightings(np.zeros((60, T, 2)), np.ones((60, T), bool), np.ones(60), FOCAL, link=link)
    near = Bundle("revolute", Twist(np.zeros(3), np.array([1.0, 0, 0]), np.zeros(3)), np.zeros(T), X, sigma=0.1)
    s = replace(s, uv=near.X[:, None, :2].repeat(T, axis=1) / near.X[:, None, 2:] * FOCAL)
    costs, others = costs_of_both(near, replace(near, kind="prismatic", X=wide), s)
    assert costs.max() < 1e-6 and not others[10:].any()
    np.testing.assert_allclose(others[:10], (0.4**2) * T)


def test_a_link_that_errs_does_not_bend_the_path():
    """The link's tracks are ten times as noisy as the scene's, which hold the camera."""
    tracks, warp, _, q = scene(noise=0.07, link_noise=0.7)
    fit = fit_joint(replace(make_video(FRAMES), warp=warp), tracks, FOCAL, camera_moving=False)
    assert fit.type == "revolute", fit.reason
    assert angle(fit) < 3 * fit.std["axis_deg"] < 6
    assert np.abs(fit.q - q).max() < 0.05


def test_where_too_little_rests_the_result_says_what_was_done():
    tracks, warp, _, _ = scene(rest=30)
    fit = fit_joint(replace(make_video(FRAMES), warp=warp), tracks, FOCAL, camera_moving=False)
    assert fit.verdict == "refused" or "taken to its first view" in fit.reason


def test_what_is_carried_before_a_hand_held_camera_is_refused():
    tracks, warp, _, _ = scene(body="carried")
    fit = fit_joint(replace(make_video(FRAMES), warp=warp), tracks, FOCAL, camera_moving=False)
    assert fit.verdict == "refused", fit.type_probability


def test_what_rests_stays_near_a_link_of_the_wrong_type():
    """A door's tracks as a slide's: with the scene at infinity the camera could go wherever the swing needs it."""
    tracks, _, (R, t), q = scene(noise=0.05)
    uv = tracks.uv.astype(float) - CENTRE
    link = np.arange(len(uv)) >= 160
    pose = joint_transform("revolute", AXIS, POINT, -q)
    rng = np.random.default_rng(0)
    door = POINT + rng.uniform([0.02, -0.2, -0.02], [0.3, 0.2, 0.0], (45, 3))
    swing = np.einsum("tij,j->ti", pose[:, :3, :3], door.mean(0)) + pose[:, :3, 3] - door.mean(0)
    chord = swing[-1] / np.linalg.norm(swing[-1])
    X = np.concatenate([uv[:, 0] / FOCAL, np.ones((len(uv), 1))], axis=1)
    slide = Bundle("prismatic", Twist(np.median(X[link], axis=0), chord, np.zeros(3)), swing @ chord, X, R=R, t=t)
    relative = np.where(link, 1.0, 0.2)
    s = Sightings(uv, tracks.visible, np.ones(len(uv)), FOCAL, R=R, t=t, link=link, relative=relative, free=True,
                  lasting=40.0)
    last = polish(slide, s, iterations=40)
    ratio = np.median(last.X[~link, 2]) / np.median(last.X[link, 2])
    assert 1 / NEARBY / 2 < ratio < 2 * NEARBY


def test_a_scene_is_called_back_from_beyond():
    X = np.array([[0, 0, 1.0], [0.1, 0, 1.1], [0, 0.2, 0.9], [0, 0, 0.1], [0.3, 0, 2.0], [0, 0, 9.0]])
    b = Bundle("prismatic", Twist(np.zeros(3), np.array([1.0, 0, 0]), np.zeros(3)), np.zeros(4), X)
    s = Sightings(np.zeros((6, 4, 2)), np.ones((6, 4), bool), np.ones(6), FOCAL, link=np.arange(6) < 3)
    near = Nearby.of(b, s, 0.3)
    H, g = near.slopes(b.X)
    assert near.unit == 1.0 and not g[[0, 1, 2, 4]].any() and g[3, 2] < 0 < g[5, 2]
    h = 1e-6
    for k in (3, 5):
        step = np.zeros_like(b.X)
        step[k, 2] = h
        slope = (near.cost(b.X + step) - near.cost(b.X - step)) / (4 * h)
        assert slope == pytest.approx(g[k, 2], rel=1e-4)
        assert H[k, 2, 2] > 0 == np.count_nonzero(H[k]) - 1
    assert Nearby.of(b, replace(s, link=None), 0.3).cost(b.X) == 0


def test_a_resting_scene_may_be_as_far_away_as_it_likes_but_the_links_points_stay_together():
    X = np.array([[0, 0, 1.0], [0.1, 0, 1.0], [0, 0.1, 1.0], [0, 0.05, 5.0], [3.0, 0, 9.0], [0, 2.0, 4.0]])
    b = Bundle("prismatic", Twist(np.zeros(3), np.array([1.0, 0, 0]), np.zeros(3)), np.zeros(4), X)
    s = Sightings(np.zeros((6, 4, 2)), np.ones((6, 4), bool), np.ones(6), FOCAL, link=np.arange(6) < 4)
    reach = Reach.of(b, s, 0.3)
    H, g = reach.slopes(X)
    assert g[3, 2] > 0 and not g[[0, 1, 2, 4, 5]].any() and not H[4:].any()
    alone = Reach.of(replace(b, X=X[:4]), replace(s.of(np.arange(4)), link=None), 0.3)
    assert reach.cost(X) == pytest.approx(alone.cost(X[:4]))


def test_a_joint_that_needs_the_camera_to_go_along_is_the_less_probable():
    """A camera at rest, and one that goes 3 % of the link's depth with the swing, which the picture holds as well."""
    T, link = 41, np.arange(8) < 4
    X = np.column_stack([np.linspace(-0.1, 0.1, 8), np.zeros(8), np.where(link, 1.0, 3.0)])
    s = Sightings(np.zeros((8, T, 2)), np.ones((8, T), bool), np.ones(8), FOCAL, link=link, free=True)
    R, along = np.tile(np.eye(3), (T, 1, 1)), np.linspace(0, 1, T)[:, None] * np.array([0.03, 0, 0])
    t = np.random.default_rng(0).normal(0, 1e-5, (T, 3))
    still = Bundle("revolute", Twist(np.zeros(3), AXIS, np.zeros(3)), np.zeros(T), X, R=R, t=t)
    goes = replace(still, kind="prismatic", t=still.t - along)
    assert calmer(still, goes, s) > 10 and calmer(still, goes, s) == -calmer(goes, still, s)
    # In another unit of length it is the same path.
    twice = replace(goes, X=2 * X, t=2 * goes.t)
    assert calmer(still, twice, s) == pytest.approx(calmer(still, goes, s))
    # What a hand does anyhow says nothing, nor does a path that is not fitted.
    sway = 0.02 * np.sin(np.linspace(0, 9, T))[:, None] * np.array([1.0, 0.5, 0])
    swaying = [replace(b, t=b.t - sway) for b in (still, replace(still, t=0.9 * still.t))]
    assert abs(calmer(*swaying, s)) < 0.5
    assert calmer(still, goes, replace(s, free=False)) == 0.0

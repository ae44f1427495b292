"""The joint from tracks with depth: derivatives, every type, noise, refusals, and the scene folder's way in."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reconstruct.cues import ProviderInfo, Tracks
from reconstruct.joint.models import joint_transform
from reconstruct.joint.rigid import bundle, evidence, fit_rigid, normal
from reconstruct.joint.rigid.cues import fit_from_cues, sample
from reconstruct.joint.rigid.kabsch import kabsch
from reconstruct.joint.rigid.observe import Noise, Observations
from reconstruct.joint.rigid.twist import KINDS, make

K = np.array([[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1.0]])
AXIS, POINT = np.array([0.2, 0.9, 0.3]) / np.linalg.norm([0.2, 0.9, 0.3]), np.array([-0.15, 0.0, 1.2])


def tracks_of(kind, q, pitch=None, moving=90, static=50, px=0.0, depth=0.0, field=0.0, wrong=0.0, orbit=0.0, seed=0):
    """uv, visible, depth, camera poses, link: of a link at 1.2 m whose points move about one joint."""
    rng = np.random.default_rng(seed)
    T = len(q)
    X = np.concatenate([POINT + rng.uniform([0.0, -0.15, -0.03], [0.3, 0.15, 0.03], (moving, 3)),
                        POINT + rng.uniform([-0.2, -0.3, 0.1], [0.4, 0.3, 0.3], (static, 3))])  # fmt: skip
    M = joint_transform(kind, AXIS, POINT, np.asarray(q), pitch)
    world = np.repeat(X[:, None], T, axis=1)
    world[:moving] = np.einsum("tij,nj->nti", M[:, :3, :3], X[:moving]) + M[:, :3, 3]
    pose = np.tile(np.eye(4), (T, 1, 1))
    turn = Rotation.from_rotvec(np.linspace(0, orbit, T)[:, None] * [0, 1, 0]).as_matrix()
    pose[:, :3, :3] = turn
    pose[:, :3, 3] = np.array([0, 0, 1.2]) - turn @ [0, 0, 1.2]
    cam = np.einsum("tji,ntj->nti", turn, world - pose[:, :3, 3])
    uv = cam[..., :2] / cam[..., 2:] * 600 + K[:2, 2] + rng.normal(scale=px, size=(*world.shape[:2], 2))
    bad = rng.random(len(X)) < wrong
    uv[bad] += np.cumsum(rng.normal(scale=3.0, size=(bad.sum(), T, 2)), axis=1)
    z = cam[..., 2] * np.exp(rng.normal(scale=field, size=T) + rng.normal(scale=depth, size=cam.shape[:2]))
    visible = rng.random(cam.shape[:2]) < 0.9
    return uv, visible, z, pose, np.arange(len(X)) < moving


def angle(a, b):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b)))


STROKE = np.concatenate([np.zeros(3), 0.9 * np.sin(np.linspace(0, np.pi / 2, 20)), np.full(3, 0.9)])
NOISE = dict(px=0.7, depth=0.01, field=0.02, wrong=0.2)


@pytest.mark.parametrize("kind", KINDS)
def test_normal_equations_are_the_derivatives(kind):
    rng = np.random.default_rng(0)
    N, T = 8, 5
    twist, _ = make(kind, rng.normal(size=3), 0.3 * rng.normal(size=3), np.array([0.1, 0, 1.5]), 0.3)
    assert np.linalg.norm(twist.xi * np.repeat([0.3, 1], 3)) == pytest.approx(1)
    d = twist.basis().shape[1]
    assert d == {"prismatic": 2, "revolute": 4, "screw": 5}[kind]
    pose = np.tile(np.eye(4), (T, 1, 1))
    pose[:, :3, 3] = 0.02 * rng.normal(size=(T, 3))
    every = np.ones((N, T), bool)
    obs = Observations(np.zeros((N, T, 2)), np.zeros((N, T)), every, every, K, pose, np.arange(N) < 6,
                       rng.normal(size=(N, T, 3)))  # fmt: skip
    s = np.append(0, rng.normal(size=T - 1))
    points = np.array([0, 0, 1.5]) + 0.2 * rng.normal(size=(N, 3))
    st, noise = bundle.State(twist, s, points, 0.02 * rng.normal(size=(T, 3)), 0), Noise()
    P = d + normal.OWN * T

    def r(x):
        moved, factor = twist.moved(x[:d])
        own = x[d:P].reshape(T, normal.OWN)
        points_x = points + x[P:].reshape(N, 3)
        return bundle.residuals(bundle.State(moved, (s + own[:, 0]) * factor, points_x, st.field + own[:, 1:], 0),
                                obs, noise)[0].ravel()  # fmt: skip

    h = 1e-6
    J = np.stack([(r(h * e) - r(-h * e)) / (2 * h) for e in np.eye(P + 3 * N)], axis=-1)
    full = J.T @ J
    made = normal.normal_equations(st, obs, noise, *bundle.residuals(st, obs, noise), np.ones((N, T)), 0.0)
    prior = np.diag(np.concatenate([np.zeros(d), np.tile(np.r_[0, np.full(3, noise.field**-2)], T)]))
    size = np.abs(full).max()
    np.testing.assert_allclose(made.dense(), full[:P, :P] + prior, atol=1e-7 * size)
    np.testing.assert_allclose(made.coupling().reshape(P, -1), full[:P, P:], atol=1e-7 * size)
    np.testing.assert_allclose(made.gp.ravel(), (J.T @ r(np.zeros(P + 3 * N)))[P:], rtol=1e-5, atol=1e-3)


def test_conjugate_gradients_solve_what_factorisation_solves(monkeypatch):
    """Large problems never form the reduced system: the answer and its uncertainty are those of the small way."""
    uv, visible, z, pose, link = tracks_of("revolute", STROKE, px=0.5, depth=0.01, field=0.02)
    small = fit_rigid(uv, visible, z, K, pose, link)
    monkeypatch.setattr(normal, "DENSE_FRAMES", 5)
    large = fit_rigid(uv, visible, z, K, pose, link)
    assert large.type == small.type
    assert angle(large.axis, small.axis) < 0.05 * small.std["axis_deg"]
    np.testing.assert_allclose(large.q, small.q, atol=1e-4)
    assert large.std["axis_deg"] == pytest.approx(small.std["axis_deg"], rel=0.05)
    assert large.std["point_m"] == pytest.approx(small.std["point_m"], rel=0.05)
    assert 0.5 < np.median(large.std["q"][5:] / small.std["q"][5:]) < 1.2


def test_slide_is_the_limit_of_a_far_hinge():
    far, length = make("revolute", np.array([0, 0, 1e-7]), np.array([1.0, 0, 0]), np.zeros(3), 0.3)
    near, _ = make("prismatic", np.zeros(3), np.array([1.0, 0, 0]), np.zeros(3), 0.3)
    np.testing.assert_allclose(far.poses(np.array([0.5])), near.poses(np.array([0.5])), atol=1e-6)
    assert np.isfinite(far.spatial_jacobian(np.array([0.5]))).all()


def test_kabsch_ignores_wrong_points():
    rng = np.random.default_rng(1)
    a, R = rng.normal(size=(40, 3)), Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    b = a @ R.T + [1, 2, 3]
    b[:12] += rng.normal(size=(12, 3))
    Rh, d, e = kabsch(a, b)
    np.testing.assert_allclose(Rh, R, atol=1e-9)
    np.testing.assert_allclose(d, [1, 2, 3], atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("orbit", [0.0, 0.5])
def test_exact_tracks_give_the_exact_joint(kind, orbit):
    q = STROKE * (0.3 if kind == "prismatic" else 1.0)
    pitch = 0.05 if kind == "screw" else None
    uv, visible, z, pose, link = tracks_of(kind, q, pitch, orbit=orbit)
    fit = fit_rigid(uv, visible, z, K, pose, link)
    assert (fit.verdict, fit.type) == ("ok", kind)
    assert angle(fit.axis, AXIS) < 0.01
    assert np.abs(np.abs(fit.q) - np.abs(q)).max() < 1e-4
    if kind != "prismatic":
        assert np.linalg.norm(np.cross(fit.point - POINT, AXIS)) < 1e-4
    if kind == "screw":
        assert fit.pitch == pytest.approx(0.05, abs=1e-4)
    assert fit.metric and fit.scale_source == "depth"


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_noisy_tracks_err_as_stated(kind):
    """Over several draws the stated deviations describe the errors, and no answer is confidently wrong."""
    q = STROKE * (0.3 if kind == "prismatic" else 1.0)
    z_axis, z_point = [], []
    for seed in range(4):
        uv, visible, z, pose, link = tracks_of(kind, q, seed=seed, **NOISE)
        fit = fit_rigid(uv, visible, z, K, pose, link, seed=seed)
        assert (fit.verdict, fit.type) == ("ok", kind), fit.reason
        assert angle(fit.axis, AXIS) < 1.0
        z_axis.append(angle(fit.axis, AXIS) / fit.std["axis_deg"])
        if kind == "revolute":
            z_point.append(np.linalg.norm(np.cross(fit.point - POINT, AXIS)) / fit.std["point_m"])
    assert max(z_axis + z_point) < 3.5
    assert 0.15 < np.median(z_axis) < 1.8


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("seed", range(2))
def test_a_type_that_started_badly_is_judged_as_the_others_are(kind, seed, monkeypatch):
    """What is far behind is judged on the frames it was fitted to: that alone must not make it the answer."""
    monkeypatch.setattr("reconstruct.joint.rigid.fit.HOPELESS", 0.0)
    q = STROKE * (0.3 if kind == "prismatic" else 1.0)
    uv, visible, z, pose, link = tracks_of(kind, q, seed=seed, orbit=0.5, **NOISE)
    fit = fit_rigid(uv, visible, z, K, pose, link, seed=seed)
    assert (fit.verdict, fit.type) == ("ok", kind), fit.reason
    assert angle(fit.axis, AXIS) < 1.0


@pytest.mark.parametrize("seed", [0, 10])
@pytest.mark.parametrize("halves", [False, True])
def test_no_type_is_likelier_than_its_best_fit(seed, halves, monkeypatch):
    """A slide of three millimetres: frames left out may be met by a hinge that fits all of them no better."""
    asked = []

    def kept(states, obs, noise, inflation, lost=()):
        out = evidence.weigh_types(states, obs, noise, inflation, lost)
        r = {kind: bundle.residuals(st, obs, noise)[0] for kind, st in states.items()}
        cost = {kind: float(np.sum(np.where(obs.seen[..., None], r[kind], 0.0) ** 2)) for kind in r}
        asked.append((out, {kind: (cost["prismatic"] - c) / 2 / inflation for kind, c in cost.items()}))
        return out

    monkeypatch.setattr("reconstruct.joint.rigid.fit.weigh_types", kept)
    q = np.concatenate([np.zeros(3), 0.0027 * np.sin(np.linspace(0, np.pi / 2, 54)), np.full(3, 0.0027)])
    uv, visible, z, pose, link = tracks_of("prismatic", q, moving=120, seed=seed, orbit=0.7, **NOISE)
    if halves:
        visible[:120:2, 30:] = False
    fit_rigid(uv, visible, z, K, pose, link, seed=seed)
    assert asked
    for out, gain in asked:
        for kind in ("revolute", "screw"):
            odds = np.log(max(out.probability[kind], 1e-300) / out.probability["prismatic"])
            assert odds <= np.log(evidence.PRIOR[kind] / evidence.PRIOR["prismatic"]) + max(gain[kind], 0.0) + 1e-6


def test_link_is_told_from_its_motion_without_masks():
    uv, visible, z, pose, _ = tracks_of("revolute", STROKE, **NOISE)
    fit = fit_rigid(uv, visible, z, K, pose)
    assert fit.type == "revolute" and angle(fit.axis, AXIS) < 1.0
    assert (fit.point_track < 90).mean() > 0.95


def test_states_that_nothing_ties_to_the_rest_follow_their_neighbours():
    """One set of points is seen early, another late: the late states go on and say how unsure they are."""
    uv, visible, z, pose, link = tracks_of("revolute", np.linspace(0, 1.0, 30), px=0.3, depth=0.003)
    visible[:45, 15:] = False
    visible[45:90, :15] = False
    fit = fit_rigid(uv, visible, z, K, pose, link)
    assert fit.type == "revolute"
    q = fit.q * np.sign(fit.q[-1])
    miss = np.abs(q - np.linspace(0, 1.0, 30))
    assert miss[:15].max() < 0.02 and miss.max() < 0.05
    assert fit.std["q"][-1] > 1.5 * fit.std["q"][10]


def test_no_motion_and_free_motion_are_refused():
    still = tracks_of("revolute", np.zeros(20), px=0.5, depth=0.01)
    fit = fit_rigid(*still[:3], K, *still[3:])
    assert fit.verdict == "refused" and "nothing moves" in fit.reason
    rng = np.random.default_rng(0)
    T = 30
    s = np.linspace(0, 1, T)
    X = POINT + rng.uniform(-0.15, 0.15, (80, 3))
    turn = Rotation.from_rotvec(np.stack([0.9 * s**2, 0.8 * np.sin(np.pi * s), 0.7 * s], -1)).as_matrix()
    shift = np.stack([0.2 * np.sin(1.5 * np.pi * s), -0.2 * s, -0.2 * s**3], -1)
    cam = np.einsum("tij,nj->nti", turn, X - POINT) + POINT + shift
    uv = cam[..., :2] / cam[..., 2:] * 600 + K[:2, 2]
    free = fit_rigid(uv, np.ones((80, T), bool), cam[..., 2], K, np.tile(np.eye(4), (T, 1, 1)), np.ones(80, bool))
    assert free.verdict == "refused"
    assert "free body" in free.reason or "no joint" in free.reason


def test_too_few_tracks_are_refused():
    uv, visible, z, pose, link = tracks_of("revolute", STROKE, moving=5)
    fit = fit_rigid(uv, visible, z, K, pose, link)
    assert fit.verdict == "refused" and "only 5 tracks" in fit.reason


def test_cues_with_points_or_depth_maps_give_the_same_joint():
    uv, visible, z, pose, link = tracks_of("revolute", STROKE)
    tracks = Tracks(uv, visible, np.zeros(len(uv), int), ProviderInfo("made", "0", "Apache-2.0"))
    x = np.concatenate([(uv - K[:2, 2]) / 600 * z[..., None], z[..., None]], -1)
    fit = fit_from_cues(tracks, {"K": K, "T_world_camera": pose}, xyz_world=x)
    assert fit.type == "revolute" and angle(fit.axis, AXIS) < 0.05
    upright = fit_from_cues(tracks, {"K": K}, xyz_world=x)  # a resting camera whose pose nobody knows: z is up
    T = upright.T_camera_world
    assert angle(T[:3, :3] @ upright.axis, AXIS) < 0.05
    maps = np.arange(24.0).reshape(2, 3, 4)
    got = sample(maps, np.array([[[0.0, 0], [7.4, 5.2]]]), np.ones((1, 2), bool), (8, 6))
    np.testing.assert_array_equal(got, [[0.0, 23.0]])


def test_a_motion_that_starts_and_stops_at_once_is_not_smoothed():
    """Constant speed between two rests: nearly all second differences are nothing, two are not."""
    q = np.clip((np.arange(40) - 8) / 20, 0, 1)
    uv, visible, z, pose, link = tracks_of("revolute", q, px=0.5, depth=0.01, field=0.01)
    fit = fit_rigid(uv, visible, z, K, pose, link)
    assert np.abs(fit.q * np.sign(fit.q[-1]) - q).max() < 0.02


def test_covariance_is_that_of_many_draws():
    """Axis and point of fits to new noise scatter as one fit's covariance says, also together with the last state."""
    draws = []
    for seed in range(12):
        uv, visible, z, pose, link = tracks_of("revolute", STROKE, moving=40, static=20, px=0.7, depth=0.005, seed=0)
        rng = np.random.default_rng(seed)
        fit = fit_rigid(uv + rng.normal(scale=0.7, size=uv.shape), visible, z, K, pose, link)
        sign = np.sign(fit.axis @ AXIS)
        point = fit.point + fit.axis * ((POINT - fit.point) @ fit.axis)
        draws.append(np.concatenate([sign * fit.axis, point, [sign * fit.q[-1]]]))
    C, with_q = fit.std["covariance"], fit.std["covariance_q"]
    assert C.shape == (6, 6) and with_q.shape == (6, len(STROKE))
    assert np.linalg.eigvalsh(C).min() > -1e-6 * np.linalg.eigvalsh(C).max()
    assert np.degrees(np.sqrt(np.trace(C[:3, :3]))) == pytest.approx(fit.std["axis_deg"])
    assert np.abs(fit.axis @ C[:3, :3] @ fit.axis) < 1e-6 * np.trace(C[:3, :3])  # an axis errs across itself
    scatter = np.cov(np.array(draws)[:, :3].T)
    assert 0.1 < np.trace(scatter) / np.trace(C[:3, :3]) < 2.0
    # No correlation beyond one.
    spread = np.sqrt(np.maximum(np.diag(C), 0))[:, None] * fit.std["q"]
    assert (np.abs(with_q) <= 1.05 * spread + 1e-12).all()


def test_a_lid_that_turns_more_than_once_is_a_screw():
    q = np.radians(420) * np.clip((np.arange(40) - 3) / 34, 0, 1)
    uv, visible, z, pose, link = tracks_of("screw", q, pitch=0.012, px=0.5, depth=0.005, field=0.005)
    fit = fit_rigid(uv, visible, z, K, pose, link)
    assert fit.type == "screw" and abs(fit.pitch) == pytest.approx(0.012, rel=0.05)
    assert np.ptp(fit.q) == pytest.approx(np.radians(420), rel=0.01) and angle(fit.axis, AXIS) < 0.5
    assert abs(abs(fit.pitch) - 0.012) < 4 * fit.std["pitch"]


@pytest.mark.parametrize(("stroke", "verdict", "reason"), [
    (0.002, "ambiguous", "60 tracks with depth hold the axis to 20 deg only"),
    (0.006, "ok", "60 tracks with depth agree"),
])  # fmt: skip
def test_an_axis_that_is_hardly_known_is_not_called_sure_nor_is_its_type(stroke, verdict, reason):
    uv, visible, z, pose, link = tracks_of("prismatic", STROKE / 0.9 * stroke, px=0.7, depth=0.01, field=0.02,
                                           moving=60, seed=1)  # fmt: skip
    fit = fit_rigid(uv, visible, z, K, pose, link)
    assert fit.type == "prismatic" and fit.verdict == verdict
    assert (fit.type_probability["prismatic"] > 0.9) == (verdict == "ok")
    assert fit.reason.startswith(reason)

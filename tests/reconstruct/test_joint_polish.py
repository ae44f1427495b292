"""The twist family and its bundle adjustment: derivatives, the noise's own bound, and which type."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from reconstruct.joint.kinds import tempered, votes
from reconstruct.joint.models import joint_transform
from reconstruct.joint.polish import (
    Bundle,
    Sightings,
    normal_equations,
    place_points,
    polish,
    positions,
    radius_cost,
    regauged,
    residuals,
)
from reconstruct.joint.twist import Twist, twist_of_joint
from reconstruct.joint.uncertainty import compact, lasting_error, shared_error, spread, strayed
from reconstruct.joint.weigh import FREE_BODY, type_probabilities

FOCAL, SIGMA = 700.0, 0.5
number = st.floats(-2, 2)


def scene(kind, seed=0, points=60, frames=40, stroke=0.8, noise=SIGMA):
    """A link seen by a static camera, its truth as a bundle, and its sightings."""
    rng = np.random.default_rng(seed)
    axis = np.array([0.2, 1.0, 0.3]) / np.linalg.norm([0.2, 1.0, 0.3])
    point = np.array([-0.3, 0.0, 1.6])
    X = point + rng.uniform([0.05, -0.3, -0.05], [0.5, 0.3, 0.05], (points, 3))
    twist, speed = twist_of_joint(kind, axis, None if kind == "prismatic" else point, X.mean(0))
    q = stroke * np.sin(np.linspace(0, np.pi / 2, frames)) * speed
    truth = Bundle(kind, twist, q, X, sigma=noise)
    blank = Sightings(np.zeros((points, frames, 2)), np.ones((points, frames), bool), np.ones(points), FOCAL)
    uv = residuals(truth, blank) + rng.normal(scale=noise, size=(points, frames, 2))
    return truth, replace(blank, uv=uv)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(["revolute", "prismatic"]), number, number, st.floats(-2.5, 2.5))
def test_a_twist_moves_points_as_the_joint_does(kind, x, y, q):
    axis, point, anchor = np.array([0.6, 0.0, 0.8]), np.array([0.1, -0.4, 1.0]), np.array([0.5, 0.5, 1.5])
    twist, speed = twist_of_joint(kind, axis, point, anchor)
    R, p = twist.pose(np.array([q * speed]))
    moved = anchor + R[0] @ (np.array([x, y, 1.0]) - anchor) + p[0]
    T = joint_transform(kind, axis, point, q)
    np.testing.assert_allclose(moved, T[:3, :3] @ [x, y, 1.0] + T[:3, 3], atol=1e-9)


def test_a_far_hinge_becomes_a_slide_smoothly():
    anchor, q = np.array([0.0, 0.0, 1.0]), np.linspace(-0.5, 0.5, 7)
    slide = Twist(anchor, np.array([1.0, 0, 0]), np.zeros(3)).pose(q)[1]
    for k in (1e-3, 1e-6, 1e-9):
        hinge = Twist(anchor, np.array([1.0, 0, 0]), np.array([0, 0, k])).pose(q)[1]
        assert np.abs(hinge - slide).max() <= 0.2 * k


@pytest.mark.parametrize("kind", ["revolute", "prismatic", "screw"])
def test_derivatives_of_the_bundle_adjustment(kind):
    truth, s = scene("revolute" if kind == "screw" else kind)
    b = replace(truth, kind=kind)
    world, cam = positions(b, s)
    r = residuals(b, s, cam)
    n = normal_equations(b, s, world, cam, r, s.seen.astype(float))
    G, h = n.Z.shape[1], 1e-6
    cost = lambda b: 0.5 * np.sum(residuals(b, s) ** 2)  # noqa: E731
    for k in range(G):
        up, down = (replace(b, twist=b.twist.moved(sign * h * n.Z[:, k], kind)) for sign in (1, -1))
        assert (cost(up) - cost(down)) / (2 * h) == pytest.approx(n.g[k], rel=1e-3, abs=0.1)
    step = np.zeros(len(b.q))
    step[7] = h
    slope = (cost(replace(b, q=b.q + step)) - cost(replace(b, q=b.q - step))) / (2 * h)
    assert slope == pytest.approx(n.g[G + 7], rel=1e-3, abs=0.1)


def test_derivatives_of_free_cameras():
    truth, s = scene("revolute", points=30, frames=12)
    rng = np.random.default_rng(0)
    R = Rotation.from_rotvec(rng.normal(scale=0.05, size=(12, 3))).as_matrix()
    s = replace(s, link=np.arange(30) < 20, free=True)
    b = replace(truth, R=R, t=rng.normal(scale=0.02, size=(12, 3)))
    world, cam = positions(b, s)
    r = residuals(b, s, cam)
    n = normal_equations(b, s, world, cam, r, s.seen.astype(float))
    cost = lambda b: 0.5 * np.sum(residuals(b, s) ** 2)  # noqa: E731
    np.testing.assert_allclose(world[20:], np.repeat(truth.X[20:, None], 12, axis=1))
    h, at = 1e-6, n.lead + 12 + 6 * 5
    for k in range(6):
        step = np.zeros(6)
        step[k] = h
        turned = [Rotation.from_rotvec(sign * step[:3]).as_matrix() @ R[5] for sign in (1, -1)]
        both = []
        for sign, Rk in zip((1, -1), turned, strict=True):
            Rs, ts = R.copy(), b.t.copy()
            Rs[5] = Rk
            ts[5] += sign * step[3:]
            both.append(cost(replace(b, R=Rs, t=ts)))
        assert (both[0] - both[1]) / (2 * h) == pytest.approx(n.g[at + k], rel=1e-3, abs=0.1)
    np.testing.assert_allclose(n.H, n.H.T, atol=1e-6 * np.abs(n.H).max())


def test_a_track_that_slides_off_slowly_is_noticed_and_shared_errors_are_not():
    rng = np.random.default_rng(0)
    r, seen = rng.normal(size=(60, 80, 2)), np.ones((60, 80), bool)
    assert strayed(r, seen, 1.0, 1.0).mean() < 0.03
    r[3, 40:] += np.linspace(0, 6, 40)[:, None]
    lost = strayed(r, seen, 1.0, 1.0)
    assert lost[3, 60:].all()
    assert not lost[3, :20].any()
    assert np.delete(lost, 3, axis=0).mean() < 0.03
    r[:, 50:60] *= 6  # all of them: fast motion, not strays
    assert np.delete(strayed(r, seen, 1.0, 1.0), 3, axis=0).mean() < 0.03


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_error_is_that_of_the_noise_and_stated_as_such(kind):
    ratio, stated = [], []
    for seed in range(8):
        truth, s = scene(kind, seed)
        rng = np.random.default_rng(seed)
        start = replace(truth, X=truth.X * rng.uniform(0.95, 1.05, (len(truth.X), 1)),
                        twist=truth.twist.moved(rng.normal(scale=0.05, size=6), kind))  # fmt: skip
        fit = polish(start, s, iterations=30)
        error = np.degrees(np.arccos(min(1.0, abs(fit.twist.axis @ truth.twist.axis))))
        stated.append(spread(fit, s).axis_deg)
        ratio.append(error / spread(truth, s).axis_deg)
        assert fit.sigma == pytest.approx(SIGMA, rel=0.1)
    assert np.sqrt(np.mean(np.square(ratio))) < 1.5
    assert np.mean(np.array(ratio) < 2) >= 0.85
    assert np.mean(stated) == pytest.approx(np.mean([spread(*scene(kind, k)).axis_deg for k in range(8)]), rel=0.3)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_type_from_one_family(kind):
    truth, s = scene(kind, 3)
    bent = replace(truth.twist, curvature=np.array([0.0, 0.2, 0.0]))
    others = {
        "revolute": replace(truth, kind="revolute", twist=bent.moved(np.zeros(6), "revolute")),
        "prismatic": replace(truth, kind="prismatic", twist=truth.twist.moved(np.zeros(6), "prismatic")),
        "screw": replace(truth, kind="screw", twist=bent),
    }
    best = {k: polish(truth if k == kind else b, s, iterations=40) for k, b in others.items()}
    p = type_probabilities(best, s)
    assert p[kind] > 0.9
    assert sum(p.values()) == pytest.approx(1)


def carried(share, seed=3):
    """Every type's best for a small hinge of which the tracks at one end are carried along its axis too."""
    truth, s = scene("revolute", seed, stroke=0.25)
    aside = truth.X @ truth.twist.axis
    lifted = aside >= np.quantile(aside, 1 - share)
    moved = replace(truth, kind="screw", twist=replace(truth.twist, direction=truth.twist.direction
                                                       + 0.2 * truth.twist.axis))  # fmt: skip
    uv = np.where(lifted[:, None, None], s.uv + residuals(moved, s) - residuals(truth, s), s.uv)
    s = replace(s, uv=uv)
    slide = replace(truth, kind="prismatic", twist=truth.twist.moved(np.zeros(6), "prismatic"))
    starts = {"revolute": [truth], "prismatic": [slide], "screw": [truth, moved]}
    tried = {k: [polish(replace(b, kind=k), s, iterations=40) for b in several] for k, several in starts.items()}
    return {k: min(several, key=lambda b: b.cost) for k, several in tried.items()}, s


def test_a_part_of_the_tracks_does_not_make_a_free_body():
    best, s = carried(0.2)
    gain = best["revolute"].cost - best["screw"].cost
    assert gain / (2 * best["screw"].sigma ** 2) > 20  # by its likelihood alone it would be one
    assert type_probabilities(best, s).get("screw", 0.0) < FREE_BODY
    best, s = carried(1.0)
    assert type_probabilities(best, s)["screw"] > FREE_BODY


def strayed_small_motion(kind, seed, points=120, frames=60):
    """Both types' best for a motion of a few pixels of which a fifth of the tracks drift off by up to as much."""
    truth, s = scene(kind, seed, points, frames, stroke=0.02 if kind == "prismatic" else 0.05)
    rng, t, uv = np.random.default_rng(100 + seed), np.arange(frames), s.uv.copy()
    for i in rng.choice(points, points // 5, replace=False):
        start, drift = rng.integers(0, frames // 2), rng.normal(size=2) * 6.0 * rng.uniform()
        uv[i] += np.clip((t - start) / (frames - start), 0, 1)[:, None] * drift
    s = replace(s, uv=uv)
    straight = replace(truth, kind="prismatic", twist=replace(truth.twist, curvature=np.zeros(3)))
    across = np.linalg.svd(truth.twist.direction[None])[2][1:]
    bent = [replace(truth, kind="revolute", twist=replace(truth.twist, curvature=e)) for e in (*across, *-across)]
    hinges = [polish(b, s, iterations=60) for b in (bent if kind == "prismatic" else [truth])]
    best = {"revolute": min(hinges, key=lambda b: b.cost + radius_cost(b, s))}
    return best | {"prismatic": polish(straight, s, iterations=60)}, s


@pytest.mark.parametrize("seed", [2, 8])
@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_what_few_tracks_gain_is_no_evidence(kind, seed):
    best, s = strayed_small_motion(kind, seed)
    hinge, slide = best["revolute"], best["prismatic"]
    # By its likelihood alone either would be a hinge.
    assert (slide.cost - hinge.cost) / (2 * hinge.sigma**2) > 10
    assert type_probabilities(best, s)[kind] > 0.9


def test_a_slide_whose_points_are_no_link_is_not_sure():
    """A small laptop was a sure slide of which a seventh of the points were far before and behind the others."""
    best, s = strayed_small_motion("prismatic", 2)
    assert type_probabilities(best, s)["prismatic"] > 0.9
    far = np.where(np.arange(len(s.uv)) % 8 == 0, 12.0, 1.0)[:, None]
    p = type_probabilities({kind: replace(b, X=far * b.X) for kind, b in best.items()}, s)
    assert 0.4 < p["prismatic"] < 0.8


@pytest.mark.parametrize(("most", "leads"), [(-0.2, "prismatic"), (0.2, "revolute")])
def test_where_the_votes_are_against_the_odds_the_side_of_most_neighbourhoods_leads(most, leads, monkeypatch):
    """Blades and a drawer of some pixels were hinges so, the more frequent type; none of them is sure."""
    truth, s = scene("prismatic", 0)
    across = np.linalg.svd(truth.twist.direction[None])[2][1]
    near = replace(truth, kind="revolute", twist=replace(truth.twist, curvature=2.0 * across))
    best = {"prismatic": polish(truth, s), "revolute": polish(near, s, iterations=60)}
    assert type_probabilities(best, s, [near])["prismatic"] > 0.9
    monkeypatch.setattr("reconstruct.joint.weigh.votes", lambda *_: -1.0)
    monkeypatch.setattr("reconstruct.joint.weigh.majority", lambda *_: most)
    p = type_probabilities(best, s, [near])
    assert max(p, key=lambda kind: p[kind]) == leads
    assert p[leads] < 0.9


def test_lasting_and_shared_errors_are_measured():
    rng = np.random.default_rng(0)
    white = rng.normal(size=(40, 80, 2))
    seen, cluster = np.ones((40, 80), bool), np.arange(40) // 4
    assert lasting_error(white, seen) < 1.5
    assert shared_error(white, seen, cluster) < 0.05
    slow = np.repeat(rng.normal(size=(40, 8, 2)), 10, axis=1)
    assert lasting_error(slow, seen) > 5
    together = white + 2 * np.repeat(rng.normal(size=(10, 80, 2)), 4, axis=0)
    assert shared_error(together, seen, cluster) > 0.6


def test_points_find_their_place_and_strays_are_told_apart():
    truth, s = scene("revolute", 5)
    lost = replace(truth, X=np.tile(np.median(truth.X, axis=0), (len(truth.X), 1)))
    found = place_points(lost, s)
    assert np.median(np.linalg.norm(found.X - truth.X, axis=1)) < 0.02
    X = np.concatenate([truth.X, truth.X[:3] * 4])
    assert compact(X).tolist() == [True] * len(truth.X) + [False] * 3


def test_a_point_that_no_frame_shows_is_placed_by_its_prior_alone():
    """There was no answer to that: a matrix of rank one."""
    truth, s = scene("revolute", 5)
    seen = s.seen.copy()
    seen[0] = False
    far = replace(truth, X=np.concatenate([3 * truth.X[:1], truth.X[1:]]), sigma=1000.0)
    found = place_points(far, replace(s, seen=seen))
    assert np.isfinite(found.X).all()


def test_a_point_whose_depth_nothing_holds_says_nothing_about_the_unit():
    truth, s = scene("revolute", 5)
    seen, X = s.seen.copy(), truth.X.copy()
    seen[0, 1:] = False  # one frame: every depth explains it
    X[0] *= 100
    stated = spread(replace(truth, X=X), replace(s, seen=seen))
    assert stated.point == pytest.approx(spread(truth, s).point, rel=0.1)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_start_far_from_its_scale_and_anchor_arrives_as_well(kind):
    """Nothing holds the scale before a resting camera: a link that has gone to a fiftieth of its anchor's depth."""
    truth, s = scene(kind, stroke=0.2)
    near = replace(truth, X=truth.X / 50, q=truth.q / 50,
                   twist=Twist(truth.twist.anchor / 50, truth.twist.direction, 50 * truth.twist.curvature))  # fmt: skip
    moved = np.array([0.0, 0.0, 1.0])
    velocity = near.twist.direction + np.cross(near.twist.curvature, moved - near.twist.anchor)
    speed = np.linalg.norm(velocity)
    odd = replace(near, q=near.q * speed, twist=Twist(moved, velocity / speed, near.twist.curvature / speed))
    same = regauged(odd, s)
    np.testing.assert_allclose(residuals(same, s), residuals(truth, s), atol=1e-6)
    assert abs(np.median(same.X[:, 2]) - 1) < 1e-9
    assert np.linalg.norm(same.twist.anchor - np.median(same.X, axis=0)) < np.linalg.norm(np.ptp(same.X, axis=0))
    assert regauged(same, s) is same
    assert polish(odd, s).cost == pytest.approx(polish(truth, s).cost, rel=1e-3)


def test_neighbourhoods_that_disagree_temper_a_likelihood():
    """What some tracks shout against what the others say is not certain, whatever the likelihood."""
    cluster = np.repeat(np.arange(20), 5)
    rng = np.random.default_rng(0)
    even = rng.uniform(1, 2, 100)
    agreed = votes(even, even + 0.5 + 0.1 * rng.random(100), cluster)
    split = votes(even, even + np.where(cluster < 8, 10.0, -6.0), cluster)
    assert agreed > 6 and abs(split) < 1
    assert votes(even + 0.5 + 0.1 * rng.random(100), even, cluster) < -6
    assert votes(even[:10], even[:10] + 1, cluster[:10]) == 0.0  # two neighbourhoods are no vote
    assert tempered(50.0, agreed) > 20 and tempered(-50.0, -agreed) < -20
    assert 0 <= tempered(50.0, split) < 2
    assert tempered(50.0, -3.0) == 0.0 and tempered(2.0, agreed) == 2.0


def test_a_hinge_is_no_nearer_or_farther_than_hinges_are_where_the_pictures_do_not_say():
    """A hinge that turns by two degrees at the noise of tracks: its prior decides, and lets go elsewhere."""
    truth, s = scene("revolute", stroke=0.03, noise=0.5)
    size = np.linalg.norm(np.quantile(truth.X, 0.95, axis=0) - np.quantile(truth.X, 0.05, axis=0))
    lasting = replace(s, lasting=40.0)
    far = replace(truth, twist=replace(truth.twist, curvature=0.02 * truth.twist.curvature))
    held = polish(place_points(far, lasting), lasting, iterations=40, hold=30.0)
    radius = 1 / np.linalg.norm(held.twist.curvature) / np.median(held.X[:, 2]) * np.median(truth.X[:, 2])
    assert 0.3 < radius / size < 0.7
    assert radius_cost(held, lasting) < radius_cost(far, lasting)
    clear, t = scene("revolute", stroke=0.8)
    off = [polish(clear, t, hold=h).twist.axis @ clear.twist.axis for h in (0.0, 1.0)]
    assert abs(off[0] - off[1]) < 1e-5

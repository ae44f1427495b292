"""Several joints of one scene: each found by its own motion, none invented."""

from dataclasses import replace

import numpy as np
import pytest

from reconstruct.joint.models import joint_transform, placed
from reconstruct.joint.rigid.several import fit_joints

K = np.array([[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1.0]])
OUT = np.array([0.5, 0.2, -0.8]) / np.linalg.norm([0.5, 0.2, -0.8])
DOWN = np.array([1.0, 0.0, 0.0])
EARLY = np.concatenate([np.linspace(0, 1, 15), np.ones(25)])
LATE = np.concatenate([np.zeros(18), np.linspace(0, 1, 15), np.ones(7)])
BOTH = np.concatenate([np.zeros(5), np.sin(np.linspace(0, np.pi / 2, 30)), np.ones(5)])


def scene(parts, static=200, wrong=0.2, px=0.7, seed=0):
    """uv, visible, depth, pose of a resting camera before a front at 1.2 m; which part each track is on (-1: wrong).

    parts: (kind, axis, point, q (T,), centre of the part, how many tracks).
    """
    rng = np.random.default_rng(seed)
    T = len(parts[0][3])
    X, owner = [rng.uniform([-0.5, -0.35, 1.2], [0.5, 0.35, 1.5], (static, 3))], [np.zeros(static, int)]
    for k, part in enumerate(parts, 1):
        X.append(np.asarray(part[4]) + rng.uniform([-0.14, -0.07, -0.03], [0.14, 0.07, 0.03], (part[5], 3)))
        owner.append(np.full(part[5], k))
    X, owner = np.concatenate(X), np.concatenate(owner)
    world = np.repeat(X[:, None], T, axis=1)
    for k, (kind, axis, point, q, *_) in enumerate(parts, 1):
        M = joint_transform(kind, axis, point, q)
        on = owner == k
        world[on] = np.einsum("tij,nj->nti", M[:, :3, :3], X[on]) + M[:, :3, 3]
    uv = world[..., :2] / world[..., 2:] * 600 + K[:2, 2] + rng.normal(scale=px, size=(*world.shape[:2], 2))
    bad = rng.random(len(X)) < wrong
    uv[bad] += np.cumsum(rng.normal(scale=4.0, size=(bad.sum(), T, 2)), axis=1)
    owner[bad] = -1
    z = world[..., 2] * np.exp(rng.normal(scale=0.01, size=T) + rng.normal(scale=0.01, size=world.shape[:2]))
    return uv, rng.random(world.shape[:2]) < 0.9, z, np.tile(np.eye(4), (T, 1, 1)), owner


def angle(a, b):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b)))


DRAWERS = [("prismatic", OUT, None, 0.2 * EARLY, (-0.1, -0.1, 1.2), 70),
           ("prismatic", OUT, None, 0.15 * LATE, (-0.1, 0.1, 1.2), 55)]  # fmt: skip
MIXED = [("prismatic", OUT, None, 0.2 * BOTH, (-0.2, -0.1, 1.2), 70),
         ("revolute", DOWN, np.array([0.0, 0.2, 1.2]), 0.8 * BOTH, (0.15, 0.1, 1.2), 60)]  # fmt: skip
THREE = [*DRAWERS, ("prismatic", OUT, None, -0.1 * BOTH, (0.3, 0.1, 1.2), 60)]


@pytest.mark.parametrize(("parts", "seed"), [(DRAWERS, 0), (MIXED, 2), pytest.param(THREE, 3, marks=pytest.mark.slow)])
def test_every_part_that_moves_gets_its_joint(parts, seed):
    uv, visible, z, pose, owner = scene(parts, seed=seed)
    fit = fit_joints(uv, visible, z, K, pose)
    joints = [fit, *fit.further]
    assert fit.verdict == "ok" and len(joints) == len(parts)
    seen = set()
    for joint in joints:
        members = owner[joint.point_track]
        k = int(np.bincount(members[members > 0]).argmax())
        assert np.mean(members == k) > 0.95
        seen.add(k)
        kind, axis, point, q, *_ = parts[k - 1]
        assert joint.type == kind and angle(joint.axis, axis) < 1.5
        assert abs(np.ptp(joint.q) / np.ptp(q) - 1) < 0.05
        if point is not None:
            off = joint.point - point
            assert np.linalg.norm(off - (off @ axis) * axis) < 0.01
    assert len(seen) == len(parts)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_one_part_and_wrong_tracks_are_one_joint(seed):
    """A third of all tracks is wrong: they never agree on a second joint."""
    uv, visible, z, pose, _ = scene(DRAWERS[:1], wrong=0.35, seed=10 + seed)
    fit = fit_joints(uv, visible, z, K, pose)
    assert fit.verdict == "ok" and fit.further == ()


@pytest.mark.slow
def test_a_free_body_beside_a_drawer_is_no_joint():
    """A cup that is carried past: its tracks agree with each other, and with no joint."""
    uv, visible, z, pose, _ = scene(DRAWERS[:1], seed=5)
    rng = np.random.default_rng(0)
    T = uv.shape[1]
    from scipy.spatial.transform import Rotation

    X = rng.uniform(-0.06, 0.06, (40, 3))
    way = np.stack([0.3 * np.sin(np.linspace(0, 6, T)), 0.2 * np.cos(np.linspace(0, 4, T)), 0.1 * np.linspace(0, 1, T)],
                   axis=-1)  # fmt: skip
    turn = Rotation.from_rotvec(np.linspace(0, 1, T)[:, None] * [0.3, 1.0, -0.5] + way[:, ::-1]).as_matrix()
    world = np.einsum("tij,nj->nti", turn, X) + way + [0.1, 0.0, 1.0]
    cup = world[..., :2] / world[..., 2:] * 600 + K[:2, 2] + rng.normal(scale=0.7, size=(40, T, 2))
    fit = fit_joints(np.concatenate([uv, cup]), np.concatenate([visible, np.ones((40, T), bool)]),
                     np.concatenate([z, world[..., 2]]), K, pose)  # fmt: skip
    assert fit.verdict == "ok" and fit.further == ()


def test_a_placed_joint_moves_the_same_pixels():
    uv, visible, z, pose, owner = scene(DRAWERS[:1], wrong=0.0)
    fit = fit_joints(uv, visible, z, K, pose)
    fit = replace(fit, further=(replace(fit, q=-fit.q),))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = joint_transform("revolute", DOWN, np.zeros(3), 0.7)[:3, :3], [0.1, 2.0, -1.0]
    moved = placed(fit, T, 1.7)
    for a, b in zip([fit, *fit.further], [moved, *moved.further], strict=True):
        at = lambda f: f.project(f.points @ f.link_pose(f.q[-1])[:3, :3].T + f.link_pose(f.q[-1])[:3, 3])  # noqa: E731
        np.testing.assert_allclose(at(a), at(b), atol=1e-6)
        assert b.std["point_m"] == pytest.approx(1.7 * a.std["point_m"])

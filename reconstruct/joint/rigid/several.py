"""Several joints of one scene from tracks with depth: one after the other, each from what the others leave.

Every link hangs on the static scene by a joint of its own. The moving tracks are taken for one link first, as
:func:`reconstruct.joint.rigid.fit.fit_rigid` does. What does not follow that joint is searched for tracks that move
together: small groups of neighbours are registered as a rigid body, a joint is read off their poses, and the joint that
the most tracks follow names the group. The group is then fitted like a first one and has to pass every refusal by
itself. Two links can pull the first joint between them: where it explains but a part of the moving tracks, groups
are sought among all of them, and it stays if they are not two or more.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reconstruct.joint.models import JointFit
from reconstruct.joint.rigid.fit import MIN_TRACKS, fit_rigid, key_frames, moving_tracks
from reconstruct.joint.rigid.kabsch import hypotheses, register
from reconstruct.joint.rigid.observe import Observations, observe, robust_mean, static_field

MOST_JOINTS = 9
OWN_TRACKS, OWN_SHARE = 12, 0.1
"""Least tracks of a further link: so many, and so many of the first link's. Wrong tracks agree by chance in few."""
NEAR = 0.006
"""Of the picture's diagonal: how far a track may lie, in most of its frames, from where a joint carries its point."""
FOLLOWS = 0.7
"""Share of a track's frames in which it has to be that near."""
MIXED = 0.6
"""Share of the moving tracks under which the first joint may be a mixture of two."""
LEAST_MOVED = 0.92
"""Quantile of its distances from one place by which a track moves: a twelfth of the video is enough."""
SEEDS, NEIGHBOURS, FRAMES = 24, 10, 12


def fit_joints(uv: np.ndarray, visible: np.ndarray, depth: np.ndarray, K: np.ndarray, T_world_camera: np.ndarray,
               link: np.ndarray | None = None, metric: bool = True, seed: int = 0) -> JointFit:  # fmt: skip
    """All joints of a scene; arguments as :func:`reconstruct.joint.rigid.fit.fit_rigid`.

    Returns:
        The joint that most tracks follow, or a refusal; the others are its ``further``, in the same world.
    """
    rng = np.random.default_rng(seed)
    N = len(visible)
    obs = observe(uv, visible, np.asarray(depth, float), K, T_world_camera, np.zeros(N, bool))
    moving = moving_tracks(obs) if link is None else np.asarray(link, bool)
    first = fit_rigid(uv, visible, depth, K, T_world_camera, moving, metric, seed)
    # Parts that rest most of the time are not among the first fit's moving tracks, and not at rest either.
    pool = moving | moving_tracks(obs, LEAST_MOVED)
    if pool.sum() < MIN_TRACKS:
        return first
    obs = replace(obs, link=pool)
    world = obs.lift(static_field(obs)[0])

    def fit_group(group: np.ndarray) -> JointFit:
        rows = np.concatenate([np.flatnonzero(~pool), group])
        part = np.arange(len(rows)) >= len(rows) - len(group)
        fit = fit_rigid(uv[rows], visible[rows], depth[rows], K, T_world_camera, part, metric, seed)
        return fit if fit.verdict == "refused" else replace(fit, point_track=rows[fit.point_track], tracks=N)

    found, free = [], pool.copy()
    if first.verdict != "refused":
        # Its inliers are tracks that agree somewhere; those that follow it throughout are what tells.
        follows = _follows(first, obs, world)
        if (follows & moving).sum() >= MIXED * moving.sum():
            found, free = [first], pool & ~follows
    while len(found) < MOST_JOINTS:
        least = max(OWN_TRACKS, OWN_SHARE * found[0].inliers) if found else OWN_TRACKS
        group = _group(obs, world, free, rng)
        if len(group) < least:
            break
        fit = fit_group(group)
        free[group] = False  # whatever comes of it, these tracks are not asked again
        if fit.verdict != "refused" and fit.inliers >= least:
            free &= ~_follows(fit, obs, world)
            found.append(fit)
    if len(found) < 2:
        return found[0] if found and first.verdict == "refused" else first
    if found[0] is not first:
        found.sort(key=lambda fit: -fit.inliers)
    words = f"{found[0].reason}; {len(found)} parts move, each on a joint of its own"
    return replace(found[0], reason=words, further=tuple(found[1:]))


def _follows(fit: JointFit, obs: Observations, world: np.ndarray) -> np.ndarray:
    """(N,) bool: tracks that a fitted joint explains."""
    return _near(fit.link_pose(fit.q), obs, world)


def _near(poses: np.ndarray, obs: Observations, world: np.ndarray) -> np.ndarray:
    """(N,) bool: tracks whose pixels are near, in most frames, to one point carried by poses (T, 4, 4)."""
    near = _miss(poses, obs, world) < NEAR * 2 * float(np.linalg.norm(obs.K[:2, 2]))
    return (near & obs.seen).sum(1) >= FOLLOWS * np.maximum(obs.seen.sum(1), 1)


def _miss(poses: np.ndarray, obs: Observations, world: np.ndarray) -> np.ndarray:
    """(N, T) px between tracks and the pictures of one point each that poses (T, 4, 4) carry."""
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    X = robust_mean(np.einsum("tji,ntj->nti", R, world - t))
    moved = np.einsum("tij,nj->nti", R, X) + t
    cam = np.einsum("tij,ntj->nti", obs.T_camera_world[:, :3, :3], moved) + obs.T_camera_world[:, :3, 3]
    uv = cam[..., :2] / np.maximum(cam[..., 2:], 1e-6) * obs.K[[0, 1], [0, 1]] + obs.K[:2, 2]
    return np.linalg.norm(uv - obs.uv, axis=-1)


def _group(obs: Observations, world: np.ndarray, free: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Indices of the largest set of free tracks that follow one joint, read off a few neighbours' poses."""
    usable = np.flatnonzero(free & (obs.ranged.sum(1) >= 4))
    best = np.zeros(0, int)
    if len(usable) < OWN_TRACKS:
        return best
    keys = key_frames(world[usable])
    keys = keys[np.unique(np.linspace(0, len(keys) - 1, min(FRAMES, len(keys))).round().astype(int))]
    if len(keys) < 3:
        return best
    some = obs.of(usable, keys)
    lifted = world[np.ix_(usable, keys)]
    # Where tracks are when they are seen: neighbours on the picture in the frames they share.
    place = np.where(some.seen[..., None], some.uv, np.nan)
    for seed in rng.permutation(len(usable))[:SEEDS]:
        gap = np.linalg.norm(place - place[seed], axis=-1)
        shared = np.isfinite(gap)
        gap = np.where(shared, gap, 0.0).sum(1) / np.maximum(shared.sum(1), 1) + np.where(shared.any(1), 0.0, np.inf)
        rows = np.argsort(gap)[:NEIGHBOURS]
        rows = _followers(lifted[rows], lifted, some, rng)
        if len(rows) >= MIN_TRACKS and len(rows) > 0.7 * len(best):  # once more from all that follow
            rows = max(rows, _followers(lifted[rows], lifted, some, rng), key=len)
        if len(rows) > len(best):
            best = rows
        if len(best) > 0.8 * len(usable):
            break
    return usable[best]


def _followers(few: np.ndarray, lifted: np.ndarray, some: Observations, rng: np.random.Generator) -> np.ndarray:
    """Rows of the tracks that follow the best joint of a few tracks' rigid motion."""
    poses = register(few)
    if poses is None:
        return np.zeros(0, int)
    best = np.zeros(0, int)
    tried: set[str] = set()
    for twist, s in hypotheses(poses, rng, count=8):
        if twist.kind in tried:
            continue
        tried.add(twist.kind)
        full = np.interp(np.arange(lifted.shape[1]), poses.frames, s)
        rows = np.flatnonzero(_near(twist.poses(full), some, lifted))
        if len(rows) > len(best):
            best = rows
    return best

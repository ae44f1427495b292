"""The Cramer-Rao bound: how well any unbiased estimator could do with the tracks that are right.

The Fisher information at the truth of everything unknown: axis, pivot, the state in every frame, every point and, with
depth, the coefficients of each frame's smooth depth error (with their prior). Points are eliminated exactly. Without
depth the scale of the world is no part of the answer: it is fixed through the mean logarithm of the points' depths.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.articulation.noise import Given, field_basis

CONDITION = 1e-9
"""Points whose depth is held worse than this, relative to the rest of their place, are left out: they say nothing."""


@dataclass(frozen=True)
class Bound:
    """Covariances of the best unbiased estimate.

    Attributes:
        axis: (3, 3), rad^2, of the unit axis.
        point: (3, 3), m^2, of the axis line at the foot of `about`; None of a slide.
        q: (T,) standard deviation, rad or m, relative to the first frame; inf where it is more than the whole range.
        scale_weight: (N,) how much each point counts when the world's scale is set by the points (row 3), sum 1.
    """

    axis: np.ndarray
    point: np.ndarray | None
    q: np.ndarray
    scale_weight: np.ndarray


def tangent(axis: np.ndarray) -> np.ndarray:
    """(2, 3) orthonormal directions across an axis."""
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    one = np.cross(axis, helper)
    one /= np.linalg.norm(one)
    return np.stack([one, np.cross(axis, one)])


def motion_jacobian(kind: str, axis: np.ndarray, about: np.ndarray, q: np.ndarray, X0: np.ndarray, X: np.ndarray):
    """Derivatives of world points by the joint.

    Args:
        about: (3,) the point on the axis at which the pivot is measured.
        q: (T,) relative to frame 0.  X0: (N, 3) at frame 0.  X: (N, T, 3) at all frames.

    Returns:
        (N, T, 3, G) by axis tangent (2) and, for a hinge, pivot tangent (2); (N, T, 3) by the frame's state.
    """
    E = tangent(axis)
    if kind == "prismatic":
        J = q[None, :, None, None] * np.broadcast_to(E.T, (len(X0), len(q), 3, 2))
        return J, np.broadcast_to(axis, X.shape)
    # X = c + R(q a) (X0 - c). Turning the axis by w (perpendicular to it) is R_w R R_w^T about c.
    cols = []
    for e in E:
        w = np.cross(axis, e)
        inner = np.cross(w, X0 - about)  # of R_w^T, with a minus sign
        cols.append(np.cross(w, X - about) - _rotate(axis, q, inner))
    for e in E:
        cols.append(np.broadcast_to(e, X.shape) - _rotate(axis, q, np.broadcast_to(e, X0.shape)))
    return np.stack(cols, axis=-1), np.cross(axis, X - about)


def _rotate(axis: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(N, 3) vectors turned by every angle: (N, T, 3)."""
    along = (v @ axis)[:, None, None] * axis
    return along + np.cos(q)[:, None] * (v[:, None] - along) + np.sin(q)[:, None] * np.cross(axis, v)[:, None]


def bound(given: Given, focal_known: bool = True) -> Bound:
    """Cramer-Rao bound of one case; only observations that are right count.

    With depth (rows 1, 2) the cameras' poses are given too. Without, those of a moving camera are unknown, but for the
    first.
    """
    scene, shot = given.scene, given.scene.shot
    kind, axis, about = scene.model.kind, scene.axis, foot(scene)
    T = len(shot.q)
    with_depth = given.depth is not None
    moves = bool(np.ptp(shot.T_world_camera[:, :3, 3], axis=0).max() > 1e-9)
    seen = given.visible & ~given.wrong
    keep = seen.sum(1) >= 2
    if not with_depth and not moves:
        keep &= scene.moving  # points that rest before a resting camera say nothing
    seen, X0, on = seen[keep], scene.points[keep], scene.moving[keep]
    A, D, C, prior = _jacobians(given, focal_known, moves, seen, X0, on, kind, axis, about)
    Hp = np.einsum("ntij,ntik->njk", C, C, optimize=True)
    held = np.linalg.eigvalsh(Hp)
    good = held[:, 0] > CONDITION * held[:, 2]
    A, D, C, Hp, X0, on = A[good], D[good], C[good], Hp[good], X0[good], on[good]
    N, G, per = len(X0), A.shape[-1], D.shape[-1]
    size = G + per * T
    H = np.zeros((size, size))
    H[:G, :G] = np.einsum("ntig,ntih->gh", A, A, optimize=True)
    cross = np.einsum("ntig,ntip->tgp", A, D, optimize=True)
    own = np.einsum("ntip,ntiq->tpq", D, D, optimize=True) + np.diag(prior)
    for t in range(T):
        s = slice(G + per * t, G + per * (t + 1))
        H[:G, s], H[s, :G], H[s, s] = cross[t], cross[t].T, own[t]
    L = np.concatenate([np.einsum("ntig,ntik->ngk", A, C, optimize=True),
                        np.einsum("ntip,ntik->ntpk", D, C, optimize=True).reshape(N, per * T, 3)], axis=1)  # fmt: skip
    inverse = np.linalg.inv(Hp)
    left = np.einsum("nak,nkl->anl", L, inverse, optimize=True).reshape(size, -1)
    H -= left @ L.transpose(1, 0, 2).reshape(size, -1).T
    # The first frame's state is zero and its camera the origin by definition.
    free = np.ones(size, bool)
    free[G] = False
    if moves and not with_depth:
        free[G + per - 6 : G + per] = False
    gauge = None
    if not with_depth:
        gauge = _scale_direction(kind, axis, about, shot, G, per, moves)
        n2 = gauge @ gauge
        H += np.mean(np.diag(H)[free]) / n2 * np.outer(gauge, gauge)
    cov = np.zeros((size, size))
    part = H[np.ix_(free, free)]
    held = np.diag(part)
    scale = 1 / np.sqrt(np.maximum(held, 1e-15 * held.max()))
    # What nothing holds (the states of frames that share no point with the others) has a huge variance, not none.
    values, vectors = np.linalg.eigh(part * scale[:, None] * scale)
    inverted = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    cov[np.ix_(free, free)] = scale[:, None] * scale * inverted
    weight, by_depth = _scale_weight(inverse, X0, on, shot)
    if gauge is not None:
        cov = _scale_from_points(cov, gauge, left, inverse, weight, by_depth)
    E = tangent(axis)
    std_q = np.sqrt(np.maximum(np.diag(cov)[G + per * np.arange(T)], 0))
    std_q[~seen[good][on].any(0) | (std_q > np.ptp(shot.q))] = np.inf
    scale_weight = np.zeros(len(scene.points))
    scale_weight[np.flatnonzero(keep)[good]] = weight
    point = E.T @ cov[2:4, 2:4] @ E if kind == "revolute" else None
    return Bound(E.T @ cov[:2, :2] @ E, point, std_q, scale_weight)


def _jacobians(given: Given, focal_known: bool, moves: bool, seen, X0, on, kind, axis, about):
    """Rows (N, T, 3, .) over their standard deviations, zero where not seen.

    Returns:
        by the joint (and the logarithm of the focal length), by what is a frame's own, by the point; and the prior
        information of what is a frame's own.
    """
    scene, shot = given.scene, given.scene.shot
    T, with_depth = len(shot.q), given.depth is not None
    R, poses = shot.T_world_camera[:, :3, :3], scene.link_poses()
    X = np.repeat(X0[:, None], T, axis=1)
    X[on] = np.einsum("tij,nj->nti", poses[:, :3, :3], X0[on]) + poses[:, :3, 3]
    cam = np.einsum("tji,ntj->nti", R, X - shot.T_world_camera[:, :3, 3])
    z, f, px = cam[..., 2], shot.K[0, 0], given.sigma_px
    P = np.zeros((len(X0), T, 3, 3))  # u, v and log z by the point in the camera frame
    P[..., 0, 0] = P[..., 1, 1] = f / z / px
    P[..., 0, 2], P[..., 1, 2] = -f * cam[..., 0] / z**2 / px, -f * cam[..., 1] / z**2 / px
    if with_depth:
        P[..., 2, 2] = 1 / z / given.sigma_depth
    P *= seen[..., None, None]
    W = np.einsum("ntij,tkj->ntik", P, R)  # by the point in the world
    q = shot.q - shot.q[0]
    Jg, Jq = np.zeros((len(X0), T, 3, 2 if kind == "prismatic" else 4)), np.zeros((len(X0), T, 3))
    Jg[on], Jq[on] = motion_jacobian(kind, axis, about, q, X0[on], X[on])
    turned = np.where(on[:, None, None, None], poses[None, :, :3, :3], np.eye(3))
    A = np.einsum("ntij,ntjg->ntig", W, Jg, optimize=True)
    C = np.einsum("ntij,ntjk->ntik", W, turned, optimize=True)
    own = [np.einsum("ntij,ntj->nti", W, Jq)[..., None]]
    prior = [0.0]
    if with_depth:
        F = np.zeros((*seen.shape, 3, 3))
        uv = cam[..., :2] / z[..., None] * f + shot.K[:2, 2]
        F[..., 2, :] = field_basis(uv) / given.sigma_depth * seen[..., None]
        own.append(F)
        prior += [1 / given.sigma_field**2] * 3
    elif moves:
        zero = np.zeros_like(z)
        x, y = cam[..., 0], cam[..., 1]
        skew = np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)
        own += [-P, np.einsum("ntij,ntjk->ntik", P, skew)]
        prior += [0.0] * 6
    if not focal_known:
        by_focal = np.zeros((*seen.shape, 3, 1))
        by_focal[..., :2, 0] = f * cam[..., :2] / z[..., None] / px * seen[..., None]
        A = np.concatenate([A, by_focal], axis=-1)
    return A, np.concatenate(own, axis=-1), C, np.array(prior)


def _scale_direction(kind: str, axis, about, shot, G: int, per: int, moves: bool) -> np.ndarray:
    """What a larger world about the first camera does to joint and frames: no picture shows it."""
    eye = shot.T_world_camera[0, :3, 3]
    T = len(shot.q)
    gauge = np.zeros(G + per * T)
    if kind == "prismatic":
        gauge[G::per] = shot.q - shot.q[0]
    else:
        gauge[2:4] = tangent(axis) @ (about - eye)
    if moves:
        shift = np.einsum("tji,tj->ti", shot.T_world_camera[:, :3, :3], shot.T_world_camera[:, :3, 3] - eye)
        gauge[G:].reshape(T, per)[:, 1:4] = shift
    return gauge


def _scale_weight(inverse, X0, on, shot) -> tuple[np.ndarray, np.ndarray]:
    """(n,) precision of the moving points' log depth in the first camera, sum 1, and (n, 3) its derivatives."""
    R, eye = shot.T_world_camera[0, :3, :3], shot.T_world_camera[0, :3, 3]
    by_depth = R[:, 2] / ((X0 - eye) @ R[:, 2])[:, None]
    weight = on / np.einsum("ni,nij,nj->n", by_depth, inverse, by_depth)
    return weight / weight.sum(), by_depth


def _scale_from_points(cov, gauge, left, inverse, weight, by_depth) -> np.ndarray:
    """Covariance when the scale is set by the moving points' weighted mean logarithm of depth in the first camera."""
    c = weight[:, None] * by_depth
    k = left @ c.ravel()
    with_mean = -cov @ k
    variance = np.einsum("ni,nij,nj->", c, inverse, c) + k @ cov @ k
    return cov + variance * np.outer(gauge, gauge) - np.outer(gauge, with_mean) - np.outer(with_mean, gauge)


def foot(scene) -> np.ndarray:
    """(3,) the point of the axis nearest to the moving link's centroid at frame 0 (the centroid itself of a slide)."""
    centre = scene.points[scene.moving].mean(0)
    if scene.point is None:
        return centre
    return scene.point + scene.axis * ((centre - scene.point) @ scene.axis)

"""A camera held in a hand: its path from what rests, once a compensated picture has told what that is.

Homographies take a hand-held clip to its first view well enough to see what moves and by which joint, but a point
nearer than the plane they follow still drifts by pixels, and the joint takes the drift up. The points that rest there
are a rigid scene of known members: structure from small motion (Yu and Gallup 2014, Ha et al. 2016), which starts from
a flat scene before a camera that only turns. Joint and path are then fitted to the picture as it was filmed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from reconstruct.joint.bundle import Observations, State
from reconstruct.joint.finish import Still, View, bundle_of_state
from reconstruct.joint.groups import adjust, resect, triangulated
from reconstruct.joint.paths import Paths
from reconstruct.joint.polish import place_points, polish

LEAST = 40
"""Resting tracks without which no path is sought."""
LASTING = 0.25
"""Share of the frames in which such a track is seen."""
MOST, KEYS = 250, 50
"""Tracks and frames of one adjustment; the other frames are placed against its points."""
WIDE_PX = 20.0
"""Scale of the loss while the scene is still taken for flat: parallax is no outlier then."""
STRAY = 3.0
"""Standard deviations by which a resting track's median residual may be off."""
RATIOS = np.exp(np.linspace(np.log(0.4), np.log(3.0), 9))
"""Depth of the scene over the link's, from which the adjustment of both starts."""
FEW_FRAMES, COARSE_PX = 40, 3.0
"""Frames in which ratios are compared, and the scale of the loss there."""
NEARER, EXPLAINED = 0.5, 0.1
"""Depth over that of the nearest of the scene from which on a track is taken for a point at rest, and the share of what
it leaves its place by in the compensated picture that it may miss that point by. A part that goes straight for a few
frames goes as some point does that is near enough to the camera."""
MIN_SEEN = 8
"""Points of the scene that every frame has to see."""


@dataclass(frozen=True)
class Path:
    """The camera's path and the scene that rests before it.

    Attributes:
        R, t: (T, 3, 3), (T, 3) scene to camera; the scene's frame is the first camera, its median depth 1.
        ids: (m,) the scene's tracks.  X: (m, 3) their points.  sigma: noise of one coordinate, working px.
    """

    R: np.ndarray
    t: np.ndarray
    ids: np.ndarray
    X: np.ndarray
    sigma: float


def filmed(uv: np.ndarray, warp: np.ndarray) -> np.ndarray:
    """Tracks (N, T, 2) of the compensated picture in the picture as it was filmed; warp: (T, 3, 3) between them."""
    x = np.concatenate([uv, np.ones((*uv.shape[:2], 1))], axis=-1)
    x = np.einsum("tij,ntj->nti", np.linalg.inv(warp), x)
    return x[..., :2] / x[..., 2:]


def path_from_rest(uv: np.ndarray, still: np.ndarray, rest: np.ndarray, focal: float) -> Path | None:
    """The path from tracks that rest.

    Args:
        uv: (N, T, 2) px from the principal point as filmed, NaN where not seen.
        still: the same in the compensated picture.
        rest: (m,) the tracks that rest.  focal: px.

    Returns:
        None where fewer than LEAST tracks last, or some frame sees fewer than MIN_SEEN of them.
    """
    T = uv.shape[1]
    ids = rest[np.isfinite(uv[rest][..., 0]).mean(1) >= LASTING]
    if len(ids) < LEAST:
        return None
    keys = np.unique(np.linspace(0, T - 1, KEYS).round().astype(int))
    x, seen = uv[ids] / focal, np.isfinite(uv[ids][..., 0])
    # A flat scene, where the compensated picture has it.
    X = np.concatenate([np.nanmedian(still[ids], axis=1) / focal, np.ones((len(ids), 1))], axis=1)
    R, t = np.tile(np.eye(3), (len(keys), 1, 1)), np.zeros((len(keys), 3))
    R, t, _ = resect(X[None], x[:, keys].swapaxes(0, 1), seen[:, keys].T, R, t, focal, 10, WIDE_PX)
    good, sigma = np.ones(len(ids), bool), 1.0
    for _ in range(4):
        some = np.flatnonzero(good)
        some = some[np.unique(np.linspace(0, len(some) - 1, min(len(some), MOST)).round().astype(int))]
        R, t, X[some], sigma = adjust(x[some][:, keys], seen[some][:, keys], R, t, X[some], focal, iterations=10)
        X = triangulated(x[:, keys], seen[:, keys], R, t, X)
        off = _off(x[:, keys], seen[:, keys], R, t, X, focal)
        good = (off < STRAY * max(sigma, 0.05)) & (X[:, 2] > 0)
        if good.sum() < LEAST:
            return None
    if seen[good].sum(0).min() < MIN_SEEN:
        return None
    every = np.arange(T)
    R = Slerp(keys, Rotation.from_matrix(R))(every).as_matrix()
    t = np.stack([np.interp(every, keys, t[:, k]) for k in range(3)], axis=1)
    R, t, _ = resect(X[good][None], x[good].swapaxes(0, 1), seen[good].T, R, t, focal, 6, 4 * max(sigma, 0.05))
    R, t = R @ R[0].T, t - np.einsum("tij,jk,k->ti", R, R[0].T, t[0])
    unit = float(np.median(X[good, 2]))
    return Path(R, t / unit, ids[good], X[good] / unit, sigma)


def at_rest(path: Path, uv: np.ndarray, still: np.ndarray, focal: float) -> np.ndarray:
    """(k,) indices of the tracks that the path explains as points at rest.

    Args:
        uv: (N, T, 2) px from the principal point as filmed, NaN where not seen.
        still: the same in the compensated picture.  focal: px.
    """
    x, seen = uv / focal, np.isfinite(uv[..., 0])
    X = triangulated(x, seen, path.R, path.t, triangulated(x, seen, path.R, path.t))
    off = _off(x, seen, path.R, path.t, X, focal)
    some = seen.any(1)
    left = np.zeros(len(uv))
    left[some] = np.nanmedian(np.linalg.norm(still[some] - np.nanmedian(still[some], axis=1)[:, None], axis=-1), axis=1)
    near = NEARER * np.quantile(path.X[:, 2], 0.05)
    return np.flatnonzero((off < np.maximum(STRAY * max(path.sigma, 0.05), EXPLAINED * left)) & (X[:, 2] > near))


def _off(x: np.ndarray, seen: np.ndarray, R: np.ndarray, t: np.ndarray, X: np.ndarray, focal: float) -> np.ndarray:
    """(N,) median residual of a coordinate's standard deviation, px; infinite where hardly seen."""
    Y = np.einsum("tij,nj->nti", R, X) + t
    r2 = np.sum(((Y[..., :2] / np.maximum(Y[..., 2:], 1e-3) - x) * focal) ** 2, axis=-1)
    out = np.full(len(x), np.inf)
    enough = seen.sum(1) >= 4
    out[enough] = np.sqrt(np.nanmedian(np.where(seen, r2, np.nan)[enough], axis=1) / (2 * np.log(2)))
    return out


def scaled_to_link(path: Path, start: tuple[State, Observations], paths: Paths, members: np.ndarray, view: View
                   ) -> tuple[View, Still]:  # fmt: skip
    """Camera and scene with the link's median depth as the unit: at the ratio of depths at which the joint fits best.

    Args:
        start: the joint found so far and its key-frame observations, of the tracks ``members`` (n,).
        paths: N tracks, px from the principal point, as filmed.
        view: focal length; its camera is replaced.

    Returns:
        The view with the path, (T, 3, 3) and (T, 3), and the scene that rests.
    """
    some = np.unique(np.linspace(0, paths.uv.shape[1] - 1, FEW_FRAMES).round().astype(int))
    b = bundle_of_state(*start, some)
    costs = []
    for ratio in RATIOS:
        there = replace(view, R=path.R, t=path.t * ratio, restless=0.0)
        sight = there.sightings(paths[members], some, lasting=100.0)
        costs.append(polish(place_points(b, sight), sight, iterations=6, scale=COARSE_PX, sharpen=False).cost)
    ratio = float(RATIOS[int(np.argmin(costs))])
    scene = Still(path.ids, path.X * ratio, known=True, sigma=path.sigma)
    return replace(view, R=path.R, t=path.t * ratio, restless=0.0), scene

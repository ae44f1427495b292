"""A camera held in a hand: its path from what rests, once a compensated picture has told what that is.

Homographies take a hand-held clip to its first view well enough to see what moves and by which joint, but a point
nearer than the plane they follow still drifts by pixels, and the joint takes the drift up. The points that rest there
are a rigid scene of known members: structure from small motion (Yu and Gallup 2014, Ha et al. 2016), which starts from
flat scenes. Joint and path are then fitted to the picture as it was filmed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from reconstruct.joint.bundle import Observations, State
from reconstruct.joint.finish import bundle_of_state
from reconstruct.joint.groups import adjust, between, resect, triangulated
from reconstruct.joint.paths import Paths, held
from reconstruct.joint.polish import place_points, polish
from reconstruct.joint.view import Still, View

LEAST = 40
"""Resting tracks without which no path is sought."""
LASTING = (0.25, 0.15, 0.08)
"""Share of the frames in which such a track is seen: the first that leaves every frame ENOUGH of them, or the last."""
MOST, KEYS = 250, 50
"""Tracks and frames of one adjustment; the other frames are placed against its points."""
FACING = np.array([[x, y, 1.0] for x in (-0.5, 0, 0.5) for y in (-0.5, 0, 0.5)])
"""Normals of the flat scenes that it starts from."""
FEW_KEYS = 24
"""Key frames beyond which every other one is enough to tell these starts apart."""
STRANGE_PX = 0.1
"""What a track costs at most by which their ends are compared: a part near its hinge is not much further off."""
WIDE_PX = (20.0, 5.0, 1.5)
"""Scales of the loss while the scene is still taken for flat: at first parallax is no outlier."""
LEAST_PX, WIDE_SIGMAS = 0.05, 4.0
"""Noise that is believed, and the scale of the loss in it."""
STRAY = 3.0
"""Standard deviations by which a resting track's median residual may be off."""
CORE, CORE_OF_NOISE = 0.25, 1.2
"""Share of the tracks that follow a path best, and the noise over what the last of them is off. The noise of all that
follows grows with what does not rest among it, and lets more of that in."""
RATIOS = np.exp(np.linspace(np.log(0.4), np.log(3.0), 9))
"""Depth of the scene over the link's, from which the adjustment of both starts."""
FEW_FRAMES, COARSE_PX = 40, 3.0
"""Frames in which ratios are compared, and the scale of the loss there."""
NEARER, EXPLAINED = 0.5, 0.1
"""Depth over that of the nearest of the scene from which on a track is taken for a point at rest, and the share of what
it leaves its place by in the compensated picture that it may miss that point by. A part that goes straight for a few
frames goes as some point does that is near enough to the camera."""
JOINS = 0.05
"""The same for a track that the path itself is held by from then on: a part that joins bends it by and by."""
MIN_SEEN, ENOUGH = 5, 30
"""Points of the scene that every frame has to see, and that it should."""


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


def path_from_rest(paths: Paths, still: np.ndarray, rest: np.ndarray, focal: float, known: Path | None = None
                   ) -> Path | None:  # fmt: skip
    """The path from tracks that rest.

    Args:
        paths: N tracks, px from the principal point, as filmed.
        still: (N, T, 2) the same in the compensated picture.
        rest: (m,) the tracks that rest.  focal: px.
        known: the path as fewer tracks have it, from which the adjustment begins besides.

    Returns:
        None where fewer than LEAST tracks last, or some frame sees fewer than MIN_SEEN of them.
    """
    T = paths.uv.shape[1]
    seen = paths[rest].seen
    share = _lasting(seen)
    ids = rest[seen.mean(1) >= share]
    if len(ids) < LEAST:
        return None
    scene = _Rays(paths[ids], focal)
    keys = np.unique(np.linspace(0, T - 1, KEYS).round().astype(int))
    # Of short tracks too few frames see too little.
    few = keys[::2] if len(keys) > FEW_KEYS and share == LASTING[0] else keys
    rough = _begun(scene.at(few), np.nanmedian(still[ids], axis=1), known and (known.R[few], known.t[few]))
    if rough.good.sum() < LEAST:
        return None
    at_keys, (R, t, X), good = scene.at(keys), rough.start, rough.good
    R, t = between(R, t, few, T)
    R, t = at_keys.of(good).resected(X[good], R[keys], t[keys], 6, WIDE_SIGMAS * rough.noise)
    done = at_keys.settled((R, t, at_keys.points(R, t)), 3, good)
    (R, t, X), good = done.start, done.good
    if good.sum() < LEAST or scene.seen[good].sum(0).min() < MIN_SEEN:
        return None
    R, t = scene.of(good).resected(X[good], *between(R, t, keys, T), 6, WIDE_SIGMAS * done.noise)
    R, t = R @ R[0].T, t - np.einsum("tij,jk,k->ti", R, R[0].T, t[0])
    unit = float(np.median(X[good, 2]))
    return Path(R, t / unit, ids[good], X[good] / unit, done.sigma)


def _lasting(seen: np.ndarray) -> float:
    """The first of the shares LASTING that leaves every frame ENOUGH tracks of seen (m, T), or the last."""
    many = (share for share in LASTING if seen[seen.mean(1) >= share].sum(0).min() >= ENOUGH)
    return next(many, LASTING[-1])


def _begun(scene: _Rays, middle: np.ndarray, known: tuple[np.ndarray, np.ndarray] | None) -> _Settled:
    """The path that the scene misses least, of several that start from a flat one.

    Which way that faces is hardly seen, and from the wrong side the adjustment ends where turns and steps of the camera
    are taken for each other.

    Args:
        scene: what rests.  middle: (m, 2) px, where the compensated picture has it.
        known: another start, R (T, 3, 3) and t (T, 3).
    """
    rays = np.concatenate([middle / scene.focal, np.ones((len(middle), 1))], axis=1)
    starts = [scene.before_plane(rays / (rays @ normal)[:, None]) for normal in FACING]
    if known is not None:
        starts.append((*known, scene.points(*known)))
    return min((scene.settled(start, rounds=2) for start in starts), key=lambda s: scene.missed(*s.start))


@dataclass(frozen=True)
class _Settled:
    """start: R, t, X.  good: (n,) bool, tracks that follow.  sigma: noise of one coordinate, px."""

    start: tuple[np.ndarray, np.ndarray, np.ndarray]
    good: np.ndarray
    sigma: float

    @property
    def noise(self) -> float:
        """That of these that is believed, px."""
        return max(self.sigma, LEAST_PX)


class _Rays:
    """Rays of n tracks in T frames, and what is asked of them of a path R (T, 3, 3), t (T, 3) and points X (n, 3)."""

    def __init__(self, paths: Paths, focal: float) -> None:
        self.focal, self.x, self.seen = focal, paths.uv / focal, paths.seen
        self.slip = np.zeros_like(self.x) if paths.slip is None else paths.slip
        self.paths = paths

    def at(self, frames: np.ndarray) -> _Rays:
        """In some frames."""
        return _Rays(self.paths.at(frames), self.focal)

    def of(self, tracks: np.ndarray) -> _Rays:
        """Of some of the tracks."""
        return _Rays(self.paths[tracks], self.focal)

    def points(self, R: np.ndarray, t: np.ndarray, X: np.ndarray | None = None) -> np.ndarray:
        """(n, 3) of a path, from the points X or from the rays alone."""
        X = triangulated(self.x, self.seen, R, t, slip=self.slip) if X is None else X
        return triangulated(self.x, self.seen, R, t, X, slip=self.slip)

    def resected(self, X: np.ndarray, R: np.ndarray, t: np.ndarray, rounds: int, scale: float):
        """The path before points."""
        slip = self.slip.swapaxes(0, 1)
        return resect(X[None], self.x.swapaxes(0, 1), self.seen.T, R, t, self.focal, rounds, scale, slip)[:2]

    def before_plane(self, X: np.ndarray):
        """R, t, X of a scene with these points, before a camera that is not known."""
        T = self.x.shape[1]
        R, t = np.tile(np.eye(3), (T, 1, 1)), np.zeros((T, 3))
        for px in WIDE_PX:
            R, t = self.resected(X, R, t, 8, px)
        return R, t, X

    def missed(self, R: np.ndarray, t: np.ndarray, X: np.ndarray) -> float:
        """px, by which the tracks miss their points before a path, STRANGE_PX each at most."""
        return float(np.sum(np.minimum(np.where(X[:, 2] > _nearest(X), self.off(R, t, X), np.inf), STRANGE_PX)))

    def off(self, R: np.ndarray, t: np.ndarray, X: np.ndarray) -> np.ndarray:
        """(n,) median residual of a coordinate's standard deviation, px; infinite where hardly seen."""
        Y = np.einsum("tij,nj->nti", R, X) + t
        r2 = np.sum(held((Y[..., :2] / np.maximum(Y[..., 2:], 1e-3) - self.x) * self.focal, self.slip) ** 2, axis=-1)
        out = np.full(len(X), np.inf)
        enough = self.seen.sum(1) >= 4
        out[enough] = np.sqrt(np.nanmedian(np.where(self.seen, r2, np.nan)[enough], axis=1) / (2 * np.log(2)))
        return out

    def settled(self, start: tuple[np.ndarray, np.ndarray, np.ndarray], rounds: int, good: np.ndarray | None = None
                ) -> _Settled:  # fmt: skip
        """Path and points adjusted to the tracks that follow them, good (n,) bool at first; all of them when None.

        Those follow that are not off by more than the best do, where enough of them are left in every frame.
        """
        R, t, X = start
        X, sigma = X.copy(), 1.0
        good = np.ones(len(X), bool) if good is None else good
        for _ in range(rounds):
            some = np.flatnonzero(good)
            some = some[np.unique(np.linspace(0, len(some) - 1, min(len(some), MOST)).round().astype(int))]
            seen, slip = self.seen[some], self.slip[some]
            R, t, X[some], sigma = adjust(self.x[some], seen, R, t, X[some], self.focal, iterations=10, slip=slip)
            X = self.points(R, t, X)
            off = self.off(R, t, X)
            if not (known := np.isfinite(off)).any():
                return _Settled((R, t, X), known, sigma)
            best = CORE_OF_NOISE * float(np.quantile(off[known], CORE))
            for px in (min(best, sigma), sigma):
                good = (off < STRAY * max(px, LEAST_PX)) & (X[:, 2] > 0)
                if self.seen[good].sum(0).min() >= ENOUGH:
                    break
            if good.sum() < LEAST:
                break
        return _Settled((R, t, X), good, sigma)


def at_rest(path: Path, paths: Paths, still: np.ndarray, focal: float, missed: float = EXPLAINED) -> np.ndarray:
    """(k,) indices of the tracks that the path explains as points at rest.

    Args:
        paths: N tracks, px from the principal point, as filmed.
        still: (N, T, 2) the same in the compensated picture.  focal: px.
        missed: share of what a track leaves its place by there that it may be off by, where that is more than noise.
    """
    rays = _Rays(paths, focal)
    X = rays.points(path.R, path.t)
    off, some = rays.off(path.R, path.t, X), paths.seen.any(1)
    left = np.zeros(len(paths))
    left[some] = np.nanmedian(np.linalg.norm(still[some] - np.nanmedian(still[some], axis=1)[:, None], axis=-1), axis=1)
    explained = off < np.maximum(STRAY * max(path.sigma, LEAST_PX), missed * left)
    return np.flatnonzero(explained & (X[:, 2] > _nearest(path.X)))


def _nearest(X: np.ndarray) -> float:
    """Depth from which on a track is taken for a point at rest, beside a scene's points (m, 3)."""
    return NEARER * float(np.quantile(X[:, 2], 0.05))


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

"""How tracks were seen: by a camera that rests or along a path, and what rests before it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from reconstruct.joint.groups import triangulated
from reconstruct.joint.paths import Paths
from reconstruct.joint.polish import Bundle, Sightings


@dataclass(frozen=True)
class View:
    """How the tracks were seen.

    Attributes:
        focal: px.  focal_std: of its logarithm, 0 where it is known.
        R, t: (T, 3, 3), (T, 3) world to camera; None for a static camera.
        restless: px by which points at rest leave their place before a camera that was made static; 0 where it was.
    """

    focal: float
    focal_std: float = 0.0
    R: np.ndarray | None = None
    t: np.ndarray | None = None
    restless: float = 0.0

    def sightings(self, paths: Paths, frames: np.ndarray, lasting: float = 1.0) -> Sightings:
        """Of tracks in some frames."""
        some = paths.at(frames)
        seen = some.seen
        R, t = (None, None) if self.R is None else (self.R[frames], self.t[frames])
        return Sightings(np.where(seen[..., None], some.uv, 0.0), seen, np.ones(len(some)), self.focal, self.focal_std,
                         R, t, frames, lasting, slip=some.slip)  # fmt: skip

    def before(self, s: Sightings) -> Sightings:
        """The same sightings before this path."""
        assert s.frames is not None
        return s if self.R is None else replace(s, R=self.R[s.frames], t=self.t[s.frames])

    def at_first(self, paths: Paths, depth: float) -> Paths:
        """Tracks as a camera that stays in the first one's place would see them, if all were at one depth before the
        camera that did; themselves where that rests.

        Args:
            paths: N tracks in T frames, px from the principal point.  depth: in the unit of t.
        """
        if self.R is None or self.t is None:
            return paths
        x = np.concatenate([paths.uv / self.focal, np.ones((*paths.uv.shape[:2], 1))], axis=-1) * depth
        x = np.einsum("tji,ntj->nti", self.R, x - self.t)
        return replace(paths, uv=self.focal * x[..., :2] / np.maximum(x[..., 2:], 1e-3))

    def corrected(self, b: Bundle, some: np.ndarray) -> View:
        """The camera's path as a bundle adjustment of some frames found it, interpolated between them."""
        assert self.R is not None and self.t is not None and b.R is not None and b.t is not None
        every = np.arange(len(self.R))
        turn = Rotation.from_matrix(b.R @ np.swapaxes(self.R[some], 1, 2))
        R = Slerp(some, turn)(every).as_matrix() @ self.R
        # The centre's correction, not the shift's: it is small where the turn is not.
        here = -np.einsum("tji,tj->ti", self.R, self.t)
        there = -np.einsum("tji,tj->ti", b.R, b.t) - here[some]
        centre = here + np.stack([np.interp(every, some, there[:, k]) for k in range(3)], axis=1)
        return replace(self, R=R, t=-np.einsum("tij,tj->ti", R, centre))


@dataclass(frozen=True)
class Still:
    """The resting scene before a moving camera.

    Attributes:
        ids: (m,) its tracks.  X: (m, 3) their points in the world.
        known: whether it is known that these rest; else the smoother path of the camera decides.
        sigma: noise of one coordinate, px; like the link's when None. Real links flex, blur and are cast into shade: a
            path that is held no better than the link bends after it.
    """

    ids: np.ndarray
    X: np.ndarray
    known: bool = False
    sigma: float | None = None

    def before(self, view: View, paths: Paths, log_focal: float) -> Still:
        """The scene with the points that a path gives it: one that was fitted has a scale of its own.

        Args:
            paths: of all tracks.  log_focal: correction of the focal length's logarithm that goes with the path.
        """
        assert view.R is not None and view.t is not None
        uv = paths.uv[self.ids]
        x, seen = uv / (view.focal * np.exp(log_focal)), np.isfinite(uv[..., 0])
        slip = None if paths.slip is None else paths.slip[self.ids]
        rough = triangulated(x, seen, view.R, view.t, slip=slip)
        X = triangulated(x, seen, view.R, view.t, rough, slip=slip)
        # What the path hardly passes goes to the others' depth.
        good = X[:, 2] > 0
        first = seen.argmax(1)
        there = np.concatenate([x[np.arange(len(x)), first], np.ones((len(x), 1))], axis=1) * np.median(X[good, 2])
        there = np.einsum("nji,nj->ni", view.R[first], there - view.t[first])
        return replace(self, X=np.where(good[:, None], X, there))

"""From exact tracks to what an estimator is given: the benchmark's rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.articulation.motions import SIZE
from benchmarks.articulation.scenes import Scene, rng_of
from reconstruct.cues import Hands
from reconstruct.joint.handheld import filmed

ROWS = (1, 2, 3)
OUTLIERS = 0.20
TRACK_PX = {2: 1.0, 3: 0.5}
FIELD_STD, LOCAL_STD = 0.02, 0.01
LOST = 0.5
MASK_PX = 3.0


@dataclass(frozen=True)
class Given:
    """What an estimator may see, and which of it is wrong (which it may not).

    Attributes:
        scene: truth.  row: 1 perfect, 2 noisy with depth, 3 noisy without, 4 and 5 rendered pixels.
        uv: (N, T, 2) px, NaN where not visible.  visible: (N, T) bool.
        depth: (N, T) m, NaN where not visible; None in row 3.
        link: (N,) bool, said by the masks to lie on the moving link; None in row 3.
        wrong: (N, T) bool, truth: not an observation of its point.
        sigma_px, sigma_depth (of the logarithm), sigma_field: standard deviations of the noise; zeros in row 1.
        hands: detected ones, slip, shade, cast: of the tracks, as in :class:`Tracks`; rows 4 and 5 only.
        frames: (T, h, w, 3) uint8 BGR; rows 4 and 5 only.
        warp: (T, 3, 3) from the pictures as filmed to these, as in :class:`Video`; row 5 only.
    """

    scene: Scene
    row: int
    uv: np.ndarray
    visible: np.ndarray
    depth: np.ndarray | None
    link: np.ndarray | None
    wrong: np.ndarray
    sigma_px: float
    sigma_depth: float
    sigma_field: float
    hands: Hands | None = None
    slip: np.ndarray | None = None
    shade: np.ndarray | None = None
    cast: np.ndarray | None = None
    frames: np.ndarray | None = None
    warp: np.ndarray | None = None

    @property
    def filmed(self) -> np.ndarray:
        """(N, T, 2) px, the tracks in the pictures as filmed."""
        return self.uv if self.warp is None else filmed(self.uv, self.warp)


def field_basis(uv: np.ndarray) -> np.ndarray:
    """(..., 3) functions of the place in the picture that the smooth error of a depth map is made of, RMS about 1.

    A common scale and two tilts across the picture; each has a third of the field's variance on average.
    """
    x = (uv - (np.array(SIZE) - 1) / 2) / (np.array(SIZE) / 2)
    return np.concatenate([np.full((*uv.shape[:-1], 1), np.sqrt(1 / 3)), x], axis=-1)


def give(scene: Scene, row: int, seed: int = 0) -> Given:
    """Noise of one row on one scene.

    Row 2: independent pixel noise of 1 px; a fifth of the tracks are wrong, half of them from some frame on (they stick
    to something else that moves or rests), half in single stretches (they jump); a hand passes over the moving link and
    what it has covered once is lost for good, half of the tracks by the end; the logarithm of depth has a smooth error
    over the picture, drawn for each frame, of 2 %, and independent noise of 1 %; the masks that tell the links apart
    are eroded or dilated by 3 px. Row 3: 0.5 px, the same wrong tracks, neither depth nor masks nor a hand.
    """
    if row not in ROWS:
        raise ValueError(f"no row {row}; rows are {', '.join(map(str, ROWS))}")
    uv, visible = scene.uv.copy(), scene.visible.copy()
    none = np.zeros(visible.shape, bool)
    if row == 1:
        return _given(scene, row, uv, visible, scene.depth.copy(), scene.moving.copy(), none, 0.0, 0.0, 0.0)
    rng = rng_of(seed, scene.name, f"row {row}")
    sigma = TRACK_PX[row]
    if row == 2:
        visible &= ~_covered(scene, rng)
    drift, wrong = _wrong_tracks(scene, visible, rng)
    uv = uv + drift + rng.normal(scale=sigma, size=uv.shape)
    visible &= ((uv > 0) & (uv < np.array(SIZE) - 1)).all(-1)
    if row == 3:
        return _given(scene, row, uv, visible, None, None, wrong, sigma, 0.0, 0.0)
    coefficients = rng.normal(scale=FIELD_STD, size=(uv.shape[1], 3))
    error = np.einsum("ntk,tk->nt", field_basis(uv), coefficients) + rng.normal(scale=LOCAL_STD, size=visible.shape)
    grow = MASK_PX * rng.choice([-1, 1])
    return _given(scene, row, uv, visible, scene.depth * np.exp(error), scene.edge > -grow, wrong,
                  sigma, LOCAL_STD, FIELD_STD)  # fmt: skip


def _given(scene, row, uv, visible, depth, link, wrong, *sigmas) -> Given:
    uv = np.where(visible[..., None], uv, np.nan)
    if depth is not None:
        depth = np.where(visible, depth, np.nan)
    return Given(scene, row, uv, visible, depth, link, wrong & visible, *sigmas)


def _wrong_tracks(scene: Scene, visible: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(N, T, 2) px by which wrong tracks miss their points, and (N, T) where they do.

    A track goes wrong somewhere in the first half of its own life.
    """
    N, T = scene.visible.shape
    off, wrong = np.zeros((N, T, 2)), np.zeros((N, T), bool)
    chosen = rng.permutation(N)[: round(OUTLIERS * N)]
    for k, i in enumerate(chosen):
        life = np.flatnonzero(visible[i])
        start = int(rng.choice(life[: max(1, len(life) // 2)])) if len(life) else 0
        if k % 2 == 0:
            # It sticks to a place in the picture, or to another point, and wanders.
            wander = np.cumsum(rng.normal(scale=rng.uniform(0.3, 2.0), size=(T, 2)), axis=0)
            other = scene.uv[int(rng.integers(N))] if rng.random() < 0.5 else np.repeat(scene.uv[i, start][None], T, 0)
            path = scene.uv[i, start] + (other - other[start]) + wander - wander[start]
            off[i, start:] = (path - scene.uv[i])[start:]
            wrong[i, start:] = np.linalg.norm(off[i, start:], axis=-1) > 0
        else:
            stop = min(T, start + int(rng.integers(T // 5, T)))
            off[i, start:stop] = rng.normal(scale=rng.uniform(4, 40), size=2)
            wrong[i, start:stop] = True
    return off, wrong


def _covered(scene: Scene, rng: np.random.Generator) -> np.ndarray:
    """(N, T) what a hand has covered so far: tracks under it are lost for good.

    The hand is a disc about a grip on the moving link that wanders; its size is found so that half of the link's tracks
    are lost by the last frame.
    """
    N, T = scene.visible.shape
    on = np.flatnonzero(scene.moving)
    grip = scene.uv[rng.choice(on)]
    spread = np.linalg.norm(np.std(scene.uv[on, T // 2], axis=0))
    phase, turn = rng.uniform(0, 2 * np.pi, 2), rng.uniform(0.5, 1.2, 2)
    wander = spread * np.sin(2 * np.pi * np.linspace(0, 1, T)[:, None] * turn + phase) - spread * np.sin(phase)
    gap = np.linalg.norm(scene.uv - (grip + wander), axis=-1)
    nearest = np.minimum.accumulate(gap, axis=1)
    return nearest < np.quantile(nearest[on, -1], LOST)

"""Exact tracks of surface points, with the visibility that rays give them."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from benchmarks.articulation.motions import SIZE, Shot, pixel_rays, shoot
from benchmarks.articulation.objects import Model

FRAMES = 100
MOVING, STATIC = 350, 150
SEED_FRAMES = 5


class Hidden(Exception):
    """The moving link is not seen: the object cannot be part of the benchmark."""


@dataclass(frozen=True)
class Scene:
    """Truth of one case: one object, one motion, one camera.

    Attributes:
        model, motion, orbit, small: what it is.
        shot: states and cameras.
        points: (N, 3) world positions at frame 0.
        moving: (N,) bool, on the moving link.
        seed: (N,) frame in which a point was picked in the picture.
        uv: (N, T, 2) px.  depth: (N, T) along the optical axis, m.  visible: (N, T) bool, met first by its pixel's ray.
        diagonal: m, of the box around all points at frame 0: the part of the object that is filmed.
        edge: (N,) distance in px to the moving link's outline in the seed frame, positive inside.
    """

    model: Model
    motion: str
    orbit: bool
    small: bool
    shot: Shot
    points: np.ndarray
    moving: np.ndarray
    seed: np.ndarray
    uv: np.ndarray
    depth: np.ndarray
    visible: np.ndarray
    diagonal: float
    edge: np.ndarray

    @property
    def name(self) -> str:
        camera = "orbit" if self.orbit else "static"
        return f"{self.model.name}:{self.motion}:{camera}" + (":small" if self.small else "")

    @property
    def axis(self) -> np.ndarray:
        return self.model.axis_and_point[0]

    @property
    def point(self) -> np.ndarray | None:
        return self.model.axis_and_point[1] if self.model.kind == "revolute" else None

    def link_poses(self) -> np.ndarray:
        """(T, 4, 4) the moving link relative to frame 0, world."""
        return self.model.link_pose(self.shot.q, float(self.shot.q[0]))


def rng_of(seed: int, *names: str) -> np.random.Generator:
    """A stream of its own for each name, the same on every machine."""
    return np.random.default_rng([seed, *(zlib.crc32(n.encode()) for n in names)])


def make_scene(model: Model, motion: str, orbit: bool = False, small: bool = False, seed: int = 0, frames: int = FRAMES,
               moving: int = MOVING, static: int = STATIC) -> Scene:  # fmt: skip
    """Truth of one case.

    Raises:
        Hidden: too little of the moving link is seen.
    """
    rng = rng_of(seed, model.name, motion, "orbit" if orbit else "static", "small" if small else "full")
    shot = shoot(model, motion, orbit, small, frames, rng)
    picked, on_link, seeds, edges = _pick(model, shot, moving, static, rng)
    poses = model.link_pose(shot.q, float(shot.q[0]))
    world = np.repeat(picked[:, None], frames, axis=1)
    world[on_link] = np.einsum("tij,nj->nti", poses[:, :3, :3], picked[on_link]) + poses[:, :3, 3]
    uv, depth = project(world, shot)
    inside = ((uv > 2) & (uv < np.array(SIZE) - 3)).all(-1) & (depth > 0)
    visible = np.zeros(uv.shape[:2], bool)
    for t in range(frames):
        rows = np.flatnonzero(inside[:, t])
        eye = shot.T_world_camera[t, :3, 3]
        ray = world[rows, t] - eye
        length = np.linalg.norm(ray, axis=1)
        met, _ = model.cast(float(shot.q[t]), eye, ray / length[:, None])
        visible[rows, t] = met > length * (1 - 1e-3) - 1e-5
    diagonal = float(np.linalg.norm(np.ptp(picked, axis=0)))
    return Scene(model, motion, orbit, small, shot, picked, on_link, seeds, uv, depth, visible, diagonal, edges)


def project(world: np.ndarray, shot: Shot) -> tuple[np.ndarray, np.ndarray]:
    """(N, T, 3) world -> (N, T, 2) px and (N, T) depth."""
    R, t = shot.T_world_camera[:, :3, :3], shot.T_world_camera[:, :3, 3]
    x = np.einsum("tji,ntj->nti", R, world - t)
    z = x[..., 2]
    safe = np.where(np.abs(z) < 1e-9, 1e-9, z)
    return x[..., :2] / safe[..., None] * shot.K[[0, 1], [0, 1]] + shot.K[:2, 2], z


def _pick(model: Model, shot: Shot, moving: int, static: int, rng: np.random.Generator):
    """Surface points seen in a few frames spread over the states, brought back to frame 0.

    Returns:
        (N, 3) world at frame 0, (N,) on the moving link, (N,) seed frame, (N,) signed distance in px to the moving
        link's outline in the seed frame (positive inside).
    """
    import cv2

    T = len(shot.q)
    order = np.argsort(shot.q, kind="stable")
    spread = order[np.linspace(0, T - 1, SEED_FRAMES - 1).round().astype(int)]
    frames = np.unique(np.concatenate([[0], spread]))
    step = 4
    u, v = np.meshgrid(np.arange(0, SIZE[0], step, dtype=float), np.arange(0, SIZE[1], step, dtype=float))
    grid = np.stack([u, v], axis=-1)
    pools: dict[bool, list] = {True: [], False: []}
    for f in frames:
        camera = shot.T_world_camera[f]
        uv = np.clip(grid + rng.uniform(0, step, grid.shape), 0, np.array(SIZE) - 1.0)
        rays = pixel_rays(uv, shot.K, camera)
        distance, geom = model.cast(float(shot.q[f]), camera[:3, 3], rays.reshape(-1, 3))
        hit = (geom >= 0) & np.isfinite(distance)
        on = (hit & model.moving_geoms[geom]).reshape(u.shape)
        inner = cv2.distanceTransform(on.astype(np.uint8), cv2.DIST_L2, 5)
        outer = cv2.distanceTransform((~on).astype(np.uint8), cv2.DIST_L2, 5)
        edge = step * np.clip(np.where(on, inner, -outer), -1e3, 1e3)
        world = camera[:3, 3] + rays * np.where(np.isfinite(distance), distance, 0.0).reshape(*u.shape, 1)
        back = model.link_pose(float(shot.q[0]), float(shot.q[f]))
        for link in (True, False):
            rows = np.flatnonzero(hit & (on.ravel() == link))
            X = world.reshape(-1, 3)[rows]
            if link:
                X = X @ back[:3, :3].T + back[:3, 3]
            pools[link] += list(zip(X, np.full(len(rows), f), edge.ravel()[rows], strict=True))
    if len(pools[True]) < 100:
        raise Hidden(f"{model.name}: only {len(pools[True])} of the picture's grid points lie on the moving link")
    chosen = []
    for link, count in ((True, moving), (False, static)):
        pool = pools[link]
        rows = rng.choice(len(pool), min(count, len(pool)), replace=False)
        chosen += [(*pool[r], link) for r in rows]
    points, seeds, edges, on_link = zip(*chosen, strict=True)
    return np.array(points), np.array(on_link), np.array(seeds), np.array(edges)

"""From one mesh a key frame, each of both links at once and each a little off, to one closed mesh a link.

An image-to-3D network makes a whole mesh from one frame: hidden sides included, scale and place only roughly right, the
two links in one piece. Many key frames make many such guesses in different states of the joint. What they agree on is
kept:

1. **Ground**: the mesh is scaled along the camera's rays to the depth of its frame, then moved by a robust similarity
   that trusts a depth less along the ray than across it, and less the farther it is.
2. **Label**: a surface point votes static or moving by the masks of every key frame, as what it would look like there
   if it belonged to either link; hidden points and pixels under hands do not vote.
3. **Register**: the meshes' static parts are brought onto each other, again by a robust similarity.
4. **Fuse**: signed distances of all observations, the moving link's with the articulation undone, are averaged on a
   grid; the zero level is one closed surface a link.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reconstruct.cues import LinkMasks
from reconstruct.errors import TaaError
from reconstruct.geometry import LinkMesh
from reconstruct.geometry.closing import zero_level
from reconstruct.joint.models import JointFit

SAMPLES = 4000
"""Surface points a mesh."""
DEPTH_NOISE = 0.01
"""Standard deviation of a depth at 1 m, m; it grows with the square of the distance, as a disparity's does."""
LATERAL_NOISE = 0.002
"""m at 1 m: half a pixel or so, across the ray."""
GRID = 60
"""Cells along the longer side of the grid that a link is fused on."""


@dataclass(frozen=True)
class KeyMesh:
    """A mesh of both links as one key frame shows them.

    Attributes:
        frame: index of the frame.
        vertices: (V, 3) in that frame's camera, right, down, forward; scale and place need only be roughly right.
        faces: (F, 3).  colors: (V, 4) uint8.
    """

    frame: int
    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray


@dataclass(frozen=True)
class Cloud:
    """Surface samples of one mesh: points, normals (n, 3), colours (n, 3), and the faces they are on."""

    points: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    face: np.ndarray

    def moved(self, S: np.ndarray) -> Cloud:
        """By a (4, 4) similarity."""
        scale = np.cbrt(np.linalg.det(S[:3, :3]))
        return Cloud(self.points @ S[:3, :3].T + S[:3, 3], self.normals @ S[:3, :3].T / scale, self.colours, self.face)

    def only(self, keep: np.ndarray) -> Cloud:
        return Cloud(self.points[keep], self.normals[keep], self.colours[keep], self.face[keep])


@dataclass(frozen=True)
class Fused:
    """Result of :func:`fuse_meshes`.

    Attributes:
        static, moving: closed meshes, world at q = 0; collision parts come when they are read as a cue.
        similarity: (K, 4, 4) that took each key mesh from its camera to the world.
        labels: per key mesh, (n,) bool of its samples: moving.
        residual_m: median distance of each registered mesh's static part from the others'.
        used: key meshes that took part; the others did not agree with the rest.
    """

    static: LinkMesh
    moving: LinkMesh
    similarity: np.ndarray
    labels: tuple[np.ndarray, ...]
    residual_m: np.ndarray
    used: np.ndarray

    @property
    def provenance(self) -> dict:
        return {"fused_meshes": {"value": int(self.used.sum()), "origin": "given", "of": len(self.used)},
                "fused_residual": {"value": float(np.median(self.residual_m[self.used])), "unit": "m",
                                   "origin": "observed"}}  # fmt: skip


def sample(mesh: KeyMesh, seed: int = 0) -> Cloud:
    """Points spread evenly over a mesh."""
    import trimesh

    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    points, face = trimesh.sample.sample_surface(surface, SAMPLES, seed=seed)
    corners = np.asarray(mesh.vertices, float)[mesh.faces[face]]
    weight = trimesh.triangles.points_to_barycentric(corners, points)
    colours = np.einsum("nk,nkd->nd", weight, mesh.colors[mesh.faces[face], :3].astype(float))
    return Cloud(np.asarray(points), np.asarray(surface.face_normals)[face], colours, np.asarray(face))


def similarity(source: np.ndarray, target: np.ndarray, whiten: np.ndarray, steps: int = 4) -> np.ndarray:
    """(4, 4) similarity that takes source to target, robustly.

    Gauss-Newton on (log scale, rotation, translation) with Cauchy weights of the whitened residuals.

    Args:
        source, target: (n, 3) matched points.
        whiten: (n, 3, 3) inverse square roots of the residuals' covariances.
    """
    from scipy.spatial.transform import Rotation

    S = np.eye(4)
    for _ in range(steps):
        x = source @ S[:3, :3].T + S[:3, 3]
        residual = np.einsum("nij,nj->ni", whiten, target - x)
        weight = 1 / (1 + (residual**2).sum(1) / 4.0)
        middle = x.mean(0)
        y = x - middle
        J = np.zeros((len(x), 3, 7))
        J[:, :, 0] = y
        J[:, 0, 2], J[:, 0, 3] = y[:, 2], -y[:, 1]
        J[:, 1, 1], J[:, 1, 3] = -y[:, 2], y[:, 0]
        J[:, 2, 1], J[:, 2, 2] = y[:, 1], -y[:, 0]
        J[:, :, 4:] = np.eye(3)
        J = np.einsum("nij,njk->nik", whiten, J)
        H = np.einsum("n,nij,nik->jk", weight, J, J)
        g = np.einsum("n,nij,ni->j", weight, J, residual)
        size = max(float(np.abs(y).max()), 1e-9)
        prior = np.diag([size**2] * 4 + [1.0] * 3) * 1e-9 * max(np.trace(H[4:, 4:]), 1e-30)
        step = np.linalg.solve(H + prior, g)
        D = np.eye(4)
        D[:3, :3] = np.exp(np.clip(step[0], -0.5, 0.5)) * Rotation.from_rotvec(step[1:4]).as_matrix()
        D[:3, 3] = middle + step[4:] - D[:3, :3] @ middle
        S = D @ S
    return S


def noise_of(points: np.ndarray) -> np.ndarray:
    """(n, 3, 3) whitening of depth's noise at points (n, 3) of a camera frame: wide along the ray, narrow across."""
    distance = np.maximum(points[:, 2], 1e-6)
    ray = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-12)
    along = ray[:, :, None] * ray[:, None, :]
    across = np.eye(3) - along
    return along / (DEPTH_NOISE * distance**2)[:, None, None] + across / (LATERAL_NOISE * distance)[:, None, None]


def facing(cloud: Cloud, K: np.ndarray, size: tuple[int, int], cells: int = 160) -> np.ndarray:
    """(n,) bool: samples that no other of the cloud hides from the camera at the origin, by a coarse depth buffer."""
    x = cloud.points
    looks = np.einsum("ij,ij->i", cloud.normals, x) < 0
    uv = x @ K.T
    uv = uv[:, :2] / np.where(np.abs(uv[:, 2:]) > 1e-9, uv[:, 2:], 1e-9)
    step = max(size) / cells
    cell = np.floor(uv / step).astype(int)
    inside = (x[:, 2] > 0) & (uv >= 0).all(1) & (uv < size).all(1)
    nearest: dict[tuple[int, int], float] = {}
    for (u, v), z in zip(map(tuple, cell[inside & looks]), x[inside & looks, 2], strict=True):
        nearest[(u, v)] = min(z, nearest.get((u, v), np.inf))
    front = np.array([nearest.get((u, v), np.inf) for u, v in map(tuple, cell)])
    extent = float(np.linalg.norm(np.ptp(x, axis=0)))
    return inside & looks & (x[:, 2] <= front + 0.03 * extent)


def lookup(image: np.ndarray, uv: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Values of an (h, w) image, of any size, at full-size pixels (n, 2); 0, False or NaN where outside."""
    h, w = image.shape
    column = np.floor((uv[:, 0] + 0.5) * w / size[0]).astype(int)
    row = np.floor((uv[:, 1] + 0.5) * h / size[1]).astype(int)
    ok = (column >= 0) & (row >= 0) & (column < w) & (row < h)
    out = np.full(len(uv), np.nan if image.dtype.kind == "f" else 0, image.dtype)
    out[ok] = image[row[ok], column[ok]]
    return out


def ground(cloud: Cloud, depth: np.ndarray, K: np.ndarray, size: tuple[int, int], steps: int = 12) -> np.ndarray:
    """(4, 4) similarity that puts a mesh's samples, in their camera's frame, onto the frame's depth.

    First a scale about the camera, which keeps the picture, by the median ratio of depths at the same pixels; then
    repeated matching at the same pixels.

    Args:
        depth: (h, w) m along the optical axis, NaN where unknown.

    Raises:
        TaaError: the mesh hardly meets known depth.
    """
    S = np.eye(4)
    for k in range(steps):
        moved = cloud.moved(S)
        seen = facing(moved, K, size)
        x = moved.points[seen]
        z = lookup(depth, _pixels(x, K), size) if len(x) else np.empty(0)
        known = np.isfinite(z) & (z > 0)
        if known.sum() < 50:
            raise TaaError("a key frame's mesh hardly meets its depth; check that both belong to the same frame")
        x, z = x[known], z[known]
        if k < 2:
            D = np.diag([*[float(np.median(z / x[:, 2]))] * 3, 1.0])
        else:
            # What lies far off the depth was hidden by something else, or is another thing.
            ratio = np.abs(np.log(z / x[:, 2]))
            near = ratio < max(4 * float(np.median(ratio)), 0.01)
            target = x[near] * (z[near] / x[near, 2])[:, None]
            # Points matched at the same pixel say nothing across the ray but by the surface's slope: point to plane.
            n = moved.normals[seen][known][near]
            sigma = DEPTH_NOISE * x[near, 2] ** 2 * np.abs(np.einsum("ij,ij->i", n, x[near])) / np.linalg.norm(
                x[near], axis=1) + LATERAL_NOISE * x[near, 2]  # fmt: skip
            weak = 1 / (0.2 * np.maximum(x[near, 2], 1e-6))  # holds still what no slope decides
            whiten = n[:, :, None] * n[:, None, :] / sigma[:, None, None] + np.eye(3) * weak[:, None, None]
            D = similarity(x[near], target, whiten)
        S = D @ S
    return S


def _pixels(x: np.ndarray, K: np.ndarray) -> np.ndarray:
    uvw = x @ K.T
    return uvw[:, :2] / np.maximum(uvw[:, 2:], 1e-9)


def vote(cloud: Cloud, frame: int, frames: Sequence[int], fit: JointFit, masks: LinkMasks,
         size: tuple[int, int], depths: np.ndarray | None, others: Sequence[tuple[int, Cloud]] = ()
         ) -> np.ndarray:  # fmt: skip
    """(n,) share of votes for the moving link, 0.5 where nothing votes.

    Args:
        cloud: samples in the world, as they are in ``frame``.
        frames: key frames that vote.
        depths: (T, h, w) or None; with it, a point that something hides does not vote.
        others: frame and samples, world, of the other meshes: as which link does a point lie on their surface too?
            That decides for what no frame sees.
    """
    from scipy.spatial import cKDTree

    q = np.asarray(fit.q, float)
    T_c = np.asarray(fit.T_camera_world, float)
    counts = np.zeros((2, len(cloud.points)))
    back = np.linalg.inv(fit.link_pose(q[frame]))
    for t in frames:
        for moves in (False, True):
            T = T_c @ (fit.link_pose(q[t]) @ back if moves else np.eye(4))
            there = cloud.moved(T)
            seen = facing(there, fit.K, size)
            uv = _pixels(there.points, fit.K)
            floats = np.zeros(len(seen), bool)
            if depths is not None:
                z = lookup(depths[t], uv, size)
                room = 4 * DEPTH_NOISE * z**2 + 0.01
                # Where the frame sees past it, it cannot be: that speaks against this link as loudly as a mask.
                floats = seen & (there.points[:, 2] < z - room)
                seen &= np.abs(there.points[:, 2] - z) <= room
            hand = lookup(masks.hand[t], uv, size)
            yes = lookup(masks.moving[t] if moves else masks.static[t], uv, size)
            no = lookup(masks.static[t] if moves else masks.moving[t], uv, size)
            ok = seen & ~hand
            # Being on the right mask speaks for a link; being on the other link's speaks against it.
            counts[int(moves)] += 1.0 * (ok & yes & ~no) - 1.0 * (ok & no & ~yes) - 1.0 * (floats & ~hand)
    reach = 0.02 * float(np.linalg.norm(np.ptp(cloud.points, axis=0)))
    for t, other in others:
        tree = cKDTree(other.points)
        for moves in (False, True):
            there = cloud.moved(fit.link_pose(q[t]) @ back if moves else np.eye(4))
            distance, index = tree.query(there.points)
            alike = np.einsum("ij,ij->i", there.normals, other.normals[index]).clip(0, 1)
            counts[int(moves)] += alike * np.exp(-0.5 * (distance / reach) ** 2)
    difference = counts[1] - counts[0]
    raw = 1 / (1 + np.exp(-2.0 * np.clip(difference, -20, 20)))
    return _smooth(cloud, np.where(np.abs(difference) > 0, raw, 0.5))


def _smooth(cloud: Cloud, share: np.ndarray, rounds: int = 3, k: int = 12) -> np.ndarray:
    """Labels of hidden points follow their neighbours'; single wrong votes give way."""
    from scipy.spatial import cKDTree

    extent = float(np.linalg.norm(np.ptp(cloud.points, axis=0)))
    # Opposite sides of a thin board are no neighbours' business to tell apart: normals may differ, places must not.
    _, near = cKDTree(cloud.points).query(cloud.points, k=k, distance_upper_bound=0.05 * extent)
    valid = near < len(share)
    near = np.where(valid, near, 0)
    out = share.copy()
    for _ in range(rounds):
        sure = np.abs(out - 0.5)[near] * valid + 1e-6
        mean = (out[near] * sure).sum(1) / sure.sum(1)
        out = np.where(np.abs(share - 0.5) > 0.05, 0.5 * share + 0.5 * mean, mean)
    return out


def register(own: np.ndarray, fixed: np.ndarray, camera: np.ndarray, steps: int = 15) -> tuple[np.ndarray, float]:
    """(4, 4) similarity of one static part onto the others', and the median distance left.

    Iterated nearest points; the residual of a pair is wide along the ray from the camera (3,), and pairs beyond four
    times the median distance are left out, as parts that only one of the two has.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(fixed)
    S = np.eye(4)
    left = np.inf
    for _ in range(steps):
        x = own @ S[:3, :3].T + S[:3, 3]
        distance, index = tree.query(x)
        left = float(np.median(distance))
        near = distance <= max(4 * left, 1e-6)
        S = similarity(x[near], fixed[index[near]], noise_of_rays(x[near], camera), steps=2) @ S
    return S, left


def noise_of_rays(points: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Whitening as :func:`noise_of`, for points of the world seen from ``camera`` (3,)."""
    ray = points - camera
    distance = np.maximum(np.linalg.norm(ray, axis=1), 1e-6)
    ray = ray / distance[:, None]
    along = ray[:, :, None] * ray[:, None, :]
    return along / (DEPTH_NOISE * distance**2)[:, None, None] + (np.eye(3) - along) / (
        LATERAL_NOISE * distance)[:, None, None]  # fmt: skip


def fuse_meshes(keys: Sequence[KeyMesh], fit: JointFit, masks: LinkMasks, size: tuple[int, int],
                depth: np.ndarray | None = None, labels: Sequence[np.ndarray] | None = None) -> Fused:  # fmt: skip
    """One closed mesh a link from one mesh of both links a key frame.

    Args:
        keys: at least one; two thirds of them should be about right.
        fit: the joint; ``T_camera_world`` is the (static) camera's.
        masks: of both links and the hands.
        size: (width, height) full px, which ``fit.K`` refers to.
        depth: (T, h, w) m, NaN where unknown; None takes the meshes' own scale and place.
        labels: per key mesh, (F,) bool: the face belongs to the moving link; voted by the masks when None.

    Raises:
        TaaError: no mesh meets its depth, or one of the links is in none of them.
    """
    if not keys:
        raise TaaError("there is no key frame mesh to fuse; give at least one")
    T_world_camera = np.linalg.inv(np.asarray(fit.T_camera_world, float))
    camera = T_world_camera[:3, 3]
    clouds, poses, grounded = [], [], []
    for key in keys:
        cloud = sample(key, seed=key.frame)
        try:
            S = ground(cloud, depth[key.frame], fit.K, size) if depth is not None else np.eye(4)
            grounded.append(True)
        except TaaError:
            S = np.eye(4)
            grounded.append(False)
        poses.append(T_world_camera @ S)
        clouds.append(cloud)
    if not any(grounded):
        raise TaaError("no key frame's mesh meets its depth; check that meshes and depth belong to the same frames")
    frames = [key.frame for key in keys]
    used = np.array(grounded)
    given, labels = labels, [np.zeros(SAMPLES, bool)] * len(keys)
    residual = np.full(len(keys), np.inf)
    for _ in range(2):
        placed = [cloud.moved(pose) for cloud, pose in zip(clouds, poses, strict=True)]
        for k in range(len(keys)):
            if given is not None:
                labels[k] = np.asarray(given[k], bool)[clouds[k].face]
                continue
            others = [(frames[i], placed[i]) for i in np.flatnonzero(used) if i != k]
            labels[k] = vote(placed[k], frames[k], frames, fit, masks, size, depth, others) > 0.5
        for k in np.flatnonzero(used):
            rest = [clouds[i].moved(poses[i]).points[~labels[i]] for i in np.flatnonzero(used) if i != k]
            own = clouds[k].moved(poses[k]).points[~labels[k]]
            if not rest or len(own) < 50 or sum(map(len, rest)) < 50:
                residual[k] = 0.0 if not rest else np.inf
                continue
            S, residual[k] = register(own, np.concatenate(rest), camera)
            poses[k] = S @ poses[k]
        middle = float(np.median(residual[used]))
        used &= residual <= max(3 * middle, 1e-9)
    q = np.asarray(fit.q, float)
    observations: dict[bool, list[tuple[Cloud, np.ndarray]]] = {False: [], True: []}
    for k in np.flatnonzero(used):
        here = clouds[k].moved(poses[k])
        back = np.linalg.inv(fit.link_pose(q[frames[k]]))
        observations[False].append((here, ~labels[k]))
        observations[True].append((here.moved(back), labels[k]))
    links = {}
    for moves, name in ((False, "static"), (True, "moving")):
        if sum(int(own.sum()) for _, own in observations[moves]) < 50:
            raise TaaError(f"the key frames' meshes hold no {name} link by the masks; check masks and joint")
        links[name] = _fuse_link(observations[moves])
    return Fused(links["static"], links["moving"], np.array(poses), tuple(labels), residual, used)


def _fuse_link(observations: list[tuple[Cloud, np.ndarray]]) -> LinkMesh:
    """Average of signed distances on a grid, and its zero level; without collision parts.

    Args:
        observations: whole cloud and which of its samples are this link's, all in one frame.
    """
    from scipy.spatial import cKDTree

    own = np.concatenate([cloud.points[mask] for cloud, mask in observations])
    low, high = np.quantile(own, 0.002, axis=0), np.quantile(own, 0.998, axis=0)
    cell = float((high - low).max()) / GRID
    low, high = low - 3 * cell, high + 3 * cell
    counts = np.ceil((high - low) / cell).astype(int) + 1
    axes = [low[i] + cell * np.arange(counts[i]) for i in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    total, weight = np.zeros(len(grid)), np.zeros(len(grid))
    for cloud, mask in observations:
        if mask.sum() < 20:
            continue
        distance, index = cKDTree(cloud.points).query(grid, k=4)
        # Inside is where most of the nearest samples look away; a single sample errs beside an edge.
        side = np.einsum("nkd,nkd->nk", cloud.normals[index], grid[:, None] - cloud.points[index]).mean(1)
        value = np.where(side < 0, distance[:, 0], -distance[:, 0])
        # Within the other link is outside of this one.
        value = np.where(mask[index].mean(1) >= 0.5, value, -np.abs(distance[:, 0]))
        value = np.clip(value, -3 * cell, 3 * cell)
        total += value
        weight += 1.0
    field = (total / np.maximum(weight, 1e-9)).reshape(counts)
    vertices, faces = zero_level(field, low, cell)
    tree = cKDTree(own)
    colours = np.concatenate([cloud.colours[mask] for cloud, mask in observations])
    near = tree.query(vertices, k=5)[1]
    rgba = np.full((len(vertices), 4), 255, np.uint8)
    rgba[:, :3] = np.clip(np.median(colours[near], axis=1), 0, 255)
    far = tree.query(vertices[faces].mean(1))[0] > 2 * cell
    return LinkMesh(vertices, faces, rgba, far, ())

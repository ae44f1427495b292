"""Refine a joint, its states and the meshes' place by what the rendered links look like.

Stages as in the paper's appendix: states, then states and joint, then both with one rigid transform and scale of the
two meshes. There the 3D tracks only start the search; here their residuals stay in the cost, weighted by their measured
noise like everything else, because silhouettes say little about a turn that leaves the outline alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from reconstruct.cues import LinkMasks, Tracks
from reconstruct.errors import TaaError
from reconstruct.geometry import Geometry, LinkMesh
from reconstruct.joint.models import JointFit
from reconstruct.refine.coverage import Edges, Mesh, Topology, coverage, face_ids, link_edges
from reconstruct.refine.terms import Observed, boundary_term, feature_term, mask_term, observe, sample

Describe = Callable[[Sequence[int]], np.ndarray]

LOG_SCALE_STD = 0.05
"""A mesh that was grounded by depth is seldom off by more than a few percent."""
STATIC_WEIGHT = 0.5
OUTLINE_CORRELATION_PX = 8.0
"""Errors of a mask's outline are alike over about this length: an outline holds that many times fewer measurements."""
STEPS = (40, 80, 80)
FEW_TRACKS = 6
REDRAW_PX = 0.25
"""Which face is seen where is drawn anew when a vertex has moved this far; coverage follows the vertices in between."""


@dataclass(frozen=True)
class Refinement:
    """What came of it.

    Attributes:
        fit: the joint with refined axis, point and q; its other fields as they were.
        T_world_mesh: (4, 4) similarity that both meshes are to be moved by (identity without the third stage).
        scale: its scale.
        before, after: term -> value (mask_px, boundary_px of the reduced picture, track_px of the full one, feature).
        frames: (K,) working frames that were compared.
    """

    fit: JointFit
    T_world_mesh: np.ndarray
    scale: float
    before: dict[str, float]
    after: dict[str, float]
    frames: np.ndarray


def moved(geometry: Geometry, refinement: Refinement) -> Geometry:
    """The geometry with both links, their collision parts included, moved by the refinement's similarity."""
    T = refinement.T_world_mesh

    def at(xyz: np.ndarray) -> np.ndarray:
        return xyz @ T[:3, :3].T + T[:3, 3]

    def link(mesh: LinkMesh) -> LinkMesh:
        return replace(mesh, vertices=at(mesh.vertices), parts=tuple((at(v), f) for v, f in mesh.parts))

    return replace(geometry, static=link(geometry.static), moving=link(geometry.moving))


@dataclass
class _Scene:
    """The data in torch, reduced: one entry a key frame."""

    fit: JointFit
    meshes: dict[str, Mesh]
    frames: np.ndarray
    size: tuple[int, int]
    K: torch.Tensor
    seen: dict[str, list[Observed]]
    features: torch.Tensor | None
    described: torch.Tensor | None
    track_uv: torch.Tensor
    track_seen: torch.Tensor
    points: torch.Tensor
    track_index: np.ndarray
    sigma_outline: float = 1.0
    sigma_track: float = 1.0
    drawn: dict[int, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    centre: torch.Tensor = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))

    def __post_init__(self) -> None:
        s, m = self.meshes["static"], self.meshes["moving"]
        self.faces = np.concatenate([s.faces, m.faces + len(s.vertices)])
        self.topology = Topology.of(self.faces)


def key_frames(q: np.ndarray, moving_hidden: np.ndarray, count: int) -> np.ndarray:
    """Frames spread evenly over the states, the least hidden of those near each.

    Args:
        q: (T,).  moving_hidden: (T,) share of the moving link that a hand hides.  count: at most this many.

    Returns:
        (K,) sorted; frame 0 is always there.
    """
    span = np.ptp(q)
    levels = np.linspace(q.min(), q.max(), count)
    chosen = {0}
    for level in levels:
        cost = np.abs(q - level) / max(span, 1e-9) * count + moving_hidden
        chosen.add(int(np.argmin(cost)))
    return np.array(sorted(chosen))


def refine_joint(fit: JointFit, tracks: Tracks | None, meshes: dict[str, Mesh], masks: LinkMasks,
                 image_size: tuple[int, int], features: Describe | None = None, count: int = 10, width: int = 240,
                 use: tuple[str, ...] = ("mask", "boundary", "feature", "track"),
                 stages: int = 3) -> Refinement:  # fmt: skip
    """Refine a joint against masks, features and tracks.

    Args:
        fit: the joint to start from, verdict not "refused".
        tracks: the tracks that ``fit.point_track`` counts; None leaves them out.
        meshes: "static" and "moving" in the world at q = 0.
        masks: of the links and of hands, (T, h, w).
        image_size: (width, height) of the full picture, px.
        features: frames -> their (n, gh, gw, C) unit descriptors on a grid over the picture, or None.
        count: key frames.  width: of the reduced picture, px.
        use: the terms of the cost: "mask", "boundary", "feature", "track".
        stages: 1 states, 2 and the joint, 3 and the meshes' rigid transform and scale.

    Raises:
        TaaError: no key frame shows the moving link, or there is nothing to compare with.
    """
    if fit.q is None or fit.axis is None:
        raise TaaError("a refused joint cannot be refined; fit one first")
    unknown = set(use) - {"mask", "boundary", "feature", "track"}
    if unknown or not use:
        raise TaaError(f"unknown term {sorted(unknown)}; known: mask, boundary, feature, track")
    scene = _scene(fit, tracks, meshes, masks, image_size, features if "feature" in use else None, count, width)
    steps = _Parameters(scene)
    before = _measure(scene, steps)
    # The noise of each kind of evidence where the search starts; floors are a raster's and a tracker's resolution.
    scene.sigma_outline = max(before["boundary_px"], 0.5)
    scene.sigma_track = max(before.get("track_px", 1.0), 0.2)
    for stage in range(min(stages, len(STEPS))):
        _descend(scene, steps, stage, use)
    after = _measure(scene, steps)
    new, T, scale = steps.result()
    if "track" in use and tracks is not None and len(scene.points):
        new = replace(new, q=_states(new, tracks, scene))
    return Refinement(new, T, scale, before, after, scene.frames)


def _scene(fit: JointFit, tracks: Tracks | None, meshes: dict[str, Mesh], masks: LinkMasks,
           image_size: tuple[int, int], features: Describe | None, count: int, width: int) -> _Scene:  # fmt: skip
    w, h = image_size
    reduced = (width, round(width * h / w))
    ratio = np.array([reduced[0] / w, reduced[1] / h])
    area = masks.moving.reshape(len(masks.moving), -1).sum(1)
    if not area.any():
        raise TaaError("the masks show no moving link in any frame; give cues/masks.npz with `moving`")
    hidden = 1 - np.minimum(area / max(np.percentile(area, 90), 1), 1)
    frames = key_frames(fit.q, hidden, count)
    frames = frames[(area[frames] > 0) | (frames == 0)]
    # Pixel centres are whole numbers: scaling keeps the corners of the picture, which lie at -0.5.
    K = np.array(fit.K, float)
    K[:2, :] *= ratio[:, None]
    K[:2, 2] += 0.5 * ratio - 0.5
    seen = {
        "moving": [observe(masks.moving[t], masks.hand[t], reduced) for t in frames],
        "static": [observe(masks.static[t], masks.hand[t], reduced) for t in frames],
    }
    small = described = None
    if features is not None:
        grid = torch.from_numpy(np.asarray(features([int(t) for t in frames]), float)).permute(0, 3, 1, 2)
        small = torch.nn.functional.interpolate(grid, size=(reduced[1], reduced[0]), mode="bilinear")
        small = torch.nn.functional.normalize(small, dim=1)
    uv = np.zeros((0, len(frames), 2))
    visible = np.zeros((0, len(frames)), bool)
    points = np.zeros((0, 3))
    index = np.zeros(0, int)
    if tracks is not None and fit.points is not None and len(fit.points):
        uv, visible = tracks.uv[fit.point_track][:, frames], tracks.visible[fit.point_track][:, frames]
        use = visible.sum(1) >= 2
        uv, visible, points = np.nan_to_num(uv[use]), visible[use], fit.points[use]
        index = np.asarray(fit.point_track)[use]
    centre = torch.from_numpy(np.asarray(meshes["static"].vertices, float).mean(0))
    return _Scene(fit, meshes, frames, reduced, torch.from_numpy(K), seen, small, described, torch.from_numpy(uv),
                  torch.from_numpy(visible), torch.from_numpy(np.array(points, float)), index,
                  centre=centre)  # fmt: skip


class _Parameters:
    """Steps from the start, each scaled so that one unit moves the moving link by about one reduced pixel.

    Order: axis (2), point (2, zero for a slide), q (K, frame 0's stays zero), turn (3), shift (3), log scale (1).
    """

    def __init__(self, scene: _Scene):
        self.scene = scene
        fit, K = scene.fit, len(scene.frames)
        self.count = 4 + K + 7
        self.basis = torch.from_numpy(np.linalg.svd(fit.axis[None])[2][1:].T.copy())
        self.x = torch.zeros(self.count, dtype=torch.float64)
        self.unit = torch.ones(self.count, dtype=torch.float64)
        rest = self._vertices(self.x, scene)
        for k in range(self.count):
            h = 1e-4
            step = torch.zeros(self.count, dtype=torch.float64)
            step[k] = h
            moved = self._vertices(step, scene)
            speed = float(max((a - b).norm(dim=-1).mean() for a, b in zip(moved, rest, strict=True))) / h
            self.unit[k] = 1 / max(speed, 1e-6) if speed > 1e-9 else 0.0

    def _vertices(self, x: torch.Tensor, scene: _Scene) -> list[torch.Tensor]:
        return [project(scene, self.link(x, "moving", k))[0] for k in range(len(scene.frames))]

    def parts(self, x: torch.Tensor) -> tuple:
        """Axis (3,), point (3,), q (K,), rotation vector, shift, scale."""
        fit, K = self.scene.fit, len(self.scene.frames)
        x = x * self.unit
        axis = torch.from_numpy(np.asarray(fit.axis, float)) + self.basis @ x[:2]
        axis = axis / axis.norm()
        point = torch.from_numpy(np.asarray(fit.point if fit.point is not None else np.zeros(3), float))
        point = point + self.basis @ x[2:4]
        still = torch.from_numpy((self.scene.frames != 0).astype(float))
        q = torch.from_numpy(fit.q[self.scene.frames].astype(float)) + x[4 : 4 + K] * still
        return axis, point, q, x[4 + K : 7 + K], x[7 + K : 10 + K], x[10 + K].exp()

    def pose(self, x: torch.Tensor, k: int) -> tuple[torch.Tensor, torch.Tensor]:
        """(3, 3), (3,) of the moving link in key frame k relative to q = 0, world."""
        axis, point, q, *_ = self.parts(x)
        kind = self.scene.fit.type
        if kind == "prismatic":
            return torch.eye(3, dtype=torch.float64), q[k] * axis
        R = rotation(axis * q[k])
        t = point - R @ point
        if kind == "screw":
            t = t + (self.scene.fit.pitch or 0.0) * q[k] * axis
        return R, t

    def link(self, x: torch.Tensor, name: str, k: int) -> torch.Tensor:
        """(V, 3) vertices of a link in key frame k, world."""
        *_, turn, shift, scale = self.parts(x)
        c = self.scene.centre
        v = torch.from_numpy(np.asarray(self.scene.meshes[name].vertices, float))
        v = scale * (v - c) @ rotation(turn).T + c + shift
        if name == "static":
            return v
        R, t = self.pose(x, k)
        return v @ R.T + t

    def free(self, stage: int) -> torch.Tensor:
        """(P,) bool, what a stage may change."""
        K = len(self.scene.frames)
        free = torch.zeros(self.count, dtype=torch.bool)
        free[4 : 4 + K] = True
        if stage >= 1:
            free[:4] = True
        if stage >= 2:
            free[4 + K :] = True
        return free & (self.unit > 0)

    def result(self) -> tuple[JointFit, np.ndarray, float]:
        with torch.no_grad():
            axis, point, q, turn, shift, scale = (v.numpy() for v in self.parts(self.x))
        fit = self.scene.fit
        # Between key frames the correction of q is interpolated; beyond the last it is kept.
        correction = np.interp(np.arange(len(fit.q)), self.scene.frames, q - fit.q[self.scene.frames])
        states = fit.q + correction
        R = rotation(torch.from_numpy(turn)).numpy()
        c = self.scene.centre.numpy()
        T = np.eye(4)
        T[:3, :3] = scale * R
        T[:3, 3] = c + shift - scale * R @ c
        points = None if fit.points is None else fit.points.copy()
        new = replace(fit, axis=axis, point=None if fit.point is None else point, q=states - states[0], points=points)
        return new, T, float(scale)


def rotation(v: torch.Tensor) -> torch.Tensor:
    """(3, 3) rotation of a rotation vector (3,)."""
    zero = v[0] * 0
    W = torch.stack([torch.stack([zero, -v[2], v[1]]), torch.stack([v[2], zero, -v[0]]),
                     torch.stack([-v[1], v[0], zero])])  # fmt: skip
    return torch.linalg.matrix_exp(W)


def project(scene: _Scene, xyz: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(N, 3) world -> (N, 2) reduced px, (N,) depth."""
    T = torch.from_numpy(np.asarray(scene.fit.T_camera_world, float))
    x = xyz @ T[:3, :3].T + T[:3, 3]
    uvw = x @ scene.K.T
    return uvw[:, :2] / uvw[:, 2:].clamp(min=1e-6), x[:, 2]


def _frame(scene: _Scene, steps: _Parameters, x: torch.Tensor, k: int) -> dict[str, tuple[torch.Tensor, Edges]]:
    """Coverage and edges of both links in key frame k, drawn together so that they hide each other."""
    both = torch.cat([steps.link(x, "static", k), steps.link(x, "moving", k)])
    uv, depth = project(scene, both)
    faces, near = scene.faces, depth.detach().numpy()
    moving = np.arange(len(faces)) >= len(scene.meshes["static"].faces)
    ids = _drawn(scene, k, uv.detach().numpy(), near, faces)
    out = {}
    for name, of_link in (("static", ~moving), ("moving", moving)):
        edges = link_edges(ids, uv, near, faces, of_link, scene.topology)
        out[name] = (coverage(ids, of_link, edges), edges)
    out["drawn"] = (uv, ids)
    return out


def _drawn(scene: _Scene, k: int, uv: np.ndarray, depth: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Face ids of key frame k, drawn again only when something has moved by :data:`REDRAW_PX` since."""
    before = scene.drawn.get(k)
    if before is None or np.abs(before[0] - uv).max() > REDRAW_PX:
        before = scene.drawn[k] = (uv.copy(), face_ids(uv, depth, faces, scene.size))
    return before[1]


def _describe(scene: _Scene, steps: _Parameters) -> torch.Tensor | None:
    """(V, C) descriptors of the moving link's vertices from the first key frame that shows each, else NaN."""
    if scene.features is None:
        return None
    first = len(scene.meshes["static"].vertices)
    n = len(scene.meshes["moving"].vertices)
    out = torch.full((n, scene.features.shape[1]), torch.nan, dtype=torch.float64)
    with torch.no_grad():
        for k in range(len(scene.frames)):
            uv, ids = _frame(scene, steps, steps.x, k)["drawn"]
            fresh = torch.from_numpy(_visible(ids, scene.faces, first + n)[first:]) & out[:, 0].isnan()
            if bool(fresh.any()):
                here = sample(scene.features[k], uv[first:][fresh]).T
                out[fresh] = torch.nn.functional.normalize(here, dim=1)
    return out


def _visible(ids: np.ndarray, faces: np.ndarray, vertices: int) -> np.ndarray:
    """(V,) bool, the vertices of faces that are drawn somewhere."""
    seen = np.zeros(vertices, bool)
    seen[faces[np.unique(ids[ids >= 0])]] = True
    return seen


def _tracks(scene: _Scene, steps: _Parameters, x: torch.Tensor) -> torch.Tensor:
    """(N, K) reprojection residual of each track, full px, 0 where not seen."""
    T = torch.from_numpy(np.asarray(scene.fit.T_camera_world, float))
    full = torch.from_numpy(np.asarray(scene.fit.K, float))
    out = []
    for k in range(len(scene.frames)):
        R, t = steps.pose(x, k)
        y = (scene.points @ R.T + t) @ T[:3, :3].T + T[:3, 3]
        uvw = y @ full.T
        r = uvw[:, :2] / uvw[:, 2:].clamp(min=1e-6) - scene.track_uv[:, k]
        out.append(torch.where(scene.track_seen[:, k], (r.square().sum(1) + 1e-12).sqrt(), 0.0))
    return torch.stack(out, 1)


def _move_points(scene: _Scene, steps: _Parameters) -> None:
    """One damped Gauss-Newton step of every track's point for the present joint: points are a nuisance, not data."""
    if not len(scene.points):
        return
    with torch.no_grad():
        T = torch.from_numpy(np.asarray(scene.fit.T_camera_world, float))
        full = torch.from_numpy(np.asarray(scene.fit.K, float))
        H = torch.zeros(len(scene.points), 3, 3, dtype=torch.float64)
        g = torch.zeros(len(scene.points), 3, dtype=torch.float64)
        for k in range(len(scene.frames)):
            R, t = steps.pose(steps.x, k)
            y = (scene.points @ R.T + t) @ T[:3, :3].T + T[:3, 3]
            uvw = y @ full.T
            uv = uvw[:, :2] / uvw[:, 2:]
            J = (full[:2][None] - uv[:, :, None] * full[2][None, None]) / uvw[:, 2, None, None] @ (T[:3, :3] @ R)
            r = uv - scene.track_uv[:, k]
            w = scene.track_seen[:, k] / (1 + r.square().sum(1) / (3 * scene.sigma_track) ** 2) ** 2
            H += w[:, None, None] * J.transpose(1, 2) @ J
            g += w[:, None] * (J.transpose(1, 2) @ r[..., None])[..., 0]
        damp = 1e-3 * H.diagonal(dim1=1, dim2=2).sum(1) + 1e-9
        H += damp[:, None, None] * torch.eye(3, dtype=torch.float64)
        scene.points = scene.points - torch.linalg.solve(H, g[..., None])[..., 0]


def _states(fit: JointFit, tracks: Tracks, scene: _Scene) -> np.ndarray:
    """(T,) states of all frames from the tracks for a fixed joint: key frames alone would leave the rest interpolated.

    A frame with fewer than :data:`FEW_TRACKS` tracks keeps what it has.
    """
    uv, seen = tracks.uv[scene.track_index], tracks.visible[scene.track_index]
    points = scene.points.numpy()
    q = fit.q.copy()
    solvable = seen.sum(0) >= FEW_TRACKS
    h = 1e-4 * max(float(np.ptp(fit.q)), 1e-6)

    def residuals(states: np.ndarray) -> np.ndarray:  # (T, N, 2) px
        T = fit.link_pose(states)
        xyz = np.einsum("tij,nj->tni", T[:, :3, :3], points) + T[:, None, :3, 3]
        return np.where(seen.T[..., None], fit.project(xyz) - np.nan_to_num(uv).transpose(1, 0, 2), 0.0)

    for _ in range(10):
        r = residuals(q)
        J = (residuals(q + h) - r) / h
        w = 1 / (1 + (r**2).sum(-1) / (3 * scene.sigma_track) ** 2) ** 2
        step = -(w[..., None] * J * r).sum((1, 2)) / ((w[..., None] * J * J).sum((1, 2)) + 1e-12)
        q = q + np.where(solvable, np.clip(step, -0.1 * np.ptp(fit.q), 0.1 * np.ptp(fit.q)), 0.0)
    return q - q[0]


def _cost(scene: _Scene, steps: _Parameters, x: torch.Tensor, use: tuple[str, ...]) -> torch.Tensor:
    """Negative log likelihood (robust, up to a constant) of the terms in use, plus smoothness and the scale's prior."""
    total = torch.zeros((), dtype=torch.float64)
    first = len(scene.meshes["static"].vertices)
    if set(use) & {"mask", "boundary", "feature"}:
        for k in range(len(scene.frames)):
            drawn = _frame(scene, steps, x, k)
            for name, weight in (("moving", 1.0), ("static", STATIC_WEIGHT)):
                cover, edges = drawn[name]
                seen = scene.seen[name][k]
                measurements = weight * len(edges.place) / OUTLINE_CORRELATION_PX / scene.sigma_outline
                if "mask" in use:
                    total = total + measurements * mask_term(cover, seen, edges)
                if "boundary" in use:
                    total = total + measurements * boundary_term(seen, edges)
            if "feature" in use and scene.described is not None:
                uv, ids = drawn["drawn"]
                shown = torch.from_numpy(_visible(ids, scene.faces, len(uv))[first:]) & ~scene.described[:, 0].isnan()
                outline = len(drawn["moving"][1].place) / OUTLINE_CORRELATION_PX
                total = total + outline * feature_term(scene.features[k], scene.described, uv[first:], shown)
    if "track" in use and len(scene.points):
        r2 = (_tracks(scene, steps, x) / scene.sigma_track).square()
        total = total + (4.5 * r2 / (9.0 + r2)).sum()
    q = steps.parts(x)[2]
    if len(q) > 2:
        span = max(float(np.ptp(scene.fit.q)), 1e-9)
        gap = torch.from_numpy(np.diff(scene.frames).astype(float))
        slope = (q[1:] - q[:-1]) / gap * gap.mean()
        total = total + ((slope[1:] - slope[:-1]) / span).square().sum()
    log_scale = steps.parts(x)[5].log()
    return total + 0.5 * (log_scale / LOG_SCALE_STD).square()


def _descend(scene: _Scene, steps: _Parameters, stage: int, use: tuple[str, ...]) -> None:
    """Adam with steps that shrink from a third of a pixel to a fiftieth; the best point seen is kept."""
    free = steps.free(stage)
    scene.described = _describe(scene, steps) if "feature" in use else None
    x = steps.x.clone().requires_grad_(True)
    adam = torch.optim.Adam([x], lr=0.3, betas=(0.8, 0.95))
    count = STEPS[stage]
    best, best_x = np.inf, steps.x.clone()
    for step in range(count):
        for group in adam.param_groups:
            group["lr"] = 0.3 * (0.02 / 0.3) ** (step / max(count - 1, 1))
        adam.zero_grad()
        cost = _cost(scene, steps, x, use)
        if float(cost.detach()) < best:
            best, best_x = float(cost.detach()), x.detach().clone()
        cost.backward()
        x.grad[~free] = 0.0
        adam.step()
        steps.x = x.detach().clone()
        if "track" in use:
            _move_points(scene, steps)
    steps.x = best_x


def _measure(scene: _Scene, steps: _Parameters) -> dict[str, float]:
    """Each term by itself, of the moving link, medians over key frames."""
    with torch.no_grad():
        mask, edge = [], []
        for k in range(len(scene.frames)):
            cover, edges = _frame(scene, steps, steps.x, k)["moving"]
            if len(edges.place):
                mask.append(float(mask_term(cover, scene.seen["moving"][k], edges)))
                edge.append(float(boundary_term(scene.seen["moving"][k], edges)))
        out = {"mask_px": float(np.median(mask)) if mask else np.nan,
               "boundary_px": float(np.median(edge)) if edge else np.nan}  # fmt: skip
        if len(scene.points):
            r = _tracks(scene, steps, steps.x)[scene.track_seen]
            out["track_px"] = float(r.median()) / 1.1774
    return out

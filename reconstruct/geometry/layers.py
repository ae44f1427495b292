"""Which cells of the link's plane belong to the link: two motions compete for every pixel.

The camera is still and the joint is known, so a pixel that the link covers must look like the same
cell of the link in frames at other q, and a pixel of the rest must look like itself in frames in
which the link is elsewhere. Comparing the two, frame by frame and cell by cell, needs no model of
what a link looks like; summing over frames in the link's own chart lets frames in which a hand hides
a piece be filled by frames in which it does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reconstruct.cues import Hands, Tracks
from reconstruct.geometry.plane import LinkPlane, apply_homography, homography, working_matrix
from reconstruct.joint.models import JointFit
from reconstruct.video import Video

LONG_SIDE = 300
"""Long side, px, of the window about the link's path in which pixels are looked at."""
GRID = 180
"""Cells along the longer side of the chart."""


@dataclass(frozen=True)
class Chart:
    """A grid on the link's plane. origin: (2,) plane coordinates of cell (0, 0); cell: its size; shape (rows, cols)."""

    origin: np.ndarray
    cell: float
    shape: tuple[int, int]

    def centres(self) -> np.ndarray:
        """(rows, cols, 2) plane coordinates; a row is a step in v, a column a step in u."""
        r, c = np.mgrid[: self.shape[0], : self.shape[1]]
        return self.origin + self.cell * np.stack([c, r], -1)

    def to_plane_matrix(self) -> np.ndarray:
        """(3, 3) (column, row, 1) -> plane (u, v, 1)."""
        return np.array([[self.cell, 0, self.origin[0]], [0, self.cell, self.origin[1]], [0, 0, 1.0]])


@dataclass(frozen=True)
class Window:
    """The piece of the working frames that the link can reach. low: (2,) first column and row; high: one past the
    last; size: (width, height) it is shrunk to."""

    low: np.ndarray
    high: np.ndarray
    size: tuple[int, int]

    def matrix(self, video: Video) -> np.ndarray:
        """(3, 3) full px -> window px."""
        s = np.array(self.size) / (self.high - self.low)
        shift = s * (0.5 - self.low) - 0.5
        return np.array([[s[0], 0, shift[0]], [0, s[1], shift[1]], [0, 0, 1.0]]) @ working_matrix(video)

    def crop(self, image: np.ndarray) -> np.ndarray:
        """Working image (bool or uint8) -> window image."""
        import cv2

        piece = np.asarray(image[self.low[1]: self.high[1], self.low[0]: self.high[0]])
        if piece.dtype == bool:
            return cv2.resize(piece.astype(np.uint8) * 255, self.size, interpolation=cv2.INTER_AREA) > 96
        return cv2.resize(piece, self.size, interpolation=cv2.INTER_AREA)

    def paste(self, mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Window mask -> (h, w) working mask."""
        import cv2

        out = np.zeros(shape, bool)
        span = tuple(int(v) for v in self.high - self.low)
        piece = cv2.resize(mask.astype(np.uint8) * 255, span, interpolation=cv2.INTER_LINEAR) > 127
        out[self.low[1]: self.high[1], self.low[0]: self.high[0]] = piece
        return out


def make_window(video: Video, fit: JointFit, plane: LinkPlane, long_side: int = LONG_SIDE) -> Window:
    """The window about everywhere the link's seed outline goes, with room for what the seed lacks."""
    seed = plane.to_world(seed_polygon(fit, plane))
    poses = fit.link_pose(np.linspace(fit.q.min(), fit.q.max(), 15))
    x = np.einsum("tij,nj->tni", poses[:, :3, :3], seed) + poses[:, None, :3, 3]
    uv = video.to_work(fit.project(x)).reshape(-1, 2)
    h, w = video.frames.shape[1:3]
    uv = uv[np.isfinite(uv).all(1)].clip(0, [w - 1, h - 1])
    low, high = uv.min(0), uv.max(0)
    pad = 0.3 * max((high - low).max(), 20)
    low = np.floor(np.maximum(low - pad, 0)).astype(int)
    high = np.ceil(np.minimum(high + pad, [w, h])).astype(int)
    s = min(1.0, long_side / (high - low).max())
    return Window(low, high, tuple(int(round(v)) for v in s * (high - low)))


@dataclass(frozen=True)
class Evidence:
    """What the frames say about the chart's cells.

    Attributes:
        chart: the grid.
        occupied: (rows, cols) bool, the link.
        score: (rows, cols) mean log-odds-like evidence, positive for the link; 0 unknown.
        seen: (rows, cols) number of frames that had a say.
        frames: (F,) working frames looked at.
        shaded: (M,) share of the frames in which the background, or a shadow on it, explains all there is to see about
            a fitted point; NaN where too few frames tell.
    """

    chart: Chart
    occupied: np.ndarray
    score: np.ndarray
    seen: np.ndarray
    frames: np.ndarray
    shaded: np.ndarray


def frame_costs(video: Video, tracks: Tracks, fit: JointFit, hand_mask: np.ndarray) -> np.ndarray:
    """(T,) how little each frame shows of the link: 0 if all of it, as the joint says; up to about 2.

    Counted are the share of the link's own area that hands cover (a hand elsewhere in the picture does no
    harm) and, with 1, frames in which the tracks contradict the joint or none is left to support it (the
    object may have been carried off).

    Args:
        hand_mask: (T, h, w) bool at working size.
    """
    import cv2

    step = 4
    small = hand_mask[:, ::step, ::step]
    h, w = small.shape[1:]
    idx = np.asarray(fit.point_track, int)
    pose = fit.link_pose(fit.q)
    points = np.asarray(fit.points)
    uv = fit.project(np.einsum("tij,nj->nti", pose[:, :3, :3], points) + pose[:, :3, 3])
    miss = np.where(tracks.visible[idx], np.linalg.norm(uv - tracks.uv[idx], axis=-1), np.nan)
    count = np.isfinite(miss).sum(0)
    middle = np.array([np.nanmedian(m) if c else np.inf for m, c in zip(miss.T, count, strict=True)])
    usual = float(np.median(middle[count > 0])) if (count > 0).any() else 0.0
    strange = (count < 3) | (middle > max(4 * usual, 0.004 * video.diagonal))
    # Points off the bulk would blow the outline up: keep nine tenths about their median.
    far = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    kept = far <= np.quantile(far, 0.9)
    hidden = np.zeros(len(fit.q))
    area = np.zeros((h, w), np.uint8)
    for t in range(len(hidden)):
        area[:] = 0
        px = np.nan_to_num(video.to_work(uv[kept, t]), nan=-9999.0).clip(-9999, 9999) / step
        cv2.fillConvexPoly(area, cv2.convexHull(np.round(px).astype(np.int32)), 1)
        hidden[t] = small[t][area > 0].mean() if area.any() else 1.0
    return hidden + strange


def spread_frames(fit: JointFit, costs: np.ndarray, count: int) -> np.ndarray:
    """Up to ``count`` frames evenly spread over q; of the frames of one bin the one that shows the link best.

    Args:
        costs: (T,) from :func:`frame_costs`.
    """
    q = np.asarray(fit.q, float)
    edges = np.linspace(q.min(), q.max(), count + 1)
    which = np.clip(np.searchsorted(edges, q, side="right") - 1, 0, count - 1)
    picks = []
    for b in range(count):
        members = np.flatnonzero(which == b)
        if len(members):
            middle = np.abs(q[members] - (edges[b] + edges[b + 1]) / 2) / max(edges[1] - edges[0], 1e-12)
            picks.append(members[np.argmin(costs[members] * 10 + middle)])
    return np.asarray(sorted(set(int(p) for p in picks)))


def seed_polygon(fit: JointFit, plane: LinkPlane) -> np.ndarray:
    """(k, 2) convex outline, plane coordinates, of what surely belongs to the link: its points and, for a
    hinged link, the stretch of the axis beside them (a link reaches its hinge)."""
    from shapely.geometry import MultiPoint

    flat = plane.to_plane(fit.points)[plane.inlier][:, :2]
    low, high = np.quantile(flat, [0.02, 0.98], axis=0)
    margin = 0.05 * (high - low).max()
    flat = flat[((flat >= low - margin) & (flat <= high + margin)).all(1)]
    hinge = np.empty((0, 2))
    if fit.type != "prismatic":
        foot = plane.to_plane(fit.point)
        if plane.kind == "across the axis":
            hinge = foot[None, :2]
        else:
            # The axis runs (nearly) along u at height foot[2] over the plane; far off the plane there is no reach.
            reach = np.linalg.norm(np.ptp(flat, axis=0))
            if abs(foot[2]) < 0.5 * reach:
                hinge = np.array([[flat[:, 0].min(), foot[1]], [flat[:, 0].max(), foot[1]]])
    hull = MultiPoint(np.vstack([flat, hinge])).buffer(0.02 * plane.extent).convex_hull
    return np.asarray(hull.exterior.coords)[:-1]


def make_chart(seed: np.ndarray, grow: float = 0.6, grid: int = GRID) -> Chart:
    """A grid around the seed, larger by ``grow`` of its size on every side."""
    low, high = seed.min(0), seed.max(0)
    pad = grow * np.maximum(high - low, 0.5 * (high - low).max())
    low, high = low - pad, high + pad
    cell = float((high - low).max() / grid)
    cols, rows = np.ceil((high - low) / cell).astype(int)
    return Chart(low, cell, (int(rows), int(cols)))


def fill(chart: Chart, polygon: np.ndarray) -> np.ndarray:
    """Polygon in plane coordinates -> (rows, cols) bool."""
    import cv2

    out = np.zeros(chart.shape, np.uint8)
    cv2.fillPoly(out, [np.round((polygon - chart.origin) / chart.cell).astype(np.int32)], 1)
    return out > 0


def warp_to_image(chart: Chart, cells: np.ndarray, H: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Chart mask -> image mask; H maps plane coordinates to px of an image of (width, height) ``size``."""
    import cv2

    M = H @ chart.to_plane_matrix()
    # Keep the scale tame for OpenCV, whose fixed-point warps dislike tiny numbers.
    M = M / np.linalg.norm(M)
    return cv2.warpPerspective(cells.astype(np.uint8) * 255, M, size, flags=cv2.INTER_LINEAR) > 127


def to_lab(image: np.ndarray) -> np.ndarray:
    """(h, w, 3) float32 slightly blurred Lab in which distances between frames are measured."""
    import cv2

    lab = cv2.cvtColor(cv2.GaussianBlur(image, (0, 0), 0.8), cv2.COLOR_BGR2LAB).astype(np.float32)
    # Brightness changes with shading and shadows far more than hue does.
    lab[..., 0] *= 0.6
    return lab


ROUNDS, GROWS = 2, 0.005
"""Rounds in which the background is learned anew in any case, and the share by which a further one has to enlarge the
link for its outline to count."""
RESTS_PX, LEAVES_PX = 1.0, 4.0
"""A track rests if it stays this close to its median place, working px; it contradicts a cell of the link that would
have carried it further than that."""


def resting_cells(video: Video, tracks: Tracks, fit: JointFit, plane: LinkPlane, chart: Chart, frames: np.ndarray
                  ) -> np.ndarray:  # fmt: skip
    """(F, rows, cols) bool: cells about points that are seen at rest where the link would carry them along.

    A shadow that moves as the link does darkens what it falls on, and both motions can explain a bare patch's colours.
    Texture under it stays where it is.
    """
    import cv2

    uv = video.to_work(np.where(tracks.visible[..., None], tracks.uv, np.nan))
    long = np.flatnonzero(tracks.visible.sum(1) >= 5)
    place = np.nanmedian(uv[long], axis=1)
    off = np.nanmax(np.linalg.norm(uv[long] - place[:, None], axis=-1), axis=1)
    long, place = long[off < RESTS_PX], place[off < RESTS_PX]
    out = np.zeros((len(frames), *chart.shape), np.uint8)
    every = homography(fit, plane, fit.q) @ chart.to_plane_matrix()
    every = working_matrix(video) @ every
    steps = np.unique(np.linspace(0, len(fit.q) - 1, 40).round().astype(int))
    for k, t in enumerate(frames):
        here = np.flatnonzero(tracks.visible[long, t])
        cell = apply_homography(np.linalg.inv(every[t]), place[here])
        rows, cols = chart.shape
        inside = np.isfinite(cell).all(1) & (cell > -0.5).all(1) & (cell < [cols - 0.5, rows - 0.5]).all(1)
        here, cell = here[inside], cell[inside]
        if not len(here):
            continue
        # Where the cell would be in the other frames that show the track.
        carried = np.stack([apply_homography(every[j], cell) for j in steps], axis=1)
        leaves = np.linalg.norm(carried - place[here][:, None], axis=-1) > LEAVES_PX
        wrong = (leaves & tracks.visible[long[here]][:, steps]).any(1)
        for c, r in np.round(cell[wrong]).astype(int):
            cv2.circle(out[k], (int(c), int(r)), 1, 1, -1)
    return out > 0


def gather(video: Video, hands: Hands, tracks: Tracks, fit: JointFit, plane: LinkPlane, costs: np.ndarray,
           count: int = 24, rounds: int = 20) -> Evidence:
    """Which cells of the link's plane are link.

    Args:
        video: stabilised, static camera.
        hands: their pixels count as unknown.
        tracks: all; those that rest speak for the background.
        fit: the joint.
        plane: from :func:`reconstruct.geometry.plane.fit_plane`.
        costs: (T,) from :func:`frame_costs`.
        count: frames to look at.
        rounds: times at most that the background is learned anew with the link's better outline excluded; after the
            first as long as that grows. Where the link goes less than its own width, what lies beyond its points is its
            own background until the outline has grown there.
    """
    import cv2

    window = make_window(video, fit, plane)
    size = window.size
    S = window.matrix(video)
    frames = spread_frames(fit, costs, count)
    seed_outline = seed_polygon(fit, plane)
    chart = make_chart(seed_outline)
    seed = fill(chart, seed_outline)
    images = np.stack([to_lab(window.crop(video.frames[t])) for t in frames])
    hand = np.stack([cv2.dilate(window.crop(hands.mask[t]).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
                     for t in frames])
    H = S @ homography(fit, plane, fit.q[frames])
    path = np.stack([warp_to_image(chart, seed, h_t, size) for h_t in H])
    images = level_exposure(images, path | hand)
    centres = chart.centres()
    uv = np.stack([apply_homography(h_t, centres) for h_t in H])
    inside = np.isfinite(uv).all(-1) & (uv > 1).all(-1) & (uv < np.array(size) - 2).all(-1)
    uvf = np.nan_to_num(uv).astype(np.float32)

    def sample(image: np.ndarray, k: int) -> np.ndarray:
        return cv2.remap(image, uvf[k, ..., 0], uvf[k, ..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    usable = inside & ~np.stack([sample(m.astype(np.uint8), k) > 0 for k, m in enumerate(hand)])
    warped = np.stack([sample(images[k], k) for k in range(len(frames))])
    noise = _noise(video, window, frames)
    facing = np.sign(plane.facing[frames])
    link_miss = _link_residual(warped, usable, uv, facing, fit.q[frames])
    rests = resting_cells(video, tracks, fit, plane, chart, frames).sum(0) >= 2
    occupied, covered = seed, path
    score = np.zeros(chart.shape)
    seen = np.zeros(chart.shape, int)
    weight = np.abs(plane.facing[frames])[:, None, None]
    for n in range(rounds):
        grown = cv2.dilate(occupied.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        over = np.stack([warp_to_image(chart, grown, H[k], size) for k in range(len(frames))])
        back_miss = np.stack([sample(b, k) for k, b in enumerate(background_residual(images, over | hand, path))])
        known = usable & (back_miss >= 0) & np.isfinite(link_miss)
        ratio = np.clip((back_miss - np.where(known, link_miss, 0.0)) / (2 * noise), -3, 3)
        votes = np.where(known, weight * ratio, 0.0)
        told = np.where(known.sum(0) >= 2, votes.sum(0) / np.maximum((weight * known).sum(0), 1e-9), 0.0)
        # Points seen at rest overrule colours that say "link", no more: they lie where there is texture only.
        told = np.where(rests, np.minimum(told, -0.5), told)
        shown = np.where(rests, np.maximum(known.sum(0), 6), known.sum(0))
        outline = _smooth(told, shown, seed, warped, usable)
        if n >= ROUNDS and outline.sum() <= (1 + GROWS) * occupied.sum():
            break
        occupied, covered, score, seen = outline, over, told, shown
    nowhere = np.zeros(covered.shape, bool)
    shaded = _shaded(background_residual(images, covered | hand, nowhere), hand, noise,
                     apply_homography(S, fit.project(_carried(fit, frames))))
    return Evidence(chart, occupied, score, seen, frames, shaded)


def _carried(fit: JointFit, frames: np.ndarray) -> np.ndarray:
    """(F, M, 3) the link's points in the world in some frames."""
    pose = fit.link_pose(fit.q[frames])
    return np.einsum("tij,nj->tni", pose[:, :3, :3], np.asarray(fit.points)) + pose[:, None, :3, 3]


def _shaded(miss: np.ndarray, hand: np.ndarray, noise: float, uv: np.ndarray) -> np.ndarray:
    """What :class:`Evidence` says of its ``shaded``. miss: (F, h, w), -1 unknown; uv: (F, M, 2) window px."""
    import cv2

    around = np.ones((5, 5), np.uint8)
    h, w = miss.shape[1:]
    px = np.nan_to_num(uv, nan=-9).round().astype(int)
    inside = (px >= 0).all(-1) & (px[..., 0] < w) & (px[..., 1] < h)
    px = px.clip(0, [w - 1, h - 1])
    told, plain = np.zeros(uv.shape[:2], bool), np.zeros(uv.shape[:2], bool)
    for k in range(len(miss)):
        known = cv2.erode(((miss[k] >= 0) & ~hand[k]).astype(np.uint8), around) > 0
        at = px[k, :, 1], px[k, :, 0]
        told[k] = inside[k] & known[at]
        plain[k] = cv2.dilate(miss[k], around)[at] < noise
    count = told.sum(0)
    return np.where(count >= 4, (told & plain).sum(0) / np.maximum(count, 1), np.nan)


def contradicted(evidence: Evidence, fit: JointFit, plane: LinkPlane) -> np.ndarray:
    """(M,) bool: points in whose surroundings the pixels say "background" (crossings of edges, reflections)."""
    import cv2

    cell = np.round((plane.to_plane(fit.points)[:, :2] - evidence.chart.origin) / evidence.chart.cell).astype(int)
    rows, cols = evidence.chart.shape
    inside = (cell >= 0).all(1) & (cell[:, 0] < cols) & (cell[:, 1] < rows)
    cell = cell.clip(0, [cols - 1, rows - 1])
    # The best cell within reach: a point at the rim is off the plane or off the outline by a little.
    near = np.ones((7, 7), np.uint8)
    best = cv2.dilate(evidence.score.astype(np.float32), near)[cell[:, 1], cell[:, 0]]
    seen = evidence.seen[cell[:, 1], cell[:, 0]]
    return inside & (seen >= 4) & (best < 0.1)


def _noise(video: Video, window: Window, frames: np.ndarray) -> float:
    """Typical difference of one unmoved pixel between two frames, in the units of :func:`to_lab`."""
    if len(frames) < 2:
        return 5.0
    late = [min(int(t) + 1, len(video) - 1) for t in frames[:: max(1, len(frames) // 4)]]
    pairs = [(to_lab(window.crop(video.frames[t])), to_lab(window.crop(video.frames[t - 1]))) for t in late if t]
    miss = [np.median(np.linalg.norm(a - b, axis=-1)) for a, b in pairs]
    return float(np.clip(2.5 * np.median(miss), 5.0, 12.0)) if miss else 5.0


def _link_residual(warped: np.ndarray, usable: np.ndarray, uv: np.ndarray, facing: np.ndarray,
                   q: np.ndarray, neighbours: int = 5) -> np.ndarray:
    """(F, rows, cols) how far a cell's colour in a frame is from its colour in frames at near, but different, q.

    Near, because shading turns with the link; different, because where the cell stood still in the image
    the comparison would hold for the background too. The median over neighbours forgives one occlusion.
    """
    F = len(warped)
    out = np.full(usable.shape, np.inf, np.float32)
    for k in range(F):
        mates = [j for j in np.argsort(np.abs(q - q[k]), kind="stable") if j != k and facing[j] == facing[k]]
        stack = []
        for j in mates[:neighbours]:
            moved = np.linalg.norm(uv[k] - uv[j], axis=-1) > 2.0
            d = np.linalg.norm(warped[k] - warped[j], axis=-1)
            stack.append(np.where(usable[k] & usable[j] & moved, d, np.nan))
        if stack:
            stack = np.stack(stack)
            enough = np.isfinite(stack).sum(0) >= min(2, len(stack))
            # A sort puts NaN last; the lower median of what is left.
            stack.sort(axis=0)
            middle = np.maximum(np.isfinite(stack).sum(0) - 1, 0) // 2
            out[k] = np.where(enough, np.take_along_axis(stack, middle[None], 0)[0], np.inf)
    return out


def level_exposure(images: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Take the camera's automatic exposure out: shift each frame's lightness so that what nothing covers agrees."""
    free = np.where(covered, np.nan, images[..., 0])[:, ::2, ::2]
    usual = np.nanmedian(np.where(np.isfinite(free).sum(0) > 0, free, 0.0), axis=0)
    shift = np.array([np.nanmedian(f - usual) if np.isfinite(f).any() else 0.0 for f in free], np.float32)
    out = images.copy()
    out[..., 0] -= shift[:, None, None]
    return out


SHADE, FAR_SHADE = 0.3, 0.1
"""What a shadow's darkening counts for among the tracked points of the link and away from them."""


def background_residual(images: np.ndarray, covered: np.ndarray, among: np.ndarray) -> np.ndarray:
    """How far each pixel is from its own colours in the frames in which nothing covers it.

    Args:
        images: (F, h, w, 3) from :func:`to_lab`.
        covered: (F, h, w) bool, link or hand.
        among: (F, h, w) bool, where the link's tracked points lie: away from them a shadow is the likelier reason why
            something grew darker.

    Returns:
        (F, h, w), -1 where fewer than two other frames show the background. A low quantile, since the link is
        likewise compared with its nearest looks only; a pixel that only grew darker by a shadow's amount,
        its colour kept, counts for less.
    """
    F = len(images)
    out = np.full(covered.shape, -1, np.float32)
    free = ~covered
    for k in range(F):
        diff = images - images[k]
        light, colour = diff[..., 0], np.square(diff[..., 1:]).sum(-1)
        # Darker here than there with the hue kept and the saturation down in step: a shadow explains it.
        ratio = np.clip(images[k, ..., 0] / np.maximum(images[..., 0], 1.0), 0, 1)[..., None]
        hue = np.square((images[..., 1:] - 128) * ratio - (images[k, ..., 1:] - 128)).sum(-1)
        shade = (light > 0) & (light < 0.75 * images[..., 0]) & (hue < 20)
        less = np.where(among[k], SHADE, FAR_SHADE)
        d = np.sqrt(np.where(shade, np.square(less * light) + hue, np.square(light) + colour))
        d = np.where(free, d, np.inf)
        d[k] = np.inf
        d.sort(axis=0)
        count = np.isfinite(d).sum(0)
        pick = np.clip((count - 1) // 8, 0, F - 1)
        value = np.take_along_axis(d, pick[None], 0)[0]
        out[k] = np.where(count >= 2, value, -1)
    return out


def _smooth(score: np.ndarray, seen: np.ndarray, seed: np.ndarray, warped: np.ndarray,
            usable: np.ndarray) -> np.ndarray:
    """Labels from votes: a quadratic field that follows the votes where there are some, and elsewhere spreads
    from its neighbours except across edges of the link's own texture."""
    import cv2
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import cg

    rows, cols = score.shape
    texture = np.where(usable[..., None], warped, 0).sum(0) / np.maximum(usable.sum(0), 1)[..., None]
    trust = np.clip(seen / 6.0, 0, 1)
    # Bare walls and table tops match under either motion: such a tie goes to the background.
    target = np.clip(score - np.where(seed, 0.2, 0.35), -1.5, 1.5)
    # Without votes: the seed is link by construction, the rim of the chart is not.
    pull = trust + 0.02
    target = (trust * target + 0.02 * np.where(seed, 1.0, -0.5)) / pull
    index = np.arange(rows * cols).reshape(rows, cols)
    i, j, wgt = [], [], []
    for a, b, d in ((index[:, :-1], index[:, 1:], np.diff(texture, axis=1)),
                    (index[:-1], index[1:], np.diff(texture, axis=0))):
        i.append(a.ravel())
        j.append(b.ravel())
        wgt.append((0.5 + 4.0 * np.exp(-((np.linalg.norm(d, axis=-1) / 6.0) ** 2))).ravel())
    i, j, wgt = np.concatenate(i), np.concatenate(j), np.concatenate(wgt)
    n = rows * cols
    degree = np.bincount(i, wgt, n) + np.bincount(j, wgt, n)
    A = coo_matrix((np.r_[-wgt, -wgt, degree + pull.ravel()], (np.r_[i, j, np.arange(n)], np.r_[j, i, np.arange(n)])))
    x, _ = cg(A.tocsr(), (pull * target).ravel(), x0=target.ravel(), rtol=1e-4, maxiter=300)
    mask = (x.reshape(rows, cols) > 0).astype(np.uint8)
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, labels = cv2.connectedComponents(mask)
    shares = np.bincount(labels[seed], minlength=labels.max() + 1)
    shares[0] = 0
    if not shares.any():
        return seed
    keep = np.isin(labels, np.flatnonzero(shares >= 0.1 * shares.max()))
    holes = 1 - keep.astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(holes)
    for k in range(1, len(stats)):
        inner = stats[k, 0] > 0 and stats[k, 1] > 0 and stats[k, 0] + stats[k, 2] < cols \
            and stats[k, 1] + stats[k, 3] < rows
        if inner and stats[k, 4] < 0.03 * keep.sum():
            keep |= labels == k
    return keep

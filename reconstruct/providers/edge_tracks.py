"""Straight edges followed through a film, as tracks that hold across their edge only.

What has no texture has rims. A corner on a rim is half on what lies behind and is lost or slides within a few frames;
the straight edge itself is seen for as long as one of its two sides is, to a tenth of a pixel across. Segments (LSD;
Grompone von Gioi et al., 2010) of neighbouring frames are matched by place, direction and the colour of the sides, and
points along each are handed on as tracks whose slip is all along it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from reconstruct.cues import ProviderInfo, Tracks
from reconstruct.joint.photometric import Pictures
from reconstruct.providers.lk_tracks import shadows
from reconstruct.video import Video

LEAST_PX = 14.0
"""Length of a segment."""
BESIDE_PX, LOOKS = 3.0, 24
"""How far beside a segment its sides' colours are read, and at how many places."""
COVERED = 0.4
"""Share of it from which on it is a hand's."""
TURN_DEG, AWAY_PX, GREY = 8.0, 7.0, 22.0
"""From one frame to the next: turn, way across, and change of the less changed side's colour, at most."""
OVERLAP = 0.4
"""Share of the shorter of two segments that has to lie beside the other."""
MISSED = 3
"""Frames after which an edge that is not found again is given up."""
LIFE = 6
"""Frames in which an edge has to be found, and a point on it seen."""
MOVES_PX = 1.0
"""Way across its points have to go: what rests is nothing to fit."""
MOSTLY = 0.5
"""Share of an edge's points on the edge of a shadow from which on all of it may be one."""
STEP_PX, END_PX = 14.0, 4.0
"""Points along an edge, and how far beyond a segment's end one may lie."""


@dataclass(frozen=True)
class Segments:
    """Straight edges of one picture, the brighter side on the right of each for who looks along it.

    Attributes:
        middle: (n, 2) px.  along: (n, 2) unit.  length: (n,) px.  sides: (n, 2, 3) mean colour of either side.
    """

    middle: np.ndarray
    along: np.ndarray
    length: np.ndarray
    sides: np.ndarray

    @property
    def across(self) -> np.ndarray:
        """(n, 2) unit, at right angles, to the brighter side."""
        return np.stack([-self.along[:, 1], self.along[:, 0]], axis=1)

    def __getitem__(self, rows: np.ndarray) -> Segments:
        """Some of them."""
        return Segments(self.middle[rows], self.along[rows], self.length[rows], self.sides[rows])


def edge_tracks(video: Video, pictures: Pictures, every: list[Segments]) -> Tracks:
    """Points along the straight edges that move, without those of shadows.

    Args:
        video: of a camera at rest.
        pictures: of its frames, and what hands cover.
        every: each frame's straight edges, as of :func:`all_segments`.

    Returns:
        Tracks in full px; from frame to frame each goes across its edge only, and its slip is all along it. None is
        on the edge of a shadow; ``cast`` is true where most of its edge is.
    """
    import cv2

    T = len(video)
    uv, slip, start, of = [np.zeros((0, T, 2))], [np.zeros((0, T, 2))], [np.zeros(0, int)], [np.zeros(0, int)]
    for chain in followed(every):
        if len(chain) < LIFE:
            continue
        places, along, frame = _points(chain, every)
        lasts = np.isfinite(places[..., 0]).sum(1) >= LIFE
        if lasts.any() and np.nanmax(np.linalg.norm(places - places[:, [frame]], axis=-1)) > MOVES_PX:
            uv.append(places[lasts])
            slip.append(along[lasts])
            start.append(np.full(int(lasts.sum()), frame))
            of.append(np.full(int(lasts.sum()), len(of)))
    places = np.concatenate(uv).astype(np.float32)
    shade, cast = shadows(video, places, pictures.covered)
    tracks = Tracks(video.to_full(places).astype(np.float32), np.isfinite(places[..., 0]), np.concatenate(start),
                    ProviderInfo("edges", cv2.__version__, "Apache-2.0"), np.concatenate(slip).astype(np.float32),
                    shade, cast)  # fmt: skip
    edge = np.concatenate(of)
    shadow = np.bincount(edge, cast) >= MOSTLY * np.bincount(edge)
    return replace(tracks, cast=shadow[edge]).of(~cast)


def all_segments(video: Video, pictures: Pictures) -> list[Segments]:
    """The straight edges of every frame that are not a hand's."""
    return [segments(pictures.grey[t], video.frames[t], pictures.covered[t]) for t in range(len(video))]


def segments(grey: np.ndarray, colour: np.ndarray, covered: np.ndarray) -> Segments:
    """The straight edges of a picture that are not a hand's.

    Args:
        grey: (h, w) uint8.  colour: (h, w, 3) uint8.  covered: (h, w) bool.
    """
    import cv2

    found = cv2.createLineSegmentDetector().detect(np.ascontiguousarray(grey))[0]
    ends = np.zeros((0, 2, 2)) if found is None else np.asarray(found, float).reshape(-1, 2, 2)
    way = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(way, axis=1)
    ends, way, length = ends[length > LEAST_PX], way[length > LEAST_PX], length[length > LEAST_PX]
    along = way / length[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    on = ends[:, :1] + np.linspace(0.02, 0.98, LOOKS)[:, None] * way[:, None]

    def read(picture: np.ndarray, at: np.ndarray) -> np.ndarray:
        x, y = np.moveaxis(np.clip(at.round().astype(int), 0, [grey.shape[1] - 1, grey.shape[0] - 1]), -1, 0)
        return picture[y, x].astype(float).mean(1)

    sides = np.stack([read(colour, on + s * BESIDE_PX * across[:, None]) for s in (1, -1)], axis=1)
    turned = sides[:, 0].sum(1) < sides[:, 1].sum(1)
    along = np.where(turned[:, None], -along, along)
    sides = np.where(turned[:, None, None], sides[:, ::-1], sides)
    return Segments(ends.mean(1), along, length, sides)[read(covered, on) < COVERED]


@dataclass
class _Edge:
    """An edge that is being followed: where it was seen last, how it went, and all of (frame, segment)."""

    last: Segments
    frame: int
    velocity: np.ndarray
    turning: float
    seen: list[tuple[int, int]]


def followed(every: list[Segments]) -> list[list[tuple[int, int]]]:
    """Chains of segments, (frame, index into that frame's), that are one edge; in the order of time.

    Args:
        every: T frames' segments.
    """
    live: list[_Edge] = []
    out: list[_Edge] = []
    for t, here in enumerate(every):
        partner = _matches(live, here, t)
        going = []
        for edge, j in zip(live, partner, strict=True):
            if j >= 0:
                now = here[[j]]
                dt, across = t - edge.frame, now.across[0]
                edge.velocity = across * float((now.middle[0] - edge.last.middle[0]) @ across) / dt
                edge.turning = _turn(edge.last.along, now.along)[0, 0] / dt
                edge.last, edge.frame = now, t
                edge.seen.append((t, int(j)))
            (going if t - edge.frame < MISSED else out).append(edge)
        new = np.setdiff1d(np.arange(len(here.length)), partner)
        live = going + [_Edge(here[[j]], t, np.zeros(2), 0.0, [(t, int(j))]) for j in new]
    return [edge.seen for edge in out + live]


def _turn(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(n, m) rad from directions (n, 2) to others (m, 2)."""
    cross = one[:, None, 0] * other[:, 1] - one[:, None, 1] * other[:, 0]
    return np.arctan2(cross, one @ other.T)


def _matches(live: list[_Edge], here: Segments, t: int) -> np.ndarray:
    """(n,) for each edge the segment of frame t that it is now, -1 for none; both choose each other."""
    if not live or not len(here.length):
        return np.full(len(live), -1)
    gap = np.array([t - e.frame for e in live])
    last = Segments(
        *(np.concatenate([getattr(e.last, k) for e in live]) for k in ("middle", "along", "length", "sides"))
    )
    middle = last.middle + gap[:, None] * np.array([e.velocity for e in live])
    angle = np.arctan2(last.along[:, 1], last.along[:, 0]) + gap * np.array([e.turning for e in live])
    turn = np.degrees(np.abs(_turn(np.stack([np.cos(angle), np.sin(angle)], axis=1), here.along)))
    off = middle[:, None] - here.middle
    away, aside = np.abs(np.sum(off * here.across, axis=2)), np.abs(np.sum(off * here.along, axis=2))
    least = np.minimum(last.length[:, None], here.length)
    overlap = np.clip((last.length[:, None] + here.length) / 2 - aside, 0, least) / least
    change = np.abs(last.sides[:, None] - here.sides).mean(-1)
    # What a rim has behind it changes; what it is the rim of does not.
    cost = away / 3 + turn / 4 + change.min(-1) / 10 + change.max(-1) / 60 + 1 - overlap
    cost[(turn > TURN_DEG) | (away > AWAY_PX) | (change.min(-1) > GREY) | (overlap < OVERLAP)] = np.inf
    best, back = cost.argmin(1), cost.argmin(0)
    rows = np.arange(len(live))
    return np.where(np.isfinite(cost[rows, best]) & (back[best] == rows), best, -1)


def _points(chain: list[tuple[int, int]], every: list[Segments]) -> tuple[np.ndarray, np.ndarray, int]:
    """Points spread along an edge where it is longest: (k, T, 2) px, (k, T, 2) slip, and that frame."""
    length = [every[t].length[j] for t, j in chain]
    at = int(np.argmax(length))
    frame, j = chain[at]
    k = max(2, int(length[at] // STEP_PX))
    s = (np.arange(k) + 0.5) / k - 0.5
    first = every[frame].middle[j] + s[:, None] * length[at] * every[frame].along[j]
    uv, slip = np.full((k, len(every), 2), np.nan), np.zeros((k, len(every), 2))
    for way in (chain[at:], chain[at::-1]):
        p = first
        for t, j in way:
            here = every[t][[j]]
            p = p - ((p - here.middle) @ here.across[0])[:, None] * here.across
            on = np.abs((p - here.middle) @ here.along[0]) <= here.length / 2 + END_PX
            uv[on, t], slip[:, t] = p[on], here.along[0]
    return uv, np.where(np.isfinite(uv), slip, 0.0), frame

"""Cues: what pretrained models, trackers or a person say about a video, one dataclass a cue.

All uv are full pixels (see :class:`reconstruct.video.Video`); T counts the working frames.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class ProviderInfo:
    """Who made a cue: carried into ``asset.json``.

    Attributes:
        name, version: of the provider; where it has weights, the version names them.
        licence: of its code and weights.
        stage: what it made ("track", "depth", ...), or "".
    """

    name: str
    version: str
    licence: str
    stage: str = ""


@dataclass(frozen=True)
class HandTrack:
    """One hand through the video.

    Attributes:
        side: "left" or "right".
        uv: (T, 21, 2) landmarks in full px (MediaPipe order: 0 wrist, 4 thumb tip, 8 index tip,
            12 middle tip, 16 ring tip, 20 little tip); NaN where not valid.
        metric: (T, 21, 3) landmarks in metres about the hand's centre, camera axes (right, down,
            forward); NaN where not valid.
        score: (T,) presence score in [0, 1].
        valid: (T,) bool.
        placed: (T, 21, 3) landmarks in metres in the camera's frame, where who made the cue measured them there; NaN
            where not valid. None for a network that sees one picture: its distance is a guess.
        placed_std: m, of each of those coordinates.
    """

    side: str
    uv: np.ndarray
    metric: np.ndarray
    score: np.ndarray
    valid: np.ndarray
    placed: np.ndarray | None = None
    placed_std: float | None = None


@dataclass(frozen=True)
class Hands:
    """All hands of a video and the pixels that hands and arms cover, sleeves included.

    Attributes:
        tracks: the hands, longest first; empty if none was seen.
        mask: (T, h, w) bool at working size.
    """

    tracks: tuple[HandTrack, ...]
    mask: np.ndarray
    provider: ProviderInfo


@dataclass(frozen=True)
class Tracks:
    """Point tracks.

    Attributes:
        uv: (N, T, 2) full px (NaN where not visible).
        visible: (N, T) bool.
        reference: (N,) working frame in which each track was seeded.
        slip: (N, T, 2) along the direction in which the picture holds the point worst (an edge's own), its square
            1 - s, where s is the noise across over the noise along: 0 at corners, near 1 on edges, where a point
            slides. None where nothing is known of it.
        shade: (N,) bool, on an edge whose two sides differ in brightness alone, as a shadow's do. None as before.
        cast: (N,) bool, these of which what lies beneath is also seen to rest, as under a shadow. None as before.
    """

    uv: np.ndarray
    visible: np.ndarray
    reference: np.ndarray
    provider: ProviderInfo
    slip: np.ndarray | None = None
    shade: np.ndarray | None = None
    cast: np.ndarray | None = None

    def of(self, rows: np.ndarray) -> Tracks:
        """Some of them: (k,) indices or (N,) bool."""
        some = [None if x is None else x[rows] for x in (self.slip, self.shade, self.cast)]
        return Tracks(self.uv[rows], self.visible[rows], self.reference[rows], self.provider, *some)


@dataclass(frozen=True)
class LinkMasks:
    """Pixels of the moving link, of the static link's visible part, and of hands.

    Attributes:
        moving, static, hand: (T, h, w) bool at working size.
        confidence: (T,) how well the moving mask is supported by tracks, [0, 1].
    """

    moving: np.ndarray
    static: np.ndarray
    hand: np.ndarray
    confidence: np.ndarray


@dataclass(frozen=True)
class HandReference:
    """The demonstration: what ``reference.npz`` holds (world frame, metres).

    Attributes:
        time: (T,) s.  q: (T,) joint state.
        hand_joints: (T, 21, 3) world.  hand_valid: (T,) bool, False where filled in.
        contact: (T,) bool, the frames in which the hand drives the part.
        side: "left" or "right".
        notes: what was assumed or could not be done.
        std: standard deviations of what stays open about the driving hand: ``depth`` and ``across`` (m, along and
            across the viewing ray), ``size`` (relative), ``time`` (s), ``tips`` (m, a finger tip), ``offset`` (m, the
            whole hand against the part); empty without one.
        holds: convex parts, each (vertices (v, 3) m, faces (f, 3)), world frame at q = 0, that the hand must be holding
            and the geometry does not show.
    """

    time: np.ndarray
    q: np.ndarray
    hand_joints: np.ndarray
    hand_valid: np.ndarray
    contact: np.ndarray
    side: str
    notes: tuple[str, ...] = field(default_factory=tuple)
    std: dict[str, float] = field(default_factory=dict)
    holds: tuple[tuple[np.ndarray, np.ndarray], ...] = ()

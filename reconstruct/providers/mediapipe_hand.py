"""Hands: MediaPipe's palm and landmark networks, followed through the video in both time directions.

The palm detector looks at the whole frame and at overlapping square tiles every few frames. Each palm that no
tracklet explains starts one, which the landmark network carries forwards and backwards, each frame's landmarks giving
the next frame's region, until the network says that no hand is there. Because the video is complete, nothing has to be
decided on the fly: tracklets are linked and gated only when all are known.

The palm detector needs a palm. Of a hand that reaches in from the picture's edge often only fingers are seen, so a
second look is taken at the picture with its edge pixels repeated outwards, where the networks complete such a hand. Its
landmarks are half a guess: it counts for the mask of hands, which keeps point tracks off it, and not as a hand track.
Where still nobody is found, the landmark network itself is put on turned squares of many sizes around what changes in
the picture: it knows fingers behind an edge, or a hand as large as the picture, where the palm detector sees no palm.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from reconstruct.cues import Hands, HandTrack, ProviderInfo
from reconstruct.providers.skin import hand_mask
from reconstruct.providers.weights import from_wheel
from reconstruct.video import Video

INFO = ProviderInfo("mediapipe-hand", "0.10.21", "Apache-2.0")
WHEEL = "mediapipe==0.10.21"
PALM = "mediapipe/modules/palm_detection/palm_detection_full.tflite"
LANDMARK = "mediapipe/modules/hand_landmark/hand_landmark_full.tflite"
DIGESTS = {
    PALM: "1b14e9422c6ad006cde6581a46c8b90dd573c07ab7f3934b5589e7cea3f89a54",
    LANDMARK: "11c272b891e1a99ab034208e23937a8008388cf11ed2a9d776ed3d01d0ba00e3",
}
PALM_SIZE, CROP_SIZE = 192, 224
PALM_SCORE = 0.5
START_PRESENCE = 0.7  # to begin a tracklet
KEEP_PRESENCE = 0.5  # to go on
DETECT_EVERY = 4  # frames
MIN_SECONDS = 0.3  # a hand that was seen for less is not reported
MAX_HANDS = 3
WIDER = (0.5, 1.0)  # of the frame's short side are added on every side to find hands at the picture's edge
FINE_LOOKS = 3  # frames in which the landmark network itself looks for a hand
FINE_SIDES = (0.5, 0.75, 1.1, 1.6)  # of the frame's short side, of the squares that it looks at
FINE_MARGIN = 0.5  # of the short side, by which the picture is widened meanwhile
FINE_TURNS = 8
FINE_LIKELY = 8  # squares that are looked at more closely
FINE_PRESENCE = 0.8
FINE_MISSES = 4  # frames in a row without it end a hand
FINE_CHANGE = 12.0  # grey levels between a pixel's darkest and brightest that are more than noise
FINE_SHARE = 0.05  # of the inner half of a square changes, or nobody looks at it: what rests misleads nobody
Palm = tuple[float, np.ndarray, np.ndarray]  # score, box (cx, cy, w, h), points (7, 2)
BONES = ((0, 5), (0, 9), (0, 13), (0, 17), (5, 6), (6, 7), (7, 8), (9, 10), (10, 11), (11, 12), (13, 14), (14, 15),
         (15, 16), (17, 18), (18, 19), (19, 20), (0, 1), (1, 2), (2, 3), (3, 4))  # fmt: skip


def _anchors() -> np.ndarray:
    """(2016, 2) anchor centres in [0, 1]: 2 a cell at stride 8, 6 a cell at stride 16."""
    out = []
    for stride, per_cell in ((8, 2), (16, 6)):
        n = PALM_SIZE // stride
        centre = (np.arange(n) + 0.5) / n
        grid = np.stack(np.meshgrid(centre, centre), -1).reshape(-1, 2)
        out.append(np.repeat(grid, per_cell, axis=0))
    return np.concatenate(out)


@dataclass(frozen=True)
class _Region:
    """A turned square: centre (x, y) and side in working px, angle in rad of its x axis against the image's."""

    centre: np.ndarray
    side: float
    angle: float

    def to_image(self) -> np.ndarray:
        """(2, 3) affine map from crop px to working px."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        turn = np.array([[c, -s], [s, c]]) * (self.side / CROP_SIZE)
        return np.column_stack([turn, self.centre - turn @ np.full(2, (CROP_SIZE - 1) / 2)])


def _upright_angle(wrist: np.ndarray, fingers: np.ndarray) -> float:
    """Turn that makes the direction wrist -> fingers point up in the crop."""
    dx, dy = fingers - wrist
    return float(np.arctan2(dx, -dy))


def _region_from_palm(box: np.ndarray, points: np.ndarray) -> _Region:
    angle = _upright_angle(points[0], points[2])
    side = max(box[2], box[3])
    up = np.array([np.sin(angle), -np.cos(angle)])
    return _Region(box[:2] + 0.5 * side * up, 2.6 * side, angle)


def _region_from_landmarks(uv: np.ndarray) -> _Region:
    """The palm and the lower finger joints; the tips would make the region jump."""
    angle = _upright_angle(uv[0], 0.25 * uv[6] + 0.5 * uv[10] + 0.25 * uv[14])
    c, s = np.cos(angle), np.sin(angle)
    stable = uv[[0, 1, 2, 3, 5, 6, 9, 10, 13, 14, 17, 18]] @ np.array([[c, -s], [s, c]])
    low, high = stable.min(0), stable.max(0)
    side = float((high - low).max())
    centre = (low + high) / 2 - np.array([0.0, 0.1 * side])
    return _Region(np.array([[c, -s], [s, c]]) @ centre, 2.0 * side, angle)


class _Networks:
    def __init__(self) -> None:
        from ai_edge_litert.interpreter import Interpreter

        files = from_wheel(WHEEL, DIGESTS)
        self._palm = Interpreter(str(files[PALM]), num_threads=1)
        self._hand = Interpreter(str(files[LANDMARK]), num_threads=1)
        for net in (self._palm, self._hand):
            net.allocate_tensors()
        self._palm_out = {tuple(d["shape"])[-1]: d["index"] for d in self._palm.get_output_details()}
        self._hand_out = {d["name"]: d["index"] for d in self._hand.get_output_details()}
        self._anchors = _anchors()

    def palms(self, image: np.ndarray, square: tuple[float, float, float]) -> list[Palm]:
        """Palms in the square (left, top, side): (score, box (cx, cy, w, h), points (7, 2)), working px."""
        import cv2

        left, top, side = square
        k = PALM_SIZE / side
        view = np.array([[k, 0, (0.5 - left) * k - 0.5], [0, k, (0.5 - top) * k - 0.5]])
        # warpAffine does not average, so shrink by area first where the square is much larger than the input.
        x0, y0 = max(0, int(left)), max(0, int(top))
        part = image[y0 : int(np.ceil(top + side)), x0 : int(np.ceil(left + side))]
        if k < 1.0:
            size = (max(1, round(part.shape[1] * k)), max(1, round(part.shape[0] * k)))
            crop = np.zeros((PALM_SIZE, PALM_SIZE, 3), np.uint8)
            small = cv2.resize(part, size, interpolation=cv2.INTER_AREA)
            # A square that starts within a pixel would be placed at -1.
            ox, oy = max(0, round((x0 - left) * k)), max(0, round((y0 - top) * k))
            small = small[: PALM_SIZE - oy, : PALM_SIZE - ox]
            crop[oy : oy + small.shape[0], ox : ox + small.shape[1]] = small
        else:
            crop = cv2.warpAffine(image, view, (PALM_SIZE, PALM_SIZE))
        self._palm.set_tensor(0, (crop[None, :, :, ::-1] / np.float32(255)).astype(np.float32))
        self._palm.invoke()
        score = self._palm.get_tensor(self._palm_out[1])[0, :, 0]
        score = 1.0 / (1.0 + np.exp(-np.clip(score, -60, 60)))
        keep = np.flatnonzero(score >= PALM_SCORE)
        if not len(keep):
            return []
        raw = self._palm.get_tensor(self._palm_out[18])[0, keep].astype(float) / PALM_SIZE
        centre = raw[:, :2] + self._anchors[keep]
        points = raw[:, 4:].reshape(-1, 7, 2) + self._anchors[keep, None]
        box = np.hstack([centre, raw[:, 2:4]]) * side
        box[:, :2] += (left - 0.5, top - 0.5)
        points = points * side + (left - 0.5, top - 0.5)
        return _merge(score[keep], box, points)

    def landmarks(self, image: np.ndarray, region: _Region) -> tuple[float, float, np.ndarray, np.ndarray]:
        """Presence, probability of a right hand, uv (21, 2) working px, metric (21, 3) m in camera axes."""
        import cv2

        affine = region.to_image()
        source = image
        shrink = region.side / CROP_SIZE
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        if shrink > 2.0:  # oversized hand: average rather than skip pixels
            source = cv2.resize(image, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA)
            scaled = affine / shrink
            scaled[:, 2] = (affine[:, 2] + 0.5) / shrink - 0.5
            crop = cv2.warpAffine(source, scaled, (CROP_SIZE, CROP_SIZE), flags=flags)
        else:
            crop = cv2.warpAffine(source, affine, (CROP_SIZE, CROP_SIZE), flags=flags)
        self._hand.set_tensor(0, (crop[None, :, :, ::-1] / np.float32(255)).astype(np.float32))
        self._hand.invoke()
        get = self._hand.get_tensor
        xyz = get(self._hand_out["Identity"])[0].astype(float).reshape(21, 3)
        metric = get(self._hand_out["Identity_3"])[0].astype(float).reshape(21, 3)
        c, s = np.cos(region.angle), np.sin(region.angle)
        metric = metric @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
        uv = xyz[:, :2] @ affine[:, :2].T + affine[:, 2]
        presence, right = (float(get(self._hand_out[name])[0, 0]) for name in ("Identity_1", "Identity_2"))
        return presence, right, uv, metric


def _overlap(box: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    low = np.maximum(box[:2] - box[2:] / 2, boxes[:, :2] - boxes[:, 2:] / 2)
    high = np.minimum(box[:2] + box[2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2)
    common = np.prod(np.clip(high - low, 0, None), axis=1)
    return common / (np.prod(box[2:]) + np.prod(boxes[:, 2:], axis=1) - common)


def _merge(score: np.ndarray, box: np.ndarray, points: np.ndarray) -> list[Palm]:
    """Score-weighted mean of overlapping boxes."""
    out = []
    left = np.argsort(-score)
    while len(left):
        same = _overlap(box[left[0]], box[left]) > 0.3
        group = left[same]
        w = score[group] / score[group].sum()
        out.append((float(score[group[0]]), w @ box[group], np.tensordot(w, points[group], 1)))
        left = left[~same]
    return out


def _squares(height: int, width: int) -> list[tuple[float, float, float]]:
    """The whole frame and overlapping square tiles at two sizes: small hands fill too few of the network's pixels."""
    long, short = max(height, width), min(height, width)
    out = [((width - long) / 2, (height - long) / 2, float(long))]
    for side in (short, 0.6 * short):
        if side >= PALM_SIZE and side < 0.9 * long:
            nx, ny = (max(1, int(np.ceil((n - 0.25 * side) / (0.75 * side)))) for n in (width, height))
            out += [(float(x), float(y), float(side)) for x in np.linspace(0, width - side, nx)
                    for y in np.linspace(0, height - side, ny)]  # fmt: skip
    return out


@dataclass(eq=False)
class _Tracklet:
    uv: dict[int, np.ndarray] = field(default_factory=dict)
    metric: dict[int, np.ndarray] = field(default_factory=dict)
    score: dict[int, float] = field(default_factory=dict)
    right: dict[int, float] = field(default_factory=dict)
    palms: int = 0  # detections of the palm network that agree
    looks: int = 0  # frames in which the palm network looked

    def put(self, t: int, uv: np.ndarray, metric: np.ndarray, score: float, right: float) -> None:
        self.uv[t], self.metric[t], self.score[t], self.right[t] = uv, metric, score, right

    def drop(self, t: int) -> None:
        for column in (self.uv, self.metric, self.score, self.right):
            column.pop(t)

    @property
    def span(self) -> tuple[int, int]:
        return min(self.uv), max(self.uv)


def _size(uv: np.ndarray) -> float:
    """Length of the palm and of the palm's width, px: does not shrink when the fingers close."""
    return float(max(np.linalg.norm(uv[9] - uv[0]), np.linalg.norm(uv[5] - uv[17]), 1.0))


def _plausible(uv: np.ndarray, shape: tuple[int, ...]) -> bool:
    """Most of the palm inside the frame, and no bone out of proportion."""
    h, w = shape[:2]
    palm = uv[[0, 5, 9, 13, 17]]
    inside = ((palm > -0.02 * w) & (palm < (1.02 * w, 1.02 * h))).all(1).mean()
    longest = max(np.linalg.norm(uv[a] - uv[b]) for a, b in BONES)
    return inside >= 0.6 and longest < 2.5 * _size(uv)


def _follow(networks: _Networks, frames: Sequence[np.ndarray], tracklet: _Tracklet, start: int, step: int,
            claimed: list[_Tracklet]) -> None:
    t = start + step
    while 0 <= t < len(frames):
        here = tracklet.uv[t - step]
        shift = here - tracklet.uv[t - 2 * step] if t - 2 * step in tracklet.uv else 0.0
        shift = np.median(shift, axis=0) if np.ndim(shift) else 0.0
        image = frames[t]
        presence, right, uv, metric = networks.landmarks(image, _region_from_landmarks(here + shift))
        if presence < KEEP_PRESENCE and np.ndim(shift):  # the hand may have stopped
            presence, right, uv, metric = networks.landmarks(image, _region_from_landmarks(here))
        if presence < KEEP_PRESENCE or not _plausible(uv, image.shape):
            return
        if not 0.5 < _size(uv) / _size(here) < 2.0:
            return
        # Region tracking sticks to its first crop; a second look from the new landmarks removes the lag.
        if np.linalg.norm((uv - here).mean(0)) > 0.15 * _size(uv):
            again = networks.landmarks(image, _region_from_landmarks(uv))
            if again[0] >= presence - 0.1 and _plausible(again[2], image.shape):
                presence, right, uv, metric = again
        rivals = [other for other in claimed if t in other.uv and _same_place(uv, other.uv[t])]
        if any(presence < other.score[t] + 0.05 for other in rivals):
            return
        for other in rivals:  # this one sees the same hand better
            other.drop(t)
        tracklet.put(t, uv, metric, presence, right)
        t += step


def _same_place(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.linalg.norm(a.mean(0) - b.mean(0)) < 0.5 * max(_size(a), _size(b)))


def _explains(uv: np.ndarray, palm_points: np.ndarray) -> bool:
    """Is a palm detection (wrist, index, middle, ring, little knuckle, ...) the hand with these landmarks?"""
    return bool(np.linalg.norm(uv[[0, 5, 9, 13, 17]].mean(0) - palm_points[:5].mean(0)) < 0.6 * _size(uv))


@dataclass(frozen=True)
class _Widened(Sequence):
    """Frames with their edge pixels repeated outwards by `margin`; made one at a time."""

    frames: np.ndarray
    margin: int

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, t):
        m = self.margin
        return np.pad(self.frames[t], ((m, m), (m, m), (0, 0)), mode="edge")


def _beyond_the_edge(networks: _Networks, video: Video, hands: list[_Tracklet], rate: float) -> list[_Tracklet]:
    """Hands of which not the whole palm is in the picture and that are not among `hands`.

    Where there is nobody else to be found the look is as close as the first, and a wider one follows.
    """
    h, w = video.frames.shape[1:3]
    every = 2 * DETECT_EVERY if hands else DETECT_EVERY
    for share in WIDER:
        wide = _Widened(video.frames, round(share * min(h, w)))
        found = [k for k in _find_tracklets(networks, wide, None, every) if k.uv]
        out = [k for k in found if _grade(k, rate) == 2]
        # One that passes for a hand vouches for the weaker stretches that continue it.
        for k in sorted(found, key=lambda k: -len(k.uv)):
            if k not in out and any(_continues(k, sure) for sure in out):
                out.append(k)
        for k in out:
            k.uv = {t: uv - wide.margin for t, uv in k.uv.items()}
            for t in [t for t in k.uv if any(t in o.uv and _same_place(k.uv[t], o.uv[t]) for o in hands)]:
                k.drop(t)
        palms = [uv[[0, 5, 9, 13, 17]] for k in out for uv in k.uv.values()]
        if any(((p < 0) | (p > (w - 1, h - 1))).any() for p in palms):
            return [k for k in out if k.uv]
        if hands:
            break
    return []


def _without_palm(networks: _Networks, video: Video, rate: float) -> list[_Tracklet]:
    """Hands that move and of which no palm is seen: the landmark network on squares everywhere in a few frames.

    In 12 frames without a hand of three real clips none of 1400 squares of a finer grid had a presence of 0.7; in
    `microwave.mp4` those around two fingers on its button had.
    """
    h, w = video.frames.shape[1:3]
    short = min(h, w)
    frames = _Widened(video.frames, round(FINE_MARGIN * short))
    changes = np.pad(_changes(video.frames), frames.margin)
    out: list[_Tracklet] = []
    for t in np.linspace(0, len(frames) - 1, FINE_LOOKS + 2)[1:-1].round().astype(int):
        if any(t in k.uv for k in out):
            continue
        image = frames[t]
        for presence, region in _fine_regions(networks, image, changes, frames.margin, short):
            if presence < FINE_PRESENCE:
                continue
            presence, right, uv, metric = networks.landmarks(image, region)
            if not _plausible(uv, image.shape):
                continue
            if any(t in k.uv and _same_place(uv, k.uv[t]) for k in out):
                continue
            new = _Tracklet({int(t): uv}, {int(t): metric}, {int(t): presence}, {int(t): right})
            for step in (1, -1):
                _carry(networks, frames, new, region, int(t), step)
            if _steady(new, rate) and np.median(list(new.score.values())) >= FINE_PRESENCE:
                out.append(new)
    for k in out:
        k.uv = {t: uv - frames.margin for t, uv in k.uv.items()}
    return out


def _carry(networks: _Networks, frames: Sequence[np.ndarray], tracklet: _Tracklet, region: _Region, start: int,
           step: int) -> None:  # fmt: skip
    """The square goes along with its landmarks and stays as it is: a palm that is invented would turn and shrink it."""
    offset = region.centre - tracklet.uv[start].mean(0)
    misses, t = 0, start + step
    while 0 <= t < len(frames) and misses < FINE_MISSES:
        presence, right, uv, metric = networks.landmarks(frames[t], region)
        if presence < KEEP_PRESENCE or not _plausible(uv, frames[t].shape):
            misses += 1
        else:
            misses = 0
            tracklet.put(t, uv, metric, presence, right)
            region = replace(region, centre=uv.mean(0) + offset)
        t += step


def _changes(frames: np.ndarray) -> np.ndarray:
    """(h, w) float32, 1 where the picture changes over the video."""
    import cv2

    low, high = np.full(frames.shape[1:3], 255, np.uint8), np.zeros(frames.shape[1:3], np.uint8)
    for t in np.unique(np.linspace(0, len(frames) - 1, 24).round().astype(int)):
        grey = cv2.GaussianBlur(cv2.cvtColor(frames[t], cv2.COLOR_BGR2GRAY), (0, 0), 2.0)
        low, high = np.minimum(low, grey), np.maximum(high, grey)
    return (high.astype(np.float32) - low > FINE_CHANGE).astype(np.float32)


def _fine_regions(networks: _Networks, image: np.ndarray, changes: np.ndarray, margin: int,
                  short: int) -> list[tuple[float, _Region]]:  # fmt: skip
    """(presence, square) of the likeliest around places that change, the likeliest first."""
    summed = np.pad(changes, ((1, 0), (1, 0))).cumsum(0).cumsum(1)
    out = []
    for share in FINE_SIDES:
        side = share * short
        for x in np.arange(margin, image.shape[1] - margin + 1, side / 3):
            for y in np.arange(margin, image.shape[0] - margin + 1, side / 3):
                (a, b), (c, d) = (np.clip([v - side / 4, v + side / 4], 0, n).astype(int)
                                  for v, n in ((x, image.shape[1]), (y, image.shape[0])))  # fmt: skip
                changed = summed[d, b] - summed[d, a] - summed[c, b] + summed[c, a]
                if changed < FINE_SHARE * (side / 2) ** 2:
                    continue
                turned = [_Region(np.array([x, y]), side, 2 * np.pi * k / FINE_TURNS) for k in range(FINE_TURNS)]
                presence = [networks.landmarks(image, region)[0] for region in turned]
                best = int(np.argmax(presence))
                out.append((presence[best], turned[best]))
    likely = sorted(out, key=lambda x: -x[0])[:FINE_LIKELY]
    return sorted((_climb(networks, image, *x) for x in likely), key=lambda x: -x[0])


def _climb(networks: _Networks, image: np.ndarray, presence: float, region: _Region) -> tuple[float, _Region]:
    """The square shifted, turned and scaled by less than the grid's steps, as long as the network is surer."""
    for _ in range(3):
        step = region.side / 6
        near = [replace(region, centre=region.centre + step * np.array(d)) for d in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        near += [replace(region, angle=region.angle + turn) for turn in (-0.4, 0.4)]
        near += [replace(region, side=region.side * scale) for scale in (0.85, 1.18)]
        scores = [networks.landmarks(image, r)[0] for r in near]
        best = int(np.argmax(scores))
        if scores[best] <= presence + 0.01:
            break
        presence, region = scores[best], near[best]
    return presence, region


def _continues(k: _Tracklet, sure: _Tracklet) -> bool:
    """Does one stretch begin or end where and when the other ends or begins?"""
    for end, step in ((k.span[0], -1), (k.span[1], 1)):
        for t in (end + step, end + 2 * step, end + 3 * step):
            if t in sure.uv and np.linalg.norm(k.uv[end].mean(0) - sure.uv[t].mean(0)) < _size(sure.uv[t]):
                return True
    return False


def _find_tracklets(networks: _Networks, frames: Sequence[np.ndarray], progress: Callable[[float], None] | None,
                    every: int = DETECT_EVERY) -> list[_Tracklet]:  # fmt: skip
    squares = _squares(*frames[0].shape[:2])
    tracklets: list[_Tracklet] = []
    for t in range(0, len(frames), every):
        image = frames[t]
        seen: set[int] = set()
        # Whole frame always, tiles in turns: every place is looked at several times a second.
        turn = (t // every) % 2
        for square in squares[:1] + squares[1 + turn :: 2]:
            for _, box, points in networks.palms(image, square):
                known = [i for i, k in enumerate(tracklets) if t in k.uv and _explains(k.uv[t], points)]
                seen.update(known)
                if known:
                    continue
                presence, right, uv, metric = networks.landmarks(image, _region_from_palm(box, points))
                if presence >= KEEP_PRESENCE:
                    presence, right, uv, metric = networks.landmarks(image, _region_from_landmarks(uv))
                if presence < START_PRESENCE or not _plausible(uv, image.shape):
                    continue
                if any(t in k.uv and _same_place(uv, k.uv[t]) for k in tracklets):
                    continue
                new = _Tracklet({t: uv}, {t: metric}, {t: presence}, {t: right})
                _follow(networks, frames, new, t, 1, tracklets)
                _follow(networks, frames, new, t, -1, tracklets)
                tracklets.append(new)
                seen.add(len(tracklets) - 1)
        for i, k in enumerate(tracklets):
            if t in k.uv:
                k.looks += 1
                k.palms += i in seen
        if progress:
            progress((t + 1) / len(frames))
    return tracklets


def _grade(tracklet: _Tracklet, rate: float) -> int:
    """Persistence gate: 2 a hand, 1 only if it continues one, 0 none.

    A hand lasts, is confidently present, is found again by the palm network, and its landmarks move like one body.
    """
    if not _steady(tracklet, rate) or tracklet.palms < 2:
        return 0
    score = np.median(list(tracklet.score.values()))
    return 2 if score >= 0.8 and tracklet.palms >= 0.1 * tracklet.looks else int(score >= 0.65)


def _steady(tracklet: _Tracklet, rate: float) -> bool:
    """Does it last, and do its landmarks move like one body?"""
    if len(tracklet.uv) < max(4, MIN_SECONDS * rate):
        return False
    frames = sorted(tracklet.uv)
    uv = np.stack([tracklet.uv[t] for t in frames])
    size = np.median([_size(x) for x in uv])
    step = np.diff(uv, axis=0)[np.diff(frames) == 1]
    jitter = np.linalg.norm(step - np.median(step, axis=1, keepdims=True), axis=-1)
    return len(step) > 0 and bool(np.median(jitter) <= 0.12 * size)


def _select(tracklets: list[_Tracklet], rate: float) -> list[_Tracklet]:
    """Hands, and weaker stretches that directly continue one (a hand half out of the frame)."""
    grades = [_grade(k, rate) if k.uv else 0 for k in tracklets]
    out = [k for k, grade in zip(tracklets, grades, strict=True) if grade == 2]
    for k in (k for k, grade in zip(tracklets, grades, strict=True) if grade == 1):
        if any(_continues(k, sure) for sure in out):
            out.append(k)
    return out


def _link(tracklets: list[_Tracklet], video: Video, rate: float) -> list[HandTrack]:
    """Tracklets of one hand, one after the other, become one track."""
    chains: list[list[_Tracklet]] = []
    for k in sorted(tracklets, key=lambda k: k.span[0]):
        first = k.span[0]
        best, best_cost = None, 1.0
        for chain in chains:
            last = chain[-1].span[1]
            gap = first - last
            if gap <= 0 or gap > 1.5 * rate:
                continue
            a, b = chain[-1].uv[last], k.uv[first]
            reach = max(_size(a), _size(b)) * (1.0 + 4.0 * gap / rate)
            cost = float(np.linalg.norm(a.mean(0) - b.mean(0))) / reach
            if cost < best_cost and 0.5 < _size(a) / _size(b) < 2.0:
                best, best_cost = chain, cost
        if best is None:
            chains.append([k])
        else:
            best.append(k)
    chains.sort(key=lambda c: -sum(len(k.uv) for k in c))
    return [_as_track(chain, video) for chain in chains[:MAX_HANDS]]


def _as_track(chain: list[_Tracklet], video: Video) -> HandTrack:
    n = len(video)
    uv, metric = np.full((n, 21, 2), np.nan), np.full((n, 21, 3), np.nan)
    score, valid = np.zeros(n), np.zeros(n, bool)
    is_right = np.mean([v for k in chain for v in k.right.values()]) > 0.5
    for k in chain:
        # A stretch that looks like the other hand has its fingers mixed up: keep its place, trust it less.
        trust = 1.0 if (np.mean(list(k.right.values())) > 0.5) == is_right else 0.5
        for t in k.uv:
            uv[t], metric[t], score[t], valid[t] = video.to_full(k.uv[t]), k.metric[t], trust * k.score[t], True
    return HandTrack("right" if is_right else "left", uv, metric, score, valid)


def detect_hands(video: Video, progress: Callable[[float], None] | None = None) -> Hands:
    """Find the hands of a video.

    Args:
        video: working frames.
        progress: called with the fraction done.

    Returns:
        Up to three hands with landmarks in full px and metric landmarks, and the mask of hands and arms, those
        of which only a part is seen included. No hand at all gives an empty tuple and an empty mask.

    Raises:
        TaaError: the networks cannot be fetched (offline on first use).
    """
    networks = _Networks()
    rate = (len(video) - 1) / max(float(video.time[-1] - video.time[0]), 1e-6)
    tracklets = _select(_find_tracklets(networks, video.frames, progress), rate)
    tracks = tuple(_link(tracklets, video, rate))
    parts = _beyond_the_edge(networks, video, tracklets, rate)
    if not tracklets and not parts:
        parts = _without_palm(networks, video, rate)
    return Hands(tracks, hand_mask(video, tracks + tuple(_as_track([k], video) for k in parts)), INFO)

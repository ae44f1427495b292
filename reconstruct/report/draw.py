"""What was found, drawn into the video; the model turning; the preview picture."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from reconstruct.cues import Hands, LinkMasks, Tracks
from reconstruct.film import fit_height, rendered, video_view
from reconstruct.joint.models import JointFit
from reconstruct.video import Video

if TYPE_CHECKING:
    from taa_envs.asset import Asset

AXIS = (255, 59, 72)
LINK = (23, 190, 187)
HAND = (255, 170, 51)
OTHER = (170, 176, 190)
BONES = ((0, 1), (1, 2), (2, 3), (3, 4), (0, 5), (5, 6), (6, 7), (7, 8), (5, 9), (9, 10), (10, 11), (11, 12), (9, 13),
         (13, 14), (14, 15), (15, 16), (13, 17), (17, 18), (18, 19), (19, 20), (0, 17))  # fmt: skip
TRAIL = 8


def state_words(fit: JointFit, t: int) -> str:
    """The joint's state in frame t, for people."""
    if fit.q is None or fit.type is None:
        return ""
    if fit.type == "prismatic":
        return f"{round(1000 * float(fit.q[t]))} mm" if fit.metric else f"{fit.q[t]:.3f} units"
    return f"{round(float(np.degrees(fit.q[t])))} deg"


def overlay(video: Video, t: int, height: int, hands: Hands | None = None, tracks: Tracks | None = None,
            fit: JointFit | None = None, masks: LinkMasks | None = None) -> np.ndarray:  # fmt: skip
    """One frame with what was found in it.

    The moving link's outline and its consensus tracks (with a short trail) in teal, other tracks as
    grey dots, hands in orange, the joint's axis in red.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    import cv2

    image = fit_height(cv2.cvtColor(video.frames[t], cv2.COLOR_BGR2RGB), height)
    full = height / video.size[1]

    def place(uv: np.ndarray) -> np.ndarray:
        return (np.asarray(uv, float) + 0.5) * full - 0.5

    def line(a: np.ndarray, b: np.ndarray, colour: tuple[int, int, int], width: int = 1) -> None:
        if np.isfinite(a).all() and np.isfinite(b).all() and np.abs([a, b]).max() < 1e5:
            ends = [tuple(int(round(16 * v)) for v in p) for p in (a, b)]
            cv2.line(image, *ends, colour, width, cv2.LINE_AA, 4)

    if masks is not None and masks.moving[t].any():
        m = cv2.resize(masks.moving[t].astype(np.uint8), image.shape[1::-1], interpolation=cv2.INTER_NEAREST)
        tint = image[m > 0].astype(np.float32)
        image[m > 0] = (0.8 * tint + 0.2 * np.float32(LINK)).astype(np.uint8)
        contours, _ = cv2.findContours(m, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        cv2.drawContours(image, contours, -1, LINK, 1, cv2.LINE_AA)
    if tracks is not None:
        chosen = np.zeros(len(tracks.uv), bool)
        if fit is not None and fit.point_track is not None:
            chosen[np.asarray(fit.point_track, int)] = True
        seen = tracks.visible[:, t]
        for n in np.flatnonzero(seen & ~chosen)[::2]:
            u, v = place(tracks.uv[n, t])
            cv2.circle(image, (int(round(u)), int(round(v))), 1, OTHER, -1, cv2.LINE_AA)
        for n in np.flatnonzero(seen & chosen):
            past = place(tracks.uv[n, max(0, t - TRAIL) : t + 1])
            for a, b in zip(past, past[1:], strict=False):
                line(a, b, LINK)
            u, v = past[-1]
            cv2.circle(image, (int(round(u)), int(round(v))), 2, LINK, -1, cv2.LINE_AA)
    for hand in hands.tracks if hands is not None else ():
        if hand.valid[t]:
            uv = place(hand.uv[t])
            for a, b in BONES:
                line(uv[a], uv[b], HAND, 2)
            for u, v in uv:
                cv2.circle(image, (int(round(u)), int(round(v))), 2, (255, 255, 255), -1, cv2.LINE_AA)
    if fit is not None and fit.image_line is not None:
        _axis(image, place(np.asarray(fit.image_line)), fit.type or "", line)
    return image


def _axis(image: np.ndarray, ends: np.ndarray, kind: str, line) -> None:
    import cv2

    a, b = ends
    along = b - a
    length = float(np.linalg.norm(along))
    if not np.isfinite(length) or length < 1e-6:
        if np.isfinite(a).all():
            cv2.circle(image, tuple(int(round(v)) for v in a), 5, AXIS, 2, cv2.LINE_AA)
        return
    if kind == "prismatic":
        tip = tuple(int(round(v)) for v in b)
        cv2.arrowedLine(image, tuple(int(round(v)) for v in a), tip, AXIS, 2, cv2.LINE_AA, tipLength=0.25)
        return
    reach = 0.35 * along
    line(a - reach, b + reach, AXIS, 1)
    line(a, b, AXIS, 3)
    for p in ends:
        cv2.circle(image, tuple(int(round(v)) for v in p), 4, AXIS, -1, cv2.LINE_AA)


def overlay_frames(video: Video, height: int, hands: Hands | None, tracks: Tracks | None, fit: JointFit | None,
                   masks: LinkMasks | None) -> Iterator[np.ndarray]:  # fmt: skip
    """Every frame with what was found in it, RGB."""
    from reconstruct.film import label

    for t in range(len(video)):
        words = f"{video.time[t]:.2f} s"
        if fit is not None and fit.q is not None and fit.verdict != "refused":
            words += f"   joint {state_words(fit, t)}"
        yield label(overlay(video, t, height, hands, tracks, fit, masks), words)


def preview(
    video: Video,
    asset: Asset,
    fit: JointFit,
    hands: Hands,
    tracks: Tracks,
    masks: LinkMasks,
    height: int = 360,
) -> np.ndarray:
    """The frame of the largest motion with what was found, beside the model in that state, RGB."""
    t = int(np.argmax(np.abs(np.asarray(fit.q))))
    left = overlay(video, t, height, hands, tracks, fit, masks)
    camera, size = video_view(asset, height)
    right = next(rendered(asset, [np.array([fit.q[t]])], None, camera, size))
    return np.hstack([left, right])

"""The mask of hands and arms, on drawn clips: what is skin, sleeve or neither is known."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from reconstruct.cues import HandTrack
from reconstruct.providers.skin import FINGERS, PALM, hand_mask
from reconstruct.video import Video

W, H, T = 480, 360, 24
SKIN, SLEEVE, WALL, WOOD = (120, 150, 205), (90, 50, 30), (190, 205, 210), (118, 152, 200)  # BGR
# A hand whose fingers point up, px about its wrist.
HAND = np.array([
    [0, 0], [-28, -18], [-46, -38], [-58, -54], [-68, -68], [-22, -68], [-26, -96], [-28, -114], [-30, -130],
    [-4, -72], [-5, -104], [-6, -124], [-6, -142], [14, -68], [16, -98], [18, -116], [19, -132],
    [30, -58], [36, -80], [40, -94], [43, -106],
], float)  # fmt: skip


def clip(arm=None, wall=WALL, step=0.5, landmarks=T, tip=False):
    """The video, its hand's track, and where hand and arm are (T, H, W): a wrist that moves by ``step`` px a frame.

    Args:
        arm: BGR from a little behind the wrist to the picture's lower rim, no arm at all when None.
        landmarks: frames in which the hand is detected.
        tip: the wrist is at the lower rim, and one more finger comes in over it beside.
    """
    rng = np.random.default_rng(3)
    grain = cv2.GaussianBlur(rng.normal(scale=14.0, size=(H, W, 3)), (0, 0), 3.0)
    frames, truth = np.zeros((T, H, W, 3), np.uint8), np.zeros((T, H, W), bool)
    uv = np.zeros((T, 21, 2))
    for t in range(T):
        uv[t] = HAND + [250 + step * t, 320 if tip else 230]
        image, mask = np.full((H, W, 3), wall, float) + grain, np.zeros((H, W), np.uint8)
        points = np.round(uv[t]).astype(np.int32)

        def paint(draw, colour, image=image, mask=mask):
            one = np.zeros((H, W), np.uint8)
            draw(one)
            image[one > 0] = colour
            mask |= one

        wrist, side = points[0], np.array([24, 0])
        bare, rim = [0, 40], [15, H - points[0, 1] + 5]
        if arm is not None:
            cuff = np.array([wrist - side + bare, wrist + side + bare, wrist + side + rim, wrist - side + rim])
            paint(lambda m, c=cuff: cv2.fillConvexPoly(m, c.astype(np.int32), 1), arm)
            forearm = np.array([wrist - side, wrist + side, wrist + side + bare, wrist - side + bare])
            paint(lambda m, c=forearm: cv2.fillConvexPoly(m, c.astype(np.int32), 1), SKIN)
        paint(lambda m, p=points: cv2.fillConvexPoly(m, cv2.convexHull(p[list(PALM)]), 1), SKIN)
        for finger in FINGERS:
            paint(lambda m, p=points, f=finger: cv2.polylines(m, [p[list(f)]], False, 1, 16), SKIN)
        if tip:
            paint(lambda m, x=int(185 + step * t): cv2.circle(m, (x, H), 18, 1, -1), SKIN)
        frames[t] = np.clip(image + rng.normal(scale=2.0, size=image.shape), 0, 255)
        truth[t] = mask > 0
    video = Video(Path("drawn.mp4"), "0" * 64, (W, H), np.arange(T) / 24, np.arange(T), T, frames, 1.0)
    valid = np.arange(T) < landmarks
    uv[~valid] = np.nan
    track = HandTrack("right", uv, np.zeros((T, 21, 3)), np.where(valid, 0.95, 0.0), valid)
    return video, track, truth


def missed_and_extra(video, track, truth):
    """Shares of what is hand or arm, of all frames; what is within 12 px of either is no mistake."""
    mask = hand_mask(video, (track,))
    near = np.stack([cv2.dilate(m.astype(np.uint8), np.ones((25, 25), np.uint8)) > 0 for m in truth])
    return (truth & ~mask).sum() / truth.sum(), (mask & ~near).sum() / truth.sum()


def test_a_sleeve_is_told_though_what_is_behind_it_is_never_seen():
    missed, extra = missed_and_extra(*clip(arm=SLEEVE))
    assert missed < 0.02 and extra < 0.02


def test_no_sleeve_is_found_where_the_arm_is_bare():
    missed, extra = missed_and_extra(*clip(arm=SKIN))
    assert missed < 0.02 and extra < 0.02


def test_a_wall_behind_the_wrist_is_no_sleeve():
    """A hand without an arm, as one that is cut out: what is behind it has the colours of all the rest."""
    missed, extra = missed_and_extra(*clip(arm=None))
    assert missed < 0.02 and extra < 0.02


def test_a_finger_that_comes_in_over_the_rim_is_the_hands():
    video, track, truth = clip(arm=SKIN, tip=True)
    missed, extra = missed_and_extra(video, track, truth)
    assert missed < 0.02 and extra < 0.02
    # Not in a world of that colour, where a patch at the rim may be anything.
    video, track, truth = clip(arm=SKIN, wall=WOOD)
    rim = hand_mask(video, (track,))[:, -8:, 100:210]
    assert rim.mean() < 0.05


@pytest.mark.parametrize("step", [0.0, 0.5])
def test_a_hand_that_is_lost_while_it_rests_is_carried_on_by_its_colour(step):
    missed, extra = missed_and_extra(*clip(arm=SKIN, landmarks=T // 2, step=step))
    assert missed < 0.05 and extra < 0.02

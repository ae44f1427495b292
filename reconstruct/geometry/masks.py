"""The moving link's silhouette in every frame."""

from __future__ import annotations

import numpy as np

from reconstruct.cues import Hands, LinkMasks, Tracks
from reconstruct.geometry.layers import (
    Evidence,
    background_residual,
    contradicted,
    fill,
    frame_costs,
    gather,
    level_exposure,
    make_window,
    seed_polygon,
    spread_frames,
    to_lab,
    warp_to_image,
)
from reconstruct.geometry.plane import LinkPlane, apply_homography, fit_plane, homography, keep_points, working_matrix
from reconstruct.joint.models import JointFit
from reconstruct.video import Video

KEY_FRAMES = 16
"""Frames whose silhouette is cut at pixel level; the others take the nearest one's, moved with the joint."""
SHADED = 0.7
"""Share of the frames; a point is no link if the background or a shadow on it explains its looks in more."""


def segment_links(video: Video, hands: Hands, tracks: Tracks, fit: JointFit) -> LinkMasks:
    """Silhouettes of the moving link, and what of the static scene can be seen.

    The outline in the link's own plane comes from :func:`reconstruct.geometry.layers.gather`. In each key
    frame GrabCut turns it into pixels: seeds are the outline's inside and the projected track points;
    background is what looks as it does when the link is elsewhere; a rim that does not look so may be
    link (its thickness, what sticks out of the plane). Hand pixels are left out of both.

    Args:
        video: stabilised, static camera.
        hands: hand pixels.
        tracks: all tracks.
        fit: the joint with its points and q.

    Returns:
        Masks at working size. ``confidence`` is the agreement (intersection over union) of the pixels cut
        in the nearest key frame with the outline projected from the evidence of all frames.
    """
    import cv2

    T, h, w = video.frames.shape[:3]
    plane = fit_plane(tracks, fit)
    costs = frame_costs(video, tracks, fit, hands.mask)
    evidence = gather(video, hands, tracks, fit, plane, costs)
    stray = contradicted(evidence, fit, plane)
    if stray.sum() <= 0.05 * len(stray):
        stray[:] = False
    # What is seen about a point is nearly always the background or a shadow on it: it moved as the link does, with the
    # shadow's edge.
    stray |= evidence.shaded > SHADED
    if 0 < stray.sum() <= len(stray) - max(5, 0.3 * len(stray)):
        fit, plane = keep_points(fit, plane, ~stray)
        evidence = gather(video, hands, tracks, fit, plane, costs)
    keys = spread_frames(fit, costs, KEY_FRAMES)
    cut, agreement = _cut_keys(video, hands, fit, plane, evidence, keys)

    S = working_matrix(video)
    to_full = np.linalg.inv(S)
    H = homography(fit, plane, fit.q)
    moving = np.zeros((T, h, w), bool)
    confidence = np.zeros(T)
    q_span = max(float(np.ptp(fit.q)), 1e-12)
    side = np.sign(plane.facing)
    sized = dict(zip((int(k) for k in keys), cut, strict=True))
    for t in range(T):
        # A key that shows the other side of the link is a poor model of this frame even if q is near.
        cost = np.abs(fit.q[keys] - fit.q[t]) / q_span + 0.5 * (side[keys] != side[t])
        n = int(np.argmin(cost))
        k = int(keys[n])
        moved = S @ H[t] @ np.linalg.inv(H[k]) @ to_full
        shift = _largest_shift(moved, sized[k])
        if shift < 0.7:
            mask = sized[k].copy()
        else:
            mask = cv2.warpPerspective(sized[k].astype(np.uint8) * 255, moved / moved[2, 2], (w, h),
                                       flags=cv2.INTER_LINEAR) > 127
        moving[t] = mask & ~hands.mask[t]
        confidence[t] = agreement[n] * float(np.exp(-((cost[n] / 0.15) ** 2)))
    static = ~moving & ~hands.mask
    return LinkMasks(moving, static, hands.mask.copy(), confidence)


def points_on_mask(video: Video, tracks: Tracks, fit: JointFit, masks: LinkMasks) -> np.ndarray:
    """(M,) bool: points whose tracks lie on (or within a hundredth of the diagonal of) the moving silhouette in at
    least half of the frames that show them; all, if fewer than five do."""
    import cv2

    idx = np.asarray(fit.point_track, int)
    T, h, w = masks.moving.shape
    hit, count = np.zeros(len(idx)), np.zeros(len(idx))
    kernel = _disc(max(2, int(0.01 * np.hypot(h, w))))
    for t in range(0, T, max(1, T // 40)):
        uv = video.to_work(tracks.uv[idx, t])
        px = np.nan_to_num(uv, nan=-9.0).round().astype(int)
        ok = tracks.visible[idx, t] & (px >= 0).all(1) & (px[:, 0] < w) & (px[:, 1] < h)
        px = px.clip(0, [w - 1, h - 1])
        ok &= ~masks.hand[t][px[:, 1], px[:, 0]]
        near = cv2.dilate(masks.moving[t].astype(np.uint8), kernel)[px[:, 1], px[:, 0]] > 0
        hit += ok & near
        count += ok
    good = hit >= 0.5 * count
    return good if good.sum() >= 5 else np.ones(len(idx), bool)


def _largest_shift(M: np.ndarray, mask: np.ndarray) -> float:
    """How far, px, the homography moves the corners of a mask's bounding box."""
    rows, cols = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return 0.0
    box = np.array([[c, r, 1.0] for c in (cols[0], cols[-1]) for r in (rows[0], rows[-1])])
    x = box @ M.T
    return float(np.abs(x[:, :2] / x[:, 2:] - box[:, :2]).max())


def _cut_keys(video: Video, hands: Hands, fit: JointFit, plane: LinkPlane, evidence: Evidence, keys: np.ndarray
              ) -> tuple[list[np.ndarray], np.ndarray]:
    """GrabCut in the key frames: masks at working size and their agreement with the projected outline."""
    import cv2

    window = make_window(video, fit, plane, 400)
    size, S = window.size, window.matrix(video)
    small = [window.crop(video.frames[t]) for t in keys]
    hand = np.stack([window.crop(hands.mask[t]) for t in keys])
    outline = np.stack([warp_to_image(evidence.chart, evidence.occupied, S @ h_t, size)
                        for h_t in homography(fit, plane, fit.q[keys])])
    reach = max(3, int(0.12 * np.sqrt(max(outline.sum((1, 2)).max(), 1))))
    wide = np.stack([cv2.dilate(m.astype(np.uint8), _disc(reach)) > 0 for m in outline])
    images = level_exposure(np.stack([to_lab(f) for f in small]), wide | hand)
    # Frames of the cut and of the evidence share the noise level; the residual decides "changed" against it.
    seed = fill(evidence.chart, seed_polygon(fit, plane))
    among = np.stack([warp_to_image(evidence.chart, seed, S @ h_t, size)
                      for h_t in homography(fit, plane, fit.q[keys])])
    change = background_residual(images, wide | hand, among)
    quiet = change[(change >= 0) & ~wide & ~hand]
    noise = float(np.clip(np.quantile(quiet, 0.9), 4.0, 14.0)) if len(quiet) else 8.0
    points = (fit.link_pose(fit.q[keys])[:, None, :3, :3] @ fit.points[plane.inlier][None, :, :, None])[..., 0]
    points = points + fit.link_pose(fit.q[keys])[:, None, :3, 3]
    masks, agreement = [], np.zeros(len(keys))
    for n in range(len(keys)):
        seeds = np.zeros(outline[n].shape, np.uint8)
        uv = apply_homography(S, fit.project(points[n]))
        for u, v in uv[np.isfinite(uv).all(-1)]:
            cv2.circle(seeds, (int(np.clip(u, -10, 9999)), int(np.clip(v, -10, 9999))), 1, 1, -1)
        drawn = outline[n] & ~hand[n]
        mask = _cut(small[n], outline[n], wide[n], hand[n], change[n], noise, seeds > 0, max(2, reach // 2))
        both = (mask & outline[n] & ~hand[n]).sum()
        either = ((mask | outline[n]) & ~hand[n]).sum()
        # Where no cut was possible the outline agrees with itself: that is no evidence.
        agreement[n] = both / max(either, 1) if (mask != drawn).any() else 0.2
        # What the hand hides here may show where this mask is carried to: the outline knows it from other frames.
        whole = mask | (outline[n] & cv2.dilate(hand[n].astype(np.uint8), _disc(2)).astype(bool))
        masks.append(window.paste(whole, video.frames.shape[1:3]))
    return masks, agreement


def _disc(radius: int) -> np.ndarray:
    import cv2

    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def _cut(image: np.ndarray, outline: np.ndarray, wide: np.ndarray, hand: np.ndarray, change: np.ndarray,
         noise: float, seeds: np.ndarray, core: int) -> np.ndarray:
    """One frame's silhouette; the projected outline itself where a cut is not possible or runs away."""
    import cv2

    inner = cv2.erode(outline.astype(np.uint8), _disc(core)) > 0
    known = change >= 0
    still = known & (change < noise)
    trimap = np.full(outline.shape, cv2.GC_BGD, np.uint8)
    trimap[wide] = cv2.GC_PR_BGD
    trimap[wide & known & (change > 2.5 * noise)] = cv2.GC_PR_FGD
    trimap[outline] = cv2.GC_PR_FGD
    trimap[wide & still & ~outline] = cv2.GC_BGD
    trimap[(inner & ~still) | (seeds & outline)] = cv2.GC_FGD
    trimap[hand] = cv2.GC_BGD
    box = np.argwhere(wide)
    if len(box) < 20 or not (trimap == cv2.GC_FGD).any() or not (trimap[wide] == cv2.GC_BGD).any():
        return outline & ~hand
    (r0, c0), (r1, c1) = np.maximum(box.min(0) - 15, 0), box.max(0) + 16
    part = trimap[r0:r1, c0:c1].copy()
    cv2.setRNGSeed(0)
    try:
        cv2.grabCut(image[r0:r1, c0:c1].copy(), part, None, np.zeros((1, 65)), np.zeros((1, 65)), 4,
                    cv2.GC_INIT_WITH_MASK)
    except cv2.error:
        return outline & ~hand
    mask = np.zeros(outline.shape, np.uint8)
    mask[r0:r1, c0:c1] = (part == cv2.GC_FGD) | (part == cv2.GC_PR_FGD)
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, labels = cv2.connectedComponents(mask)
    touch = np.unique(labels[inner & (mask > 0)])
    mask = np.isin(labels, touch[touch > 0])
    overlap = (mask & outline & ~hand).sum() / max(((mask | outline) & ~hand).sum(), 1)
    return mask if overlap > 0.55 else outline & ~hand

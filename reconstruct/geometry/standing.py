"""What stands still: the picture without the link and hands, and which of its pixels belong to the static link."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from reconstruct.cues import LinkMasks
from reconstruct.geometry.layers import Window
from reconstruct.joint.models import JointFit
from reconstruct.video import Video

if TYPE_CHECKING:
    from manifold3d import Manifold

LONG_SIDE = 320


@dataclass(frozen=True)
class Plate:
    """The scene without what moves, shrunk.

    Attributes:
        image: (h, w, 3) uint8 BGR, the median of the frames that show a pixel free.
        known: (h, w) bool, pixels that enough frames show free.
        S: (3, 3) full px -> px of the plate.
    """

    image: np.ndarray
    known: np.ndarray
    S: np.ndarray

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) px."""
        return self.image.shape[1], self.image.shape[0]


def make_plate(video: Video, masks: LinkMasks, frames: np.ndarray) -> Plate:
    """The scene without link and hands, from frames spread over q. Shadows that pass are voted out too."""
    import cv2

    h, w = video.frames.shape[1:3]
    s = min(1.0, LONG_SIDE / max(h, w))
    window = Window(np.zeros(2, int), np.array([w, h]), (int(round(s * w)), int(round(s * h))))
    images = np.stack([window.crop(video.frames[t]) for t in frames]).astype(np.float32)
    kernel = np.ones((5, 5), np.uint8)
    covered = np.stack([cv2.dilate(window.crop(masks.moving[t] | masks.hand[t]).astype(np.uint8), kernel) > 0
                        for t in frames])
    count = (~covered).sum(0)
    # A sort puts NaN last: the middle one of those that are numbers.
    images[covered] = np.nan
    images.sort(axis=0)
    middle = np.maximum(count - 1, 0) // 2
    image = np.take_along_axis(images, np.broadcast_to(middle[None, ..., None], (1, *images.shape[1:])), 0)[0]
    known = count >= max(2, len(frames) // 8)
    return Plate(np.nan_to_num(image).astype(np.uint8), known, window.matrix(video))


def project(plate: Plate, fit: JointFit, points: np.ndarray) -> np.ndarray:
    """(n, 3) world -> (n, 2) px of the plate."""
    uv = fit.project(points)
    return (np.concatenate([uv, np.ones((len(uv), 1))], 1) @ plate.S.T)[:, :2]


def fill_hull(plate: Plate, uv: np.ndarray) -> np.ndarray:
    """(h, w) bool, convex hull of pixels."""
    import cv2

    out = np.zeros(plate.image.shape[:2], np.uint8)
    cv2.fillConvexPoly(out, cv2.convexHull(np.round(uv.clip(-9999, 9999)).astype(np.int32)), 1)
    return out > 0


def separate(plate: Plate, region: np.ndarray) -> tuple[np.ndarray, float]:
    """What within ``region`` differs from what surrounds it.

    GrabCut with the surroundings as background: a table or a wall goes on outside the region, a body does not.

    Args:
        region: (h, w) bool, where the body is expected.

    Returns:
        (h, w) bool, and its contrast, [0, 1]: one minus the overlap of the two sides' colours; 0 if nothing was found.
    """
    import cv2

    nothing = np.zeros(region.shape, bool)
    area = float(region.sum())
    if area < 60:
        return nothing, 0.0
    radius = max(3, int(0.35 * np.sqrt(area)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    around = cv2.dilate(region.astype(np.uint8), disc) > 0
    trimap = np.full(region.shape, cv2.GC_BGD, np.uint8)
    trimap[region & plate.known] = cv2.GC_PR_FGD
    use = around & (plate.known | ~region)
    box = np.argwhere(around)
    (r0, c0), (r1, c1) = box.min(0), box.max(0) + 1
    # Background pixels outside the surroundings would teach colours that are not there: leave them out by filling.
    image = plate.image.copy()
    outside = ~use & (trimap == cv2.GC_BGD)
    ring = use & ~region & plate.known
    if ring.sum() < 30 or not (trimap == cv2.GC_PR_FGD).any():
        return nothing, 0.0
    image[outside] = np.median(image[ring], axis=0).astype(np.uint8)
    part = trimap[r0:r1, c0:c1].copy()
    cv2.setRNGSeed(0)
    try:
        cv2.grabCut(np.ascontiguousarray(image[r0:r1, c0:c1]), part, None, np.zeros((1, 65)), np.zeros((1, 65)), 5,
                    cv2.GC_INIT_WITH_MASK)
    except cv2.error:
        return nothing, 0.0
    found = np.zeros(region.shape, np.uint8)
    found[r0:r1, c0:c1] = part == cv2.GC_PR_FGD
    found = cv2.morphologyEx(found, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
    if not found.any():
        return nothing, 0.0
    common = float(np.minimum(_histogram(plate.image[found]), _histogram(plate.image[ring])).sum())
    return found, 1 - common


def shown_through(fit: JointFit, masks: LinkMasks, video: Video, surface: np.ndarray, box: np.ndarray,
                  frames: np.ndarray) -> float:
    """Share of the link's seen surface that a convex block would hide from the camera: it cannot stand there.

    Args:
        surface: (n, 3) points of the moving link, world at q = 0.
        box: (m, 3) corners of the block, world.
    """
    from scipy.spatial import ConvexHull

    eq = ConvexHull(box).equations
    camera = -fit.T_camera_world[:3, :3].T @ fit.T_camera_world[:3, 3]
    h, w = masks.moving.shape[1:]
    hidden = seen = 0
    for t in frames:
        T = fit.link_pose(float(fit.q[t]))
        x = surface @ T[:3, :3].T + T[:3, 3]
        px = np.nan_to_num(video.to_work(fit.project(x)), nan=-9).round().clip(-9, 99999).astype(int)
        ok = (px >= 0).all(1) & (px[:, 0] < w) & (px[:, 1] < h)
        ok[ok] = masks.moving[t][px[ok, 1], px[ok, 0]]
        # The stretch of each ray, 0 at the camera and 1 at the point, that lies within all planes of the block.
        start = camera @ eq[:, :3].T + eq[:, 3]
        slope = x[ok] @ eq[:, :3].T + eq[:, 3] - start
        with np.errstate(divide="ignore", invalid="ignore"):
            at = -start / slope
        enter = np.where(slope < 0, at, np.where(start > 0, np.where(slope > 0, -np.inf, np.inf), -np.inf)).max(1)
        leave = np.where(slope > 0, at, np.inf).min(1)
        hidden += int(((enter < leave) & (enter < 0.999) & (leave > 0)).sum())
        seen += int(ok.sum())
    return hidden / max(seen, 1)


def cone(plate: Plate, fit: JointFit, region: np.ndarray, near: float, far: float) -> Manifold | None:
    """Everything that the camera sees within the convex hull of a region, between two depths, as a solid."""
    import cv2
    from manifold3d import CrossSection, Manifold

    contours, _ = cv2.findContours(region.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not contours:
        return None
    ring = cv2.approxPolyDP(cv2.convexHull(np.concatenate(contours)), 1.0, True)[:, 0].astype(float)
    if len(ring) < 3:
        return None
    full = (np.concatenate([ring, np.ones((len(ring), 1))], 1) @ np.linalg.inv(plate.S).T)[:, :2]
    flat = (np.concatenate([full, np.ones((len(full), 1))], 1) @ np.linalg.inv(fit.K).T)[:, :2] * near
    section = CrossSection([flat]).hull()
    solid = Manifold.extrude(section, far - near, scale_top=(far / near, far / near)).translate([0.0, 0.0, near])
    return solid.transform(np.linalg.inv(fit.T_camera_world)[:3])


def _histogram(bgr: np.ndarray) -> np.ndarray:
    """Normalised, blurred Lab histogram of (n, 3) pixels."""
    import cv2
    from scipy.ndimage import gaussian_filter

    lab = cv2.cvtColor(bgr[None], cv2.COLOR_BGR2LAB)[0].astype(float)
    count, _ = np.histogramdd(lab, bins=(12, 16, 16), range=((0, 256), (64, 192), (64, 192)))
    count = gaussian_filter(count, 0.7)
    return count / max(count.sum(), 1e-12)

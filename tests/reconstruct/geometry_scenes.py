"""A small drawn scene with a hinged or sliding slab, its exact joint, and true masks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from reconstruct.cues import Hands, HandTrack, ProviderInfo, Tracks
from reconstruct.joint.models import JointFit
from reconstruct.video import Video

INFO = ProviderInfo("drawn", "0", "none")
WIDTH, HEIGHT, FRAMES = 320, 240, 30


@dataclass(frozen=True)
class Scene:
    """Everything a geometry stage takes, and the truth: masks (T, h, w) and the slab's corners (low, high)."""

    video: Video
    hands: Hands
    tracks: Tracks
    fit: JointFit
    masks: np.ndarray
    low: np.ndarray
    high: np.ndarray


def _texture(rng: np.random.Generator, base: tuple[int, int, int], size: int = 128, contrast: float = 35):
    image = sum(cv2.resize(rng.normal(size=(s, s, 3)), (size, size), interpolation=cv2.INTER_CUBIC)
                for s in (6, 16, 40))
    return np.clip(image * contrast / 1.7 + np.array(base), 0, 255).astype(np.uint8)


BAR = np.array([[0.08, -0.06, 0.08], [0.11, -0.05, 0.24]])
"""Low and high corner of the bar that may stand before the slab's face, its posts left out."""


def _faces(low: np.ndarray, high: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Corners (4, 3) and outward normal (3,) of a box's sides."""
    faces = []
    for a in range(3):
        b, c = [k for k in range(3) if k != a]
        for side, level in ((-1.0, low[a]), (1.0, high[a])):
            corners = np.empty((4, 3))
            corners[:, a] = level
            corners[:, b] = [low[b], high[b], high[b], low[b]]
            corners[:, c] = [low[c], low[c], high[c], high[c]]
            normal = np.zeros(3)
            normal[a] = side
            faces.append((corners, normal))
    return faces


def make_scene(kind: str = "revolute", unit: float = 1.0, seed: int = 0, hand: bool = True, bar: bool = False,
               shadow: bool = False, plain: bool = False) -> Scene:  # fmt: skip
    """A slab 0.4 x 0.02 x 0.3 (times ``unit``) that turns about its left edge or slides sideways.

    A pale disc, the hand, rides on the free edge and is in ``hands``.  bar: a dark :data:`BAR` stands before its face.
    shadow: the background below it is dark where the slab's plane goes on, and the last 12 points follow
    that shadow's corners.  plain: it has one colour all over.
    """
    rng = np.random.default_rng(seed)
    low, high = np.array([0.0, -0.01, 0.0]) * unit, np.array([0.4, 0.01, 0.3]) * unit
    eye, look = np.array([0.35, -1.1, 0.55]) * unit, np.array([0.15, 0.0, 0.12]) * unit
    forward = (look - eye) / np.linalg.norm(look - eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    T_cw = np.eye(4)
    T_cw[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    T_cw[:3, 3] = -T_cw[:3, :3] @ eye
    K = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])
    s = np.clip((np.arange(FRAMES) - 2) / (FRAMES - 6), 0, 1)
    if kind == "revolute":
        axis, point, q = np.array([0, 0, 1.0]), np.array([0.0, 0.01, 0.0]) * unit, -1.2 * s
    else:
        axis, point, q = np.array([1.0, 0, 0]), None, 0.25 * s * unit
    fit = JointFit("ok", "", kind, {kind: 1.0}, axis, point, q=q, frames=np.arange(FRAMES), K=K, T_camera_world=T_cw,
                   metric=unit == 1.0, residual_px=0.5, moving_frames=np.abs(np.gradient(q)) > 0)
    back = cv2.resize(_texture(rng, (120, 110, 90)), (WIDTH, HEIGHT))
    even = np.full((128, 128, 3), (70, 130, 190), np.uint8)
    skins = [even if plain else _texture(rng, (70, 130, 190)) for _ in range(6)]
    faces = _faces(low, high)
    if bar:
        faces += _faces(*(BAR * unit))
        skins += [np.full((128, 128, 3), 40, np.uint8)] * 6
    dark = np.array([[0.02, 0, -0.12], [0.36, 0, -0.12], [0.36, 0, 0.0], [0.02, 0, 0.0]]) * unit
    frames, masks, hand_masks, tips = [], [], [], []
    for t in range(FRAMES):
        T = fit.link_pose(q[t])
        image, mask = back.copy(), np.zeros((HEIGHT, WIDTH), np.uint8)
        if shadow:
            shape = np.zeros_like(mask)
            cv2.fillConvexPoly(shape, np.round(fit.project(dark @ T[:3, :3].T + T[:3, 3])).astype(np.int32), 1)
            image[shape > 0] = (0.6 * image[shape > 0]).astype(np.uint8)
        for (corners, normal), skin in zip(faces, skins, strict=True):
            x = corners @ T[:3, :3].T + T[:3, 3]
            if (T[:3, :3] @ normal) @ (eye - x.mean(0)) <= 0:
                continue
            uv = fit.project(x).astype(np.float32)
            M = cv2.getPerspectiveTransform(np.array([[0, 0], [127, 0], [127, 127], [0, 127]], np.float32), uv)
            shape = np.zeros_like(mask)
            cv2.fillConvexPoly(shape, np.round(uv * 16).astype(np.int32), 1, shift=4)
            drawn = cv2.warpPerspective(skin, M, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE)
            image[shape > 0] = drawn[shape > 0]
            mask |= shape
        tip = fit.project(np.array([0.39, -0.01, 0.2]) * unit @ T[:3, :3].T + T[:3, 3])
        hm = np.zeros_like(mask)
        if hand:
            cv2.circle(hm, tuple(int(v) for v in np.round(tip + [8, 0])), 13, 1, -1)
        image[hm > 0] = (150, 170, 220)
        mask[hm > 0] = 0
        noisy = image + rng.normal(size=image.shape) * 2
        frames.append(np.clip(noisy, 0, 255).astype(np.uint8))
        masks.append(mask > 0)
        hand_masks.append(hm > 0)
        tips.append(tip)
    # Points on the front face, with noise along the rays as a fit has, and a few that are wrong.
    n = 60
    points = low + rng.random((n, 3)) * (high - low) * [0.8, 0, 0.9]
    if bar:
        points = np.concatenate([points, (BAR[0] + rng.random((12, 3)) * (BAR[1] - BAR[0]) * [1, 0, 1]) * unit])
    if shadow:
        points = np.concatenate([points, np.tile(dark[[0, 1]], (6, 1)) + rng.normal(size=(12, 3)) * 0.002 * unit])
    n = len(points)
    poses = fit.link_pose(q)
    moved = np.einsum("tij,nj->nti", poses[:, :3, :3], points) + poses[None, :, :3, 3]
    uv = fit.project(moved) + rng.normal(size=(n, FRAMES, 2)) * 0.3
    far = np.where((rng.random(n) < 0.06) & (np.arange(n) < 60), 0.15, 0.004)
    noisy_points = eye + (points - eye) * (1 + rng.normal(size=n) * far)[:, None]
    fit = replace(fit, points=noisy_points, point_track=np.arange(n), inliers=n, tracks=n,
                  std={"axis_deg": 0.5, "point_m": 0.002 * unit, "q": np.full(FRAMES, 0.005)})
    tracks = Tracks(uv, np.ones((n, FRAMES), bool), np.zeros(n, int), INFO)
    landmarks = np.repeat(np.array(tips)[:, None], 21, 1) + rng.normal(size=(1, 21, 2)) * 2
    one = HandTrack("right", landmarks, np.zeros((FRAMES, 21, 3)), np.ones(FRAMES), np.ones(FRAMES, bool))
    hands = Hands((one,) if hand else (), np.stack(hand_masks), INFO)
    video = Video(Path("drawn"), "0" * 64, (WIDTH, HEIGHT), np.arange(FRAMES) / 30, np.arange(FRAMES), FRAMES,
                  np.stack(frames), 1.0)
    return Scene(video, hands, tracks, fit, np.stack(masks), low, high)

"""Point tracks by CoTracker3's offline model, through occlusion.

Written for ``cotracker.predictor.CoTrackerPredictor`` as its repository documents it: video (1, T, 3, H, W) in
[0, 255], queries (1, N, 3) of (frame, x, y), out come tracks (1, T, N, 2) in the picture's pixels and visibility
(1, T, N). The seeds are the corners that the embedded tracker would take, in several reference frames.

Source: Karaev et al., CoTracker3, 2024.
"""

from __future__ import annotations

import numpy as np

from reconstruct.errors import TaaError
from reconstruct.providers.hub import device_of, model_of, rgb, version_of
from reconstruct.providers.make import Made, Request

REFERENCES = 8
SEEDS = 200
QUERIES = 800
"""Queries a run; halved where memory does not suffice."""


def tracks(request: Request) -> Made:
    """``tracks.npz``."""
    import torch
    from cotracker.predictor import CoTrackerPredictor

    section = request.settings.section("cotracker3")
    model = model_of("cotracker3", "track", section)
    device = device_of(section)
    try:
        network = CoTrackerPredictor(checkpoint=model, offline=True).to(device)
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise TaaError(f"cannot load {model} as CoTracker3 ({str(error)[:160]}); set model of [cotracker3] in taa.toml "
                       "to scaled_offline.pth") from error  # fmt: skip
    video = request.video
    queries = seeds(request)
    if not len(queries):
        raise TaaError("nothing changes in this video, so there is nothing to track; film a part that moves")
    frames = torch.from_numpy(rgb(video, range(len(video))).transpose(0, 3, 1, 2)[None].astype(np.float32)).to(device)
    size, done, uv, visible = QUERIES, 0, [], []
    while done < len(queries):
        some = queries[done : done + size]
        try:
            with torch.inference_mode():
                where, seen = network(frames, queries=torch.from_numpy(some)[None].to(device), backward_tracking=True)
        except torch.cuda.OutOfMemoryError:
            if size <= 50:
                words = "the video does not fit into the GPU's memory; shorten it, or choose --track lk"
                raise TaaError(words) from None
            torch.cuda.empty_cache()
            size //= 2
            continue
        where, seen = where[0].float().cpu().numpy(), seen[0].cpu().numpy()
        if where.shape != (len(video), len(some), 2) or seen.shape != where.shape[:2]:
            raise TaaError(f"cotracker gave tracks of shape {where.shape} for {len(some)} queries; its version is not "
                           "supported")  # fmt: skip
        uv.append(where.transpose(1, 0, 2))
        visible.append((seen > 0.5).T)
        done += len(some)
        request.tell(done / len(queries))
    where, seen = np.concatenate(uv), np.concatenate(visible)
    h, w = video.frames.shape[1:3]
    seen &= np.isfinite(where).all(-1) & (where >= 0).all(-1) & (where <= (w - 1, h - 1)).all(-1)
    if request.hands is not None:
        seen &= ~_under(request.hands.mask, where)
    arrays = {"uv": video.to_full(np.where(seen[..., None], where, np.nan)).astype(np.float32), "visible": seen}
    return Made({"tracks": arrays}, version_of("cotracker", model))


def seeds(request: Request) -> np.ndarray:
    """(N, 3) float32 of (frame, x, y), working px: corners where the picture ever changes, hands left out."""
    import cv2

    from reconstruct.providers.seeds import change_region, corners, even_exposure, reference_frames

    video, hands = request.video, request.hands
    grey, region = even_exposure(video), change_region(video)
    out = []
    for r in reference_frames(video, hands, REFERENCES):
        free = region
        if hands is not None:
            free = region & ~(cv2.dilate(hands.mask[r].astype(np.uint8), np.ones((11, 11), np.uint8)) > 0)
        found = corners(grey[r], free, SEEDS)
        out.append(np.column_stack([np.full(len(found), r, np.float32), found]))
    return np.concatenate(out).astype(np.float32) if out else np.zeros((0, 3), np.float32)


def _under(mask: np.ndarray, where: np.ndarray) -> np.ndarray:
    """(N, T) bool: the point is under the hand's pixels."""
    T, h, w = mask.shape
    at = np.round(np.nan_to_num(where)).astype(int)
    x, y = np.clip(at[..., 0], 0, w - 1), np.clip(at[..., 1], 0, h - 1)
    return mask[np.arange(T)[None], y, x]

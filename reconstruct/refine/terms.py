"""What the rendered links are compared with: masks, their boundaries, features; in pixels of the reduced picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from reconstruct.refine.coverage import Edges

EXTRA = 0.3
"""Weight of rendered pixels outside the observed mask: a mask misses what a hand or a neighbour hides, so a rendered
pixel too many says less than one too few (the paper's "reduced penalty")."""
FAR_PX = 15.0
"""Distances to the observed boundary count no further than this."""


@dataclass(frozen=True)
class Observed:
    """One link's observed mask in one frame, at the reduced size.

    Attributes:
        cover: (H, W) share of each pixel.  counted: (H, W) bool, False where a hand hides the link.
        distance: (H, W) px to the mask's boundary, at most :data:`FAR_PX`.
    """

    cover: torch.Tensor
    counted: torch.Tensor
    distance: torch.Tensor


def observe(mask: np.ndarray, hidden: np.ndarray, size: tuple[int, int]) -> Observed:
    """An observed mask at the reduced size.

    Args:
        mask: (h, w) bool.  hidden: (h, w) bool, pixels that say nothing (a hand).  size: (width, height) to reduce to.
    """
    cover = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA).astype(float)
    # The mask ends next to the hand where the hand begins, not the link: two pixels more are left out.
    unknown = cv2.resize(hidden.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.05
    unknown = cv2.dilate(unknown.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    inner = cover >= 0.5
    apart = np.where(inner, cv2.distanceTransform(inner.astype(np.uint8), cv2.DIST_L2, 5),
                     cv2.distanceTransform((~inner).astype(np.uint8), cv2.DIST_L2, 5)) - 0.5  # fmt: skip
    return Observed(torch.from_numpy(cover), torch.from_numpy(~unknown),
                    torch.from_numpy(np.minimum(apart, FAR_PX).astype(float)))  # fmt: skip


def mask_term(cover: torch.Tensor, seen: Observed, edges: Edges) -> torch.Tensor:
    """Missing foreground at full weight and extra foreground at :data:`EXTRA`, over the outline's length: mean px."""
    missing = (seen.cover - cover).clamp(min=0.0)
    extra = (cover - seen.cover).clamp(min=0.0)
    return ((missing + EXTRA * extra) * seen.counted).sum() / max(len(edges.place), 1)


def sample(image: torch.Tensor, uv: torch.Tensor) -> torch.Tensor:
    """Bilinear samples.

    Args:
        image: (C, H, W) or (H, W).  uv: (N, 2) px, the centre of the top-left pixel is (0, 0).

    Returns:
        (C, N) or (N,).
    """
    flat = image if image.ndim == 3 else image[None]
    h, w = flat.shape[1:]
    grid = torch.stack([2 * uv[:, 0] / (w - 1) - 1, 2 * uv[:, 1] / (h - 1) - 1], 1)[None, None]
    out = torch.nn.functional.grid_sample(flat[None].to(grid.dtype), grid, align_corners=True, padding_mode="border")[
        0, :, 0
    ]
    return out if image.ndim == 3 else out[0]


def boundary_term(seen: Observed, edges: Edges) -> torch.Tensor:
    """Mean distance of the rendered outline from the observed one, px; the picture's rim and hands are left out."""
    h, w = seen.distance.shape
    uv = edges.uv
    inner = (uv[:, 0] > 1) & (uv[:, 0] < w - 2) & (uv[:, 1] > 1) & (uv[:, 1] < h - 2)
    at = uv.detach().round().long()
    inner &= seen.counted[at[:, 1].clamp(0, h - 1), at[:, 0].clamp(0, w - 1)]
    if not bool(inner.any()):
        return uv.sum() * 0.0
    return sample(seen.distance, uv[inner]).mean()


def feature_term(features: torch.Tensor, described: torch.Tensor, uv: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
    """Mean cosine distance between descriptors carried by vertices and those seen where the vertices are rendered.

    Args:
        features: (C, H, W) unit descriptors of the frame.  described: (V, C) unit descriptors of the vertices.
        uv: (V, 2) px.  seen: (V,) bool, vertices that are visible in this frame and have a descriptor.
    """
    if not bool(seen.any()):
        return uv.sum() * 0.0
    here = torch.nn.functional.normalize(sample(features, uv[seen]), dim=0)
    return (1 - (here.T * described[seen]).sum(1)).mean()

"""Dense descriptors of frames, for comparing what is seen in one frame with what is seen in another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reconstruct.cues import ProviderInfo
from reconstruct.providers.settings import Settings, load_settings
from reconstruct.providers.table import find
from reconstruct.video import Video


def describe(video: Video, frames: Sequence[int], name: str = "xfeat",
             settings: Settings | None = None) -> tuple[np.ndarray, ProviderInfo]:  # fmt: skip
    """Unit descriptors on a grid.

    Args:
        video: working frames.  frames: which.  name: "xfeat" or "dinov2".

    Returns:
        (n, gh, gw, C) float32 unit vectors; cell (i, j) covers working rows i h / gh to (i + 1) h / gh and columns
        alike. Who made them.

    Raises:
        TaaError: no such provider, or its weights cannot be loaded.
    """
    provider = find("features", name)
    settings = settings or load_settings()
    grid, version = (_dinov2 if name == "dinov2" else _xfeat)(video, frames, settings)
    norm = np.linalg.norm(grid, axis=-1, keepdims=True)
    return grid / np.maximum(norm, 1e-9), ProviderInfo(name, version, provider.licence, "features")


def sample(grid: np.ndarray, uv_work: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(N, C) descriptors at points of one frame, bilinear.

    Args:
        grid: (gh, gw, C).  uv_work: (N, 2) working px.  shape: (h, w) of the working frame.
    """
    import cv2

    gh, gw, count = grid.shape
    where = (np.asarray(uv_work, float) + 0.5) * (gw / shape[1], gh / shape[0]) - 0.5
    x, y = where[:, 0].astype(np.float32), where[:, 1].astype(np.float32)
    out = np.empty((len(where), count), np.float32)
    for c in range(count):  # remap takes at most four channels at once
        plane = np.ascontiguousarray(grid[..., c], np.float32)
        out[:, c] = cv2.remap(plane, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel()
    return out / np.maximum(np.linalg.norm(out, axis=-1, keepdims=True), 1e-9)


def _dinov2(video: Video, frames: Sequence[int], settings: Settings) -> tuple[np.ndarray, str]:
    """Patch tokens of DINOv2 (Oquab et al., 2023) at the working size rounded to whole patches."""
    import cv2
    import torch
    from transformers import AutoModel

    from reconstruct.providers.hub import device_of, dtype_of, load_pretrained, model_of, rgb, run_batches, version_of

    section = settings.section("dinov2")
    model = model_of("dinov2", "features", section)
    device = device_of(section)
    dtype = dtype_of(section, device)
    network = load_pretrained(AutoModel, model, device, dtype)
    patch = int(network.config.patch_size)
    h, w = video.frames.shape[1:3]
    gh, gw = max(1, round(h / patch)), max(1, round(w / patch))
    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    extra = 1 + int(getattr(network.config, "num_register_tokens", 0))
    frames = list(frames)

    def run(part: range) -> list[np.ndarray]:
        images = [cv2.resize(i, (gw * patch, gh * patch), interpolation=cv2.INTER_AREA)
                  for i in rgb(video, [frames[k] for k in part])]  # fmt: skip
        pixels = torch.from_numpy(((np.stack(images) / 255 - mean) / std).transpose(0, 3, 1, 2)).to(device, dtype)
        with torch.inference_mode():
            tokens = network(pixel_values=pixels).last_hidden_state[:, extra:]
        return list(tokens.float().reshape(len(part), gh, gw, -1).cpu().numpy())

    return np.stack(run_batches(run, len(frames), section.get("batch", 0))), version_of("transformers", model)


def _xfeat(video: Video, frames: Sequence[int], settings: Settings) -> tuple[np.ndarray, str]:
    """XFeat's dense map (Potje et al., CVPR 2024), stride 8."""
    import torch

    from reconstruct.providers.xfeat import network, version

    net = network()
    out = []
    h, w = video.frames.shape[1:3]
    for t in frames:
        # The network wants multiples of 32; padding on the right and below keeps the cells where they are.
        padded = np.zeros((-(-h // 32) * 32, -(-w // 32) * 32, 3), np.float32)
        padded[:h, :w] = video.frames[t][..., ::-1]
        pixels = torch.from_numpy(padded.transpose(2, 0, 1)[None])
        with torch.inference_mode():
            dense, _, _ = net.net(pixels)
        gh, gw = max(1, round(h / 8)), max(1, round(w / 8))
        out.append(dense[0, :, :gh, :gw].permute(1, 2, 0).numpy())
    return np.stack(out), version()

"""Metric depth, frame by frame, by MoGe-2.

Written for ``moge.model.v2.MoGeModel.infer`` as its source states it: (3, H, W) RGB in [0, 1] in; depth along the
optical axis at the picture's size, infinite where the mask says that there is none; metres for MoGe-2.

Source: Wang et al., MoGe-2, 2025.
"""

from __future__ import annotations

import numpy as np

from reconstruct.cues_io import focal_of
from reconstruct.errors import TaaError
from reconstruct.providers.hub import device_of, model_of, rgb, version_of
from reconstruct.providers.make import Made, Request


def depth(request: Request) -> Made:
    """``depth.npz`` at working size, metres."""
    import torch
    from moge.model.v2 import MoGeModel

    section = request.settings.section("moge")
    model = model_of("moge", "depth", section)
    device = device_of(section)
    try:
        network = MoGeModel.from_pretrained(model).to(device).eval()
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise TaaError(f"cannot load {model} as MoGeModel ({str(error)[:160]}); set model of [moge] in taa.toml to the "
                       "checkpoint file, or connect to the internet once") from error  # fmt: skip
    video, focal = request.video, request.video.focal_px
    if "camera" in request.folder.given():
        focal = focal_of(request.folder.read("camera", "K"))
    # One field of view for all frames: without it every frame would get its own.
    fov = float(np.degrees(2 * np.arctan(video.size[0] / (2 * focal)))) if focal else None
    h, w = video.frames.shape[1:3]
    out = np.empty((len(video), h, w), np.float32)
    for t in range(len(video)):
        image = torch.from_numpy(rgb(video, [t])[0].astype(np.float32).transpose(2, 0, 1) / 255).to(device)
        with torch.inference_mode():
            found = network.infer(image, fov_x=fov, use_fp16=device.type == "cuda")
        z = found["depth"].float().cpu().numpy()
        if z.shape != (h, w):
            raise TaaError(f"moge gave depth of shape {z.shape} for a picture of {(h, w)}; its version is not "
                           "supported")  # fmt: skip
        out[t] = z
        request.tell((t + 1) / len(video))
    out[~(np.isfinite(out) & (out > 0))] = np.nan
    if not np.isfinite(out).any():
        raise TaaError("moge saw no surface in any frame; try another --depth provider")
    return Made({"depth": {"depth": out, "metric": np.array(True)}}, version_of("moge", model))

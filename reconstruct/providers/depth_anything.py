"""Metric depth, frame by frame, by Depth Anything 2 in transformers.

The metric models predict metres along the optical axis. The others predict inverse depth up to an unknown scale and
shift of every frame, which is no depth cue; they are refused.

Source: Yang et al., Depth Anything V2, NeurIPS 2024.
"""

from __future__ import annotations

import numpy as np

from reconstruct.errors import TaaError
from reconstruct.providers.hub import device_of, dtype_of, load_pretrained, model_of, rgb, run_batches, version_of
from reconstruct.providers.make import Made, Request

NAME = "depth-anything-v2"


def depth(request: Request) -> Made:
    """``depth.npz`` at working size, metres.

    Raises:
        TaaError: the model is not a metric one, or cannot be loaded.
    """
    import torch
    from transformers import AutoModelForDepthEstimation
    from transformers.models.dpt.image_processing_pil_dpt import DPTImageProcessorPil

    section = request.settings.section(NAME)
    model = model_of(NAME, "depth", section)
    device = device_of(section)
    dtype = dtype_of(section, device)
    network = load_pretrained(AutoModelForDepthEstimation, model, device, dtype)
    if getattr(network.config, "depth_estimation_type", "relative") != "metric":
        raise TaaError(f"{model} predicts inverse depth up to scale and shift, which is no depth; set model of "
                       f"[{NAME}] to one of the Metric models")  # fmt: skip
    processor = DPTImageProcessorPil.from_pretrained(model)
    video = request.video
    h, w = video.frames.shape[1:3]

    def run(part: range) -> list[np.ndarray]:
        pixels = processor(images=list(rgb(video, part)), return_tensors="pt")["pixel_values"].to(device, dtype)
        with torch.inference_mode():
            z = network(pixel_values=pixels).predicted_depth.float()
        z = torch.nn.functional.interpolate(z[:, None], size=(h, w), mode="bilinear", align_corners=False)[:, 0]
        return list(z.cpu().numpy())

    z = np.stack(run_batches(run, len(video), section.get("batch", 0), request.tell)).astype(np.float32)
    z[~(np.isfinite(z) & (z > 0))] = np.nan
    if not np.isfinite(z).any():
        raise TaaError(f"{model} predicted no positive depth anywhere; try another --depth provider")
    small = "small" in model.lower()
    licence = None if small else f"code Apache-2.0; weights {_licence(model)}"
    return Made({"depth": {"depth": z, "metric": np.array(True)}}, version_of("transformers", model), licence)


def _licence(model: str) -> str:
    large = any(word in model.lower() for word in ("base", "large", "giant"))
    return "CC-BY-NC-4.0 (non-commercial)" if large else "as its model card says"

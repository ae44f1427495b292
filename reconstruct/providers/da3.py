"""Depth, camera poses and intrinsics of all frames by Depth Anything 3.

Written for ``depth_anything_3.api.DepthAnything3.inference`` as its documentation and source state it: depth along
the optical axis, confidence, world-to-camera extrinsics and intrinsics, all at the processed resolution. Depth is
metric only for the NESTED and METRIC models. A long video goes through in overlapping runs, whose scale and pose are
joined on the frames they share, because one run holds all its frames on the GPU.

Source: Lin et al., Depth Anything 3, 2025.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from reconstruct.errors import TaaError
from reconstruct.providers.hub import device_of, model_of, rgb, version_of, weights_name, work_to_full_K
from reconstruct.providers.make import Made, Request
from reconstruct.providers.world import inverse_poses, upright
from reconstruct.video import Video

RUN_FRAMES = 96
"""Frames a run; ``batch`` of ``[da3]`` in ``taa.toml`` changes it."""
SHARED = 8
FREE = ("DA3-SMALL", "DA3-BASE", "DA3METRIC-LARGE", "DA3MONO-LARGE")


@dataclass(frozen=True)
class Prediction:
    """What came out for all frames.

    Attributes:
        depth: (T, h, w) at the processed size.  confidence: alike, or None.
        pose: (T, 4, 4) camera to the model's world, or None.  K: (T, 3, 3) processed px, or None.
        metric: True if lengths are metres.
    """

    depth: np.ndarray
    confidence: np.ndarray | None
    pose: np.ndarray | None
    K: np.ndarray | None
    metric: bool


_last: dict[str, Prediction] = {}


def depth(request: Request) -> Made:
    """``depth.npz`` at the processed size."""
    found, model = _predict(request)
    z = found.depth.astype(np.float32)
    metric = found.metric
    if _kind(model) == "METRIC":
        z = z * np.float32(_focal(request) * z.shape[2] / request.video.size[0] / 300.0)
        metric = True
    z[~(np.isfinite(z) & (z > 0))] = np.nan
    arrays = {"depth": z, "metric": np.array(metric)}
    if found.confidence is not None:
        arrays["confidence"] = found.confidence.astype(np.float16)
    notes = () if metric else ("Depth Anything 3: this model's depth is not metric; the scale comes from elsewhere",)
    return Made({"depth": arrays}, version_of("depth-anything-3", model), _licence(model), notes)


def camera(request: Request) -> Made:
    """``camera.npz``: intrinsics in full px, poses in a world with z up.

    Raises:
        TaaError: the model has no camera head.
    """
    found, model = _predict(request)
    if found.pose is None or found.K is None:
        raise TaaError(f"{weights_name(model)} predicts no camera; set model of [da3] to DA3-SMALL, DA3-BASE, "
                       "DA3-LARGE, DA3-GIANT or a NESTED one, or choose another --camera")  # fmt: skip
    K = work_to_full_K(_pixel_centres(found.K), request.video, found.depth.shape[:0:-1])
    arrays = {"K": K, "T_world_camera": upright(found.pose) @ found.pose, "metric": np.array(found.metric)}
    note = "Depth Anything 3 knows no gravity; which way is up is assumed from how a camera is held"
    return Made({"camera": arrays}, version_of("depth-anything-3", model), _licence(model), (note,))


def _pixel_centres(K: np.ndarray) -> np.ndarray:
    """Its principal point counts from the corner of the picture, ours from the centre of the first pixel."""
    K = np.array(K, float)
    K[..., :2, 2] -= 0.5
    return K


def _kind(model: str) -> str:
    name = weights_name(model).upper()
    return next((kind for kind in ("NESTED", "METRIC", "MONO") if kind in name), "ANY")


def _licence(model: str) -> str:
    name = weights_name(model).upper()
    if any(free in name for free in FREE):
        return "Apache-2.0"
    if any(word in name for word in ("LARGE", "GIANT", "NESTED")):
        return "code Apache-2.0; weights CC-BY-NC-4.0 (non-commercial)"
    return "code Apache-2.0; weights as their model card says"


def _focal(request: Request) -> float:
    if "camera" in request.folder.given():
        from reconstruct.cues_io import focal_of

        return focal_of(request.folder.read("camera", "K"))
    if request.video.focal_px:
        return float(request.video.focal_px)
    raise TaaError("DA3METRIC depth needs the focal length, and the video names none; choose --camera colmap or da3 "
                   "too, or put cues/camera.npz there")  # fmt: skip


def _predict(request: Request) -> tuple[Prediction, str]:
    """All frames, once for depth and camera."""
    section = request.settings.section("da3")
    model = model_of("da3", "depth", section)
    key = repr((request.video.sha256, request.video.frames.shape, sorted(section.items()), model))
    if key not in _last:
        _last.clear()
        _last[key] = _run(request.video, model, section, request.tell)
    return _last[key], model


def _run(video: Video, model: str, section: Mapping[str, Any], tell: Any) -> Prediction:
    import torch
    from depth_anything_3.api import DepthAnything3

    device = device_of(section)
    try:
        network = DepthAnything3.from_pretrained(model).to(device).eval()
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise TaaError(f"cannot load {model} as DepthAnything3 ({str(error)[:160]}); set model of [da3] in taa.toml to "
                       "a folder with the weights, or connect to the internet once") from error  # fmt: skip
    size = int(section.get("batch", 0)) or RUN_FRAMES
    T = len(video)
    whole: Prediction | None = None
    while whole is None or len(whole.depth) < T:
        shared = 0 if whole is None else min(SHARED, len(whole.depth), max(1, size // 4))
        start = 0 if whole is None else len(whole.depth) - shared
        part = range(start, min(T, start + size))
        try:
            with torch.inference_mode():
                out = network.inference(image=list(rgb(video, part)), process_res=int(section.get("process_res", 504)),
                                        process_res_method="upper_bound_resize")  # fmt: skip
        except torch.cuda.OutOfMemoryError:
            if size <= 4:
                raise TaaError("four frames do not fit into the GPU's memory; set a smaller model or process_res "
                               "of [da3]") from None  # fmt: skip
            torch.cuda.empty_cache()
            size //= 2
            continue
        piece = _checked(out, len(part), _kind(model))
        whole = piece if whole is None else _joined(whole, piece, shared)
        tell(len(whole.depth) / T)
    return whole


def _checked(out: Any, count: int, kind: str) -> Prediction:
    """The package's prediction object as ours; TaaError if its shapes are not as documented."""
    z = np.asarray(out.depth, float)
    if z.ndim != 3 or len(z) != count:
        raise TaaError(f"depth_anything_3 gave depth of shape {z.shape} for {count} frames; its version is not "
                       "supported")  # fmt: skip
    confidence, pose, K = getattr(out, "conf", None), None, None
    extrinsics, intrinsics = getattr(out, "extrinsics", None), getattr(out, "intrinsics", None)
    if extrinsics is not None and intrinsics is not None and kind in ("ANY", "NESTED"):
        extrinsics, K = np.asarray(extrinsics, float), np.asarray(intrinsics, float)
        if extrinsics.shape[0] != count or extrinsics.shape[1:] not in ((3, 4), (4, 4)) or K.shape != (count, 3, 3):
            raise TaaError(f"depth_anything_3 gave extrinsics {extrinsics.shape} and intrinsics {K.shape} for {count} "
                           "frames; its version is not supported")  # fmt: skip
        pose = inverse_poses(extrinsics)
    return Prediction(z, None if confidence is None else np.asarray(confidence), pose, K, kind == "NESTED")


def _joined(whole: Prediction, piece: Prediction, shared: int) -> Prediction:
    """Append a run in the scale and world of those before; the runs overlap by ``shared`` frames."""
    n = len(whole.depth)
    old, new = whole.depth[n - shared :], piece.depth[:shared]
    both = np.isfinite(old) & np.isfinite(new) & (old > 0) & (new > 0)
    s = 1.0 if piece.metric or not both.any() else float(np.exp(np.median(np.log(old[both] / new[both]))))
    pose = None
    if whole.pose is not None and piece.pose is not None:
        scaled = piece.pose.copy()
        scaled[:, :3, 3] *= s
        middle = shared // 2
        across = whole.pose[n - shared + middle] @ np.linalg.inv(scaled[middle])
        pose = np.concatenate([whole.pose, across @ scaled[shared:]])

    def both_of(a: np.ndarray | None, b: np.ndarray | None) -> np.ndarray | None:
        return None if a is None or b is None else np.concatenate([a, b[shared:]])

    z = np.concatenate([whole.depth, s * piece.depth[shared:]])
    confidence, K = both_of(whole.confidence, piece.confidence), both_of(whole.K, piece.K)
    return Prediction(z, confidence, pose, K, whole.metric)

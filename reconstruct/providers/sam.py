"""Masks of the links and of the hand by Segment Anything 2.1 and 3, in transformers.

Points come from the track clusters (:mod:`reconstruct.providers.prompts`): moving part, static part, hand. SAM 3 also
takes words, where ``taa.toml`` has them: it then finds every instance of the concept, and the one that holds the
cluster's points is taken. The networks' own video processors need torchvision; resizing and normalising are
therefore done here, with the numbers of the model's own preprocessor file.

Sources: Ravi et al., SAM 2, 2024; Carion et al., SAM 3, 2025.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from reconstruct.errors import TaaError
from reconstruct.providers.hub import device_of, dtype_of, load_pretrained, model_of, version_of
from reconstruct.providers.make import Made, Request
from reconstruct.providers.prompts import Prompt, point_prompts
from reconstruct.video import Video

PARTS = ("moving", "static", "hand")
IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
HALF = ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))


def sam2(request: Request) -> Made:
    """``masks.npz`` by Sam2Video with point prompts.

    Raises:
        TaaError: no joint and no tracks to take points from, or the weights cannot be loaded.
    """
    from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession, Sam2VideoModel

    return _masks(request, "sam2", Sam2VideoModel, Sam2VideoInferenceSession, IMAGENET)


def sam3(request: Request) -> Made:
    """``masks.npz`` by Sam3TrackerVideo with point prompts, and by Sam3Video for parts that ``taa.toml`` gives words.

    Raises:
        TaaError: neither points nor words to prompt with, or the weights cannot be loaded.
    """
    from transformers.models.sam3_tracker_video.modeling_sam3_tracker_video import (
        Sam3TrackerVideoInferenceSession,
        Sam3TrackerVideoModel,
    )

    made = _masks(request, "sam3", Sam3TrackerVideoModel, Sam3TrackerVideoInferenceSession, HALF)
    section = request.settings.section("sam3")
    words = {part: str(section[part]) for part in PARTS if section.get(part)}
    if not words:
        return made
    arrays = {name: np.array(made.cues["masks"][name]) for name in PARTS}  # type: ignore[index]
    found, notes = _by_words(request, words)
    prompts = _prompts(request)
    for part, instances in found.items():
        mask = _instance_of(instances, part, prompts, request.video)
        if mask is None:
            notes.append(f'SAM 3 found no "{words[part]}" where the {part} points are; their mask is from the points')
        else:
            arrays[part] = mask
    return Made({"masks": _without_overlap(arrays)}, made.version, made.licence, (*made.notes, *notes))


def _prompts(request: Request) -> list[Prompt]:
    if request.tracks is None:
        raise TaaError("a promptable segmenter takes its points from tracks, and there are none; choose --track lk")
    prompts = point_prompts(request.video, request.tracks, request.fit, request.hands)
    if not prompts:
        raise TaaError("no frame shows three tracks of the moving part, so there is nothing to click on; "
                       "choose --segment motion")  # fmt: skip
    return prompts


def _masks(request: Request, name: str, model_class: Any, session_class: Any, normal: tuple) -> Made:
    import torch

    section = request.settings.section(name)
    prompts = _prompts(request)
    model = model_of(name, "segment", section)
    device = device_of(section)
    dtype = dtype_of(section, device)
    network = load_pretrained(model_class, model, device, dtype)
    video, side = request.video, _side(network.config)
    h, w = video.frames.shape[1:3]
    session = session_class(video=None, video_height=h, video_width=w, inference_device=device,
                            inference_state_device=device, video_storage_device="cpu", dtype=dtype)  # fmt: skip
    for frame in pixels(video, side, *_normal(model, normal)):
        session.add_new_frame(torch.from_numpy(frame).to(dtype))
    parts = _add_points(session, prompts, video, side)
    out = {part: np.zeros((len(video), h, w), bool) for part in PARTS}
    with torch.inference_mode():
        for prompt in prompts:
            network(session, frame_idx=prompt.frame)
        first = prompts[0].frame
        steps = 0
        for reverse in (False, True):
            for result in network.propagate_in_video_iterator(session, start_frame_idx=first, reverse=reverse):
                logits = torch.nn.functional.interpolate(result.pred_masks.float(), size=(h, w), mode="bilinear",
                                                         align_corners=False)[:, 0]  # fmt: skip
                for part, mask in zip((parts[i] for i in session.obj_ids), (logits > 0).cpu().numpy(), strict=True):
                    out[part][int(result.frame_idx)] = mask
                steps += 1
                request.tell(min(1.0, steps / len(video)))
    if not out["moving"].any():
        raise TaaError(f"{name} found no pixel of the moving part; choose another --segment provider")
    notes = [] if "static" in parts.values() else [f"{name}: no track rests beside the part; the static mask is empty"]
    return Made({"masks": _without_overlap(out)}, version_of("transformers", model), notes=tuple(notes))


def _add_points(session: Any, prompts: list[Prompt], video: Video, side: int) -> dict[int, str]:
    """Put the points of all parts into the session; object id -> part."""
    import torch

    parts = {n: part for n, part in enumerate(PARTS) if any(len(getattr(p, part)) for p in prompts)}
    for prompt in prompts:
        asked = []
        for n, part in parts.items():
            on = getattr(prompt, part)
            if not len(on):
                continue
            off = [getattr(prompt, other) for other in PARTS if other != part]
            off = np.concatenate(off)[:8]
            points = np.concatenate([on, off])
            # Full px (centre of a pixel is whole) -> px of the square input, whose corner is zero.
            points = (points + 0.5) * (side / video.size[0], side / video.size[1])
            labels = np.r_[np.ones(len(on)), np.zeros(len(off))]
            index = session.obj_id_to_idx(n)
            session.add_point_inputs(index, prompt.frame, {
                "point_coords": torch.from_numpy(points).float()[None, None],
                "point_labels": torch.from_numpy(labels).int()[None, None],
            })  # fmt: skip
            asked.append(n)
        session.obj_with_new_inputs = sorted(set(session.obj_with_new_inputs) | set(asked))
    return parts


def _by_words(request: Request, words: Mapping[str, str]) -> tuple[dict[str, list[np.ndarray]], list[str]]:
    """Every instance of each concept, (T, h, w) bool at working size, and notes."""
    import torch
    from transformers import AutoTokenizer
    from transformers.models.sam3_video.modeling_sam3_video import Sam3VideoInferenceSession, Sam3VideoModel

    section = request.settings.section("sam3")
    model = model_of("sam3", "segment", section)
    device = device_of(section)
    dtype = dtype_of(section, device)
    network = load_pretrained(Sam3VideoModel, model, device, dtype)
    tokenizer = AutoTokenizer.from_pretrained(model)
    video = request.video
    h, w = video.frames.shape[1:3]
    session = Sam3VideoInferenceSession(
        video=None, video_height=h, video_width=w, inference_device=device, inference_state_device=device,
        video_storage_device="cpu", dtype=dtype,
    )  # fmt: skip
    for frame in pixels(video, _side(network.config), *_normal(model, HALF)):
        session.add_new_frame(torch.from_numpy(frame).to(dtype))
    for text in dict.fromkeys(words.values()):
        prompt = session.add_prompt(text)
        encoded = tokenizer(text, return_tensors="pt", padding="max_length", max_length=32, truncation=True).to(device)
        session.prompt_input_ids[prompt] = encoded.input_ids
        session.prompt_attention_masks[prompt] = encoded.attention_mask
    seen: dict[int, np.ndarray] = {}
    hidden: set[int] = set()
    with torch.inference_mode():
        for result in network.propagate_in_video_iterator(session):
            hidden |= set(result.removed_obj_ids)
            for n, logits in result.obj_id_to_mask.items():
                big = torch.nn.functional.interpolate(logits.float().reshape(1, 1, *logits.shape[-2:]), size=(h, w),
                                                      mode="bilinear", align_corners=False)[0, 0]  # fmt: skip
                mask = seen.setdefault(int(n), np.zeros((len(video), h, w), bool))
                mask[int(result.frame_idx)] = (big > 0).cpu().numpy()
    instances: dict[str, list[np.ndarray]] = {part: [] for part in words}
    for n, mask in seen.items():
        text = session.prompts[session.obj_id_to_prompt_id[n]]
        for part, wanted in words.items():
            if wanted == text and n not in hidden and mask.any():
                instances[part].append(mask)
    return instances, []


def _instance_of(instances: list[np.ndarray], part: str, prompts: list[Prompt], video: Video) -> np.ndarray | None:
    """The instance that holds most of the part's points, all together for hands; None where none holds any."""
    if part == "hand":
        return np.logical_or.reduce(instances) if instances else None
    best, most = None, 0
    for mask in instances:
        held = 0
        for prompt in prompts:
            at = np.round(video.to_work(getattr(prompt, part))).astype(int)
            at = np.clip(at, 0, (mask.shape[2] - 1, mask.shape[1] - 1))
            held += int(mask[prompt.frame, at[:, 1], at[:, 0]].sum())
        if held > most:
            best, most = mask, held
    return best


def _without_overlap(masks: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The hand is in front of the part it moves, and the moving part before the static one."""
    hand, moving = masks["hand"], masks["moving"] & ~masks["hand"]
    return {"static": masks["static"] & ~moving & ~hand, "moving": moving, "hand": hand}


def _side(config: Any) -> int:
    """Side of the network's square input, px."""
    for holder in (config, getattr(config, "prompt_encoder_config", None)):
        size = getattr(holder, "image_size", None)
        if size is not None:
            return int(size[0] if isinstance(size, (list, tuple)) else size)
    raise TaaError("the segmenter's configuration names no image size; set model in taa.toml to another checkpoint")


def _normal(model: str, default: tuple) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the model's own preprocessor, if its folder says them."""
    for name in ("video_preprocessor_config.json", "preprocessor_config.json"):
        file = Path(model) / name
        if file.is_file():
            facts = json.loads(file.read_text(encoding="utf-8"))
            if "image_mean" in facts and "image_std" in facts:
                return np.array(facts["image_mean"], np.float32), np.array(facts["image_std"], np.float32)
    return np.array(default[0], np.float32), np.array(default[1], np.float32)


def pixels(video: Video, side: int, mean: np.ndarray, std: np.ndarray) -> Any:
    """Yield (3, side, side) float32 normalised RGB, one working frame after another."""
    import cv2

    for frame in video.frames:
        how = cv2.INTER_AREA if side < min(frame.shape[:2]) else cv2.INTER_LINEAR
        image = cv2.resize(np.asarray(frame), (side, side), interpolation=how)
        yield ((image[..., ::-1].astype(np.float32) / 255 - mean) / std).transpose(2, 0, 1)

"""Tiny networks with random weights, saved to a folder, so that the real loading path can be run without downloads."""

from __future__ import annotations

import json
from pathlib import Path

SIDE = 112


def save_sam2(folder: Path, seed: int = 0) -> Path:
    """A Sam2Video of 128 px."""
    import torch
    from transformers import Sam2VideoConfig
    from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoModel

    torch.manual_seed(seed)
    side = 128
    vision = {
        "model_type": "sam2_vision_model",
        "backbone_config": {
            "model_type": "sam2_hiera_det_model", "hidden_size": 12, "image_size": [side, side],
            "embed_dim_per_stage": [12, 24, 48, 96], "num_attention_heads_per_stage": [1, 2, 4, 8],
            "blocks_per_stage": [1, 1, 3, 1], "window_size_per_stage": [8, 4, 4, 4], "global_attention_blocks": [3],
            "window_positional_embedding_background_size": [7, 7],
        },
        "backbone_channel_list": [96, 48, 24, 12], "backbone_feature_sizes": [[32, 32], [16, 16], [8, 8]],
        "fpn_hidden_size": 128,
    }  # fmt: skip
    config = Sam2VideoConfig(vision_config=vision, **_tracker(side, 16))
    network = Sam2VideoModel(config)
    _always_there(network)
    network.save_pretrained(folder)
    mean, std = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]
    (folder / "preprocessor_config.json").write_text(json.dumps({"image_mean": mean, "image_std": std}))
    return folder


def _always_there(tracker) -> None:
    """Random weights may say that no object is in the picture, and then give an empty mask."""
    tracker.mask_decoder.pred_obj_score_head.proj_out.bias.data[:] = 10.0


def _tracker(side: int, patch: int) -> dict:
    grid = side // patch
    return {
        "prompt_encoder_config": {"hidden_size": 128, "image_size": side, "patch_size": patch,
                                  "mask_input_channels": 8},
        "mask_decoder_config": {"hidden_size": 128, "mlp_dim": 64, "num_attention_heads": 2,
                                "iou_head_hidden_dim": 128},
        "image_size": side, "memory_attention_hidden_size": 128, "memory_attention_num_layers": 1,
        "memory_attention_feed_forward_hidden_size": 128, "memory_attention_rope_feat_sizes": [grid, grid],
        "memory_encoder_hidden_size": 128, "memory_encoder_output_channels": 64, "mask_downsampler_embed_dim": 128,
        "memory_fuser_num_layers": 1, "memory_fuser_embed_dim": 128, "memory_fuser_intermediate_dim": 128,
        "mask_downsampler_total_stride": patch, "num_maskmem": 3, "max_object_pointers_in_encoder": 4,
    }  # fmt: skip


def save_depth_anything(folder: Path, kind: str = "metric", seed: int = 0) -> Path:
    """A DepthAnything of 56 px with a DPT preprocessor."""
    import torch
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config
    from transformers.models.dpt.image_processing_pil_dpt import DPTImageProcessorPil

    torch.manual_seed(seed)
    backbone = Dinov2Config(hidden_size=32, num_hidden_layers=4, num_attention_heads=2, image_size=56, patch_size=14,
                            out_indices=[1, 2, 3, 4], reshape_hidden_states=False, apply_layernorm=True)  # fmt: skip
    config = DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=32, patch_size=14, neck_hidden_sizes=[8, 8, 16, 16],
        fusion_hidden_size=16, head_hidden_size=8, depth_estimation_type=kind, max_depth=20,
    )  # fmt: skip
    DepthAnythingForDepthEstimation(config).save_pretrained(folder)
    DPTImageProcessorPil(size={"height": 56, "width": 56}, keep_aspect_ratio=True, ensure_multiple_of=14,
                         image_mean=[0.485, 0.456, 0.406], image_std=[0.229, 0.224, 0.225],
                         ).save_pretrained(folder)  # fmt: skip
    return folder


def save_dinov2(folder: Path, seed: int = 0) -> Path:
    """A DINOv2 of 56 px."""
    import torch
    from transformers import Dinov2Config, Dinov2Model

    torch.manual_seed(seed)
    Dinov2Model(Dinov2Config(hidden_size=32, num_hidden_layers=2, num_attention_heads=2, image_size=56,
                             patch_size=14)).save_pretrained(folder)  # fmt: skip
    return folder


def save_sam3(folder: Path, seed: int = 0) -> Path:
    """A Sam3Video of 112 px with a word-level tokenizer; its tracker is what Sam3TrackerVideo loads too."""
    import torch
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast, Sam3VideoConfig
    from transformers.models.sam3_video.modeling_sam3_video import Sam3VideoModel

    torch.manual_seed(seed)
    grid = SIDE // 14
    vision = {
        "model_type": "sam3_vision_model",
        "backbone_config": {
            "model_type": "sam3_vit_model", "hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2,
            "num_attention_heads": 2, "image_size": SIDE, "patch_size": 14, "window_size": 4,
            "global_attn_indexes": [1], "pretrain_image_size": 56,
        },
        "fpn_hidden_size": 128, "backbone_feature_sizes": [[4 * grid] * 2, [2 * grid] * 2, [grid] * 2],
    }  # fmt: skip
    small = {"hidden_size": 128, "num_attention_heads": 2, "intermediate_size": 64}
    detector = {
        "model_type": "sam3", "vision_config": vision,
        "text_config": {"model_type": "clip_text_model", "vocab_size": 64, "hidden_size": 32, "intermediate_size": 64,
                        "num_hidden_layers": 2, "num_attention_heads": 2, "max_position_embeddings": 32,
                        "projection_dim": 32, "eos_token_id": 1, "bos_token_id": 0, "pad_token_id": 1},
        "geometry_encoder_config": {**small, "num_layers": 1}, "detr_encoder_config": {**small, "num_layers": 1},
        "detr_decoder_config": {**small, "num_layers": 1, "num_queries": 6},
        "mask_decoder_config": {"hidden_size": 128, "num_attention_heads": 2},
    }  # fmt: skip
    tracker = {"model_type": "sam3_tracker_video", "vision_config": vision, **_tracker(SIDE, 14)}
    tracker["mask_downsampler_total_stride"] = 16  # the network interpolates to sixteenths of its own mask size
    # Random detections score near 0.5: everything counts, so that the whole path is run.
    config = Sam3VideoConfig(
        detector_config=detector, tracker_config=tracker, score_threshold_detection=0.0, new_det_thresh=0.0,
        hotstart_delay=0, hotstart_unmatch_thresh=0, hotstart_dup_thresh=0, low_res_mask_size=4 * grid,
        det_nms_thresh=0.0, assoc_iou_thresh=0.0, max_num_objects=3,
    )  # fmt: skip
    network = Sam3VideoModel(config)
    _always_there(network.tracker_model)
    network.save_pretrained(folder)
    words = ["<s>", "</s>", "<unk>", "hand", "door", "cabinet"]
    tokenizer = Tokenizer(models.WordLevel({w: n for n, w in enumerate(words)}, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    PreTrainedTokenizerFast(tokenizer_object=tokenizer, bos_token="<s>", eos_token="</s>", pad_token="</s>",
                            unk_token="<unk>", model_max_length=32).save_pretrained(folder)  # fmt: skip
    return folder

"""Small or randomly initialised networks in files, for the matchers whose weights cannot be had where tests run."""

from __future__ import annotations

from pathlib import Path

import torch
from kornia.feature import LoFTR
from transformers import (
    LightGlueConfig,
    LightGlueForKeypointMatching,
    SuperGlueConfig,
    SuperGlueForKeypointMatching,
    SuperPointConfig,
)

# Of the weights, larger than by default: equal descriptors are to be closer than others.
_SPREAD = 0.1


def write_loftr(folder: Path) -> Path:
    path = folder / "loftr_outdoor.ckpt"
    torch.save({"state_dict": LoFTR(None).state_dict()}, path)
    return path


def write_superglue(folder: Path) -> Path:
    configuration = SuperGlueConfig(
        keypoint_detector_config=_superpoint(),
        hidden_size=32,
        keypoint_encoder_sizes=[8, 32],
        gnn_layers_types=["self", "cross"],
        num_attention_heads=2,
        initializer_range=_SPREAD,
        sinkhorn_iterations=5,
    )
    SuperGlueForKeypointMatching(configuration).save_pretrained(folder)
    return folder


def write_lightglue(folder: Path) -> Path:
    configuration = LightGlueConfig(
        keypoint_detector_config=_superpoint(),
        descriptor_dim=32,
        num_hidden_layers=2,
        num_attention_heads=2,
        initializer_range=_SPREAD,
        filter_threshold=0.0,  # untrained it is confident of nothing
    )
    LightGlueForKeypointMatching(configuration).save_pretrained(folder)
    return folder


def _superpoint() -> SuperPointConfig:
    # The softmax over a cell's pixels and "no keypoint", 65 classes, is to have peaks over the threshold.
    return SuperPointConfig(
        encoder_hidden_sizes=[8, 8, 16, 16],
        decoder_hidden_size=16,
        descriptor_decoder_dim=32,
        keypoint_threshold=0.01,
        initializer_range=0.5,
    )


WRITERS = {
    "loftr": write_loftr,
    "superpoint-superglue": write_superglue,
    "superpoint-lightglue": write_lightglue,
}

"""Images as the networks take them, and matches as they give them."""

from __future__ import annotations

import torch

from gsfeatloc_ros.common.arrays import Array, to_device
from gsfeatloc_ros.match.base import Features, Matches

# What red, green and blue count in brightness, as in OpenCV's.
LUMA = (0.299, 0.587, 0.114)


def as_tensor(array: Array) -> torch.Tensor:
    """Return what is known to be a tensor, such as features that were found in torch."""
    assert isinstance(array, torch.Tensor)
    return array


def is_blank(image: Array) -> bool:
    """Return whether an RGB image (H, W, 3) has one colour: networks that normalize contrast find something in it."""
    return bool((image == image[0, 0]).all())


def to_tensor(image: Array, device: str, multiple: int = 1) -> torch.Tensor:
    """Turn an RGB image (H, W, 3) uint8 into a tensor (1, 3, H', W') float32 in [0, 1] on a device.

    H' and W' are the next multiples of `multiple`. The image is padded at the bottom and right, not resized: pixels
    stay where they are, and a resampled image has weaker features.
    """
    tensor = to_device(image, device).permute(2, 0, 1)[None].float() / 255.0
    height, width = image.shape[:2]
    return torch.nn.functional.pad(tensor, (0, -width % multiple, 0, -height % multiple), mode="replicate")


def to_matches(a: Features, b: Features, index_a: torch.Tensor, index_b: torch.Tensor, scores: torch.Tensor) -> Matches:
    """Return the matches between features `index_a` (M,) of `a` and `index_b` (M,) of `b`, with scores (M,)."""
    # In one copy, as each waits for the device.
    keypoints_a, keypoints_b = as_tensor(a.keypoints), as_tensor(b.keypoints)
    columns = torch.column_stack([keypoints_a[index_a], keypoints_b[index_b], scores])
    numbers = columns.cpu().double().numpy()
    return Matches(numbers[:, :2], numbers[:, 2:4], numbers[:, 4])

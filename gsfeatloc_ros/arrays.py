"""Pictures and features lie on the host, as numpy's arrays, or on a GPU, as tensors of torch's."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias, Union

import numpy as np

if TYPE_CHECKING:  # torch takes a second to import, which a robot without a GPU is spared
    import torch

Array: TypeAlias = Union[np.ndarray, "torch.Tensor"]


def to_host(array: Array) -> np.ndarray:
    """The same as an array of numpy's; a tensor is copied from its device."""
    return array if isinstance(array, np.ndarray) else array.cpu().numpy()

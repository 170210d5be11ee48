"""Pictures and features lie on the host, as numpy's arrays, or on a GPU, as torch's tensors."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias, Union

import numpy as np

if TYPE_CHECKING:  # torch takes a second to import, which a robot without a GPU is spared
    import torch

Array: TypeAlias = Union[np.ndarray, "torch.Tensor"]


def to_host(array: Array) -> np.ndarray:
    """Return the same as a numpy array; a tensor is copied from its device."""
    return array if isinstance(array, np.ndarray) else array.cpu().numpy()


def to_device(array: Array, device: str | torch.device) -> torch.Tensor:
    """Return the same as a tensor on a device of torch's.

    The host does not wait until it is there; the array may change as soon as this returns.
    """
    import torch

    # torch warns of arrays that are not to be written to, as those of messages are.
    if isinstance(array, np.ndarray) and not array.flags.writeable:
        array = array.copy()
    return torch.as_tensor(array).to(device, non_blocking=True)

"""A simulated GPU: a device of torch's whose tensors compute on the CPU and keep apart from the CPU's as a GPU's do.

It shows on a machine without a GPU that code keeps its tensors on one device, and what costs time on a real one:
operations, copies and waits. The numbers are the CPU's. Of streams, memory and speed it shows nothing; pinned memory
and backward() it has not.

    with simulated_gpu() as gpu:
        x = torch.zeros(3, device=gpu.device)

A tensor on it wraps one of the CPU's and gets each operation through `__torch_dispatch__`. Operations without such a
tensor come down to the three at the end of this file, so that it works in all threads and in inference mode.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import torch
from torch.utils._pytree import tree_leaves, tree_map

# The device that torch keeps for others to fill in. Given another name it would become the process's accelerator,
# before CUDA.
NAME = "privateuseone"
_COMPOSITE = torch._C.DispatchKey.CompositeImplicitAutograd
# Tensors on the device may be indexed by those of the CPU, which are copied there.
_INDEXING = {"index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index", "_unsafe_index_put"}
# No kernels, besides views.
_FREE = {"empty_like", "new_empty", "new_empty_strided", "_unsafe_view", "_has_compatible_shallow_copy_type"}
# The host needs a number from the device: for the shape of the result, or to see how it went.
_WAITING = {
    "equal", "nonzero", "masked_select", "_unique", "_unique2", "unique_dim", "bincount",
    "unique_consecutive", "histc", "_linalg_check_errors", "_linalg_svd", "_linalg_eigh", "linalg_eig", "linalg_lstsq",
}  # fmt: skip


# The release of torch with which the tests' counts of operations, copies and waits were made.
COUNTED_WITH = "2.13"


class SimulatedGpu:
    """What the device was asked to do.

    Attributes:
        device: to pass to torch.
        operations: names of torch's operations that a GPU launches one kernel for, or more; of views there are none.
        to_host: bytes of each copy to the host.
        to_device: bytes of each copy to the device.
        waits: names of the operations in which the host waits until the device has done all before: copies to the
            host, copies to the device without `non_blocking`, and what needs a number from the device.
    """

    device = NAME

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget what was asked."""
        self.operations: list[str] = []
        self.to_host: list[int] = []
        self.to_device: list[int] = []
        self.waits: list[str] = []

    def explain(self) -> str:
        """Return what to make of a count that a test did not expect, and what was counted."""
        return (
            f"\nCounted with torch {COUNTED_WITH}; this is {torch.__version__}. Another torch may take operations "
            "apart otherwise, or wait where that one did not: if the code asks for the same as before, count anew.\n"
            f"operations: {len(self.operations)}, {dict(Counter(self.operations).most_common())}\n"
            f"bytes to the host: {self.to_host}\nbytes to the device: {self.to_device}\nwaits: {self.waits}"
        )

    def _copy(self, name: str, source: torch.Tensor, to_device: bool, non_blocking: bool = False) -> None:
        if to_device and isinstance(source, SimulatedTensor):
            self.operations.append(name)
            return
        (self.to_device if to_device else self.to_host).append(source.numel() * source.element_size())
        if not (to_device and non_blocking):
            self.waits.append(name)

    def _compute(self, name: str, args: tuple, kwargs: dict) -> None:
        self.operations.append(name)
        waits = name in _WAITING or (name == "repeat_interleave" and kwargs.get("output_size") is None)
        if name in _INDEXING:
            indices = [index for index in args[1] if index is not None]
            for index in indices:
                if not isinstance(index, SimulatedTensor):
                    self._copy(name, index, to_device=True)
            # One number of the CPU's is filled in where the mask is; for others its places are counted.
            filled = (
                len(indices) == 1 and len(args) > 2 and not args[2].dim() and not isinstance(args[2], SimulatedTensor)
            )
            waits = not filled and any(index.dtype in (torch.bool, torch.uint8) for index in indices)
        if waits:
            self.waits.append(name)


class SimulatedTensor(torch.Tensor):
    """A tensor on the device; `host` is the one that it wraps."""

    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, host: torch.Tensor) -> SimulatedTensor:
        # In inference mode too, a view of an ordinary tensor is an ordinary one.
        with torch.inference_mode(host.is_inference()):
            tensor = torch.Tensor._make_wrapper_subclass(
                cls, host.shape, host.stride(), host.storage_offset(), dtype=host.dtype, device=torch.device(NAME, 0)
            )
        tensor.host = host
        return tensor

    @classmethod
    def __torch_dispatch__(cls, operation: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        # In inference mode torch leaves to the backend what it takes apart otherwise.
        if torch._C._dispatch_has_kernel_for_dispatch_key(operation.name(), _COMPOSITE):
            return operation._op_dk(_COMPOSITE, *args, **(kwargs or {}))
        return _run(operation, args, kwargs or {})

    def numpy(self, **_: Any) -> None:
        raise TypeError(
            f"can't convert {NAME} device type tensor to numpy. Use Tensor.cpu() to copy it to the host first"
        )

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def __format__(self, specification: str) -> str:
        return self.cpu().__format__(specification)

    def __repr__(self, **_: Any) -> str:
        return f"simulated {self.host!r}"


def _run(operation: Any, args: tuple, kwargs: dict) -> Any:
    """Note an operation and do it on the CPU."""
    name = operation._schema.name.removeprefix("aten::")
    tensors = [value for value in tree_leaves((args, kwargs)) if isinstance(value, torch.Tensor)]
    to_device = torch.device(kwargs.get("device") or NAME).type == NAME
    if name == "copy_":
        to_device = isinstance(args[0], SimulatedTensor)
        _gpu()._copy(name, args[1], to_device, kwargs.get("non_blocking") or args[2:] == (True,))
    elif name == "_local_scalar_dense" or (name == "_to_copy" and not to_device):
        _gpu()._copy(name, args[0], to_device=False)
    elif to_device:
        _refuse_mixture(name, args, tensors)
        if not _is_view(operation) and name not in _FREE:
            _gpu()._compute(name, args, kwargs)

    def on_device(result: Any) -> Any:
        if not isinstance(result, torch.Tensor):
            return result
        wrapper = wrappers[id(result)] if id(result) in wrappers else SimulatedTensor(result)
        if (wrapper.shape, wrapper.stride()) != (result.shape, result.stride()):  # it was changed in place
            wrapper.data = SimulatedTensor(result)
        return wrapper

    wrappers = {id(tensor.host): tensor for tensor in tensors if isinstance(tensor, SimulatedTensor)}
    if "device" in kwargs:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    results = operation(*tree_map(_on_host, args), **tree_map(_on_host, kwargs))
    return tree_map(on_device, results) if to_device else results


def _on_host(value: Any) -> Any:
    return value.host if isinstance(value, SimulatedTensor) else value


def _refuse_mixture(name: str, args: tuple, tensors: list[torch.Tensor]) -> None:
    """Refuse tensors of the CPU, but for single numbers and indices, as CUDA does."""
    if name in _INDEXING and isinstance(args[0], SimulatedTensor):
        tensors = [args[0], *args[2:3]]
    read_only = not name.endswith("_") or isinstance(args[0], SimulatedTensor)
    numbers_allowed = read_only and name not in ("cat", "stack")
    if not all(isinstance(tensor, SimulatedTensor) or (numbers_allowed and not tensor.dim()) for tensor in tensors):
        raise RuntimeError(
            f"Expected all tensors to be on the same device, but found at least two devices, {NAME} and cpu! ({name})"
        )


def _is_view(operation: Any) -> bool:
    aliases = [value.alias_info for value in operation._schema.returns]
    views = bool(aliases) and all(alias and not alias.is_write for alias in aliases)
    return views or torch.Tag.inplace_view in operation.tags


def _gpu() -> SimulatedGpu:
    if not _active:
        raise RuntimeError("a tensor of a simulated GPU is used outside of `with simulated_gpu()`")
    return _active[-1]


_active: list[SimulatedGpu] = []


@contextmanager
def simulated_gpu() -> Iterator[SimulatedGpu]:
    """Let there be a GPU that notes what it is asked to do."""
    _active.append(SimulatedGpu())
    try:
        yield _active[-1]
    finally:
        _active.pop()


def as_kernel(function: Callable) -> Callable:
    """A function of the CPU's tensors, as an operation of the device."""

    @functools.wraps(function)
    def launch(*args: Any, **kwargs: Any) -> Any:
        tensors = [value for value in tree_leaves((args, kwargs)) if isinstance(value, torch.Tensor)]
        if not all(isinstance(tensor, SimulatedTensor) for tensor in tensors):
            raise RuntimeError(f"{function.__name__} takes tensors on {NAME} and was given some of the cpu's")
        _gpu().operations.append(function.__name__)
        results = function(*tree_map(_on_host, args), **tree_map(_on_host, kwargs))
        return tree_map(lambda value: SimulatedTensor(value) if isinstance(value, torch.Tensor) else value, results)

    return launch


class _Guard(torch._C._acc.DeviceGuard):
    def type_(self) -> Any:
        return torch._C._autograd.DeviceType.PrivateUse1


def _empty(make: Callable[..., torch.Tensor]) -> Callable[..., SimulatedTensor]:
    return lambda *args, **kwargs: SimulatedTensor(make(*args, **{**kwargs, "device": "cpu"}))


def _copy_from(source: torch.Tensor, target: SimulatedTensor, non_blocking: bool = False) -> SimulatedTensor:
    """Copy to the device, for torch.tensor(), which goes past the wrappers."""
    _gpu()._copy("copy_", source, to_device=True, non_blocking=non_blocking)
    target.host.copy_(source)
    return target


# It stays while the process lives: torch cannot forget a device.
_answers = {"is_initialized": True, "_is_in_bad_fork": False, "manual_seed_all": None, "get_amp_supported_dtype": []}
torch._register_device_module(
    NAME, SimpleNamespace(**{name: lambda *_, answer=answer: answer for name, answer in _answers.items()})
)
torch._C._acc.register_python_privateuseone_device_guard(_Guard())
_library = torch.library.Library("aten", "IMPL")
_library.impl("empty.memory_format", _empty(torch.ops.aten.empty.memory_format), "PrivateUse1")
_library.impl("empty_strided", _empty(torch.ops.aten.empty_strided.default), "PrivateUse1")
_library.impl("_copy_from", _copy_from, "PrivateUse1")

"""A simulated GPU: CPU tensors that report the device `cuda:0` and cannot be combined with other CPU tensors.

Inside `simulated_gpu()`, each tensor created on or moved to the device `cuda` is a `GpuTensor`, a CPU tensor that
reports `cuda:0`. An operation on a GpuTensor and an ordinary CPU tensor raises RuntimeError, as with CUDA. The
conversion of a GpuTensor to a numpy array raises TypeError. The CPU rasterizer renders in place of gsplat. If the
machine has a GPU and gsplat with its compiled extension, nothing is simulated and the real GPU is used.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map

from reffusion.fit import view_loader
from reffusion.gaussians import adam, ssim
from reffusion.splat import cpu, cuda
from reffusion.types import Rendering

GPU_DEVICE = torch.device("cuda:0")
GPU_PROPERTIES = {torch.Tensor.device.__get__: GPU_DEVICE, torch.Tensor.is_cuda.__get__: True}
ONLY_ON_CPU = (torch.Tensor.numpy, torch.Tensor.__array__)
INDEXING = (torch.Tensor.__getitem__, torch.Tensor.__setitem__)


class GpuTensor(torch.Tensor):
    """A CPU tensor that reports the device `cuda:0`."""


def disguise(tensor: torch.Tensor) -> torch.Tensor:
    return tensor if isinstance(tensor, GpuTensor) else tensor.as_subclass(GpuTensor)


def undisguise(tensor: torch.Tensor) -> torch.Tensor:
    with torch._C.DisableTorchFunction():
        return tensor.as_subclass(torch.Tensor)


def _is_gpu(device: Any) -> bool:
    return isinstance(device, (str, torch.device)) and torch.device(device).type == "cuda"


class GpuMode(TorchFunctionMode):
    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
        here = bool(args) and isinstance(args[0], GpuTensor)
        if func in GPU_PROPERTIES and here:
            return GPU_PROPERTIES[func]
        with torch._C.DisableTorchFunctionSubclass():
            if func in (torch.Tensor.cpu, torch.Tensor.to, torch.Tensor.cuda):
                return self._moved(func, args, kwargs)
            if func in ONLY_ON_CPU and here:
                raise TypeError("can't convert cuda:0 device type tensor to numpy")
            to_gpu = _is_gpu(kwargs.get("device"))
            leaf = to_gpu and kwargs.pop("requires_grad", False)  # the GpuTensor must be the leaf, not the CPU tensor
            if to_gpu:
                kwargs.pop("device")
            on_gpu = any(isinstance(t, GpuTensor) for t in tensors)
            self._refuse_mixed(func, args, tensors)
            result = func(*args, **kwargs)
        if not (to_gpu or on_gpu) or func is torch.Tensor.as_subclass:
            return result
        output = tree_map(lambda each: disguise(each) if isinstance(each, torch.Tensor) else each, result)
        return output.requires_grad_() if leaf else output

    def _moved(self, func: Any, args: Any, kwargs: dict[str, Any]) -> torch.Tensor:
        tensor, *rest = args
        device = kwargs.pop("device", None)
        positional = [*rest]
        if rest and (isinstance(rest[0], (str, torch.device))):
            device = positional.pop(0)
        elif rest and isinstance(rest[0], torch.Tensor):  # to(other): dtype and device of the other tensor
            device, positional = (GPU_DEVICE if isinstance(rest[0], GpuTensor) else "cpu"), [rest[0].dtype, *rest[1:]]
        if func is not torch.Tensor.to:
            device, positional, kwargs = ("cpu" if func is torch.Tensor.cpu else GPU_DEVICE), [], {}
        on_gpu = isinstance(tensor, GpuTensor) if device is None else _is_gpu(device)
        moved = tensor.to(*positional, **kwargs) if positional or kwargs else tensor
        return disguise(moved) if on_gpu else moved.as_subclass(torch.Tensor)

    def _refuse_mixed(self, func: Any, args: Any, tensors: list[torch.Tensor]) -> None:
        if func is torch.Tensor.copy_:
            return
        if func in INDEXING and isinstance(args[0], GpuTensor):  # CUDA tensors accept indices on the CPU
            tensors = [args[0], *(leaf for leaf in tree_leaves(args[2:]) if isinstance(leaf, torch.Tensor))]
        kinds = {isinstance(t, GpuTensor) for t in tensors if t.ndim or isinstance(t, GpuTensor)}
        if len(kinds) > 1:
            raise RuntimeError(f"{getattr(func, '__name__', func)}: expected all tensors to be on the same device")


def has_gpu() -> bool:
    """Return whether the machine has a GPU, and gsplat with its compiled extension."""
    try:
        cuda.require_gpu(torch.zeros(1, device="cuda" if torch.cuda.is_available() else "cpu"))
    except ValueError:
        return False
    return True


@contextmanager
def simulated_gpu() -> Iterator[None]:
    """Open a context in which the device `cuda` works: the real GPU, or a simulation if the machine has none."""
    if has_gpu():
        yield
        return
    leave = lambda value: undisguise(value) if isinstance(value, torch.Tensor) else value
    enter = lambda value: disguise(value) if isinstance(value, torch.Tensor) else value

    def render(gaussians, camera, features, background, degree, probe):
        inputs = (leave(each) for each in (features, background))
        rendering = cpu.render(gaussians.map(leave), camera, *inputs, degree, leave(probe))
        return Rendering(*map(enter, rendering))

    def accumulate(gaussians, camera, values, count):
        return enter(cpu.accumulate(gaussians.map(leave), camera, leave(values), count))

    with pytest.MonkeyPatch.context() as patched, GpuMode():
        patched.setattr(cuda, "require_gpu", lambda means: None)
        patched.setattr(cuda, "render", render)
        patched.setattr(cuda, "accumulate", accumulate)
        patched.setattr(ssim, "triton_works", lambda: False)
        patched.setattr(adam, "triton_works", lambda: False)
        patched.setattr(view_loader, "ThreadPoolExecutor", partial(ThreadPoolExecutor, initializer=GpuMode().__enter__))
        yield

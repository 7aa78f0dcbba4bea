"""The number of samples per pass that fits into a memory budget, and the explanation of out-of-memory errors."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from reffusion.prior import diffusion
from reffusion.prior.model import Prior

USABLE_SHARE = 0.9  # of a budget; the rest is left for workspaces of kernels and fragmentation


class _TensorBytes(TorchDispatchMode):
    """A counter of the bytes of all live tensors that were created inside the context, and of their peak."""

    def __init__(self) -> None:
        super().__init__()
        self.current, self.peak = 0, 0
        self._known: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        inputs = {_address(leaf) for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)}
        result = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(result):
            if isinstance(leaf, Tensor) and (key := _address(leaf)) not in inputs and key not in self._known:
                storage = leaf.untyped_storage()
                self._known.add(key)
                self.current += storage.nbytes()
                weakref.finalize(storage, self._release, key, storage.nbytes())
        self.peak = max(self.peak, self.current)
        return result

    def _release(self, key: int, count: int) -> None:
        self._known.discard(key)
        self.current -= count


def _address(tensor: Tensor) -> int:
    return tensor.untyped_storage()._cdata


def peak_bytes(work: Callable[[], object], device: torch.device | str) -> int:
    """Return the peak memory in bytes of the tensors created by `work`, beyond the memory allocated before.

    On a GPU this is the count of the allocator. On other devices live tensors are counted, without the workspaces of
    kernels.
    """
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
        initial = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        work()
        torch.cuda.synchronize(device)
        return torch.cuda.max_memory_allocated(device) - initial
    with _TensorBytes() as tracker:
        work()
    return tracker.peak


def rows_within(budget_gb: float, fixed: int, row: int, param: str) -> int:
    """Return the number of samples that fit into a memory budget beside the weights.

    Args:
        budget_gb: The budget in GB (1e9 bytes), of which the share `USABLE_SHARE` is used.
        fixed: Bytes of the weights.
        row: Bytes of one sample.
        param: Name of the parameter that sets the budget, e.g. "distill.memory_gb".

    Raises:
        ValueError: Not even one sample fits. The message names `param` and other remedies.
    """
    count = int((USABLE_SHARE * budget_gb * 1e9 - fixed) // max(row, 1))
    if count < 1:
        stage = param.partition(".")[0]
        needed_gb = 1.01 * (fixed + row) / USABLE_SHARE / 1e9
        raise ValueError(
            f"{param} is {budget_gb:g}, but the prior takes {fixed / 1e9:.2g} GB and one sample {row / 1e9:.2g} GB: "
            f"raise it to {needed_gb:.3g}, or take half precision ({stage}.dtype) or recomputation (checkpointing)"
        )
    return count


def fit_to_memory(
    prior: Prior, budget_gb: float, param: str, backward: Callable[[Prior], object] | None = None
) -> Prior:
    """Return the prior with the number of samples per pass set to the number that fits into the budget.

    The memory of one sample is measured by running the networks.

    Args:
        prior: The diffusion prior.
        budget_gb: The budget in GB. With 0 the prior is returned unchanged.
        param: Name of the parameter that sets the budget.
        backward: Function of the prior that computes the loss and the gradient of one sample, whose memory determines
            `rows_with_grad`. The gradients in the networks are removed afterwards. None: `rows_with_grad` keeps its
            value.

    Raises:
        ValueError: As `rows_within`.
    """
    if not budget_gb:
        return prior
    rows = rows_within(budget_gb, prior.bytes, peak_bytes(lambda: inpaint_one_sample(prior), prior.device), param)
    if backward is None:
        return replace(prior, rows=rows)
    sample_bytes = peak_bytes(lambda: backward(prior), prior.device)
    for network in (prior.unet, prior.vae, prior.text_encoder, prior.text_encoder_2):
        if network is not None:
            network.zero_grad(set_to_none=True)
    return replace(prior, rows=rows, rows_with_grad=rows_within(budget_gb, prior.bytes, sample_bytes, param))


@torch.no_grad()
def inpaint_one_sample(prior: Prior) -> None:
    """Run the passes of inpainting for one sample: encoder, UNet, decoder."""
    size = prior.native_size
    config: Any = prior.unet.config
    latents = diffusion.encode(prior, torch.zeros(1, 3, size, size, device=prior.device))
    condition = torch.cat([latents[:, :1], latents], 1)
    timestep = torch.zeros(1, dtype=torch.long, device=prior.device)
    diffusion.raw_prediction(prior, latents, timestep, condition, latents.new_zeros(1, 78, config.cross_attention_dim))
    diffusion.decode(prior, latents)


def encode_one_sample(prior: Prior) -> None:
    """Run the pass of score distillation that needs a gradient, for one sample: the encoder, forward and backward."""
    size = prior.native_size
    image = torch.zeros(1, 3, size, size, device=prior.device, requires_grad=True)
    diffusion.encode(prior, image).sum().backward()


@contextmanager
def explain_oom(param: str, value: float) -> Iterator[None]:
    """Turn an out-of-memory error inside the context into a ValueError that names the parameter to lower.

    Args:
        param: Name of the parameter that sets the memory budget.
        value: Its present value in GB; 0 means no limit.
    """
    try:
        yield
    except (torch.OutOfMemoryError, RuntimeError) as error:
        text = str(error).lower()
        if not isinstance(error, torch.OutOfMemoryError) and "can't allocate memory" not in text:
            raise
        stage = param.partition(".")[0]
        current = f"{value:g}" if value else "0: no limit"
        advice = (
            f"lower {param} (now {current}), or take half precision ({stage}.dtype) or recomputation (checkpointing)"
        )
        raise ValueError(f"out of memory: {advice}") from error

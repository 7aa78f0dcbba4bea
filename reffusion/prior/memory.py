"""How many samples of a batch fit into a memory budget, measured on one; what to say where memory runs out."""

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

SPARE = 0.9  # part of a budget that is planned with: kernels have workspaces, allocators gaps


class _Living(TorchDispatchMode):
    """Counts the bytes of all tensors made inside it, as long as they live."""

    def __init__(self) -> None:
        super().__init__()
        self.now, self.most = 0, 0
        self._known: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given = {_address(leaf) for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)}
        result = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(result):
            if isinstance(leaf, Tensor) and (key := _address(leaf)) not in given and key not in self._known:
                storage = leaf.untyped_storage()
                self._known.add(key)
                self.now += storage.nbytes()
                weakref.finalize(storage, self._gone, key, storage.nbytes())
        self.most = max(self.most, self.now)
        return result

    def _gone(self, key: int, count: int) -> None:
        self._known.discard(key)
        self.now -= count


def _address(tensor: Tensor) -> int:
    return tensor.untyped_storage()._cdata


def peak_bytes(work: Callable[[], object], device: torch.device | str) -> int:
    """The most memory that tensors made within `work` take at any moment, beside what was there before.

    On a GPU its allocator's own count; elsewhere a count of the living tensors, workspaces inside kernels left out.
    """
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        work()
        torch.cuda.synchronize(device)
        return torch.cuda.max_memory_allocated(device) - before
    with _Living() as living:
        work()
    return living.most


def rows_within(budget_gb: float, fixed: int, row: int, param: str) -> int:
    """How many samples fit into a budget of GB (1e9 bytes) at `row` bytes each, beside `fixed` bytes of weights.

    Raises:
        ValueError: not one does; names `param` and what else would help.
    """
    count = int((SPARE * budget_gb * 1e9 - fixed) // max(row, 1))
    if count < 1:
        stage = param.partition(".")[0]
        need = 1.01 * (fixed + row) / SPARE / 1e9
        raise ValueError(
            f"{param} is {budget_gb:g}, but the prior takes {fixed / 1e9:.2g} GB and one sample {row / 1e9:.2g} GB: "
            f"raise it to {need:.3g}, or take half precision ({stage}.dtype) or recomputation (checkpointing)"
        )
    return count


def fitted(prior: Prior, budget_gb: float, param: str, graded: Callable[[Prior], object] | None = None) -> Prior:
    """The prior with as many samples in one pass as fit into the budget; as it is where that is 0.

    Args:
        graded: does for one sample what will be done with a gradient for many; what it leaves in `grad` is removed.
    Raises ValueError as `rows_within`.
    """
    if not budget_gb:
        return prior
    rows = rows_within(budget_gb, prior.bytes, peak_bytes(lambda: answering(prior), prior.device), param)
    if graded is None:
        return replace(prior, rows=rows)
    one = peak_bytes(lambda: graded(prior), prior.device)
    for network in (prior.unet, prior.vae, prior.text_encoder):
        if network is not None:
            network.zero_grad(set_to_none=True)
    return replace(prior, rows=rows, rows_graded=rows_within(budget_gb, prior.bytes, one, param))


@torch.no_grad()
def answering(prior: Prior) -> None:
    """What inpainting does with one sample: encode, ask the UNet, decode."""
    size, wide = prior.native_size, prior.unet.config.cross_attention_dim
    latents = diffusion.encode(prior, torch.zeros(1, 3, size, size, device=prior.device))
    condition = torch.cat([latents[:, :1], latents], 1)
    at = torch.zeros(1, dtype=torch.long, device=prior.device)
    diffusion.raw_prediction(prior, latents, at, condition, latents.new_zeros(1, 78, wide))
    diffusion.decode(prior, latents)


def encoding(prior: Prior) -> None:
    """What score distillation does with a gradient for one sample: encode it."""
    size = prior.native_size
    image = torch.zeros(1, 3, size, size, device=prior.device, requires_grad=True)
    diffusion.encode(prior, image).sum().backward()


@contextmanager
def blamed(param: str, value: float) -> Iterator[None]:
    """Where memory runs out inside, a ValueError that names the parameter by which less of it would be taken."""
    try:
        yield
    except (torch.OutOfMemoryError, RuntimeError) as error:
        text = str(error).lower()
        if not isinstance(error, torch.OutOfMemoryError) and "can't allocate memory" not in text:
            raise
        stage = param.partition(".")[0]
        now = f"{value:g}" if value else "0: no limit"
        cure = f"lower {param} (now {now}), or take half precision ({stage}.dtype) or recomputation (checkpointing)"
        raise ValueError(f"out of memory: {cure}") from error

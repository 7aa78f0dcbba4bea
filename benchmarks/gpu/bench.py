"""Shared by the parts of gpu-check: sizes, scene, prior, and the clock."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.gpu import full_size
from reffusion.params.distill import AdversarialTerm
from reffusion.prior import memory
from reffusion.prior.model import Prior, load_prior
from reffusion.seeding import generator
from reffusion.types import Gaussians
from reffusion.weights import local, published


@dataclass(frozen=True)
class Sizes:
    """Sizes of what is measured: rows of a view (a quarter wider), Gaussians, samples, steps and views of the fit."""

    rows: int
    gaussians: int
    batch: int
    fit_steps: int
    views: int
    repeats: int
    critic: AdversarialTerm
    shape: full_size.Shape
    oracle: tuple[int, int] = (400, 200)  # Gaussians and image width of the comparison with the oracle


PAPER = Sizes(1280, 500_000, 16, 400, 12, 3, AdversarialTerm(), full_size.SD2)  # 1600 x 1280 px
TOY = Sizes(
    40, 300, 2, 4, 3, 1, AdversarialTerm(patches=8, size=8, width=8), full_size.shrink(full_size.SD2), (100, 70)
)


@dataclass
class Bench:
    """Device and sizes of the parts, and the last prior, which the next part may need again.

    Attributes:
        sizes: of what is measured.
        device: "cuda" or "cpu".
        out: folder for files of a part.
    """

    sizes: Sizes
    device: str
    out: Path
    _prior: tuple[str, Prior, str] | None = field(default=None, repr=False)

    def prior(self, half: str) -> tuple[Prior, str]:
        """(prior, source): in that precision on a GPU, else float32; published weights if present, else random ones."""
        if self._prior is None or self._prior[0] != half:
            self._prior = None
            gc.collect()
            dtype, shape = getattr(torch, half if self.device == "cuda" else "float32"), self.sizes.shape
            if shape == full_size.SD2 and local.locate(published.SD2) is not None:
                self._prior = half, load_prior(published.SD2, self.device, dtype), published.SD2
            else:
                self._prior = half, full_size.build_prior(shape, dtype, self.device), "random"
        return self._prior[1], self._prior[2]

    def forget_prior(self) -> None:
        self._prior = None

    def scene(self) -> tuple[Gaussians, Tensor]:
        """Gaussians that fill the view, and labels."""
        gaussians = full_size.gaussians(self.sizes.gaussians, self.device)
        masked = torch.rand(len(gaussians), generator=generator(0, "labels")) < 0.1
        return gaussians, masked.to(self.device)

    def measure(self, work: Callable[[], dict[str, float] | None]) -> dict[str, Any]:
        """Median seconds after a warm-up, peak memory of the GPU (or of live tensors), and the values of `work`."""
        values, seconds = work() or {}, []
        for _ in range(self.sizes.repeats):
            self._wait()
            began = time.perf_counter()
            work()
            self._wait()
            seconds.append(time.perf_counter() - began)
        peak = memory.peak_bytes(work, self.device)
        result = {"seconds": float(np.median(seconds)), "peak_gb": peak / 1e9}
        if self.device == "cuda":
            result["peak_gb"] += torch.cuda.memory_allocated() / 1e9
            result["reserved_gb"] = torch.cuda.max_memory_reserved() / 1e9
        return result | values

    def _wait(self) -> None:
        if self.device == "cuda":
            torch.cuda.synchronize()

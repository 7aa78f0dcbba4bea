"""Helpers shared by the parts of gpu-check: sizes, scene, prior, and measurement of time and memory."""

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

from lab.gpu import full_size, random_priors
from reffusion.params.distill import AdversarialTerm
from reffusion.prior import memory
from reffusion.prior.model import Prior, load_prior
from reffusion.seeding import generator
from reffusion.types import Gaussians
from reffusion.weights import local, published


@dataclass(frozen=True)
class Sizes:
    """Sizes of the measured computations.

    Attributes:
        rows: height of a view, px; the width is a quarter larger.
        gaussians: number of Gaussians.
        batch: samples of a personalization step.
        fit_steps: steps of the fit.
        views: views of the fit.
        repeats: number of timed repetitions.
        critic: parameters of the adversarial term.
        shape: configuration of the prior.
        oracle: number of Gaussians and image width in px for comparisons with the oracle.
    """

    rows: int
    gaussians: int
    batch: int
    fit_steps: int
    views: int
    repeats: int
    critic: AdversarialTerm
    shape: random_priors.Shape
    oracle: tuple[int, int] = (400, 200)


PAPER = Sizes(1280, 500_000, 16, 400, 12, 3, AdversarialTerm(), random_priors.SD2)  # 1600 x 1280 px
TOY = Sizes(
    40, 300, 2, 4, 3, 1, AdversarialTerm(patches=8, size=8, width=8), random_priors.shrink(random_priors.SD2), (100, 70)
)


@dataclass
class Bench:
    """Device and sizes of all parts. It also keeps the last prior, which the next part may need again.

    Attributes:
        sizes: sizes of the computations.
        device: "cuda" or "cpu".
        out: folder for files of a part.
    """

    sizes: Sizes
    device: str
    out: Path
    _prior: tuple[str, Prior, str] | None = field(default=None, repr=False)

    def prior(self, half: str) -> tuple[Prior, str]:
        """Return the prior and the source of its weights: the name of the published ones, or "random".

        The published weights are used if they are on this machine, else random ones of the same shapes.

        Args:
            half: dtype on a GPU, "float16" or "bfloat16"; on the CPU the prior is in float32.
        """
        if self._prior is None or self._prior[0] != half:
            self._prior = None
            gc.collect()
            dtype, shape = getattr(torch, half if self.device == "cuda" else "float32"), self.sizes.shape
            if shape == random_priors.SD2 and local.locate(published.SD2) is not None:
                self._prior = half, load_prior(published.SD2, self.device, dtype), published.SD2
            else:
                self._prior = half, random_priors.build_prior(shape, dtype, self.device), "random"
        return self._prior[1], self._prior[2]

    def forget_prior(self) -> None:
        """Drop the kept prior, to free its memory or because a part has changed it."""
        self._prior = None

    def scene(self) -> tuple[Gaussians, Tensor]:
        """Make random Gaussians that fill the view, and random labels, bool [N], about a tenth True (masked)."""
        gaussians = full_size.gaussians(self.sizes.gaussians, self.device)
        masked = torch.rand(len(gaussians), generator=generator(0, "labels")) < 0.1
        return gaussians, masked.to(self.device)

    def measure(self, work: Callable[[], dict[str, float] | None]) -> dict[str, Any]:
        """Measure the time and memory of `work`, after a warm-up call. `work` is called `sizes.repeats` + 2 times.

        Returns:
            "seconds": median wall time of a call. "peak_gb": on a GPU, peak of all allocated memory; on the CPU, peak
            of the live tensors that a call creates. On a GPU, "reserved_gb": peak of the memory that torch reserved.
            And the values that `work` returns in its first call.
        """
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

"""Diagrams of the rasterizer in float32 against the oracle, the plain torch implementation in float64.

They vary the size of footprints and the cut-off of faint contributions.
"""

from __future__ import annotations

import numpy as np
import torch

from lab.bench.points import Diagram, Point, cpu_seconds
from reffusion.splat import pure_torch, rasterizer
from reffusion.types import PARAMETERS, Camera, Gaussians

VIEW = Camera("bench", 96, 72, 100.0, 100.0, 48.0, 36.0, np.eye(4))
FOOTPRINTS = (0.3, 1.0, 3.0, 10.0, 30.0)  # standard deviation, px
CUTOFFS = (1 / 2048, 1 / 1024, 1 / 512, 1 / 255, 1 / 128, 1 / 64, 1 / 32)  # alpha below which contributions are skipped
LAYERS = 20  # approximate number of opaque layers over a pixel


def scene(sigma: float, seed: int = 0) -> Gaussians:
    """Make random Gaussians all over the frustum of `VIEW`, in float64.

    Args:
        sigma: typical standard deviation of the footprints, px.
        seed: seed.
    """
    draw = torch.Generator().manual_seed(seed)
    count = int(np.clip(LAYERS * VIEW.width * VIEW.height / (2 * np.pi * max(sigma, 1.0) ** 2), 40, 1500))
    uniform = lambda *shape: torch.rand(*shape, generator=draw, dtype=torch.float64)
    normal = lambda *shape: torch.randn(*shape, generator=draw, dtype=torch.float64)
    depth = 1.5 + 5 * uniform(count)
    place = (1.1 * uniform(count, 2) - 0.55) * torch.tensor([VIEW.width, VIEW.height])
    return Gaussians(
        means=torch.cat((place * depth[:, None] / VIEW.fx, depth[:, None]), 1),
        quaternions=normal(count, 4),
        log_scales=torch.log(sigma * depth / VIEW.fx)[:, None] + 0.5 * normal(count, 3),
        opacity_logits=1.5 * normal(count),
        sh=torch.cat((0.5 * normal(count, 1, 3), 0.1 * normal(count, 8, 3)), 1),
    ).map(lambda p: p.float().double())  # exactly representable in float32


def step(gaussians: Gaussians, impl: str) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Render the Gaussians with an implementation of the rasterizer, forward and backward.

    Returns:
        The colors [H, W, 3], and the gradients of a fixed linear function of the colors with respect to each of
        `PARAMETERS`.
    """
    leaves = gaussians.map(lambda p: p.detach().clone().requires_grad_())
    color = rasterizer.render(leaves, VIEW, impl=impl).color
    rows, columns = torch.meshgrid(torch.arange(VIEW.height), torch.arange(VIEW.width), indexing="ij")
    pattern = torch.sin(0.3 * rows + 0.2 * columns).to(color)[..., None]
    gradients = torch.autograd.grad((pattern * color).sum(), [getattr(leaves, name) for name in PARAMETERS])
    return color.detach(), list(gradients)


def relative(value: torch.Tensor, truth: torch.Tensor) -> float:
    """Return the L2 norm of a tensor's difference from the truth, relative to the norm of the truth."""
    return float((value.double() - truth).norm() / truth.norm())


def errors(gaussians: Gaussians) -> tuple[float, float]:
    """Return relative L2 errors of the float32 rasterizer: of the image, and the largest of all parameters' gradients.

    The truth is the pure-torch rasterizer in float64.
    """
    (picture, slopes), (color, gradients) = step(gaussians.map(torch.Tensor.float), "cpu"), step(gaussians, "torch")
    return relative(picture, color), max(relative(a, b) for a, b in zip(slopes, gradients, strict=True))


def footprint_diagram() -> Diagram:
    """Measure the rasterizer by the size of footprints: the errors of `errors`, and the CPU time of a `step`."""
    points = []
    for sigma in FOOTPRINTS:
        single = scene(sigma).map(torch.Tensor.float)
        seconds = cpu_seconds(lambda single=single: step(single, "cpu"), repeats=5)
        # The median of three scenes, because in rare cases a contribution near 1/255 is skipped in only one precision.
        image, worst = np.median([errors(scene(sigma, seed)) for seed in range(3)], 0).tolist()
        points.append(Point("image", f"{sigma:g} px", sigma, image, seconds))
        points.append(Point("worst gradient", f"{sigma:g} px", sigma, worst, seconds))
    return Diagram(
        "footprint",
        f"Rasterizer float32 against the float64 oracle, {VIEW.width}x{VIEW.height}, by footprint",
        "relative L2 error",
        None,
        points,
        tolerance=1.5,  # rounding: another vector length sums in another order
        over="footprint, px",
        why="Required are 2e-5 for ordinary scenes and 1e-3 for extreme ones.",
    )


def cutoff_diagram() -> Diagram:
    """Measure the effect of skipping faint contributions, in the oracle.

    The errors are the relative L2 errors of the image and of the worst gradient against practically no cut-off. The
    seconds are not measured: they are the number of blended pixel-Gaussian pairs times a time per pair.
    """
    gaussians, original = scene(3.0), pure_torch.MIN_ALPHA
    draw = lambda: step(gaussians, "torch")
    ones = torch.ones(VIEW.height, VIEW.width, 1, dtype=torch.float64)
    pairs = lambda: float(rasterizer.accumulate(gaussians, VIEW, ones,
                                           impl="torch", count=True).sum())  # fmt: skip
    points = []
    try:
        pure_torch.MIN_ALPHA = 1e-12
        color, gradients = draw()
        for cutoff in CUTOFFS:
            pure_torch.MIN_ALPHA = cutoff
            picture, slopes = draw()
            # Seconds per pair, docs/method.md#splatting. The oracle cannot be timed, as its time does not depend on the
            # cut-off.
            per_pair = 4.2e-9
            seconds, name = per_pair * pairs(), f"1/{1 / cutoff:.0f}"
            worst = max(relative(a, b) for a, b in zip(slopes, gradients, strict=True))
            points.append(Point("image", name, cutoff, relative(picture, color), seconds))
            points.append(Point("worst gradient", name, cutoff, worst, seconds, False))
    finally:
        pure_torch.MIN_ALPHA = original
    return Diagram(
        "cutoff",
        "Cut-off of faint contributions, float64, footprints of 3 px (work: pairs that blend x 4.2 ns)",
        "relative L2 error against no cut-off",
        ("image", "1/255"),
        points,
        why="Kept at 1/255, under half a level of 8 bits, as in 3DGS, with which scenes are exchanged.",
    )

"""gsplat and SSIM on a device against float64 on the CPU: every output and every gradient."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.gpu import full_size
from benchmarks.gpu.bench import Bench
from reffusion.gaussians.ssim import dssim, dssim_torch
from reffusion.seeding import generator
from reffusion.splat import rasterizer
from reffusion.types import PARAMETERS, Camera, Gaussians

# Relative errors. Emulated in float32, gsplat's formulas err by 4e-7 in values and 2e-6 in gradients; its fast
# exponential may add 8 units in the last place, 1e-6. The bounds are ten and fifty times that; errors of method are far
# above.
VALUES, GRADIENTS = 1e-5, 1e-4
# A contribution that falls on the other side of 1/255 in float32 changes a pixel by as much, which is no error.
FLIPPED = 1e-4  # share of the pixels that may differ by more
COUNTED = 1e-3  # allowed relative change of the numbers of blended pixels by these


def render_with_gradients(
    bench: Bench, scene: Gaussians, camera: Camera, impl: str, dtype: torch.dtype
) -> dict[str, Tensor]:
    """Images, sums of weights and counts of one implementation, and the gradients of a random sum over its images."""
    device = "cpu" if impl == "torch" else bench.device
    place = lambda tensor: tensor.detach().to(device, dtype).clone().requires_grad_()
    leaf = scene.map(place)
    draw = generator(0, "pull")
    random = lambda *shape: torch.rand(*shape, generator=draw).to(device, dtype)
    features, background = place(random(len(scene), 3)), place(torch.tensor([0.2, 0.3, 0.4]))
    probe = place(torch.zeros(len(scene), 2))
    picture = rasterizer.render(leaf, camera, features=features, background=background, probe=probe, impl=impl)
    images = {name: getattr(picture, name) for name in ("color", "depth", "alpha", "features")}
    loss = sum((image * random(*image.shape)).sum() for image in images.values())
    names = (*PARAMETERS, "features", "background", "probe")
    leaves = (*(getattr(leaf, name) for name in PARAMETERS), features, background, probe)
    slopes = torch.autograd.grad(loss, leaves)
    results = {name: image.detach() for name, image in images.items()}
    results |= {f"gradient of {name}": slope for name, slope in zip(names, slopes, strict=True)}
    values, still = random(camera.height, camera.width, 2), leaf.map(Tensor.detach)
    results["weights"] = rasterizer.accumulate(still, camera, values, impl=impl)
    results["counts"] = rasterizer.accumulate(still, camera, torch.ones_like(values), impl=impl, count=True)
    return {name: tensor.cpu().double() for name, tensor in results.items()}


def compare_blocks(results: dict[str, Tensor], truth: dict[str, Tensor]) -> dict[str, Any]:
    """Relative errors: of images the one that only `FLIPPED` of the values exceed, over the maximum; else by norm."""
    errors, limits = {}, {}
    for name, true in truth.items():
        difference = (results[name] - true).abs()
        if name in ("color", "depth", "alpha", "features"):
            nearly_all = difference.flatten().sort().values[int((1 - FLIPPED) * (difference.numel() - 1))]
            errors[name], limits[name] = float(nearly_all / true.abs().max().clamp_min(1e-12)), VALUES
        else:
            errors[name] = float(difference.norm() / true.norm().clamp_min(1e-12))
            limits[name] = COUNTED if name == "counts" else GRADIENTS
    beyond = [name for name, error in errors.items() if not error <= limits[name]]
    return {"errors": errors, "ok": not beyond} | ({"beyond": ", ".join(beyond)} if beyond else {})


def check_splatting(bench: Bench, antialiased: bool = False, crop: bool = False) -> dict[str, Any]:
    count, width = bench.sizes.oracle
    height = width * 4 // 5
    camera = Camera("oracle", width, height, width, width, width / 2, height / 2, np.eye(4))
    camera = camera.cropped(width // 3, height // 4, width // 3, height // 3) if crop else camera
    scene = replace(full_size.gaussians(count, "cpu").map(Tensor.detach), antialiased=antialiased)
    impl = "cuda" if bench.device == "cuda" else "cpu"
    results = render_with_gradients(bench, scene, camera, impl, torch.float32)
    return compare_blocks(results, render_with_gradients(bench, scene, camera, "torch", torch.float64))


def check_similarity(bench: Bench) -> dict[str, Any]:
    """D-SSIM and its gradient in float32 on the device against float64; TF32 would err by a tenth."""
    draw, size = generator(0, "ssim"), bench.sizes.oracle[1]
    image, other = (torch.rand(size, size, 3, generator=draw, dtype=torch.float64) for _ in range(2))
    image, other = 0.5 + 0.1 * image, 0.5 + 0.1 * other  # low contrast loses most digits in the subtraction
    weights = torch.rand(size, size, generator=draw, dtype=torch.float64) > 0.3

    def evaluate(loss, dtype: torch.dtype, device: str) -> dict[str, Tensor]:
        leaf = image.to(device, dtype).requires_grad_()
        value = loss(leaf, other.to(device, dtype), weights.to(device, dtype))
        (slope,) = torch.autograd.grad(value, leaf)
        return {"value": value.detach().cpu().double(), "gradient": slope.cpu().double()}

    return compare_blocks(evaluate(dssim, torch.float32, bench.device), evaluate(dssim_torch, torch.float64, "cpu"))

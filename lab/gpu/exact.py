"""Comparison of the rasterizer and SSIM on a device with float64 on the CPU: all outputs and all gradients.

The rasterizer is gsplat on a GPU, and the compiled one on the CPU. The *oracle* is the plain torch implementation in
float64.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lab.gpu import full_size
from lab.gpu.bench import Bench
from reffusion.gaussians.ssim import dssim, dssim_torch
from reffusion.seeding import generator
from reffusion.splat import rasterizer
from reffusion.types import PARAMETERS, Camera, Gaussians

# Bounds of relative errors. Emulated in float32, gsplat's formulas have errors of 4e-7 in values and 2e-6 in gradients;
# gsplat's fast exponential may add 8 units in the last place, 1e-6. The bounds are ten and fifty times as large. Errors
# of a wrong formula would be far above.
VALUES, GRADIENTS = 1e-5, 1e-4
# A contribution near the cut-off 1/255 may be skipped in only one precision. The pixel then differs by up to 1/255,
# which is not an error.
FLIPPED = 1e-4  # share of the pixels that may differ by more than `VALUES`
COUNTED = 1e-3  # allowed relative change of the numbers of blended pixels for the same reason


def render_with_gradients(
    bench: Bench, scene: Gaussians, camera: Camera, impl: str, dtype: torch.dtype
) -> dict[str, Tensor]:
    """Render a scene with one implementation of the rasterizer, forward and backward.

    Args:
        bench: device and sizes.
        scene: the Gaussians.
        camera: the view.
        impl: implementation, "cuda", "cpu" or "torch"; "torch" runs on the CPU.
        dtype: precision.

    Returns:
        Tensors on the CPU in float64: the images "color", "depth", "alpha" and "features"; "gradient of <input>", the
        gradients of a fixed random linear function of the images; "weights" [N, 2], for each Gaussian the sums of
        random values of pixels times blending weights; and "counts" [N, 2], for each Gaussian the number of blended
        pixels, twice.
    """
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
    """Compare results with the truth and return their relative errors.

    The error of an image is the absolute difference that only the share `FLIPPED` of the values exceeds, relative to
    the largest absolute value of the true image. The error of any other result is the L2 norm of its difference,
    relative to the norm of the truth.

    Returns:
        "errors": name -> relative error; "ok": True if all errors are within their bounds; "beyond": names of those
        that are not, if any.
    """
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
    """Compare the rasterizer in float32 with the oracle.

    Args:
        bench: device and sizes.
        antialiased: True renders with the 2D filter of Mip-Splatting.
        crop: True renders a part of the image only.

    Returns:
        As `compare_blocks`.
    """
    count, width = bench.sizes.oracle
    height = width * 4 // 5
    camera = Camera("oracle", width, height, width, width, width / 2, height / 2, np.eye(4))
    camera = camera.cropped(width // 3, height // 4, width // 3, height // 3) if crop else camera
    scene = replace(full_size.gaussians(count, "cpu").map(Tensor.detach), antialiased=antialiased)
    impl = "cuda" if bench.device == "cuda" else "cpu"
    results = render_with_gradients(bench, scene, camera, impl, torch.float32)
    return compare_blocks(results, render_with_gradients(bench, scene, camera, "torch", torch.float64))


def check_similarity(bench: Bench) -> dict[str, Any]:
    """Compare D-SSIM and its gradient in float32 on the device with float64 on the CPU, as `compare_blocks` does.

    With TF32 the error would be a tenth.
    """
    draw, size = generator(0, "ssim"), bench.sizes.oracle[1]
    image, other = (torch.rand(size, size, 3, generator=draw, dtype=torch.float64) for _ in range(2))
    image, other = 0.5 + 0.1 * image, 0.5 + 0.1 * other  # with low contrast, subtractions lose most digits
    weights = torch.rand(size, size, generator=draw, dtype=torch.float64) > 0.3

    def evaluate(loss, dtype: torch.dtype, device: str) -> dict[str, Tensor]:
        leaf = image.to(device, dtype).requires_grad_()
        value = loss(leaf, other.to(device, dtype), weights.to(device, dtype))
        (slope,) = torch.autograd.grad(value, leaf)
        return {"value": value.detach().cpu().double(), "gradient": slope.cpu().double()}

    return compare_blocks(evaluate(dssim, torch.float32, bench.device), evaluate(dssim_torch, torch.float64, "cpu"))

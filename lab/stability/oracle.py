"""Comparison of the compiled rasterizer ("cpu", float32) with an oracle, the plain torch implementation in float64.

A cut-off (alpha below 1/255, a pixel whose transmittance is used up) is a discontinuity. If float32 and float64 decide
differently there, the difference says nothing about accuracy. So the oracle uses the kernel's decisions about which
Gaussian is blended into which pixel, and sorts by depth in float32, as the kernel does. Everything else is float64. A
*block* is one image, or the gradient with respect to one input.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from reffusion.splat import pure_torch, rasterizer
from reffusion.splat.conventions import MAX_ALPHA
from reffusion.types import PARAMETERS, Camera, Gaussians

BLOCKS = (*PARAMETERS, "features", "background", "probe")  # inputs with gradients
IMAGES = ("color", "depth", "alpha", "features")
CHANNELS = 2  # channels of the features
EPSILON = 2.0**-24  # relative error of one rounding to float32


class Rendered(NamedTuple):
    """Images of an implementation, and the gradients of a fixed random linear function of these images.

    Attributes:
        images: name in `IMAGES` -> [H, W, ...].
        gradients: name in `BLOCKS` -> gradient.
        radii: [N] int32, radii of the footprints, px; 0 for culled Gaussians.
    """

    images: Mapping[str, Tensor]
    gradients: Mapping[str, Tensor]
    radii: Tensor


def render_with_gradients(gaussians: Gaussians, camera: Camera, impl: str, seed: int = 0, far: float = 1.0) -> Rendered:
    """Render Gaussians and compute the gradients of a fixed random linear function of the images.

    Args:
        gaussians: the Gaussians.
        camera: the view.
        impl: "cpu" for the compiled rasterizer in float32, "torch" for the oracle in float64.
        seed: seed of features, background and linear function.
        far: unit of depth in the linear function.

    Returns:
        Images and gradients in the dtype of the implementation.
    """
    dtype = torch.float32 if impl == "cpu" else torch.float64
    random = torch.Generator().manual_seed(seed)
    normal = lambda *shape: torch.randn(*shape, generator=random).to(dtype)
    leaf = lambda tensor: tensor.detach().to(dtype).clone().requires_grad_()
    count, blended = len(gaussians), None if impl == "cpu" else blended_pixels(gaussians, camera)
    gaussians = gaussians.map(leaf)
    features, background, probe = leaf(normal(count, CHANNELS)), leaf(normal(3)), leaf(torch.zeros(count, 2))
    extras = {"features": features, "background": background, "probe": probe}
    if impl == "cpu":
        rendering = rasterizer.render(gaussians, camera, impl="cpu", **extras)
        images, radii = {name: getattr(rendering, name) for name in IMAGES}, rendering.radii
    else:
        images, radii = _render_reference(blended, gaussians, camera, **extras)
    units = {"depth": far}
    loss = sum((image * normal(*image.shape)).sum() / units.get(name, 1.0) for name, image in images.items())
    leaves = [*(getattr(gaussians, name) for name in PARAMETERS), features, background, probe]
    slopes = torch.autograd.grad(loss, leaves, allow_unused=True)
    gradients = {n: torch.zeros_like(x) if g is None else g for n, x, g in zip(BLOCKS, leaves, slopes, strict=True)}
    return Rendered({name: image.detach() for name, image in images.items()}, gradients, radii)


def blended_pixels(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Return bool [H * W, N], True where the compiled kernel blends a Gaussian into a pixel. For small images only."""
    pixels = camera.width * camera.height
    each = torch.eye(pixels).reshape(camera.height, camera.width, pixels)
    return rasterizer.accumulate(gaussians, camera, each, impl="cpu", count=True).T > 0


def _render_reference(blended: Tensor, gaussians: Gaussians, camera: Camera, features, background, probe):
    """Render in float64 with the cut-offs of `blended_pixels`; return the images by name, and the radii."""
    projected, radii = pure_torch.project(gaussians, camera, probe)
    again = torch.sort(projected.depths.float(), stable=True).indices  # equal depths by index
    projected = pure_torch.Projected(*(array[again] for array in projected))
    order = projected.order
    columns, rows = torch.meshgrid(torch.arange(camera.width), torch.arange(camera.height), indexing="xy")
    dx, dy = (torch.stack((columns, rows), -1).reshape(-1, 1, 2) + 0.5 - projected.means).unbind(2)
    _, xy, yy = projected.covariances.unbind(1)
    distance = dy.square() / yy + (dx - xy / yy * dy).square() * (yy / projected.determinants)
    alpha = torch.clamp_max(projected.opacities * torch.exp(-0.5 * distance), MAX_ALPHA) * blended[:, order]
    after = torch.cumprod(1 - alpha, 1)
    weights = alpha * torch.cat((torch.ones_like(after[:, :1]), after), 1)[:, :-1]
    behind = after[:, -1:] if len(order) else torch.ones_like(dx.sum(1, keepdim=True))
    layers = (pure_torch.colors(gaussians, camera, gaussians.sh_degree)[order], projected.depths[:, None])
    image = weights @ torch.cat((*layers, features[order]), 1)
    covered = weights.sum(1)
    shaped = lambda array: array.reshape(camera.height, camera.width, *array.shape[1:])
    depth = torch.where(covered > 0, image[:, 3], 0) / torch.where(covered > 0, covered, 1)
    color = image[:, :3] + behind * background
    return dict(zip(IMAGES, map(shaped, (color, depth, covered, image[:, 4:])), strict=True)), radii


FLOOR = {"values": 1e-6, "gradients": 1e-5}
"""Absolute errors that do not count. A gradient is a sum over up to 200 pixels of 8 channels. Each term is of order one
(upstream gradients are standard normal) and is rounded about ten times, so the errors add up, as a random walk, to
10 * 2^-24 * sqrt(1600) = 2e-5 in the worst case. A value is a sum over the Gaussians of one pixel only."""


def errors(gaussians: Gaussians, camera: Camera, relative: float, seed: int = 0) -> dict[str, float]:
    """Return the relative L2 errors of the compiled rasterizer, |kernel - oracle| / (|oracle| + floor / relative).

    The floor is in `FLOOR`. An error of at most `relative` means |kernel - oracle| <= relative * |oracle| + floor.
    Gradients of quaternions are multiplied by the quaternions' lengths. They are then gradients of rotations; otherwise
    the gradient of the shortest quaternion would dominate.

    Args:
        gaussians: the Gaussians.
        camera: the view.
        relative: bound of the relative error.
        seed: seed of the random inputs.

    Returns:
        Name of an image or "gradient of <input>" -> error. If the radii differ, only {"radii": infinity}.
    """
    # Depth is in units of the farthest depth, so that the terms of all sums are of order one, as `FLOOR` assumes.
    far = max(1.0, rasterizer.render(gaussians, camera, impl="cpu").depth.max().item())
    fast, exact = (render_with_gradients(gaussians, camera, impl, seed, far) for impl in ("cpu", "torch"))
    if not torch.equal(fast.radii, exact.radii):
        return {"radii": float("inf")}
    lengths = gaussians.quaternions.double().norm(dim=1, keepdim=True)
    by_name = {}
    for kind, actual, expected in (
        ("values", fast.images, exact.images),
        ("gradients", *_scale_quaternions(fast, exact, lengths)),
    ):
        for name in expected:
            error = (actual[name].double() - expected[name]).norm().item()
            label = name if kind == "values" else f"gradient of {name}"
            by_name[label] = error / (expected[name].norm().item() + FLOOR[kind] / relative)
    return by_name


def _scale_quaternions(fast: Rendered, exact: Rendered, lengths: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return the gradients of both renderings, with those of quaternions multiplied by the quaternions' lengths."""
    turn = lambda blocks: {**blocks, "quaternions": blocks["quaternions"].double() * lengths}
    return turn(fast.gradients), turn(exact.gradients)


def worst_error(gaussians: Gaussians, camera: Camera, relative: float) -> float:
    """Return the largest of the relative errors from `errors`, or infinity if an error is NaN."""
    values = errors(gaussians, camera, relative).values()
    return max(error if error == error else float("inf") for error in values)

"""D-SSIM and Adam on CUDA as Triton kernels, each in a few passes over memory (Triton comes with torch's CUDA builds).

In plain torch the windows of SSIM and the gathering of visible rows (one row per Gaussian) for Adam take three quarters
of a step of `fit` on a GPU (docs/gpu.md). The formulas are those of `gaussians.ssim` and `gaussians.adam`.

The kernels of D-SSIM hold a picture [H, W, C] as H * W * C consecutive numbers: a pixel to the right is C numbers away,
a row below is W * C numbers away. Arguments with the same meaning everywhere: `count` is H * W * C, `row` is W * C,
`BLOCK` the numbers per program, `RADIUS` half the window, `WEIGHTED` False if there are no weights.
"""

from __future__ import annotations

import sys

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

_BLOCK = 1024  # elements per program of a kernel


def works() -> bool:
    """Return whether the kernels can be compiled and run on this machine's GPU. If not, the reason goes to stderr."""
    try:
        probe = torch.zeros(4, 4, 1, device="cuda")
        dssim_and_gradient(probe, probe, None, np.ones(1), (1.0, 1.0))
    except Exception as error:  # the compiler of Triton and the driver raise many types
        reason = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
        print(f"Triton does not work here ({reason}): SSIM and Adam take plain torch, slower", file=sys.stderr)
        return False
    return True


class Dssim(torch.autograd.Function):
    """Autograd function of `gaussians.ssim.dssim` for float32 on CUDA; arguments as for `dssim_and_gradient`."""

    @staticmethod
    def forward(ctx, image: Tensor, target: Tensor, weights: Tensor | None, taps: np.ndarray, constants) -> Tensor:
        value, ctx.gradient = dssim_and_gradient(image, target, weights, taps, constants)
        return value

    @staticmethod
    def backward(ctx, upstream: Tensor):
        return ctx.gradient * upstream, None, None, None, None


@torch.no_grad()
def dssim_and_gradient(
    image: Tensor, target: Tensor, weights: Tensor | None, window: np.ndarray, constants: tuple[float, float]
) -> tuple[Tensor, Tensor]:
    """Compute the mean of weights * (1 - SSIM) over pixels and channels, and its gradient with respect to the image.

    Args:
        image, target: [H, W, C] float32 in [0, 1].
        weights: [H, W] float32, or None for weights of 1. Pixels of weight 0 must be finite.
        window: [2 R + 1], the taps of the window along one axis.
        constants: C1 and C2 of SSIM.

    Returns:
        The mean, a scalar, and the gradient [H, W, C].
    """
    channels, count, row = image.shape[2], image.numel(), image.shape[1] * image.shape[2]
    x, y = image.contiguous(), target.contiguous()
    weights_or_dummy = x if weights is None else weights.contiguous()  # a dummy that is not read without weights
    taps = torch.as_tensor(window, dtype=torch.float32).to(x.device)
    fields, slopes = x.new_empty(5, count), x.new_empty(3, count)
    programs = triton.cdiv(count, _BLOCK)
    sums, gradient = x.new_empty(programs), torch.empty_like(x)
    options = {"BLOCK": _BLOCK, "RADIUS": len(window) // 2, "WEIGHTED": weights is not None}
    _products_along_rows[(programs,)](x, y, weights_or_dummy, taps, fields, count, row, channels, **options)
    _compared_down_columns[(programs,)](
        weights_or_dummy, taps, fields, slopes, sums, count, row, channels, *constants, **options
    )
    _slopes_along_rows[(programs,)](taps, slopes, fields, count, row, channels, _BLOCK, len(window) // 2)
    _gathered_down_columns[(programs,)](x, y, weights_or_dummy, taps, fields, gradient, count, row, channels, **options)
    return (sums.double().sum() / count).to(x.dtype), gradient.div_(count)


@triton.jit
def _products_along_rows(
    x, y, weights, taps, fields, count, row, channels, BLOCK: tl.constexpr, RADIUS: tl.constexpr, WEIGHTED: tl.constexpr
):
    """Write fields [5, H, W * C]: weights * (x, y, x^2 + y^2, x y, 1), filtered by the window along each row."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    column = at % row
    mean_x = tl.zeros((BLOCK,), tl.float32)
    mean_y = tl.zeros((BLOCK,), tl.float32)
    squares = tl.zeros((BLOCK,), tl.float32)
    product = tl.zeros((BLOCK,), tl.float32)
    total = tl.zeros((BLOCK,), tl.float32)
    for k in tl.static_range(2 * RADIUS + 1):
        step = (k - RADIUS) * channels
        inside = (at < count) & (column + step >= 0) & (column + step < row)
        a = tl.load(x + at + step, mask=inside, other=0.0)
        b = tl.load(y + at + step, mask=inside, other=0.0)
        weight = tl.where(inside, tl.load(taps + k), 0.0)
        if WEIGHTED:
            weight *= tl.load(weights + (at + step) // channels, mask=inside, other=0.0)
        mean_x += weight * a
        mean_y += weight * b
        squares += weight * (a * a + b * b)
        product += weight * a * b
        total += weight
    tl.store(fields + at, mean_x, mask=at < count)
    tl.store(fields + count + at, mean_y, mask=at < count)
    tl.store(fields + 2 * count + at, squares, mask=at < count)
    tl.store(fields + 3 * count + at, product, mask=at < count)
    tl.store(fields + 4 * count + at, total, mask=at < count)


@triton.jit
def _filtered(field, taps, at, step, low, high, BLOCK: tl.constexpr, RADIUS: tl.constexpr):
    """Return the window sums around the elements `at` of a field; neighboring pixels are `step` elements apart."""
    total = tl.zeros((BLOCK,), tl.float32)
    for k in tl.static_range(2 * RADIUS + 1):
        to = at + (k - RADIUS) * step
        # Elements before `low` or from `high` on count as 0.
        total += tl.load(taps + k) * tl.load(field + to, mask=(to >= low) & (to < high), other=0.0)
    return total


@triton.jit
def _compared_down_columns(
    weights, taps, fields, slopes, sums, count, row, channels, c1, c2,
    BLOCK: tl.constexpr, RADIUS: tl.constexpr, WEIGHTED: tl.constexpr,
):  # fmt: skip
    """Filter the fields down the columns, and compute SSIM and its derivatives at each pixel."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mean_x = _filtered(fields, taps, at, row, 0, count, BLOCK, RADIUS)
    mean_y = _filtered(fields + count, taps, at, row, 0, count, BLOCK, RADIUS)
    squares = _filtered(fields + 2 * count, taps, at, row, 0, count, BLOCK, RADIUS)
    product = _filtered(fields + 3 * count, taps, at, row, 0, count, BLOCK, RADIUS)
    total = _filtered(fields + 4 * count, taps, at, row, 0, count, BLOCK, RADIUS)
    inverse = 1.0 / tl.where(total > 0, total, 1.0)
    mean_x *= inverse
    mean_y *= inverse
    light = 2.0 * mean_x * mean_y + c1
    structure = 2.0 * (product * inverse - mean_x * mean_y) + c2
    brightness = mean_x * mean_x + mean_y * mean_y
    contrast = squares * inverse - brightness + c2
    brightness += c1
    over = 1.0 / (brightness * contrast)
    similarity = light * structure * over
    pixel = tl.where(at < count, 1.0, 0.0)
    if WEIGHTED:
        pixel = tl.load(weights + at // channels, mask=at < count, other=0.0)
    # `sums` [programs] has the sum of weights * (1 - SSIM) over the pixels of each program.
    tl.store(sums + tl.program_id(0), tl.sum(pixel * (1.0 - similarity), 0))
    # `slopes` [3, H, W * C] has the derivatives of this sum with respect to the windowed x, x^2 + y^2 and x y.
    part = -pixel * inverse
    by_mean = 2.0 * over * (mean_y * (structure - light) + mean_x * similarity * (brightness - contrast))
    tl.store(slopes + at, part * by_mean, mask=at < count)
    tl.store(slopes + count + at, -part * similarity * brightness * over, mask=at < count)
    tl.store(slopes + 2 * count + at, part * 2.0 * light * over, mask=at < count)


@triton.jit
def _slopes_along_rows(taps, slopes, filtered, count, row, channels, BLOCK: tl.constexpr, RADIUS: tl.constexpr):
    """Write filtered [3, H, W * C]: the slopes, filtered by the window along each row."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    low = at - at % row
    high = tl.minimum(low + row, count)
    for field in tl.static_range(3):
        along = _filtered(slopes + field * count, taps, at, channels, low, high, BLOCK, RADIUS)
        tl.store(filtered + field * count + at, along, mask=at < count)


@triton.jit
def _gathered_down_columns(
    x, y, weights, taps, filtered, gradient, count, row, channels,
    BLOCK: tl.constexpr, RADIUS: tl.constexpr, WEIGHTED: tl.constexpr,
):  # fmt: skip
    """Write gradient [H, W * C], the derivative of the sum of weights * (1 - SSIM) with respect to x."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    # The filtered slopes are filtered down the columns, too: the window is symmetric, so this is the backward pass of
    # the windowing.
    by_mean = _filtered(filtered, taps, at, row, 0, count, BLOCK, RADIUS)
    by_squares = _filtered(filtered + count, taps, at, row, 0, count, BLOCK, RADIUS)
    by_product = _filtered(filtered + 2 * count, taps, at, row, 0, count, BLOCK, RADIUS)
    a = tl.load(x + at, mask=at < count, other=0.0)
    b = tl.load(y + at, mask=at < count, other=0.0)
    slope = by_mean + 2.0 * a * by_squares + b * by_product
    if WEIGHTED:
        slope *= tl.load(weights + at // channels, mask=at < count, other=0.0)
    tl.store(gradient + at, slope, mask=at < count)


@torch.no_grad()
def adam(updates, steps, visible, masked, unbias1, unbias2, beta1, beta2, epsilon) -> None:
    """Take the step of `gaussians.adam.adam` in one pass over memory; arguments as there."""
    for parameter, first, second, gradient, rates, masked_factor in updates:
        count, wide = parameter.numel(), parameter.shape[1]
        tables = parameter, first, second, gradient.contiguous(), rates.to(parameter)
        rows = steps, visible, masked, unbias1, unbias2
        numbers = masked_factor, beta1, beta2, epsilon, count, wide, len(rates)
        _adam_kernel[(triton.cdiv(count, _BLOCK),)](*tables, *rows, *numbers, BLOCK=_BLOCK)


@triton.jit
def _adam_kernel(
    parameters, firsts, seconds, gradients, rates, steps, visible, masked, unbias1, unbias2,
    masked_factor, beta1, beta2, epsilon, count, wide, moving, BLOCK: tl.constexpr,
):  # fmt: skip
    """Update one parameter: `count` numbers in rows of `wide`, of which the first `moving` columns are updated."""
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    row, column = at // wide, at % wide
    moves = (at < count) & (column < moving)
    moves = moves & (tl.load(visible + row, mask=moves, other=0) != 0)
    t = tl.load(steps + row, mask=moves, other=1)
    rate = tl.load(rates + column, mask=moves, other=0.0)
    rate = tl.where(tl.load(masked + row, mask=moves, other=0) != 0, rate * masked_factor, rate)
    rate *= tl.load(unbias1 + t, mask=moves, other=1.0)
    g = tl.load(gradients + at, mask=moves, other=0.0)
    m = tl.load(firsts + at, mask=moves, other=0.0)
    v = tl.load(seconds + at, mask=moves, other=0.0)
    m += (1.0 - beta1) * (g - m)
    v = beta2 * v + (1.0 - beta2) * g * g
    tl.store(firsts + at, m, mask=moves)
    tl.store(seconds + at, v, mask=moves)
    unbiased = v * tl.load(unbias2 + t, mask=moves, other=1.0)
    moved = tl.load(parameters + at, mask=moves, other=0.0) - rate * m / (tl.sqrt(unbiased) + epsilon)
    tl.store(parameters + at, moved, mask=moves)

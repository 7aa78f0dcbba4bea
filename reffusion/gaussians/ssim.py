"""Structural similarity over windows that leave out masked pixels, differentiable in the first image.

Windows are those of 3DGS: Gaussian, 11 x 11, sigma 1.5. Local statistics are *normalized convolutions*: weighted sums
divided by the sum of the weights in the window. So a pixel of weight 0 is in no window, and neither is a pixel outside
the image (3DGS counts pixels outside as black). The alternative is to make both images equal where they are masked. It
would put an edge that both images share into the windows around a mask, and so raise the similarity there.

`dssim` runs a numba kernel on float32 CPU tensors, a Triton kernel on CUDA, and plain torch elsewhere; all compute the
same formula.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, lru_cache, partial
from importlib.util import find_spec

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from reffusion.kernels.compiled import FREE_ROUNDING, empty_aligned, kernel, parallel_for
from reffusion.kernels.vectors import take_ticket

RADIUS, SIGMA = 5, 1.5
C1, C2 = 0.01**2, 0.03**2


def window() -> np.ndarray:
    """Return the 11 taps of the window along one axis, float64 with sum 1."""
    taps = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
    return taps / taps.sum()


def dssim(image: Tensor, target: Tensor, weights: Tensor | None = None) -> Tensor:
    """Compute the mean of weights * (1 - SSIM) over pixels and channels; its gradient reaches `image` only.

    Args:
        image, target: [H, W, C] in [0, 1].
        weights: [H, W], bool or in [0, 1]; None: all 1. A pixel of weight 0 influences nothing, even if it holds NaN.

    Returns:
        A scalar in [0, 2]. The sum is divided by H * W * C, not by the sum of weights, so that a pixel has the same
        influence however large the mask is.
    """
    if weights is not None:
        weights = weights.to(image.dtype)
        counts = (weights > 0)[..., None]
        image, target = torch.where(counts, image, 0.0), torch.where(counts, target, 0.0)
    if image.device.type == "cpu" and image.dtype == torch.float32:
        return _FastDssim.apply(image, target.detach(), weights)
    if image.is_cuda and image.dtype == torch.float32 and triton_works():
        from reffusion.gaussians import cuda_kernels

        return cuda_kernels.Dssim.apply(image, target.detach(), weights, window(), (C1, C2))
    return dssim_torch(image, target.detach(), weights)


@cache
def triton_works() -> bool:
    """Return whether `gaussians.cuda_kernels` can be used: there is a CUDA device, and Triton can compile for it.

    The answer is kept. If Triton is installed and fails, the reason is printed.
    """
    if not torch.cuda.is_available() or find_spec("triton") is None:
        return False
    from reffusion.gaussians import cuda_kernels

    return cuda_kernels.works()


def dssim_torch(image: Tensor, target: Tensor, weights: Tensor | None = None) -> Tensor:
    """Compute `dssim` in plain torch, on any device and in any dtype; the kernels are tested against this function.

    Unlike in `dssim`, pixels of weight 0 must be finite, and weights must have the images' dtype.
    """
    if weights is None:
        weights = torch.ones_like(image[..., 0])
    weights = weights[..., None]
    products = [weights * field for field in (image, target, image**2 + target**2, image * target)]
    windowed = _Windowed.apply(torch.cat([*products, weights], -1))
    total = torch.where(weights > 0, windowed[..., -1:], 1.0)
    mu_x, mu_y, squares, product = (windowed[..., :-1] / total).chunk(4, -1)
    covariance = product - mu_x * mu_y
    variances = squares - mu_x**2 - mu_y**2
    similarity = (2 * mu_x * mu_y + C1) * (2 * covariance + C2) / ((mu_x**2 + mu_y**2 + C1) * (variances + C2))
    return (weights * (1 - similarity)).sum() / image.numel()


class _Windowed(torch.autograd.Function):
    """Window sums of F fields [H, W, F], with zeros around the image.

    The window is symmetric, so the operation is its own adjoint: the backward pass is the same operation. Without this
    class autograd would compute the backward pass outside of `no_tf32`, with fewer digits.
    """

    @staticmethod
    def forward(ctx, fields: Tensor) -> Tensor:
        taps = torch.as_tensor(window(), dtype=fields.dtype, device=fields.device)
        planes = fields.permute(2, 0, 1)[:, None]
        with no_tf32():
            planes = F.conv2d(planes, taps.view(1, 1, 1, -1), padding=(0, RADIUS))
            planes = F.conv2d(planes, taps.view(1, 1, -1, 1), padding=(RADIUS, 0))
        return planes[:, 0].permute(1, 2, 0)

    @staticmethod
    def backward(ctx, upstream: Tensor) -> Tensor:
        return _Windowed.apply(upstream)


@contextmanager
def no_tf32() -> Iterator[None]:
    """Disable TF32 in CUDA convolutions inside this context.

    SSIM subtracts E[x]^2 from E[x^2]. Hardly any of the 10 bits of TF32 would be left after the subtraction, and
    gradients would be wrong by a tenth to a third.
    """
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = False
    try:
        yield
    finally:
        torch.backends.cudnn.allow_tf32 = before


class _FastDssim(torch.autograd.Function):
    """Autograd function of `dssim` for float32 on the CPU, by numba kernels; its forward pass computes the gradient."""

    @staticmethod
    def forward(ctx, image: Tensor, target: Tensor, weights: Tensor | None) -> Tensor:
        height, width, channels = image.shape
        flat = lambda t: t.detach().contiguous().numpy().reshape(height, width * channels)
        if weights is None:
            weight_rows, norm_rows = _unmasked_weight_rows(height, width, channels)
        else:
            weight_rows, norm_rows = _weight_rows(weights.contiguous().numpy(), channels)
        images = flat(image), flat(target), weight_rows
        fields, partials, sums = _allocate_fields(4, images[0]), _allocate_fields(3, images[0]), np.empty(height)
        parallel_for(_filter_products, *images, channels, fields)
        parallel_for(_compare, fields, weight_rows, norm_rows, channels, sums, partials)
        if ctx.needs_input_grad[0]:
            gradient = empty_aligned(*images[0].shape)
            parallel_for(_gather_gradient, partials, *images, gradient)
            ctx.gradient = torch.from_numpy(gradient).view(height, width, channels)
        return image.new_tensor(float(sums.sum()) / image.numel())

    @staticmethod
    def backward(ctx, upstream: Tensor):
        return ctx.gradient * (upstream / ctx.gradient.numel()), None, None


def _allocate_fields(count: int, image: np.ndarray) -> np.ndarray:
    """Return `count` uninitialized fields [count, H + 10, W * C], with 5 rows of zeros above and below each."""
    fields = empty_aligned(count, image.shape[0] + 2 * RADIUS, image.shape[1])
    fields[:, :RADIUS], fields[:, -RADIUS:] = 0, 0
    return fields


def _weight_rows(weights: np.ndarray, channels: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights [H, W] and their window sums, each repeated for every channel: two arrays [H, W * C]."""
    # Window sums at pixels of weight 0 are set to 1, so that nothing is divided by 0.
    norm = np.where(weights > 0, _filtered(weights, 1), np.float32(1))
    return np.repeat(weights, channels, 1), np.repeat(norm, channels, 1)


@lru_cache(maxsize=8)
def _unmasked_weight_rows(height: int, width: int, channels: int) -> tuple[np.ndarray, np.ndarray]:
    """Return `_weight_rows` for weights of 1, from a cache."""
    return _weight_rows(np.ones((height, width), np.float32), channels)


# The kernels hold an image as H rows of W * C numbers, so that inner loops run along memory. Fields are filtered along
# rows, then along columns. Pixels outside the image count as 0. Both filters are symmetric, so the backward pass uses
# them, too. A ticket of a thread is one row.
_K0, _K1, _K2, _K3, _K4, _K5 = (np.float32(k) for k in window()[RADIUS:])
_jit = partial(kernel, fastmath=FREE_ROUNDING)


@_jit
def _along_row(padded, out, n, step):
    """Write out[j], the window sum around padded[5 * step + j] along a row with `step` channels, for j < n."""
    a0, a1, a2, a3 = padded[:n], padded[step:], padded[2 * step :], padded[3 * step :]
    a4, a5, a6, a7 = padded[4 * step :], padded[5 * step :], padded[6 * step :], padded[7 * step :]
    a8, a9, a10 = padded[8 * step :], padded[9 * step :], padded[10 * step :]
    for j in range(n):
        out[j] = (
            _K0 * a5[j]
            + _K1 * (a4[j] + a6[j])
            + _K2 * (a3[j] + a7[j])
            + _K3 * (a2[j] + a8[j])
            + _K4 * (a1[j] + a9[j])
            + _K5 * (a0[j] + a10[j])
        )


@_jit
def _down_column(rows, i, out, n):
    """Write out[j], the window sum around rows[i + 5, j] down the column, for j < n; i is the row of the image."""
    # `rows` [H + 10, n] has 5 rows of zeros above and below.
    r0, r1, r2, r3 = rows[i], rows[i + 1], rows[i + 2], rows[i + 3]
    r4, r5, r6, r7 = rows[i + 4], rows[i + 5], rows[i + 6], rows[i + 7]
    r8, r9, r10 = rows[i + 8], rows[i + 9], rows[i + 10]
    for j in range(n):
        out[j] = (
            _K0 * r5[j]
            + _K1 * (r4[j] + r6[j])
            + _K2 * (r3[j] + r7[j])
            + _K3 * (r2[j] + r8[j])
            + _K4 * (r1[j] + r9[j])
            + _K5 * (r0[j] + r10[j])
        )


@_jit
def _filtered(field, channels):
    """Return the window sums [H, W * C] of a field [H, W * C]."""
    height, n = field.shape
    rows = np.zeros((height + 2 * RADIUS, n), np.float32)
    padded = np.zeros(n + 2 * RADIUS * channels, np.float32)
    out = np.empty((height, n), np.float32)
    for i in range(height):
        for j in range(n):
            padded[RADIUS * channels + j] = field[i, j]
        _along_row(padded, rows[i + RADIUS], n, channels)
    for i in range(height):
        _down_column(rows, i, out[i], n)
    return out


@_jit
def _filter_products(tickets, x, y, weights, channels, fields):
    """Write fields [4, H + 10, W * C]: weights * (x, y, x^2 + y^2, x y), filtered by the window along each row."""
    height, n = x.shape
    lead = RADIUS * channels
    padded = np.zeros((4, n + 2 * lead), np.float32)
    p0, p1, p2, p3 = padded[0, lead:], padded[1, lead:], padded[2, lead:], padded[3, lead:]
    while True:
        i = take_ticket(tickets)
        if i >= height:
            return
        xi, yi, wi = x[i], y[i], weights[i]
        for j in range(n):
            a, b, w = xi[j], yi[j], wi[j]
            p0[j] = w * a
            p1[j] = w * b
            p2[j] = w * (a * a + b * b)
            p3[j] = w * a * b
        for f in range(4):
            _along_row(padded[f], fields[f, i + RADIUS], n, channels)


@_jit
def _compare(tickets, fields, weights, norm, channels, sums, partials):
    """Filter the fields down the columns, and compute SSIM and its derivatives at each pixel."""
    # `fields` [4, H + 10, W * C] is from `_filter_products`; `weights` and `norm` [H, W * C] are from `_weight_rows`.
    height, n = weights.shape
    lead = RADIUS * channels
    column, padded = np.empty((4, n), np.float32), np.zeros((3, n + 2 * lead), np.float32)
    m0, m1, m2, m3 = column[0], column[1], column[2], column[3]
    d0, d1, d2 = padded[0, lead:], padded[1, lead:], padded[2, lead:]
    c1, c2, one, two = np.float32(C1), np.float32(C2), np.float32(1), np.float32(2)
    while True:
        i = take_ticket(tickets)
        if i >= height:
            return
        for f in range(4):
            _down_column(fields[f], i, column[f], n)
        wi, ni = weights[i], norm[i]
        total = np.float32(0)
        for j in range(n):
            inverse = one / ni[j]
            mx, my = m0[j] * inverse, m1[j] * inverse
            squares, product = m2[j] * inverse, m3[j] * inverse
            light = two * mx * my + c1
            structure = two * (product - mx * my) + c2
            brightness = mx * mx + my * my
            contrast = squares - brightness + c2
            brightness += c1
            over = one / (brightness * contrast)
            similarity = light * structure * over
            total += wi[j] * (one - similarity)
            part = -wi[j] * inverse
            # Derivatives of the sum of weights * (1 - SSIM) with respect to the windowed x, x^2 + y^2 and x y.
            d0[j] = part * two * over * (my * (structure - light) + mx * similarity * (brightness - contrast))
            d1[j] = part * -similarity * brightness * over
            d2[j] = part * two * light * over
        sums[i] = total
        # The derivatives are filtered along each row: the first half of the backward pass.
        for f in range(3):
            _along_row(padded[f], partials[f, i + RADIUS], n, channels)


@_jit
def _gather_gradient(tickets, partials, x, y, weights, gradient):
    """Write gradient [H, W * C], the derivative of the sum of weights * (1 - SSIM) with respect to x."""
    height, n = x.shape
    column, two = np.empty((3, n), np.float32), np.float32(2)
    c0, c1, c2 = column[0], column[1], column[2]
    while True:
        i = take_ticket(tickets)
        if i >= height:
            return
        for f in range(3):
            # `partials`, which `_compare` filtered along each row, is filtered down the columns here.
            _down_column(partials[f], i, column[f], n)
        xi, yi, wi, out = x[i], y[i], weights[i], gradient[i]
        for j in range(n):
            out[j] = wi[j] * (c0[j] + two * xi[j] * c1[j] + yi[j] * c2[j])

"""One step of Adam on the parameters of Gaussians, each of which counts its own steps.

`adam` is written in plain torch; `adam_cpu` (numba) and `cuda_kernels.adam` (Triton) compute the same, faster.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from reffusion.gaussians.ssim import triton_works
from reffusion.kernels.compiled import FREE_ROUNDING, kernel, parallel_for
from reffusion.kernels.vectors import take_ticket

_CHUNK = 512  # Gaussians that a thread takes at a time
_jit = partial(kernel, fastmath=FREE_ROUNDING)


@lru_cache(maxsize=4)
def unbiasing(betas: tuple[float, float], kilo: int, device: torch.device) -> list[Tensor]:
    """Return Adam's bias corrections 1 / (1 - beta^t) as one tensor per beta, indexed by the step count t.

    Args:
        betas: decay rates of the first and of the second moment.
        kilo: length of the tensors in units of 1024; t goes from 0 (never used) to 1024 * `kilo` - 1.
        device: device of the tensors.
    """
    t = torch.arange(1024 * kilo, dtype=torch.float64).clamp(min=1)
    return [(1 / (1 - beta**t)).float().to(device) for beta in betas]


class Update(NamedTuple):
    """Inputs of an Adam step for one parameter of N Gaussians, such as their means.

    Attributes:
        parameter: [N, D], one row per Gaussian, updated in place.
        first, second: [N, D], Adam's first and second moments, updated in place.
        gradient: [N, D].
        rates: [d] learning rates of the first d <= D columns; all other columns stay unchanged.
        masked_factor: factor on the learning rates of masked Gaussians.
    """

    parameter: Tensor
    first: Tensor
    second: Tensor
    gradient: Tensor
    rates: Tensor
    masked_factor: float


def fastest(device: torch.device) -> Callable[..., None]:
    """Return the fastest implementation of `adam` for float32 on this device; all have the same arguments."""
    if device.type == "cpu":
        return adam_cpu
    if device.type == "cuda" and triton_works():
        from reffusion.gaussians import cuda_kernels

        return cuda_kernels.adam
    return adam


@torch.no_grad()
def adam(updates: list[Update], steps, visible, masked, unbias1, unbias2, beta1, beta2, epsilon) -> None:
    """Take one Adam step on the visible Gaussians: update their parameters and moments in place.

    Args:
        updates: the parameters with their moments, gradients and learning rates.
        steps: [N] int32, step count t of each Gaussian, this step included.
        visible: [N] bool, True for the Gaussians to update.
        masked: [N] bool, True where the learning rates are multiplied by `Update.masked_factor`.
        unbias1, unbias2: [T] bias corrections 1 / (1 - beta^t) of the two moments (see `unbiasing`).
        beta1, beta2: decay rates of the two moments.
        epsilon: added to the root of the second moment.
    """
    rows = visible.nonzero()[:, 0]
    first_unbias, second_unbias = unbias1[steps[rows], None], unbias2[steps[rows], None]
    for *tables, rates, masked_factor in updates:
        parameter, first, second, gradient = (table[:, : len(rates)] for table in tables)
        g = gradient[rows]
        m = first[rows].lerp_(g, 1 - beta1)
        v = second[rows].mul_(beta2).addcmul_(g, g, value=1 - beta2)
        first[rows], second[rows] = m, v
        factor = torch.where(masked[rows], masked_factor, 1.0)[:, None]
        parameter[rows] -= rates.to(g) * factor * first_unbias * m / ((v * second_unbias).sqrt() + epsilon)


def adam_cpu(updates: list[Update], steps, visible, masked, unbias1, unbias2, beta1, beta2, epsilon) -> None:
    """Take the step of `adam` in one pass over memory, for float32 on the CPU; arguments as for `adam`."""
    if not updates:
        return
    columns = [tuple(t.numpy() for t in kind) for kind in list(zip(*updates, strict=True))[:5]]
    factors = np.array([update.masked_factor for update in updates], np.float32)
    rows = tuple(t.numpy() for t in (steps, visible, masked, unbias1, unbias2))
    parallel_for(_adam_kernel, *columns, factors, rows, (np.float32(beta1), np.float32(beta2), np.float32(epsilon)))


@_jit
def _adam_kernel(tickets, parameters, firsts, seconds, gradients, rates, factors, rows, numbers):
    """Update all parameters (tuples as in `Update`); a ticket is a chunk of `_CHUNK` Gaussians of one parameter."""
    # `factors` are the masked factors. `rows` has steps, visible, masked, unbias1 and unbias2 of `adam`; `numbers` has
    # beta1, beta2 and epsilon.
    count = len(rows[0])
    chunks = (count + _CHUNK - 1) // _CHUNK
    while True:
        ticket = take_ticket(tickets)
        if ticket >= chunks * len(parameters):
            return
        kind, start = ticket // chunks, ticket % chunks * _CHUNK
        tables = parameters[kind], firsts[kind], seconds[kind], gradients[kind]
        _adam_rows(start, min(start + _CHUNK, count), tables, rates[kind], factors[kind], rows, numbers)


@_jit
def _adam_rows(begin, end, tables, rates, masked_factor, rows, numbers):
    """Update rows `begin` to `end` - 1 of a parameter; `tables` holds the parameter, its moments and its gradient."""
    parameter, first, second, gradient = tables
    steps, visible, masked, unbias1, unbias2 = rows
    beta1, beta2, epsilon = numbers
    new1, new2 = np.float32(1) - beta1, np.float32(1) - beta2
    min_moment = np.float32(1e-30)  # smaller first moments would become denormal, which is slow
    for i in range(begin, end):
        if not visible[i]:
            continue
        factor, correction2 = unbias1[steps[i]] * (masked_factor if masked[i] else np.float32(1)), unbias2[steps[i]]
        for j in range(len(rates)):
            g = gradient[i, j]
            new_first = beta1 * first[i, j] + new1 * g
            new_first = np.float32(0) if abs(new_first) < min_moment else new_first
            new_second = beta2 * second[i, j] + new2 * g * g
            first[i, j], second[i, j] = new_first, new_second
            parameter[i, j] -= factor * rates[j] * new_first / (np.sqrt(new_second * correction2) + epsilon)

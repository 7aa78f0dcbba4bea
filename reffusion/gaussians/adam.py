"""One step of Adam over rows of parameters, each with its own step count: in plain torch and in two faster ways."""

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

_CHUNK = 512  # rows per ticket of a thread
_jit = partial(kernel, fastmath=FREE_ROUNDING)


@lru_cache(maxsize=4)
def unbiasing(betas: tuple[float, float], kilo: int, device: torch.device) -> list[Tensor]:
    """Bias corrections 1 / (1 - beta^t) of each beta, for t = 0 (never used) to 1024 * `kilo` - 1."""
    t = torch.arange(1024 * kilo, dtype=torch.float64).clamp(min=1)
    return [(1 / (1 - beta**t)).float().to(device) for beta in betas]


class Update(NamedTuple):
    """Inputs of an Adam step for one parameter.

    Attributes:
        parameter, first, second: the parameter and its two moments [N, D], updated in place.
        gradient: [N, D].
        rates: learning rates [d] of the first d columns; the other columns stay.
        masked_factor: factor on the rates in masked rows.
    """

    parameter: Tensor
    first: Tensor
    second: Tensor
    gradient: Tensor
    rates: Tensor
    masked_factor: float


def fastest(device: torch.device) -> Callable[..., None]:
    """The fastest implementation for the device; all compute the same formula."""
    if device.type == "cpu":
        return adam_cpu
    if device.type == "cuda" and triton_works():
        from reffusion.gaussians import cuda_kernels

        return cuda_kernels.adam
    return adam


@torch.no_grad()
def adam(updates: list[Update], steps, visible, masked, unbias1, unbias2, beta1, beta2, epsilon) -> None:
    """One Adam step on the visible rows.

    `unbias1` and `unbias2` [T] are the bias corrections 1 / (1 - beta^t); `steps` [N] is t of each row.
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
    """`adam` in one pass over memory, for float32 on the CPU."""
    if not updates:
        return
    columns = [tuple(t.numpy() for t in kind) for kind in list(zip(*updates, strict=True))[:5]]
    factors = np.array([update.masked_factor for update in updates], np.float32)
    rows = tuple(t.numpy() for t in (steps, visible, masked, unbias1, unbias2))
    parallel_for(_adam_kernel, *columns, factors, rows, (np.float32(beta1), np.float32(beta2), np.float32(epsilon)))


@_jit
def _adam_kernel(tickets, parameters, firsts, seconds, gradients, rates, factors, rows, numbers):
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

"""The gradient of score distillation (RefFusion section 4.2), in latents.

Every function takes tensors, plain numbers and one callable, the denoiser, so that tests can compare it with a
distribution whose score is known. Notation: z is a clean latent and z_t = a z + s eps is the noisy one, with a =
sqrt(alpha_bar_t) and s = sqrt(1 - alpha_bar_t).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

Weighting = Literal["sigma2", "alpha_sigma2", "x0", "one"]
Denoiser = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]  # (z_t [B, C, h, w], t [B]) -> (eps, x0)


def draw_timesteps(count: int, steps: int, low: float, high: float, generator: torch.Generator) -> Tensor:
    """Draw timesteps uniformly from a part of the noise schedule, long [count] on the CPU.

    Args:
        count: Number of timesteps to draw.
        steps: Number of timesteps of the prior's schedule.
        low, high: First and last timestep, both included, as fractions of the schedule: 0 <= low < high <= 1.
        generator: The source of randomness, on the CPU.

    Raises:
        ValueError: `low` and `high` violate this condition.
    """
    if not 0 <= low < high <= 1:
        raise ValueError(f"timestep range must satisfy 0 <= low < high <= 1, got {low}..{high}")
    first, last = round(low * (steps - 1)), round(high * (steps - 1))
    return torch.randint(first, last + 1, (count,), generator=generator)


def anneal(first: float, last: float | None, progress: float) -> float:
    """Return a value that goes linearly from `first` to `last` in the first half of a run, and then stays.

    Args:
        first: The value at the start.
        last: The value in the second half; None for `first`.
        progress: The finished share of the run, in [0, 1].
    """
    return first if last is None else first + (last - first) * min(2 * progress, 1.0)


def match_contrast(x0: Tensor, latents: Tensor, mask: Tensor) -> Tensor:
    """Return `x0` with its contrast inside the mask raised to that of the latents, as far as their patterns agree.

    A denoiser predicts the mean of all plausible images, which has less contrast than any of them. Repeated steps
    towards this mean remove contrast from a rendering that was correct. So for each sample and channel, the deviations
    x0' from the mean inside the mask are multiplied by b = <z', x0'> / <x0', x0'>. This factor minimizes the squared
    difference from the deviations z' of the latents. A factor below 1 is replaced by 1, so that x0 may add contrast.
    With a factor above 1, |b x0'| <= |z'|, so the contrast never exceeds that of the latents. The elements outside the
    mask are multiplied by the same factor.

    Args:
        x0: [B, C, h, w], the clean latents predicted by the denoiser.
        latents: [B, C, h, w], the latents of the rendering.
        mask: [B, 1, h, w], 1 inside and 0 outside.
    """
    count = mask.sum((2, 3), keepdim=True).clamp(min=1)
    mean = (x0 * mask).sum((2, 3), keepdim=True) / count
    deviation = (x0 - mean) * mask
    energy = deviation.square().sum((2, 3), keepdim=True)
    shared = (latents * deviation).sum((2, 3), keepdim=True)  # deviations sum to 0, so the latents' mean cancels
    factor = torch.where(shared > energy, shared / energy.clamp(min=torch.finfo(x0.dtype).tiny), 1.0)
    return mean + factor * (x0 - mean)


def sds_gradient(
    latents: Tensor,
    denoise: Denoiser,
    timesteps: Tensor,
    noise: Tensor,
    alphas_cumprod: Tensor,
    *,
    weighting: Weighting = "sigma2",
    keep_contrast: bool = False,
    mask: Tensor | None = None,
) -> Tensor:
    """Return the SDS gradient w(t) (eps_theta(z_t, t) - eps), without the UNet's Jacobian (DreamFusion eq. 3).

    PAPER leaves open: w(t), and any normalization (none here). Equation 2 has the factor dz_t/dz = a, which libraries
    omit; it is part of w here. Since eps_theta - eps = (a / s) (z - x0_theta), the weightings differ only by a function
    of t:
      "sigma2"  s^2 (eps_theta - eps), as in DreamFusion and threestudio;
      "alpha_sigma2"  a s^2 (eps_theta - eps): w = s^2 in equation 2, as in Fantasia3D;
      "x0"      z - x0_theta, i.e. w = s / a, bounded at both ends of the schedule;
      "one"     eps_theta - eps; with v-prediction, noise dominates it near t = 0.

    Args:
        latents: [B, C, h, w] clean latents z; no gradient flows here.
        denoise: Function of z_t and t that returns (eps, x0), with guidance and conditioning applied.
        timesteps: [B] long.
        noise: [B, C, h, w], standard normal, one for each latent.
        alphas_cumprod: [T], alpha_bar of every timestep.
        weighting: The choice of w(t), see above.
        keep_contrast: Whether the prediction x0_theta is replaced by `match_contrast` of x0_theta, inside `mask` or,
            with None, everywhere; eps_theta changes accordingly. Not in the paper.
        mask: [B, 1, h, w], 1 where the gradient is kept and 0 where the gradient is set to zero. None keeps all of it.
            PAPER leaves open: whether the gradient is masked. The paper distils the whole view, and only masked
            Gaussians receive the gradient in any case.

    Returns:
        [B, C, h, w] without gradient.
    """
    with torch.no_grad():
        alpha_bar = alphas_cumprod[timesteps].reshape(-1, 1, 1, 1)
        # 1 - alpha_bar is computed before rounding to the latents' type: half precision would cancel it near t = 0.
        signal, spread, variance = (x.to(latents) for x in (alpha_bar.sqrt(), (1 - alpha_bar).sqrt(), 1 - alpha_bar))
        eps, x0 = denoise(signal * latents + spread * noise, timesteps)
        if keep_contrast:
            contrasted = match_contrast(x0, latents, torch.ones_like(latents[:, :1]) if mask is None else mask)
            eps, x0 = eps + signal / spread * (x0 - contrasted), contrasted
        if weighting == "x0":
            gradient = latents - x0
        elif weighting == "sigma2":
            gradient = variance * (eps - noise)
        elif weighting == "alpha_sigma2":
            gradient = signal * variance * (eps - noise)
        else:
            gradient = eps - noise
        if mask is not None:
            gradient = gradient * mask
        return gradient


def sds_loss(latents: Tensor, gradient: Tensor, reduction: Literal["sum", "mean"] = "sum") -> Tensor:
    """Return a scalar whose gradient with respect to `latents` is the weighted SDS gradient. Its value has no meaning.

    Sample 0 is the whole view and has weight 1. The other samples are P patches, each with weight 1 / P: L_global +
    mean(L_local).

    PAPER leaves open: "sum" (threestudio) or "mean" over a latent's elements.

    Args:
        latents: [1 + P, C, h, w], differentiable back to the rendering.
        gradient: [1 + P, C, h, w] from `sds_gradient`.
        reduction: Whether the elements of a latent are summed or averaged.
    """
    patches = latents.shape[0] - 1
    share = latents.new_full((latents.shape[0],), 1 / max(patches, 1))
    share[0] = 1
    if reduction == "mean":
        share = share / latents[0].numel()
    return (share * (latents * gradient).flatten(1).sum(1)).sum()

"""Multi-scale score distillation (RefFusion section 4.2): the whole view and patches of it, pulled towards the prior.

Every function takes tensors, plain numbers and one callable, the denoiser, so that the mathematics can be checked
against a distribution whose score is known. Notation: z a clean latent, z_t = a z + s eps its noised form, with
a = sqrt(alpha_bar_t) and s = sqrt(1 - alpha_bar_t).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

Weighting = Literal["x0", "sigma2", "one"]
Denoiser = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]  # (z_t [B, C, h, w], t [B]) -> (eps, x0)


def draw_timesteps(count: int, steps: int, low: float, high: float, generator: torch.Generator) -> Tensor:
    """[count] long, uniform in [low, high] x `steps` (the number of the prior's training timesteps)."""
    if not 0 <= low < high <= 1:
        raise ValueError(f"timestep range must satisfy 0 <= low < high <= 1, got {low}..{high}")
    first, last = round(low * (steps - 1)), round(high * (steps - 1))
    return torch.randint(first, last + 1, (count,), generator=generator)


def unfaded(x0: Tensor, latents: Tensor, mask: Tensor) -> Tensor:
    """`x0` with its contrast inside the mask raised to that of the latents, as far as it shows the same.

    A denoiser answers a mean over what it holds possible, which is paler than any of it; step by step that takes
    contrast from a render that was right. So for each sample and channel, deviations from the mean are multiplied by
    b = <z', x0'> / <x0', x0'>, the factor that brings them nearest to the latents' own. Never by less than 1: what x0
    has more of, it may add. Where b counts, |b x0'| <= |z'|: nothing is blown up.

    Args:
        x0, latents: [B, C, h, w]. mask: [B, 1, h, w], 1 inside.
    """
    count = mask.sum((2, 3), keepdim=True).clamp(min=1)
    mean = (x0 * mask).sum((2, 3), keepdim=True) / count
    deviation = (x0 - mean) * mask
    energy = deviation.square().sum((2, 3), keepdim=True)
    shared = (latents * deviation).sum((2, 3), keepdim=True)  # the deviations sum to 0: the latents' mean drops out
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
    """w(t) (eps_theta(z_t, t) - eps), one noise for each latent; the UNet's Jacobian left out (DreamFusion eq. 3).

    PAPER leaves open: w(t), the factor a of dz_t/dz, which is taken into w, and any normalisation (none here). In
    every case eps_theta - eps = (a / s) (z - x0_theta), so the weightings differ only by a function of t:
      "sigma2"  s^2 (eps_theta - eps), DreamFusion's and threestudio's;
      "x0"      z - x0_theta, i.e. w = s / a: bounded at both ends of the schedule;
      "one"     eps_theta - eps; with v-prediction, noise dominates it near t = 0.

    Args:
        latents: [B, C, h, w] clean latents z; no gradient flows here.
        denoise: (z_t, t) -> (eps, x0), guidance and conditioning inside.
        timesteps: [B] long.
        noise: [B, C, h, w], standard normal.
        alphas_cumprod: [T], alpha_bar of every timestep.
        keep_contrast: x0_theta is taken `unfaded`. Not in the paper.
        mask: [B, 1, h, w], 1 where the gradient is kept; None keeps it everywhere.
            PAPER leaves open: it distils the whole view; only masked Gaussians receive the gradient in any case.
    Returns:
        [B, C, h, w] without gradient.
    """
    with torch.no_grad():
        alpha_bar = alphas_cumprod[timesteps].reshape(-1, 1, 1, 1)
        # 1 - alpha_bar before any rounding to the latents' type: in half precision it would have no digits near t = 0.
        signal, spread, variance = (x.to(latents) for x in (alpha_bar.sqrt(), (1 - alpha_bar).sqrt(), 1 - alpha_bar))
        eps, x0 = denoise(signal * latents + spread * noise, timesteps)
        if keep_contrast:
            clear = unfaded(x0, latents, torch.ones_like(latents[:, :1]) if mask is None else mask)
            eps, x0 = eps + signal / spread * (x0 - clear), clear
        if weighting == "x0":
            gradient = latents - x0
        elif weighting == "sigma2":
            gradient = variance * (eps - noise)
        elif weighting == "one":
            gradient = eps - noise
        else:
            raise ValueError(f"weighting must be x0, sigma2 or one, got {weighting!r}")
        if mask is not None:
            gradient = gradient * mask
        return gradient


def sds_loss(latents: Tensor, gradient: Tensor, reduction: Literal["sum", "mean"] = "sum") -> Tensor:
    """A scalar whose gradient with respect to `latents` is the distillation gradient (its value means nothing).

    Sample 0 is the whole view and counts 1; the others are patches and count by their mean: L_global + mean(L_local).
    PAPER leaves open: "sum" (threestudio) or "mean" over a latent's elements.

    Args:
        latents: [1 + P, C, h, w], with gradient back to the render.
        gradient: [1 + P, C, h, w] from `sds_gradient`.
    """
    patches = latents.shape[0] - 1
    share = latents.new_full((latents.shape[0],), 1 / max(patches, 1))
    share[0] = 1
    if reduction == "mean":
        share = share / latents[0].numel()
    elif reduction != "sum":
        raise ValueError(f"reduction must be sum or mean, got {reduction!r}")
    return (share * (latents * gradient).flatten(1).sum(1)).sum()

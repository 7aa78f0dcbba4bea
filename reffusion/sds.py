"""Multi-scale score distillation (RefFusion section 4.2): the whole view and patches of it, pulled towards the prior.

Every function takes tensors, plain numbers and one callable, the denoiser, so that the mathematics can be checked
against a distribution whose score is known. Notation: z a clean latent, z_t = a z + s eps its noised form, with
a = sqrt(alpha_bar_t) and s = sqrt(1 - alpha_bar_t).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

Weighting = Literal["x0", "sigma2", "one"]
Denoiser = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]  # (z_t [B, C, h, w], t [B]) -> (eps, x0)


def window_around(mask: Tensor, size: int, generator: torch.Generator) -> tuple[int, int]:
    """(top, left) of a size x size window inside the view that shows a randomly drawn masked pixel.

    PAPER leaves open: how a patch is drawn from the mask's box. A box may be mostly unmasked (a ring, two objects),
    so a masked pixel is drawn first, then its place in the window; the window is pushed back inside the view.

    Args:
        mask: [H, W] bool with at least one True pixel.
        size: side of the window in pixels, at most min(H, W).
    """
    return tuple(windows_around(mask, size, 1, generator)[0].tolist())


def windows_around(mask: Tensor, size: int, count: int, generator: torch.Generator) -> Tensor:
    """[count, 2] long: (top, left) of each of `count` windows, drawn independently as by `window_around`."""
    height, width = mask.shape
    if size > min(height, width):
        raise ValueError(f"a window of {size} px does not fit into a view of {width} x {height} px; enlarge it first")
    pixels = torch.nonzero(mask)
    if len(pixels) == 0:
        raise ValueError("no window can be drawn around an empty mask; leave this view out")
    picks = torch.randint(len(pixels), (count,), generator=generator)
    shifts = torch.randint(size, (count, 2), generator=generator)
    corners = pixels[picks] - shifts
    return torch.minimum(corners.clamp(min=0), torch.tensor([height - size, width - size]))


def enlarged(image: Tensor, size: int) -> Tensor:
    """[C, H, W] -> the same image, bilinearly enlarged where needed so that a window of `size` px fits into it."""
    height, width = image.shape[-2:]
    factor = size / min(height, width)
    if factor <= 1:
        return image
    shape = (max(size, round(height * factor)), max(size, round(width * factor)))
    return F.interpolate(image[None], size=shape, mode="bilinear", align_corners=False)[0]


def two_scales(image: Tensor, windows: list[tuple[int, int]], size: int) -> Tensor:
    """The whole view resized to size x size, then its patches in full resolution (section 4.2).

    PAPER leaves open: whether the bilinear reduction is antialiased. It is: each rendered pixel then receives a
    share of the global gradient, where plain bilinear sampling of a large view would skip most of them.

    Args:
        image: [C, H, W].
        windows: (top, left) of each patch.
    Returns:
        [1 + len(windows), C, size, size], differentiable in `image`.
    """
    whole = F.interpolate(image[None], size=(size, size), mode="bilinear", align_corners=False, antialias=True)
    patches = [image[None, :, top : top + size, left : left + size] for top, left in windows]
    return torch.cat([whole, *patches])


def two_scale_masks(mask: Tensor, windows: list[tuple[int, int]], size: int) -> Tensor:
    """`two_scales` of a bool [H, W] mask -> [1 + len(windows), 1, size, size] float, 1 = repaint.

    A reduced pixel is repainted as soon as any part of it was masked: what is masked must not reach the UNet.
    """
    return (two_scales(mask.to(torch.float32)[None], windows, size) > 1e-4).to(torch.float32)


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
    unit_rms: bool = False,
    keep_contrast: bool = False,
    mask: Tensor | None = None,
) -> Tensor:
    """w(t) (eps_theta(z_t, t) - eps), one noise for each latent; the UNet's Jacobian left out (DreamFusion eq. 3).

    PAPER leaves open: w(t), and the factor a of dz_t/dz, which is taken into w. In every case
    eps_theta - eps = (a / s) (z - x0_theta), so the weightings differ only by a function of t:
      "sigma2"  s^2 (eps_theta - eps), DreamFusion's and threestudio's;
      "x0"      z - x0_theta, i.e. w = s / a: bounded at both ends of the schedule;
      "one"     eps_theta - eps; with v-prediction, noise dominates it near t = 0.

    Args:
        latents: [B, C, h, w] clean latents z; no gradient flows here.
        denoise: (z_t, t) -> (eps, x0), guidance and conditioning inside.
        timesteps: [B] long.
        noise: [B, C, h, w], standard normal.
        alphas_cumprod: [T], alpha_bar of every timestep.
        unit_rms: divide each sample by its own root mean square. PAPER leaves open: any normalisation.
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
        if unit_rms:
            kept = torch.ones_like(gradient) if mask is None else mask.expand_as(gradient)
            energy = gradient.square().sum((1, 2, 3), keepdim=True) / kept.sum((1, 2, 3), keepdim=True).clamp_min(1)
            gradient = gradient / energy.sqrt().clamp_min(1e-8)
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

"""The loss of personalization: the prior's own denoising loss, over the whole image of a sample."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from reffusion.params.base import Prompts
from reffusion.prior import diffusion
from reffusion.prior.crops import GLOBAL, LOCAL, Batch, Picture
from reffusion.prior.model import Prior
from reffusion.prior.windows import two_scale_masks, two_scales, window_around
from reffusion.seeding import generator as seeded


def spread_timesteps(count: int, steps: int, generator: torch.Generator) -> Tensor:
    """Draw stratified timesteps in random order, long [count]: one in each of `count` equal parts of [0, steps).

    All timesteps have the same random position within their part. Stratified timesteps vary less between batches than
    independent ones.

    Args:
        count: Number of timesteps to draw, the size of a batch.
        steps: Number of timesteps of the noise schedule.
        generator: The source of randomness, on the CPU.
    """
    positions = torch.randperm(count, generator=generator) + torch.rand(1, generator=generator)
    return (positions * (steps / count)).long().clamp(max=steps - 1)


def latent_shape(prior: Prior, size: int) -> tuple[int, int, int]:
    """Return the shape (C, h, w) of the latents of a size x size image."""
    side = size // prior.factor
    config: Any = prior.vae.config
    return config.latent_channels, side, side


def denoising_error(
    prior: Prior, samples: Batch, text: Tensor, timesteps: Tensor, noise: Tensor, outside_weight: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Return two mean squared errors of the denoiser for each sample: of its target, and of the clean latent, [B] each.

    The target is the quantity that the network was trained to predict: eps, or v = a eps - s z. Both errors are means
    over all latents of a sample, with the weight `outside_weight` outside the mask. The latents are those of the
    picture at the levels at which the model sees it.

    PAPER leaves open: the target (the paper's prior predicts eps) and whether the loss covers the whole image or the
    mask. As in RealFill, it covers the whole image.

    Args:
        prior: The diffusion prior.
        samples: The training samples.
        text: [3, L, D], the embeddings of the global, the local and the empty prompt.
        timesteps: [B] long.
        noise: [B, C, h, w] standard normal, in the shape of the latents.
        outside_weight: Weight of latents outside the mask in the means. Latents to repaint have weight 1. With 0 the
            errors are those in the hole.
    """
    images, masks = samples.images.to(prior.device), samples.masks.to(prior.device)
    timesteps, noise = timesteps.to(prior.device), noise.to(prior.device)
    with torch.no_grad():
        images = diffusion.measure_levels(prior, images, masks).normalize(images)
        latents = diffusion.encode(prior, images)
        condition = diffusion.conditioning(prior, images, masks)
        noisy = diffusion.add_noise(prior, latents, noise, timesteps)
        target = diffusion.training_target(prior, latents, noise, timesteps)
    output = diffusion.raw_prediction(prior, noisy, timesteps, condition, text[samples.prompts.to(prior.device)])
    weight = torch.where(condition[:, :1] > 0.5, 1.0, outside_weight)  # channel 0 is the mask
    error = (weight * (output - target).square()).mean((1, 2, 3)) / weight.mean((1, 2, 3))
    # With z_t fixed both targets are linear in the clean latent: an error of 1 in it is a/s in eps and 1/s in v.
    alpha_bar = diffusion.alpha_bar(prior, timesteps).flatten()
    scale = alpha_bar if prior.prediction_type == "epsilon" else 1.0
    return error, (1 - alpha_bar) * error / scale


def held_out_samples(references: Sequence[Picture], size: int, seed: int) -> Batch:
    """Return two fixed samples of the first reference, first the whole view and then a crop, with its hole as mask.

    These samples measure the error of the prior. If the reference has no hole, or nothing but a hole, the mask covers
    its middle, half as wide and half as high.

    Args:
        references: The references, of which the first is used.
        size: Side of a sample in pixels.
        seed: Determines the position of the crop.
    """
    generator = seeded(seed, "personalize", "held out")
    reference = references[0]
    region = reference.region
    if not region.any() or region.all():
        height, width = region.shape
        region = torch.zeros_like(region)
        region[height // 4 : height - height // 4, width // 4 : width - width // 4] = True
    windows = [window_around(region, size, generator)]
    masks = two_scale_masks(region, windows, size)
    return Batch(two_scales(reference.image, windows, size), masks, torch.tensor([GLOBAL, LOCAL]))


def backward_one_sample(prior: Prior, references: Sequence[Picture], seed: int) -> None:
    """Compute the loss of one sample, and add its gradient to the `.grad` of the prior's trained parameters.

    `memory.fit_to_memory` measures the memory that this takes.
    """
    sample = Batch(*(tensor[:1] for tensor in held_out_samples(references, prior.native_size, seed)))
    noise = torch.zeros(1, *latent_shape(prior, prior.native_size))
    text = diffusion.embed_text(prior, Prompts().texts)
    denoising_error(prior, sample, text, torch.zeros(1, dtype=torch.long), noise)[0].sum().backward()

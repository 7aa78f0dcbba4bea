"""Errors measured during personalization: in the hole of the reference, and in holes of other photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from reffusion.prior import diffusion, lora
from reffusion.prior.crops import GLOBAL, Batch, Picture
from reffusion.prior.denoising import denoising_error, held_out_samples, latent_shape
from reffusion.prior.model import Prior
from reffusion.prior.windows import two_scale_masks, two_scales
from reffusion.seeding import generator as seeded
from reffusion.trace import decibels

NOISE_LEVELS = (0.2, 0.55, 0.9)  # timesteps, as fractions of the schedule, at which errors are measured
PHOTOS = 4  # number of photographs used for validation
SHIFTS_PER_SIDE = 4  # positions per side at which the hole of the reference is tried in a photograph


@dataclass(frozen=True)
class HeldOut:
    """Fixed samples for validation.

    Attributes:
        reference: Two samples of the reference with its hole as mask, the whole view and a crop.
        pictures: [1 + B, 3, n, n] in [-1, 1], the whole reference and B photographs.
        repaint: [1 + B, 1, n, n], 1 at the pixels to repaint.
        holes: [1 + B, 1, n, n], 1 at the pixels to repaint whose true colors are known, i.e. outside the object.
    """

    reference: Batch
    pictures: Tensor
    repaint: Tensor
    holes: Tensor


def choose_photos(names: Sequence[str], references: Sequence[str]) -> list[str]:
    """Return up to `PHOTOS` of the names that are no references, evenly spread from the first one on."""
    others = [name for name in names if name not in references]
    count = min(PHOTOS, len(others))
    return [others[k * len(others) // count] for k in range(count)]


def make_held_out(
    references: Sequence[Picture], photographs: Sequence[tuple[Tensor, Tensor]], size: int, seed: int
) -> HeldOut:
    """Build the samples for `measure_errors`. They are the same for equal seeds.

    Args:
        references: The references, of which the first is used.
        photographs: Other views, [3, H, W] in [-1, 1], each with the object's mask, bool [H, W]. The hole of the
            reference is placed in each photograph, shifted to where it overlaps least with the object. A photograph in
            which the object covers all of the hole even there is left out.
        size: Side of a sample in pixels.
        seed: Determines the crop of the reference.
    """
    reference = held_out_samples(references, size, seed)
    hole = reference.masks[0]
    pictures, repaint, holes = [reference.images[0]], [hole], [hole]
    for image, hidden in photographs:
        object_mask = two_scale_masks(hidden, [], size)[0]
        steps = [round(k * size / SHIFTS_PER_SIDE) for k in range(SHIFTS_PER_SIDE)]
        shifted_holes = [hole.roll((down, right), (1, 2)) for down in steps for right in steps]
        shifted_hole = min(shifted_holes, key=lambda each: float((each * object_mask).sum()))
        if (known := shifted_hole * (1 - object_mask)).any():
            pictures.append(two_scales(image, [], size)[0])
            repaint.append(torch.maximum(shifted_hole, object_mask))
            holes.append(known)
    return HeldOut(reference, *(torch.stack(each) for each in (pictures, repaint, holes)))


def measure_errors(prior: Prior, held: HeldOut, prompts: list[str], seed: int) -> dict[str, float]:
    """Return the errors for the trace of personalization, by their key.

    All errors are measured in holes. "target_mse" and "clean_latent_mse" are the two errors of `denoising_error` for
    the whole reference, and "crop_latent_mse" is the error of the clean latent for its crop; each is a mean over
    `NOISE_LEVELS`. "hole_psnr" and "photo_psnr" are the PSNR in dB of pictures painted in one denoising step from pure
    noise: of the reference, and of all photographs together (from the mean of their squared errors). Without
    photographs "photo_psnr" is left out.

    The noise is fixed, so the errors are comparable during training. LoRA's dropout is switched off and stays off. With
    a small model this takes about as long as one training step.

    Args:
        prior: The prior with LoRA layers attached.
        held: The samples.
        prompts: The global, the local and the empty prompt.
        seed: Seed of the noise.
    """
    lora.set_dropout(prior, False)
    with torch.no_grad():
        text = diffusion.embed_text(prior, prompts)
    errors = [_hole_errors(prior, held, text, seed, level) for level in NOISE_LEVELS]
    target, clean = torch.stack(errors).mean(0)
    result = {"target_mse": float(target[0]), "clean_latent_mse": float(clean[0]), "crop_latent_mse": float(clean[1])}
    return result | _one_step_psnr(prior, held, text, seed)


@torch.no_grad()
def _hole_errors(prior: Prior, held_out: HeldOut, text: Tensor, seed: int, level: float) -> Tensor:
    """Return the errors of `denoising_error` in the reference's hole at a noise level, [2 errors, view and crop]."""
    samples = held_out.reference
    timesteps = torch.full((len(samples.prompts),), round(level * (prior.timesteps - 1)))
    generator = seeded(seed, "personalize", "held out", level)
    noise = torch.randn(len(samples.prompts), *latent_shape(prior, samples.images.shape[-1]), generator=generator)
    # The rows are the error of the target and of the clean latent; the columns are the whole view and the crop.
    return torch.stack(denoising_error(prior, samples, text, timesteps, noise, outside_weight=0))


@torch.no_grad()
def _one_step_psnr(prior: Prior, held_out: HeldOut, text: Tensor, seed: int) -> dict[str, float]:
    """Return the PSNR in the holes of the reference and of photographs, for one denoising step from pure noise."""
    text = text[GLOBAL].expand(len(held_out.pictures), -1, -1)
    images, repaint, holes = (each.to(prior.device) for each in (held_out.pictures, held_out.repaint, held_out.holes))
    generator = seeded(seed, "personalize", "expected")
    # One step predicts the mean of the pictures that the prior would paint.
    sampled = diffusion.sample(prior, images, repaint, text, steps=1, random=generator)
    squared_error = (((sampled - images) / 2).square().mean(1, keepdim=True) * holes).sum((1, 2, 3)) / holes.sum(
        (1, 2, 3)
    )
    result = {"hole_psnr": decibels(float(squared_error[0]))}
    return result | ({"photo_psnr": decibels(float(squared_error[1:].mean()))} if len(squared_error) > 1 else {})

"""What personalization is for, measured while it learns: the reference's hole, and holes in other photographs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from reffusion.prior import diffusion, lora
from reffusion.prior.crops import GLOBAL, PROMPTS, Batch, Picture
from reffusion.prior.denoising import denoising_error, held_out_samples, latent_shape
from reffusion.prior.model import Prior
from reffusion.prior.windows import two_scale_masks, two_scales
from reffusion.seeding import generator as seeded
from reffusion.trace import decibels

LEVELS = (0.2, 0.55, 0.9)  # of the noise, as parts of the schedule, at which the clean latent is asked for
SHIFTS = 4  # places along a side where the reference's hole is tried in a photograph


@dataclass(frozen=True)
class HeldOut:
    """Attributes:
    reference: its own hole, in the whole view and in a crop.
    pictures, repaint, holes: [1 + B, ...] the whole reference and B photographs, what is to be repainted of them
        [1 + B, 1, n, n], and where the truth is known.
    """

    reference: Batch
    pictures: Tensor
    repaint: Tensor
    holes: Tensor


def held_out(
    references: Sequence[Picture], photographs: Sequence[tuple[Tensor, Tensor]], size: int, seed: int
) -> HeldOut:
    """What `measured` looks at; same for equal seeds.

    Args:
        photographs: of other views, [3, H, W] in [-1, 1], and the object in them, bool [H, W]. The reference's hole is
            put where least of the object is.
    """
    own = held_out_samples(references, size, seed)
    hole = own.masks[0]
    pictures, repaint, holes = [own.images[0]], [hole], [hole]
    for image, hidden in photographs:
        thing = two_scale_masks(hidden, [], size)[0]
        steps = [round(k * size / SHIFTS) for k in range(SHIFTS)]
        places = [hole.roll((down, right), (1, 2)) for down in steps for right in steps]
        place = min(places, key=lambda each: float((each * thing).sum()))
        if (known := place * (1 - thing)).any():
            pictures.append(two_scales(image, [], size)[0])
            repaint.append(torch.maximum(place, thing))
            holes.append(known)
    return HeldOut(own, *(torch.stack(each) for each in (pictures, repaint, holes)))


def measured(prior: Prior, held: HeldOut, seed: int, each: Callable[..., Iterable] = map) -> dict[str, float]:
    """The errors of docs/traces.md, with fixed noise: comparable through the training. A small model takes about the
    time of a step of training.

    Args:
        each: like `map`; may do several at once.
    """
    lora.set_dropout(prior, False)
    parts = [partial(_errors, prior, held, seed, level) for level in LEVELS] + [partial(_expected, prior, held, seed)]
    *errors, expected = each(lambda part: part(), parts)
    target, clean = torch.stack(errors).mean(0)
    said = {"target_mse": float(target[0]), "clean_latent_mse": float(clean[0]), "crop_latent_mse": float(clean[1])}
    return said | expected


@torch.no_grad()
def _errors(prior: Prior, held: HeldOut, seed: int, level: float) -> Tensor:
    """[2, B]: those of the reference's own hole, at a level of the noise; see `denoising_error`."""
    samples = held.reference
    timesteps = torch.full((len(samples.prompts),), round(level * (prior.timesteps - 1)))
    draw = seeded(seed, "personalize", "held out", level)
    noise = torch.randn(len(samples.prompts), *latent_shape(prior, samples.images.shape[-1]), generator=draw)
    text = diffusion.embed_text(prior, list(PROMPTS))
    return torch.stack(denoising_error(prior, samples, text, timesteps, noise, outside_weight=0))


@torch.no_grad()
def _expected(prior: Prior, held: HeldOut, seed: int) -> dict[str, float]:
    """PSNR of the reference's hole, and of those in photographs, as the prior expects them from pure noise, in a step:
    the mean of what it would paint."""
    text = diffusion.embed_text(prior, [PROMPTS[GLOBAL]]).expand(len(held.pictures), -1, -1)
    images, repaint, holes = (each.to(prior.device) for each in (held.pictures, held.repaint, held.holes))
    draw = seeded(seed, "personalize", "expected")
    made = diffusion.sample(prior, images, repaint, text, steps=1, random=draw)
    squared = (((made - images) / 2).square().mean(1, keepdim=True) * holes).sum((1, 2, 3)) / holes.sum((1, 2, 3))
    found = {"hole_psnr": decibels(float(squared[0]))}
    return found | ({"photo_psnr": decibels(float(squared[1:].mean()))} if len(squared) > 1 else {})

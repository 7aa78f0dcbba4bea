"""personalize: the prior learns the reference by LoRA (RefFusion section 4.1)."""

from __future__ import annotations

import time
from pathlib import Path

import torch

from reffusion import trace
from reffusion.io.scene import load_references, load_scene
from reffusion.params.personalize import Params
from reffusion.prior import crops, denoising, lora, memory
from reffusion.prior.model import load_prior, recomputing
from reffusion.prior.personalize import personalize

MEMORY = "personalize.memory_gb"  # what an error names


def run(params: Params, out: Path, *, poses: Path, reference: Path) -> None:
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
    chosen = params.lora
    trained = lora.add(prior, chosen.rank, chosen.alpha, chosen.dropout, chosen.layers, params.seed)

    def learn(folder: Path, steps: int) -> None:
        personalize(prior, trained, references, params.model_copy(update={"steps": steps}), folder)

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

"""personalize: fine-tune the prior on the reference by LoRA (RefFusion section 4.1)."""

from __future__ import annotations

import time
from pathlib import Path

import torch

from reffusion import trace
from reffusion.io.scene import load_raw_masks, load_references, load_scene, load_views
from reffusion.params.personalize import Params
from reffusion.prior import crops, denoising, lora, memory
from reffusion.prior.model import enable_checkpointing, load_prior
from reffusion.prior.personalize import personalize
from reffusion.types import Scene

MEMORY_PARAM = "personalize.memory_gb"  # named in errors
VALIDATION_PHOTOS = 4  # number of photographs used for validation


def run(params: Params, out: Path, *, poses: Path, raw_masks: Path, reference: Path) -> None:
    start = time.monotonic()
    if not params.steps:
        raise ValueError("personalize.steps is 0: there is nothing to learn, leave the stage out")
    scene = load_scene(poses)
    prior = load_prior(params.prior, device=params.device, dtype=getattr(torch, params.dtype))
    prior = enable_checkpointing(prior) if params.checkpointing else prior
    references = [
        crops.make_picture(torch.from_numpy(r.image), torch.from_numpy(r.mask), prior.native_size)
        for r in load_references(reference, scene)
    ]
    photographs = load_validation_photos(
        scene, poses, raw_masks, [r.camera.name for r in load_references(reference, scene)]
    )
    lora_params = params.lora
    trained = lora.attach(
        prior, lora_params.rank, lora_params.alpha, lora_params.dropout, lora_params.layers, params.seed
    )

    def train(folder: Path, steps: int) -> None:
        personalize(prior, trained, references, params.model_copy(update={"steps": steps}), folder, photographs)

    def try_training(folder: Path, steps: int) -> None:
        state = lora.state(prior)
        train(folder, steps)
        lora.load_state(prior, state)

    backward = lambda prior: denoising.backward_one_sample(prior, references, params.seed)
    with memory.explain_oom(MEMORY_PARAM, params.memory_gb):
        prior = memory.fit_to_memory(prior, params.memory_gb, MEMORY_PARAM, backward)
        train(
            out,
            trace.steps_within_budget(
                out, params.steps, params.seconds, lambda: time.monotonic() - start, try_training
            ),
        )
    lora.save(prior, out)
    trace.clear_checkpoint(out)


def load_validation_photos(
    scene: Scene, poses: Path, raw_masks: Path, references: list[str]
) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Photographs [3, H, W] in [-1, 1] of views that are not references, and the object's masks, bool [H, W]."""
    masks = load_raw_masks(raw_masks, scene.train)
    names = [name for name in scene.train if name in masks and name not in references]
    photos = load_views(poses, names[:: max(1, len(names) // VALIDATION_PHOTOS)][:VALIDATION_PHOTOS])
    to_tensor = lambda image: torch.from_numpy(image).permute(2, 0, 1).float() / 127.5 - 1
    return [(to_tensor(image), torch.from_numpy(masks[name])) for name, image in photos.items()]

"""The stage `personalize`: the diffusion prior is fine-tuned on the references by LoRA (RefFusion section 4.1)."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import torch

from reffusion import trace
from reffusion.io.scene import load_raw_masks, load_references, load_scene, load_teaching, load_views
from reffusion.params.personalize import Params
from reffusion.prior import crops, denoising, lora, memory, validation
from reffusion.prior.inpaint import to_input
from reffusion.prior.model import enable_checkpointing, load_prior
from reffusion.prior.personalize import personalize

MEMORY_PARAM = "personalize.memory_gb"  # the parameter that out-of-memory errors name


def run(params: Params, out: Path, *, poses: Path, raw_masks: Path, reference: Path) -> None:
    """Run the stage: train the LoRA, and write pytorch_lora_weights.safetensors (for diffusers) and trace.jsonl.

    Some photographs that are no references are used to measure the progress; the LoRA is not trained on them. An
    interrupted run resumes from the checkpoint in `out`.

    Args:
        out: folder of this stage.
        poses, raw_masks, reference: folders of the stages of these names.

    Raises:
        ValueError: `params.steps` is 0, or the memory does not suffice.
    """
    start = time.monotonic()
    if not params.steps:
        raise ValueError("personalize.steps is 0: there is nothing to learn, leave the stage out")
    scene = load_scene(poses)
    prior = load_prior(params.prior, params.device, params.dtype)
    prior = enable_checkpointing(prior) if params.checkpointing else prior
    references = load_references(reference, scene)
    to_tensor = torch.from_numpy
    examples = [(each.image, each.mask) for each in references]
    examples += [(image, np.zeros(image.shape[:2], bool)) for image in load_teaching(reference)]
    pictures = [crops.make_picture(to_tensor(image), to_tensor(hole), prior.native_size) for image, hole in examples]
    masks = load_raw_masks(raw_masks, scene.train)
    names = validation.choose_photos(list(masks), [r.camera.name for r in references])
    photographs = [(to_input(image), to_tensor(masks[name])) for name, image in load_views(poses, names).items()]
    trained = lora.attach(prior, **params.lora.model_dump(), seed=params.seed)

    def train(folder: Path, steps: int) -> None:
        personalize(prior, trained, pictures, params.changed({"steps": steps}), folder, photographs)

    def try_training(folder: Path, steps: int) -> None:
        state = lora.state(prior)
        train(folder, steps)
        lora.load_state(prior, state)

    backward = lambda prior: denoising.backward_one_sample(prior, pictures, params.seed)
    with memory.explain_oom(MEMORY_PARAM, params.memory_gb):
        prior = memory.fit_to_memory(prior, params.memory_gb, MEMORY_PARAM, backward)
        elapsed = lambda: time.monotonic() - start
        train(out, trace.steps_within_budget(out, params.steps, params.seconds, elapsed, try_training))
    lora.save(prior, out)
    trace.clear_checkpoint(out)

"""Inputs and steps of the GPU benchmark, and the memory of full-size priors: `python -m lab.gpu.full_size`.

The program counts the gigabytes of SD2-inpainting's weights and of one sample of each step, in half precision. The
configurations are the published ones (`random_priors`); the steps are those of the library.
"""

from __future__ import annotations

import json

import numpy as np
import torch

from lab.gpu.random_priors import SD2, Shape, assemble_prior, networks
from reffusion.distill.terms.sds import evaluate_sds
from reffusion.distill.train_view import TrainView
from reffusion.params.distill import SdsTerm
from reffusion.params.personalize import Optimizer, Params
from reffusion.prior import crops, denoising, lora, memory
from reffusion.prior.model import Prior, enable_checkpointing
from reffusion.prior.personalize import WEIGHT_DECAY
from reffusion.seeding import generator
from reffusion.types import Camera, Gaussians


def reference(size: int) -> crops.Picture:
    """Make a reference of `size` px height, a quarter wider than high: stripes, with a hole in the middle."""
    rows, columns = torch.meshgrid(torch.arange(size), torch.arange(size + size // 4), indexing="ij")
    image = torch.stack([128 + 100 * torch.sin((rows + k * columns) / 9) for k in (1, 2, 3)], 2)
    hole = torch.zeros(rows.shape, dtype=torch.bool)
    hole[size // 3 : 2 * size // 3, size // 2 : size] = True
    return crops.make_picture(image.to(torch.uint8), hole, size)


def trainer(prior: Prior, batch: int) -> tuple[dict[str, list], torch.optim.Optimizer, Params]:
    """Attach the paper's LoRA to a prior (rank 8, alpha 16, dropout 0.1, attention layers), and make AdamW for it.

    The prior is changed in place.

    Returns:
        The trained parameters of "unet" and "text", the optimizer, and the parameters of the stage `personalize`.
    """
    training = Params(optimizer=Optimizer(batch=batch))
    chosen, rates = training.lora, training.optimizer
    trained = lora.attach(prior, chosen.rank, chosen.alpha, chosen.dropout, chosen.layers, training.seed)
    groups = [{"params": trained["unet"], "lr": rates.lr_unet}, {"params": trained["text"], "lr": rates.lr_text}]
    return trained, torch.optim.AdamW(groups, betas=rates.betas, weight_decay=WEIGHT_DECAY), training


def peak_memory(shape: Shape, dtype: torch.dtype) -> dict[str, float]:
    """Count the memory of the weights, and the peak memory of live tensors for one sample, in GB (1e9 bytes).

    The memory is counted on the meta device. There, attention computes whole attention matrices; GPU kernels need less.

    Returns:
        "weights"; and the peak, without the weights, of "inpainting", "SDS", "personalization", "SDS, checkpointing"
        and "personalization, checkpointing" (of activations).
    """
    with torch.device("meta"):
        models = networks(shape, dtype)
    prior = assemble_prior(shape, models, "meta")
    picture = reference(prior.native_size)
    steps = {"inpainting": memory.inpaint_one_sample, "SDS": memory.encode_one_sample}
    sizes = {"weights": prior.bytes}
    sizes |= {name: memory.peak_bytes(lambda s=step: s(prior), "meta") for name, step in steps.items()}
    trainer(prior, 1)
    training = lambda: denoising.backward_one_sample(prior, [picture], 0)
    sizes["personalization"] = memory.peak_bytes(training, "meta")
    enable_checkpointing(prior)
    sizes["SDS, checkpointing"] = memory.peak_bytes(lambda: memory.encode_one_sample(prior), "meta")
    sizes["personalization, checkpointing"] = memory.peak_bytes(training, "meta")
    return {name: round(count / 1e9, 6) for name, count in sizes.items()}


def train_view(size: int, device: str) -> TrainView:
    """Make a training view of `size` px height, a quarter wider than high, whose middle is to be repainted."""
    width = size + size // 4
    camera = Camera("view", width, size, width, width, width / 2, size / 2, np.eye(4))
    hole = torch.zeros(size, width, dtype=torch.bool)
    hole[size // 3 : 2 * size // 3, size // 2 : size] = True
    photo = torch.rand(size, width, 3, generator=generator(0, "photo"))
    return TrainView(camera, photo.to(device), ~hole.to(device), hole.to(device), False)


def gaussians(number: int, device: str, degree: int = 3) -> Gaussians:
    """Make random Gaussians that fill the view of `train_view`; all parameters require gradients."""
    draw = generator(0, "gaussians")
    rand = lambda *shape: torch.rand(*shape, generator=draw)
    means = torch.cat([rand(number, 2) * 2.4 - 1.2, 2 + rand(number, 1)], 1)
    sizes = torch.full((number, 3), float(np.log(2.0 / number**0.5))) + 0.3 * rand(number, 3)
    harmonics = torch.cat([rand(number, 1, 3) - 0.5, 0.1 * (rand(number, (degree + 1) ** 2 - 1, 3) - 0.5)], 1)
    cloud = Gaussians(means, rand(number, 4) - 0.5, sizes, 2 * rand(number), harmonics)
    return cloud.map(lambda p: p.to(device).requires_grad_(True))


def sds_step(
    prior: Prior, text: torch.Tensor, view: TrainView, scene: Gaussians, sds: SdsTerm, step: int = 0
) -> dict[str, float]:
    """Evaluate the SDS term of the library once, with its backward pass into the Gaussians.

    Args:
        prior: the prior.
        text: embedded prompts.
        view: training view.
        scene: the Gaussians; gradients are added to their `.grad`.
        sds: parameters of the term.
        step: number of the step, which seeds the draws.

    Returns:
        "gradient_norm": L2 norm of the gradient of 0.001 times the term with respect to the harmonics.

    Raises:
        FloatingPointError: this norm is 0 or not finite.
    """
    masked = torch.ones(len(scene), dtype=torch.bool, device=scene.means.device)
    loss, _ = evaluate_sds(scene, masked, view, prior, text, sds, generator(0, "sds", step))
    (1e-3 * loss).backward()
    norm = float(scene.sh.grad.norm())
    if not (np.isfinite(norm) and norm > 0):
        raise FloatingPointError(f"the SDS gradient's norm is {norm}")
    return {"gradient_norm": norm}


if __name__ == "__main__":
    print(json.dumps(peak_memory(SD2, torch.bfloat16), indent=1))

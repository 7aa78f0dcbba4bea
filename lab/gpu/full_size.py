"""One personalization step and one SDS step of the full-size SD2-inpainting on this machine, with random weights.

The configurations are the published ones (`random_priors`); the steps are those of the library. The script also
compares the noise (epsilon) that the trained model predicts with that of a fresh model of the same weights, into which
the saved LoRA is merged. It reports the largest difference, which should be rounding only.

    python -m lab.gpu.full_size --dtype bfloat16 --out runs/full-size      (--toy: the same at a small size)
"""

from __future__ import annotations

import argparse
import gc
import json
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lab.gpu.random_priors import SD2, Shape, assemble_prior, build_prior, count_parameters, networks, shrink
from reffusion.distill.terms.sds import evaluate_sds
from reffusion.distill.train_view import TrainView
from reffusion.params.base import Prompts
from reffusion.params.distill import SdsTerm
from reffusion.params.personalize import Optimizer, Params
from reffusion.prior import crops, denoising, diffusion, lora, memory
from reffusion.prior.model import Prior, drop_text_encoders, enable_checkpointing
from reffusion.prior.personalize import WEIGHT_DECAY, train_step
from reffusion.seeding import generator
from reffusion.types import Camera, Gaussians
from reffusion.weights import published


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


def personalization_step(prior: Prior, picture: crops.Picture, batch: int, folder: Path) -> dict[str, float]:
    """Attach a LoRA to the prior in place, make one personalization step, and save the LoRA to `folder`.

    Returns:
        "loss" of the step, and "lora_unet" and "lora_text", the sums of absolute values of the LoRA's weights after it.
    """
    trained, optimizer, training = trainer(prior, batch)
    loss = train_step(prior, optimizer, [picture], training, 0)
    lora.set_dropout(prior, False)
    lora.save(prior, folder)
    moved = {f"lora_{part}": sum(float(p.detach().abs().sum()) for p in of) for part, of in trained.items()}
    return {"loss": loss} | moved


@torch.no_grad()
def epsilon(prior: Prior) -> torch.Tensor:
    """Return the noise that the prior predicts for a fixed input, to be compared before and after saving the LoRA."""
    side, draw = prior.native_size // prior.factor, generator(0, "epsilon")
    channels = prior.vae.config.latent_channels
    noisy, blanked = (torch.randn(1, channels, side, side, generator=draw).to(prior.device) for _ in range(2))
    condition = torch.cat([torch.ones_like(noisy[:, :1]), blanked], 1)
    at = torch.tensor([500], device=prior.device)
    return diffusion.raw_prediction(prior, noisy, at, condition, diffusion.embed_text(prior, [Prompts().whole])).cpu()


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


# ---------------------------------------------------------------------------------------------------------------- main


def record_time(report: dict[str, Any], name: str, work: Any) -> Any:
    """Call `work`, record and print its time and the process's peak memory so far, and return its result.

    Args:
        report: receives under `name` "seconds" (wall time), "cpu_seconds" and "peak_gb", and the entries of the result
            if it is a dictionary.
        name: name of the measured work.
        work: function to call.
    """
    began, cpu = time.perf_counter(), time.process_time()
    result = work()
    line = {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - cpu}
    line["peak_gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    report[name] = {key: round(value, 3) for key, value in line.items()}
    report[name] |= result if isinstance(result, dict) else {}
    print(f"{name:<24} {json.dumps(report[name])}", flush=True)
    return result


def run(shape: Shape, dtype: torch.dtype, options: argparse.Namespace) -> dict[str, Any]:
    """Run one personalization step and one SDS step on the CPU, test the saved LoRA, and return the measurements.

    Args:
        shape: configuration of the prior.
        dtype: dtype of UNet and text encoders.
        options: the parsed command line.

    Returns:
        "parameters", "dtype", "size" (px), the measurements of `record_time`, and "epsilon difference": the largest
        absolute difference of the noise predicted with the saved LoRA from that of the trained model; "epsilon size":
        the largest absolute value of the latter.
    """
    options.out.mkdir(parents=True, exist_ok=True)
    report: dict[str, Any] = {
        "parameters": count_parameters(shape),
        "dtype": str(dtype),
        "size": shape.unet["sample_size"] * 8,
    }

    def made() -> Prior:
        prior = build_prior(shape, dtype)
        return enable_checkpointing(prior) if options.checkpointing else prior

    prior = record_time(report, "build", made)
    report["size"] = size = prior.native_size
    picture = reference(size)
    record_time(
        report, "personalization step", lambda: personalization_step(prior, picture, options.batch, options.out)
    )
    before = record_time(report, "epsilon of the trained", lambda: epsilon(prior))
    del prior
    gc.collect()
    prior = lora.merge(record_time(report, "build again", made), options.out)
    after = record_time(report, "epsilon of the loaded", lambda: epsilon(prior))
    report["epsilon difference"] = float((after - before).abs().max())
    report["epsilon size"] = float(before.abs().max())
    with torch.no_grad():
        text = record_time(report, "embed prompts", lambda: diffusion.embed_text(prior, Prompts().texts))
    prior = drop_text_encoders(prior)
    gc.collect()
    sds, scene = SdsTerm(patches=options.patches), gaussians(options.gaussians, "cpu")
    record_time(report, "SDS step", lambda: sds_step(prior, text, train_view(size, "cpu"), scene, sds))
    return report


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dtype", choices=["float32", "bfloat16"], default="bfloat16")
    parser.add_argument("--size", type=int, default=0, help="native side in px; 0: the published one")
    parser.add_argument("--batch", type=int, default=1, help="samples of the personalization step")
    parser.add_argument("--patches", type=int, default=2, help="local patches of the SDS step")
    parser.add_argument("--gaussians", type=int, default=2000)
    parser.add_argument("--memory-gb", type=float, default=20.0, help="refuse to start if the weights need more")
    parser.add_argument("--checkpointing", action="store_true")
    parser.add_argument("--toy", action="store_true", help="few channels, 32 px")
    parser.add_argument("--count", action="store_true", help="only count the memory of one sample")
    parser.add_argument("--out", type=Path, default=Path("runs/full-size"))
    options = parser.parse_args()
    shape = shrink(SD2) if options.toy else SD2
    if options.size:
        factor = 2 ** (len(shape.vae["block_out_channels"]) - 1)
        shape = Shape(shape.unet | {"sample_size": options.size // factor}, shape.vae, shape.texts)
    if options.count:
        print(json.dumps(peak_memory(shape, getattr(torch, options.dtype)), indent=1))
        return
    need = 1.2 * count_parameters(shape) * (4 if options.dtype == "float32" else 2) / 1e9
    if need > options.memory_gb:
        parser.error(f"the weights alone take {need:.0f} GB, more than --memory-gb {options.memory_gb:g}")
    with memory.explain_oom("--size", options.size):
        report = run(shape, getattr(torch, options.dtype), options)
    (options.out / "full_size.json").write_text(json.dumps(report, indent=1) + "\n")
    if not options.toy and report["parameters"] != published.PUBLISHED[published.SD2].parameters:
        raise SystemExit(
            f"error: reffusion/weights/published.py states another number of parameters: {report['parameters']}"
        )


if __name__ == "__main__":
    main()

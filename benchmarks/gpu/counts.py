"""Table of the cost model: operations and bytes of the parts of a step at full size, mostly counted without computing.

The script runs the networks on torch's meta device, and the reconstruction loss and Adam on the CPU at a small size,
scaled up. It counts the floating-point operations of matrix products and convolutions, and the bytes that all
operations read and write. Large attention matrices are left out, because GPU kernels do not write them.

    python -m benchmarks.gpu.counts > reffusion/cost/counts.py
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.gpu import full_size
from reffusion.distill.discriminator import Critic, critic_loss, generator_loss, gradient_penalty
from reffusion.gaussians import adam, optimize
from reffusion.gaussians.ssim import dssim_torch
from reffusion.prior import denoising, diffusion
from reffusion.prior.model import Prior

HEIGHT, WIDTH, GAUSSIANS = 300, 400, 1000  # image size and number of Gaussians of counts per pixel and per Gaussian
# The operations that read or write attention matrices
ATTENTION = ("bmm", "_safe_softmax", "_softmax_backward_data", "_to_copy")
PATCHES, SIDE = 64, 64  # number and side in px of the critic's patches, as in the paper


class _TrafficCounter(TorchDispatchMode):
    """Counter of the bytes of all operations' inputs and outputs.

    Views of tensors and operations on large attention matrices count nothing.
    """

    def __init__(self) -> None:
        super().__init__()
        self.bytes = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        inputs = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        outputs = [leaf for leaf in tree_leaves(result) if isinstance(leaf, Tensor)]
        homes = {leaf.untyped_storage()._cdata for leaf in inputs}
        name = func.__name__.split(".")[0]
        view = outputs and all(leaf.untyped_storage()._cdata in homes for leaf in outputs) and not name.endswith("_")
        attends = name in ATTENTION and any(map(_is_large_square, inputs + outputs))
        if not view and not attends:
            self.bytes += sum(leaf.numel() * leaf.element_size() for leaf in inputs + outputs)
        return result


def _is_large_square(tensor: Tensor) -> bool:
    """Return whether the last two sides of a tensor are equal and at least 1024, as those of a large attention matrix.

    A feature map may have this shape, too.
    """
    return tensor.ndim >= 3 and tensor.shape[-1] == tensor.shape[-2] >= 1024


def count_work(work: Callable[[], object]) -> dict[str, float]:
    """Count the operations ("tflop", 1e12) and the moved bytes ("gb", 1e9) of one call of `work`."""
    with FlopCounterMode(display=False) as flops, _TrafficCounter() as moved:
        work()
    return {"tflop": round(flops.get_total_flops() / 1e12, 5), "gb": round(moved.bytes / 1e9, 5)}


def count_prior(shape: full_size.Shape, name: str) -> dict[str, dict[str, float]]:
    """Count the work of a prior for one sample at its native size.

    Counted are the UNet, encoding, encoding with its backward pass, decoding, and a personalization sample forward and
    backward. For SDXL, which only inpaints references, nothing is counted backward.

    Args:
        shape: configuration of the prior.
        name: name of the prior, which begins the names of the counts.

    Returns:
        Name of a computation -> counts as from `count_work`.
    """
    with torch.device("meta"):
        models = full_size.networks(shape, torch.float16)
    prior = full_size.assemble_prior(shape, models, "meta")
    size, side = prior.native_size, prior.native_size // prior.factor
    image = torch.zeros(1, 3, size, size, device="meta")
    latents = torch.zeros(1, 4, side, side, device="meta")
    counts = {
        "unet": count_work(lambda: run_unet(prior, latents)),
        "encode": count_work(_without(diffusion.encode, prior, image)),
    }
    counts["decode"] = count_work(_without(diffusion.decode, prior, latents))
    if prior.text_encoder_2 is None:  # SDXL only inpaints references
        graded = image.clone().requires_grad_()
        counts["encode and back"] = count_work(lambda: diffusion.encode(prior, graded).sum().backward())
        full_size.trainer(prior, 1)
        picture = full_size.reference(size)
        counts["personalize a sample"] = count_work(lambda: denoising.backward_one_sample(prior, [picture], 0))
    return {f"{name} {part}": each for part, each in counts.items()}


def _without(function: Callable[..., Tensor], *arguments: Any) -> Callable[[], Tensor]:
    """Return a function that calls `function` without recording gradients."""

    def work() -> Tensor:
        with torch.no_grad():
            return function(*arguments)

    return work


@torch.no_grad()
def run_unet(prior: Prior, latents: Tensor) -> None:
    """Run the UNet once, with dummy text and mask."""
    text = torch.zeros(1, 78, prior.unet.config.cross_attention_dim, device="meta")
    condition = torch.cat([latents[:, :1], latents], 1)
    diffusion.raw_prediction(prior, latents, torch.zeros(1, dtype=torch.long, device="meta"), condition, text)


def count_critic_step(width: int) -> dict[str, float]:
    """Count one adversarial step: the critic's loss with R1 and its backward pass, then the generator's.

    These are the computations of `Adversary.train_step`, without the optimizer, and of `Adversary.generator_loss`.

    Args:
        width: channels of the critic.
    """
    critic = Critic(SIDE, width, torch.Generator()).to("meta")
    real = torch.zeros(PATCHES, 3, SIDE, SIDE, device="meta")
    leaf = torch.zeros(PATCHES, 3, SIDE, SIDE, device="meta", requires_grad=True)

    def work() -> None:
        fake = 1 * leaf  # a product, because the counter cannot follow a leaf tensor
        scores = critic(fake)
        (critic_loss(critic(real), scores) + gradient_penalty(scores, fake)).backward()
        critic.requires_grad_(False)
        generator_loss(critic(1 * leaf)).backward()

    return count_work(work)


def count_depth_network(height: int = 518, width: int = 686) -> dict[str, float]:
    """Count the work of Depth Anything V2 Small on a 4:3 view."""
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config

    backbone = Dinov2Config(
        hidden_size=384, num_hidden_layers=12, num_attention_heads=6, image_size=518, patch_size=14,
        out_features=["stage3", "stage6", "stage9", "stage12"], reshape_hidden_states=False,
    )  # fmt: skip
    with torch.device("meta"):
        model = DepthAnythingForDepthEstimation(DepthAnythingConfig(
            backbone_config=backbone, reassemble_hidden_size=384, neck_hidden_sizes=[48, 96, 192, 384],
            fusion_hidden_size=64, head_hidden_size=32,
        ))  # fmt: skip
    picture = torch.zeros(1, 3, height, width, device="meta")
    return count_work(lambda: _without(lambda: model(pixel_values=picture).predicted_depth)())


def count_pixel_loss() -> dict[str, float]:
    """Count the reconstruction loss and its backward pass, per million pixels of three channels.

    gsplat's reads and writes, about as much again, are not included.
    """
    image = torch.zeros(HEIGHT, WIDTH, 3, requires_grad=True)

    def work() -> None:
        difference = (image - torch.zeros(HEIGHT, WIDTH, 3)).abs().mean()
        (0.8 * difference + 0.2 * dssim_torch(image, torch.zeros(HEIGHT, WIDTH, 3))).backward()

    return _scaled(count_work(work), HEIGHT * WIDTH)


def count_adam() -> dict[str, float]:
    """Count one Adam step, per million Gaussians of degree 3, all visible."""
    scene = full_size.gaussians(GAUSSIANS, "cpu")
    optimizer = optimize.GaussianOptimizer(scene)
    rates = optimizer.rates.at(0.0, optimizer.gaussians)
    updates = []
    for name in optimize.PARAMETERS:
        rows = [optimize._rows(getattr(each, name)) for each in optimizer._states()]
        updates.append(adam.Update(*rows, torch.zeros_like(rows[0]), rates[name], 1.0))
    everyone, steps = torch.ones(GAUSSIANS, dtype=torch.bool), torch.ones(GAUSSIANS, dtype=torch.int32)
    arguments = (steps, everyone, ~everyone, *adam.unbiasing((0.9, 0.999), 1, steps.device), 0.9, 0.999, 1e-15)
    return _scaled(count_work(lambda: adam.adam(updates, *arguments)), GAUSSIANS)


def _scaled(counts: dict[str, float], count: int) -> dict[str, float]:
    """Return counts per million pixels or Gaussians, from the counts of `count` of them."""
    return {name: round(value * 1e6 / count, 5) for name, value in counts.items()}


def main() -> None:
    counts = count_prior(full_size.SD2, "SD2") | count_prior(full_size.SDXL, "SDXL")
    counts |= {f"critic {width}": count_critic_step(width) for width in (256, 512)}
    counts |= {"depth network": count_depth_network(), "loss, a million pixels": count_pixel_loss()}
    counts["Adam, a million Gaussians"] = count_adam()
    rows = "".join(f"    {json.dumps(name)}: {json.dumps(each)},\n" for name, each in counts.items())
    print('"""TFLOP and GB of the parts of a step: made by `python -m benchmarks.gpu.counts`."""')
    print(f"\nCOUNTS = {{\n{rows}}}")


if __name__ == "__main__":
    main()

"""Parts of gpu-check that measure seconds and memory: one step of each loss at the paper's sizes, and a fit.

A step of a loss term is its evaluation on one view, with all renderings, and the backward pass into the Gaussians,
without the step of their optimizer. Each part takes the `Bench` with device and sizes. It returns the measurements of
`Bench.measure` and facts on the step.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lab.gpu import full_size
from lab.gpu.bench import PAPER, Bench, Sizes
from reffusion import trace
from reffusion.depth import monocular
from reffusion.depth.background_depth import CompletionSettings, ViewDepth
from reffusion.distill.adversary import Adversary
from reffusion.distill.depth_estimator import DepthEstimator, network_estimator
from reffusion.distill.terms.adversarial import evaluate_adversarial
from reffusion.distill.terms.depth import evaluate_depth
from reffusion.distill.terms.reconstruction import evaluate_reconstruction
from reffusion.distill.terms.reference import evaluate_reference
from reffusion.fit.reconstruction import fit
from reffusion.geometry import Degenerate
from reffusion.params.base import Prompts
from reffusion.params.distill import DepthTerm, SdsTerm
from reffusion.params.fit import Densify, Params, SphericalHarmonics
from reffusion.prior import denoising, diffusion, memory
from reffusion.prior.model import Prior, drop_text_encoders
from reffusion.prior.personalize import train_step
from reffusion.seeding import generator
from reffusion.splat import rasterizer
from reffusion.types import PARAMETERS, Camera, Gaussians
from reffusion.weights import local, published


def backpropagate(scene: Gaussians, loss: Tensor) -> None:
    """Run the backward pass of a loss into the Gaussians of a scene, and drop the gradients."""
    loss.backward()
    for name in PARAMETERS:
        getattr(scene, name).grad = None


def reconstruction(bench: Bench) -> dict[str, Any]:
    """Measure a step of the reconstruction term."""
    (scene, masked), view = bench.scene(), full_size.train_view(bench.sizes.rows, bench.device)
    return bench.measure(lambda: backpropagate(scene, evaluate_reconstruction(scene, ~masked, view)[0]))


def reference(bench: Bench) -> dict[str, Any]:
    """Measure a step of the reference term."""
    (scene, masked), view = bench.scene(), full_size.train_view(bench.sizes.rows, bench.device)
    return bench.measure(
        lambda: backpropagate(scene, evaluate_reference(scene, masked, view.camera, view.picture, view.repaint)[0])
    )


def personalization(bench: Bench) -> dict[str, Any]:
    """Measure a personalization step with the paper's LoRA, with the optimizer's step.

    As many samples of the batch run at once as fit into 20 GB.
    """
    prior, source = bench.prior("bfloat16")
    picture = full_size.reference(prior.native_size)
    trained, optimizer, training = full_size.trainer(prior, bench.sizes.batch)
    prior = memory.fit_to_memory(
        prior, 20.0, "personalize.memory_gb", lambda p: denoising.backward_one_sample(p, [picture], 0)
    )
    values = bench.measure(lambda: {"loss": train_step(prior, optimizer, [picture], training, 0)})
    moved = sum(float(p.detach().abs().sum()) for p in trained["text"])
    bench.forget_prior()  # its layers now have a LoRA
    return values | {"batch": bench.sizes.batch, "rows": prior.rows_with_grad, "lora_text": moved, "weights": source}


def prior_and_prompts(bench: Bench) -> tuple[Prior, Tensor, str]:
    """Return the prior without its text encoder, the embedded prompts, and the source of the weights."""
    prior, source = bench.prior("float16")
    with torch.no_grad():
        return drop_text_encoders(prior), diffusion.embed_text(prior, Prompts().texts), source


def distillation(bench: Bench) -> dict[str, Any]:
    """Measure a step of the SDS term."""
    prior, text, source = prior_and_prompts(bench)
    (scene, _), view = bench.scene(), full_size.train_view(bench.sizes.rows, bench.device)

    def step() -> dict[str, float]:
        values = full_size.sds_step(prior, text, view, scene, SdsTerm())
        for name in PARAMETERS:
            getattr(scene, name).grad = None
        return values

    return bench.measure(step) | {"weights": source}


def depth(bench: Bench) -> dict[str, Any]:
    """Measure a step of the depth term, which inpaints a view and estimates its depth."""
    prior, text, source = prior_and_prompts(bench)
    (scene, masked), view = bench.scene(), full_size.train_view(bench.sizes.rows, bench.device)
    estimator, whose = depth_estimator(bench.sizes, bench.device)

    def step() -> dict[str, float]:
        draw = generator(0, "depth")
        loss, _ = evaluate_depth(scene, masked, view, prior, text, DepthTerm(), SdsTerm().guidance, draw, estimator)
        backpropagate(scene, loss)
        return {"loss": float(loss.detach())}

    return bench.measure(step) | {"weights": f"{source}, {whose}"}


def adversarial(bench: Bench) -> dict[str, Any]:
    """Measure a step of the adversarial term, with the critic's own optimizer step."""
    bench.forget_prior()
    (scene, masked), view = bench.scene(), full_size.train_view(bench.sizes.rows, bench.device)
    critic = Adversary(bench.sizes.critic, 0, bench.device)

    def step() -> dict[str, float]:
        draw = generator(0, "patches")
        loss, _, values = evaluate_adversarial(scene, masked, view, view.picture, view.repaint, critic, draw)
        backpropagate(scene, loss)
        return values

    return bench.measure(step)


def depth_estimator(sizes: Sizes, device: str) -> tuple[DepthEstimator, str]:
    """Return a depth estimator with Depth Anything V2 Small, and the source of its weights.

    The weights are the published ones if they are on this machine and `sizes` is `PAPER`, else random. With random
    weights the disparity may have the wrong sign, so the opposite sign is tried if the first one does not fit the
    scene.
    """
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config

    if sizes == PAPER and local.locate(published.DEPTH_ANYTHING) is not None:
        network, source = monocular.load_network(published.DEPTH_ANYTHING, device), published.DEPTH_ANYTHING
    else:
        backbone = Dinov2Config(
            hidden_size=384, num_hidden_layers=12, num_attention_heads=6, image_size=518 if sizes == PAPER else 56,
            patch_size=14, out_features=["stage3", "stage6", "stage9", "stage12"], reshape_hidden_states=False,
        )  # fmt: skip
        torch.manual_seed(0)
        model = DepthAnythingForDepthEstimation(DepthAnythingConfig(
            backbone_config=backbone, reassemble_hidden_size=384, neck_hidden_sizes=[48, 96, 192, 384],
            fusion_hidden_size=64, head_hidden_size=32, initializer_range=0.1,
        ))  # fmt: skip
        torch.nn.init.constant_(model.head.conv3.bias, 1e4)  # so that the last ReLU does not cut nearly all values to 0
        network, source = monocular.make_network(model, device), "random"
    tries = [
        network_estimator(
            lambda image, sign=sign: sign * monocular.predict_disparity(network, image), CompletionSettings()
        )
        for sign in (1, -1)
    ]

    def disparity(view: ViewDepth, picture: Callable[[], np.ndarray]) -> np.ndarray:
        painted = picture()
        try:
            return tries[0].disparity(view, lambda: painted)
        except Degenerate:
            return tries[1].disparity(view, lambda: painted)

    return DepthEstimator(tries[0].how, disparity), source


def fit_scene(bench: Bench) -> dict[str, Any]:
    """Fit Gaussians to renders of known Gaussians, starting from shifted Gaussians with weaker colors.

    Returns:
        "size" of the images, "images_per_second" (steps per second of the fit), "psnr_before" and "psnr_after" of the
        first view in dB, and "ok": True if the PSNR has increased.
    """
    sizes, device, out = bench.sizes, bench.device, bench.out
    truth = full_size.gaussians(sizes.gaussians, device, degree=1).map(Tensor.detach)
    cameras, images = [], {}
    for k in range(sizes.views):
        base, pose = full_size.train_view(sizes.rows, "cpu").camera, np.eye(4)
        pose[0, 3] = 0.3 * (k / max(sizes.views - 1, 1) - 0.5)
        camera = Camera(f"v{k}", base.width, base.height, base.fx, base.fy, base.cx, base.cy, pose)
        with torch.no_grad():
            color = rasterizer.render(truth, camera).color.clamp(0, 1)
        cameras.append(camera)
        images[camera.name] = (color * 255).round().to(torch.uint8).cpu().numpy()
    noise = torch.randn(truth.means.shape, generator=generator(0, "start")).to(device)
    start = truth.map(lambda p: p.clone())
    start.means.add_(0.003 * noise)
    start.sh.mul_(0.5)

    def psnr(gaussians: Gaussians) -> float:
        with torch.no_grad():
            color = rasterizer.render(gaussians, cameras[0]).color.clamp(0, 1).cpu()
        error = (color - torch.from_numpy(images[cameras[0].name]) / 255).square().mean()
        return float(-10 * error.log10())

    before = psnr(start)
    densify, sh = Densify(stop=0.0, cap_max=2 * sizes.gaussians), SphericalHarmonics(degree=1)
    settings = Params(iterations=sizes.fit_steps, sh=sh, densify=densify)
    trace.clear_checkpoint(out)  # an interrupted check may have left a checkpoint, from which the fit would continue
    began = time.perf_counter()
    after = psnr(fit(cameras, images, start, settings, folder=out))
    seconds = time.perf_counter() - began
    trace.clear_checkpoint(out)
    size = f"{cameras[0].width}x{cameras[0].height}"
    rate = sizes.fit_steps / seconds
    return {"size": size, "images_per_second": rate, "psnr_before": before, "psnr_after": after, "ok": after > before}

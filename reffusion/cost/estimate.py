"""Estimate of the time and the memory that a stage needs on a GPU.

The time is the number of operations and bytes of a stage, counted at full size (counts.py), over the GPU's peak rates.
The work of a stage is that of all its steps, without regard to a time budget. The estimate assumes two fifths of each
peak rate, and no overlap of computation and memory traffic. On the only kind of GPU that was timed, an H200, the
estimate differs from the measured time by at most a fifth (docs/gpu.md). A plan does not know the size of the scene
yet, so an example scene is assumed, which `BASIS` states. The CPU time of a stage is not included.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from reffusion.cost.counts import COUNTS
from reffusion.io.machine import detect
from reffusion.params.base import PRIOR, REFINED_FROM
from reffusion.params.distill import Params as Distill
from reffusion.params.fit import Params as Fit
from reffusion.params.personalize import Params as Personalize
from reffusion.params.reference import Params as Reference

PEAK_SHARE = 0.4  # share of a GPU's peak rates that is reached
VIEWS, WIDTH, HEIGHT, GAUSSIANS = 60, 1600, 1200, 1_000_000  # the assumed scene
MEAN_SHARE = 0.6  # mean number of Gaussians during a fit, as a share of the final number
HOLE_SHARE = 0.2  # share of a view's pixels that is inpainted
BASIS = (
    f"counted operations, {PEAK_SHARE:.0%} of the GPU's peak as timed on an H200; {VIEWS} views of {WIDTH} x "
    f"{HEIGHT} px, {GAUSSIANS:,} Gaussians"
)
# Floats of a Gaussian with harmonics of degree 3, and copies in memory: parameters, gradient, two moments of Adam.
FLOATS, COPIES = 59, 4
# SPLAT_BYTES, PIXEL_BYTES: bytes that gsplat moves per Gaussian and per pixel, forward and backward (parameters,
# footprint, 10 list entries). SPLAT_FLOPS: operations per pixel, 100 per Gaussian. Views of the demo blend 36 Gaussians
# per pixel and evaluate three times as many.
SPLAT_BYTES, PIXEL_BYTES, SPLAT_FLOPS = 3000, 200, 3 * 36 * 100
# GB of SD2's weights, and of one sample in inpainting, SDS and personalization, in half precision at 512 px, from
# `python -m benchmarks.gpu.full_size --count`.
WEIGHTS, PAINTED, DISTILLED, TRAINED = 2.7, 0.8, 3.3, 3.9
SDXL = "diffusers/stable-diffusion-xl-1.0-inpainting-0.1"
PRIORS = {PRIOR: ("SD2", 512), SDXL: ("SDXL", 1024)}  # hub id -> (name in the counts, native size in pixels)


@dataclass(frozen=True)
class Gpu:
    """Peak rates of a GPU, as stated by its manufacturer.

    Attributes:
        half: rate of matrix products in half precision, 1e12 operations per second.
        single: the same in float32 (in TF32 if the GPU has it, which torch's convolutions use).
        plain: rate of other float32 arithmetic, 1e12 operations per second.
        bandwidth: memory bandwidth, 1e12 bytes per second.
        gigabytes: size of the memory, GB.
    """

    half: float
    single: float
    plain: float
    bandwidth: float
    gigabytes: float


GPUS = {
    "rtx-3090": Gpu(71, 35.6, 35.6, 0.936, 24),
    "rtx-4090": Gpu(165, 82.6, 82.6, 1.008, 24),
    "a100": Gpu(312, 156, 19.5, 2.0, 80),
    "h100": Gpu(989, 494, 67, 3.35, 80),
    "h200": Gpu(989, 494, 67, 4.8, 141),
}


def find_gpu(name: str) -> str | None:
    """Find a GPU in the table `GPUS` by its name in any spelling, such as "NVIDIA GeForce RTX 4090".

    Args:
        name: name of the GPU; "" for the GPU of this machine.

    Returns:
        The key in `GPUS`. None if `name` is "" and this machine has no GPU of the table.

    Raises:
        ValueError: `name` is not in the table.
    """
    normalize = lambda text: re.sub(r"[^a-z0-9]", "", text.lower())
    requested = name or detect().gpu or ""
    match = next((gpu for gpu in GPUS if requested and normalize(gpu) in normalize(requested)), None)
    if name and not match:
        raise ValueError(f"GPU {name!r} is none of {', '.join(GPUS)}")
    return match


@dataclass(frozen=True)
class Work:
    """An amount of computation and memory traffic.

    Attributes:
        half: operations of matrix products and convolutions in half precision, 1e12.
        single: the same in float32, 1e12.
        plain: other float32 operations, 1e12.
        moved: bytes read and written, 1e12.
    """

    half: float = 0.0
    single: float = 0.0
    plain: float = 0.0
    moved: float = 0.0

    def __add__(self, other: Work) -> Work:
        return Work(*(getattr(self, name) + getattr(other, name) for name in self.__dataclass_fields__))

    def times(self, count: float) -> Work:
        """Return `count` times this work."""
        return Work(*(getattr(self, name) * count for name in self.__dataclass_fields__))

    def seconds(self, gpu: Gpu) -> float:
        """Return the estimated time of this work on a GPU at the share `PEAK_SHARE` of its peak rates."""
        computing = self.half / gpu.half + self.single / gpu.single + self.plain / gpu.plain
        return (computing + self.moved / gpu.bandwidth) / PEAK_SHARE


def network(name: str, half: bool = False) -> Work:
    """Return the work of one pass of an entry of `COUNTS`.

    Args:
        name: key of `COUNTS`.
        half: True if the operations run in half precision, False if they run in float32.
    """
    tera = COUNTS[name]["tflop"]
    return Work(tera * half, tera * (not half), 0.0, COUNTS[name]["gb"] / 1e3)


def rendering(pixels: float, gaussians: float) -> Work:
    """Return the work of rendering a view, forward and backward.

    Args:
        pixels: number of pixels.
        gaussians: number of Gaussians.
    """
    return Work(plain=SPLAT_FLOPS * pixels / 1e12, moved=(SPLAT_BYTES * gaussians + PIXEL_BYTES * pixels) / 1e12)


def reconstruction(gaussians: float) -> Work:
    """Return the work of one reconstruction step on a view of the assumed size: rendering and loss, without Adam.

    Args:
        gaussians: number of Gaussians.
    """
    return rendering(WIDTH * HEIGHT, gaussians) + network("loss, a million pixels").times(WIDTH * HEIGHT / 1e6)


def adam(gaussians: float) -> Work:
    """Return the work of one step of Adam on all parameters of `gaussians` Gaussians."""
    return network("Adam, a million Gaussians").times(gaussians / 1e6)


def inpainting(prior: str, half: bool, steps: float, guided: bool) -> Work:
    """Return the work of inpainting a picture at the prior's native size, with encoding and decoding.

    Args:
        prior: "SD2" or "SDXL".
        half: True if the UNet runs in half precision.
        steps: steps of the sampler.
        guided: True for classifier-free guidance, which evaluates the UNet twice per step.
    """
    known = network(f"{prior} encode").times(2) + network(f"{prior} decode")
    return known + network(f"{prior} unet", half).times(steps * (1 + guided))


def fit(params: Fit) -> tuple[Work, float]:
    """Return the work of the stage `fit` and the GPU memory that it needs, in GB."""
    number = min(GAUSSIANS, params.densify.cap_max)
    step = reconstruction(MEAN_SHARE * number) + adam(MEAN_SHARE * number)
    return step.times(params.iterations), _scene(number)


def reference(params: Reference) -> tuple[Work, float] | None:
    """Return the work of the stage `reference` and the GPU memory that it needs, in GB.

    None if no diffusion prior inpaints, or if the prior is not in `PRIORS`.
    """
    if params.prior not in PRIORS or params.inpainter.kind != "diffusion":
        return None
    prior, size = PRIORS[params.prior]
    finer, side = 0.0, 2 * size
    while side < 2 * HEIGHT:  # windows of 3/4 of the native size over the hole, at sizes up to that of the view
        shorter = min(side, HEIGHT)
        finer += max(1.0, HOLE_SHARE * shorter * shorter * WIDTH / HEIGHT / (0.75 * size) ** 2)
        side *= 2
    sampler, half = params.sampler, params.dtype != "float32"
    guided = sampler.guidance > 0 and bool(params.prompt)
    whole = inpainting(prior, half, sampler.steps, guided)
    window = inpainting(prior, half, REFINED_FROM * sampler.steps, guided)
    return (whole + window.times(finer)).times(params.candidates), WEIGHTS * (2.6 if prior == "SDXL" else 1) + PAINTED


def personalize(params: Personalize) -> tuple[Work, float] | None:
    """Return the work of the stage `personalize` and the GPU memory that it needs, in GB; None if the prior is not the
    default SD2."""
    if params.prior != PRIOR:
        return None
    rate = (params.samples.size or 512) / 512
    sample = network("SD2 personalize a sample", params.dtype != "float32").times(rate**2)
    samples = _samples_per_pass(params.memory_gb, TRAINED * rate**2, params.optimizer.batch)
    recompute = 4 / 3 if params.checkpointing else 1  # activations are computed twice
    return sample.times(params.steps * params.optimizer.batch * recompute), WEIGHTS + samples * TRAINED * rate**2


def distill(params: Distill) -> tuple[Work, float] | None:
    """Return the work of the stage `distill` and the GPU memory that it needs, in GB; None if the prior is not the
    default SD2."""
    if params.prior != PRIOR:
        return None
    half, samples = params.dtype != "float32", 1 + params.sds.patches
    view, sds = rendering(WIDTH * HEIGHT, GAUSSIANS), Work()
    step = adam(GAUSSIANS)
    if params.reconstruction.every:
        step += reconstruction(GAUSSIANS).times(1 / params.reconstruction.every)
    if params.sds.weight:
        unet = network("SD2 unet", half).times(1 + (params.sds.guidance > 0))
        sds = (network("SD2 encode and back") + network("SD2 encode") + unet).times(samples) + view
    if params.depth.weight:
        painted = inpainting("SD2", half, params.depth.steps / 2, params.sds.guidance > 0)
        sds += (painted + view + network("depth network")).times(1 / params.depth.every)
    if params.adversarial.weight:
        sds += view + _critic(params.adversarial.width, params.adversarial.patches * params.adversarial.size**2)
    gigabytes = WEIGHTS + _samples_per_pass(params.memory_gb, DISTILLED, samples) * DISTILLED + _scene(GAUSSIANS)
    photos = VIEWS * WIDTH * HEIGHT * 3 * 4 / 1e9
    return (step + sds).times(params.iterations), gigabytes + photos


def _critic(width: int, pixels: int) -> Work:
    """Return the work of one step of the critic, interpolated linearly between the two widths that were counted, and
    extrapolated beyond.

    Args:
        width: number of channels of the critic, `distill.adversarial.width`.
        pixels: number of pixels of all real patches of the step.
    """
    low, high = network("critic 256"), network("critic 512")
    share = (width - 256) / 256
    extrapolation = max(share, -0.95)
    return (low + (high + low.times(-1)).times(extrapolation)).times(pixels / (64 * 64**2))


def _scene(gaussians: float) -> float:
    """Return the GB of the Gaussians with their gradients and moments of Adam, and of the backward pass of a view."""
    return gaussians * FLOATS * COPIES * 4 / 1e9 + WIDTH * HEIGHT * PIXEL_BYTES / 1e9


def _samples_per_pass(memory_gb: float, sample: float, most: int) -> int:
    """Return how many samples a pass of the prior takes, 1 to `most`.

    Args:
        memory_gb: memory limit of the prior, GB; 0 for no limit.
        sample: memory of one sample, GB.
    """
    if not memory_gb:
        return most
    return max(1, min(most, int((0.9 * memory_gb - WEIGHTS) / sample)))


def format_estimate(name: str, device: str, found: tuple[Work, float] | None) -> Mapping[str, object] | None:
    """Return the estimate that a plan prints for a stage.

    Args:
        name: name of the GPU; "" for the GPU of this machine.
        device: the stage's device.
        found: the stage's work and GPU memory in GB; None if they are unknown.

    Returns:
        "gpu": key in `GPUS`; "seconds": time of the whole stage; "gb": GPU memory that the stage needs, GB; "basis":
        the assumptions. None if the stage does not run on "cuda", its work is unknown, or there is no known GPU.

    Raises:
        ValueError: `name` is not in the table `GPUS`, on whatever device the stage runs.
    """
    gpu = find_gpu(name)
    if gpu is None or device != "cuda" or found is None:
        return None
    work, gigabytes = found
    return {"gpu": gpu, "seconds": work.seconds(GPUS[gpu]), "gb": gigabytes, "basis": BASIS}

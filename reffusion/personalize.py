"""Personalization (RefFusion section 4.1): the prior learns the reference, as a whole and in crops, by LoRA.

A sample is an image, a mask to repaint and a prompt; the loss is the prior's own denoising loss over the whole image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, isfinite, pi
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from reffusion import lora, trace
from reffusion import prior as diffusion
from reffusion.sds import enlarged, two_scale_masks, two_scales, window_around
from reffusion.trace import generator as seeded

PROMPTS = ("A photo of sks", "A photo of sks, cropped", "")
GLOBAL, LOCAL, EMPTY = 0, 1, 2


@dataclass(frozen=True)
class Picture:
    """A training picture.

    Attributes:
        image: [3, H, W] float32 in [-1, 1], no side shorter than the prior's native size.
        region: [H, W] bool; of a reference the pixels it stands for, of a scene's view those that must not be used.
    """

    image: Tensor
    region: Tensor


@dataclass(frozen=True)
class Sampling:
    """How a training sample is drawn. Shares are probabilities.

    PAPER leaves open all of these figures. Rectangles (count, side, inversion) and the share of empty prompts are
    RealFill's; half of the samples are local.

    Attributes:
        local_share: of the reference's samples, those that are native-size crops around its mask.
        scene_share: of all samples, crops of the scene's own views that touch none of their masked pixels (paper: 0).
        hole_share: of the reference's samples, those whose mask is the hole itself (paper: 0). That is the mask of the
            job; rectangles leave most of the hole to be seen, and a short training does not get beyond them.
        empty_share: samples whose prompt is replaced by the empty one, so that guidance stays meaningful.
        border: largest share of height or width that a global sample loses at each side.
        rectangles: smallest and largest number of rectangles in a mask.
        side: shortest and longest side of a rectangle, in sides of the sample.
        inverted_share: masks that repaint everything but their rectangles.
    """

    local_share: float = 0.5
    scene_share: float = 0.0
    hole_share: float = 0.0
    empty_share: float = 0.1
    border: float = 0.1
    rectangles: tuple[int, int] = (1, 29)
    side: tuple[float, float] = (0.03, 0.25)
    inverted_share: float = 0.5


class Samples(NamedTuple):
    """images [B, 3, n, n] in [-1, 1]; masks [B, 1, n, n], 1 = repaint; prompts [B] long, indices into PROMPTS."""

    images: Tensor
    masks: Tensor
    prompts: Tensor


def picture(image: Tensor, region: Tensor, size: int) -> Picture:
    """A `Picture` from a uint8 [H, W, 3] image and a bool [H, W] region, enlarged where shorter than `size` pixels."""
    floats = enlarged(image.permute(2, 0, 1).to(torch.float32) / 127.5 - 1, size)
    return Picture(floats, enlarged(region.to(torch.float32)[None], size)[0] > 1e-4)


def _uniform(low: float, high: float, generator: torch.Generator) -> float:
    return low + (high - low) * float(torch.rand((), generator=generator))


def rectangle_mask(size: int, sampling: Sampling, generator: torch.Generator) -> Tensor:
    """[1, size, size] float, 1 = repaint: a union of random rectangles, or everything but them."""
    fewest, most = sampling.rectangles
    mask = torch.zeros(1, size, size)
    for _ in range(int(torch.randint(fewest, most + 1, (), generator=generator))):
        height, width = (max(1, round(_uniform(*sampling.side, generator) * size)) for _ in range(2))
        top, left = (int(torch.randint(size - extent + 1, (), generator=generator)) for extent in (height, width))
        mask[:, top : top + height, left : left + width] = 1
    return 1 - mask if _uniform(0, 1, generator) < sampling.inverted_share else mask


def without_border(source: Picture, border: float, generator: torch.Generator) -> Picture:
    """The picture less a thin strip, drawn for each of its four sides: at most `border` of its height or width."""
    height, width = source.region.shape
    top, bottom = (int(_uniform(0, border, generator) * height) for _ in range(2))
    left, right = (int(_uniform(0, border, generator) * width) for _ in range(2))
    rows, columns = slice(top, height - bottom), slice(left, width - right)
    return Picture(source.image[:, rows, columns], source.region[rows, columns])


def clear_windows(region: Tensor, size: int) -> Tensor:
    """[K, 2] long, the (top, left) of every size x size window of a [H, W] bool region that holds no True pixel."""
    counts = torch.zeros(region.shape[0] + 1, region.shape[1] + 1, dtype=torch.int64)
    counts[1:, 1:] = region.to(torch.int64).cumsum(0).cumsum(1)
    inside = counts[size:, size:] - counts[:-size, size:] - counts[size:, :-size] + counts[:-size, :-size]
    return torch.nonzero(inside == 0)


class Clear(NamedTuple):
    """image [3, H, W]; windows [K, 2] long, (top, left) of its windows without a masked pixel, K > 0."""

    image: Tensor
    windows: Tensor


def clear_views(views: Sequence[Picture], size: int) -> list[Clear]:
    """The views that have a size x size window free of their region, with all such windows."""
    found = (Clear(view.image, clear_windows(view.region, size)) for view in views)
    return [view for view in found if len(view.windows)]


def draw_samples(
    references: Sequence[Picture],
    views: Sequence[Clear],
    native: int,
    size: int,
    count: int,
    sampling: Sampling,
    generator: torch.Generator,
) -> Samples:
    """`count` training samples of side `size`. All the randomness comes from `generator`.

    Args:
        references: what is to be learned; every pixel of them may be used.
        views: the scene's own views for `sampling.scene_share`, their windows of side `size`; none: no such samples.
        native: the side that distillation reduces a whole view to. A global sample is reduced to it as well, and,
            where `size` is smaller, a window of it that shows some of the hole, so that the model learns it in the
            scale it will see.
    """
    images, masks, prompts = [], [], []
    for _ in range(count):
        if views and _uniform(0, 1, generator) < sampling.scene_share:
            view = views[int(torch.randint(len(views), (), generator=generator))]
            top, left = view.windows[int(torch.randint(len(view.windows), (), generator=generator))].tolist()
            image, hole, prompt = view.image[:, top : top + size, left : left + size], None, LOCAL
        else:
            source = references[int(torch.randint(len(references), (), generator=generator))]
            image, hole, prompt = _of_reference(source, native, size, sampling, generator)
        images.append(image)
        as_asked = hole is not None and hole.any() and _uniform(0, 1, generator) < sampling.hole_share
        masks.append(hole if as_asked else rectangle_mask(size, sampling, generator))
        prompts.append(EMPTY if _uniform(0, 1, generator) < sampling.empty_share else prompt)
    return Samples(torch.stack(images), torch.stack(masks), torch.tensor(prompts))


def _of_reference(
    source: Picture, native: int, size: int, sampling: Sampling, generator: torch.Generator
) -> tuple[Tensor, Tensor, int]:
    """A local or global sample of a reference: image [3, size, size], its hole there [1, size, size], prompt."""
    if _uniform(0, 1, generator) < sampling.local_share:
        image, hole, prompt = source.image, source.region[None].to(torch.float32), LOCAL
    else:
        whole = without_border(source, sampling.border, generator)
        image, hole = two_scales(whole.image, [], native)[0], two_scale_masks(whole.region, [], native)[0]
        prompt = GLOBAL
    if hole.shape[-2:] == (size, size):
        return image, hole, prompt
    window = window_around if hole.any() else _window_anywhere  # a border may have been all of the hole
    top, left = window(hole[0] > 0, size, generator)
    return image[:, top : top + size, left : left + size], hole[:, top : top + size, left : left + size], prompt


def _window_anywhere(mask: Tensor, size: int, generator: torch.Generator) -> tuple[int, int]:
    return tuple(int(torch.randint(extent - size + 1, (), generator=generator)) for extent in mask.shape)


def spread_timesteps(count: int, steps: int, generator: torch.Generator) -> Tensor:
    """[count] long, each uniform in [0, steps), one in each of `count` equal parts: batches differ less."""
    places = torch.randperm(count, generator=generator) + torch.rand(1, generator=generator)
    return (places * (steps / count)).long().clamp(max=steps - 1)


def latent_shape(prior: diffusion.Prior, size: int) -> tuple[int, int, int]:
    """(C, h, w) of the latents of a size x size image."""
    side = size // prior.factor
    return prior.vae.config.latent_channels, side, side


def denoising_error(
    prior: diffusion.Prior, samples: Samples, timesteps: Tensor, noise: Tensor
) -> tuple[Tensor, Tensor]:
    """([B], [B]): mean squared error of the prior's own target over the whole image, and of the clean latent.

    The target is what the network was trained to predict: eps, or v = a eps - s z. PAPER leaves open: the target
    (its prior predicts eps) and whether the loss covers the whole image or the mask; as in RealFill it covers all.

    Args:
        timesteps: [B] long.
        noise: [B, C, h, w] standard normal, shaped as the latents.
    """
    images, masks = samples.images.to(prior.device), samples.masks.to(prior.device)
    timesteps, noise = timesteps.to(prior.device), noise.to(prior.device)
    with torch.no_grad():
        latents = diffusion.encode(prior, images)
        condition = diffusion.conditioning(prior, images, masks)
        noisy = diffusion.add_noise(prior, latents, noise, timesteps)
        target = diffusion.training_target(prior, latents, noise, timesteps)
    text = diffusion.embed_text(prior, list(PROMPTS))[samples.prompts.to(prior.device)]
    output = diffusion.raw_prediction(prior, noisy, timesteps, condition, text)
    error = (output - target).square().mean((1, 2, 3))
    # z_t is given, so both targets are linear in the clean latent: an error of 1 in it is one of a/s in eps, 1/s in v.
    alpha_bar = diffusion.abar(prior, timesteps).flatten()
    odds = alpha_bar if prior.prediction_type == "epsilon" else 1.0
    return error, (1 - alpha_bar) * error / odds


def held_out_samples(references: Sequence[Picture], size: int, seed: int) -> Samples:
    """The reference's own hole: the whole view and a crop. Same for equal seeds."""
    draw = seeded(seed, "personalize", "held out")
    first = references[0]
    windows = [window_around(first.region, size, draw)]
    masks = two_scale_masks(first.region, windows, size)
    return Samples(two_scales(first.image, windows, size), masks, torch.tensor([GLOBAL, LOCAL]))


def one_sample(prior: diffusion.Prior, references: Sequence[Picture], seed: int) -> None:
    """Loss and gradient of one sample: what `memory.fitted` measures."""
    sample = Samples(*(tensor[:1] for tensor in held_out_samples(references, prior.native_size, seed)))
    noise = torch.zeros(1, *latent_shape(prior, prior.native_size))
    denoising_error(prior, sample, torch.zeros(1, dtype=torch.long), noise)[0].sum().backward()


@torch.no_grad()
def held_out_error(prior: diffusion.Prior, samples: Samples, seed: int) -> dict[str, float]:
    """{"target_mse", "clean_latent_mse"} at three fixed timesteps with fixed noise: comparable through the training.

    It costs a small model about a step of training.
    """
    lora.set_dropout(prior, False)
    errors = []
    for level in (0.2, 0.55, 0.9):
        timesteps = torch.full((len(samples.prompts),), round(level * (prior.timesteps - 1)))
        draw = seeded(seed, "personalize", "held out", level)
        noise = torch.randn(len(samples.prompts), *latent_shape(prior, samples.images.shape[-1]), generator=draw)
        errors.append(torch.stack(denoising_error(prior, samples, timesteps, noise)))
    target, clean = torch.stack(errors).mean((0, 2)).tolist()
    return {"target_mse": target, "clean_latent_mse": clean}


def learning_rate_factor(step: int, steps: int, warm_up: int, schedule: str) -> float:
    """What the base learning rate is multiplied with: a linear warm-up, then constant or half a cosine down to 0.

    PAPER leaves open: the schedule (default constant, without warm-up).
    """
    if step < warm_up:
        return (step + 1) / warm_up
    if schedule == "constant":
        return 1.0
    return 0.5 * (1 + cos(pi * (step - warm_up) / max(steps - warm_up, 1)))


@dataclass(frozen=True)
class Training:
    """How LoRA is trained: AdamW, a learning rate each for UNet and text encoder.

    Attributes:
        steps: optimiser steps, each on `accumulate` batches of `batch` samples.
        lr_unet, lr_text: learning rates. weight_decay, betas: AdamW's. clip: largest norm of the gradient.
        warm_up, schedule: see `learning_rate_factor`.
        size: side of a sample in pixels, at most the prior's native size.
        seed: of samples, timesteps, noise and dropout.
        checkpoint_seconds: seconds of work between checkpoints.
        patience, stop_gain: stop when in so many twentieths of the steps `clean_latent_mse` has not fallen so many dB,
            and give the weights that were best; 0: never.
    """

    steps: int
    lr_unet: float
    lr_text: float
    batch: int
    accumulate: int
    weight_decay: float
    betas: tuple[float, float]
    clip: float
    warm_up: int
    schedule: str
    size: int
    seed: int
    checkpoint_seconds: float
    patience: int = 0
    stop_gain: float = 0.0


def personalize(
    prior: diffusion.Prior,
    trained: dict[str, list[torch.nn.Parameter]],
    references: Sequence[Picture],
    views: Sequence[Clear],
    sampling: Sampling,
    training: Training,
    folder: Path,
) -> None:
    """Train the prior's LoRA in place; resumes from `folder`'s checkpoint, bit for bit on the CPU.

    Args:
        trained: what `lora.add` returned.
        references, views: see `draw_samples`.
        folder: gets trace.jsonl (`held_out_error`, measured with the clock stopped) and checkpoints.
    Raises:
        ValueError: samples larger than the prior's native size.
        FloatingPointError: a loss or gradient is not finite; names the step.
    """
    if not 0 < training.size <= prior.native_size or training.size % prior.factor:
        raise ValueError(
            f"samples of {training.size} px: the size must be a multiple of {prior.factor} "
            f"up to the prior's native {prior.native_size} px"
        )
    rates = {"unet": training.lr_unet, "text": training.lr_text}
    groups = [{"params": trained[part], "lr": rate} for part, rate in rates.items()]
    optimizer = torch.optim.AdamW(groups, betas=training.betas, weight_decay=training.weight_decay)
    patience = trace.Patience(training.patience, training.stop_gain)
    state, start, seconds, best = trace.load_checkpoint(folder), 0, 0.0, None
    if state is not None:
        lora.load_state(prior, state["lora"])
        optimizer.load_state_dict(state["optimizer"])
        patience.load_state_dict(state["patience"])
        start, seconds, best = state["step"], state["seconds"], state["best"]
    log, saved = trace.Trace(folder, seconds, start), seconds
    held_out = held_out_samples(references, prior.native_size, training.seed)

    def measured(step: int) -> dict[str, Any]:
        """Write a line of the trace; what it says of the end."""
        nonlocal best
        with log.paused():
            errors = held_out_error(prior, held_out, training.seed)
            end = patience.ends(step, training.steps, trace.decibels(errors["clean_latent_mse"]))
            log.log(step, **errors, **end)
            if patience.watching and patience.best_at == step:
                best = lora.state(prior)
        return end

    for step in trace.progress(training.steps, "personalize", start):
        if patience.due(step, training.steps, per_octave=1) and measured(step):
            lora.load_state(prior, best)
            break
        factor = learning_rate_factor(step, training.steps, training.warm_up, training.schedule)
        for group, rate in zip(optimizer.param_groups, rates.values(), strict=True):
            group["lr"] = rate * factor
        train_step(prior, optimizer, references, views, sampling, training, step)
        if log.seconds - saved > training.checkpoint_seconds:
            saved = log.seconds
            done = {"lora": lora.state(prior), "optimizer": optimizer.state_dict(), "step": step + 1, "seconds": saved}
            trace.save_checkpoint(folder, done | {"patience": patience.state_dict(), "best": best})
    else:
        measured(training.steps)
    lora.set_dropout(prior, False)


def train_step(
    prior: diffusion.Prior,
    optimizer: torch.optim.Optimizer,
    references: Sequence[Picture],
    views: Sequence[Clear],
    sampling: Sampling,
    training: Training,
    step: int,
) -> float:
    """One optimiser step; the mean loss. Its draws depend on `step`, not on what was drawn before.

    Raises:
        FloatingPointError: naming the step; the weights are as before it.
    """
    lora.set_dropout(prior, True)
    optimizer.zero_grad(set_to_none=True)
    total = 0.0
    for part in range(training.accumulate):
        draw = seeded(training.seed, "personalize", step, part)
        samples = draw_samples(references, views, prior.native_size, training.size, training.batch, sampling, draw)
        timesteps = spread_timesteps(training.batch, prior.timesteps, draw)
        noise = torch.randn(training.batch, *latent_shape(prior, training.size), generator=draw)
        # LoRA's dropout takes no generator of its own: seed the global one from the step's.
        torch.manual_seed(int(torch.randint(2**62, (), generator=draw)))
        for rows in torch.arange(training.batch).split(prior.rows_graded or training.batch):
            some = Samples(*(tensor[rows] for tensor in samples))
            loss = denoising_error(prior, some, timesteps[rows], noise[rows])[0].sum()
            loss = loss / training.batch / training.accumulate
            loss.backward()
            total += loss.item()
    trained = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    norm = float(torch.nn.utils.clip_grad_norm_(trained, training.clip))
    if not (isfinite(norm) and isfinite(total)):
        where = f"personalization, step {step}"
        raise FloatingPointError(f"{where}: loss {total}, gradient norm {norm}; lower the learning rates")
    optimizer.step()
    return total

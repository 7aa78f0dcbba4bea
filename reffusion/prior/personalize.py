"""Personalization (RefFusion section 4.1): the prior learns the reference, as a whole and in crops, by LoRA."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, isfinite, pi
from pathlib import Path
from typing import Any

import torch

from reffusion import trace
from reffusion.prior import lora
from reffusion.prior.crops import Clear, Picture, Samples, Sampling, draw_samples
from reffusion.prior.denoising import denoising_error, held_out_error, held_out_samples, latent_shape, spread_timesteps
from reffusion.prior.model import Prior
from reffusion.seeding import generator as seeded


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
        outside_weight: of what a sample's mask leaves to be seen, in the loss.
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
    outside_weight: float = 1.0
    patience: int = 0
    stop_gain: float = 0.0


def personalize(
    prior: Prior,
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
    _refuse_size(prior, training.size)
    rates = (training.lr_unet, training.lr_text)
    groups = [{"params": trained[part], "lr": rate} for part, rate in zip(("unet", "text"), rates, strict=True)]
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
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * factor
        train_step(prior, optimizer, references, views, sampling, training, step)
        if log.seconds - saved > training.checkpoint_seconds:
            saved = log.seconds
            done = {"lora": lora.state(prior), "optimizer": optimizer.state_dict(), "step": step + 1, "seconds": saved}
            trace.save_checkpoint(folder, done | {"patience": patience.state_dict(), "best": best})
    else:
        measured(training.steps)
    lora.set_dropout(prior, False)


def _refuse_size(prior: Prior, size: int) -> None:
    if not 0 < size <= prior.native_size or size % prior.factor:
        raise ValueError(
            f"samples of {size} px: the size must be a multiple of {prior.factor} "
            f"up to the prior's native {prior.native_size} px"
        )


def train_step(
    prior: Prior,
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
            error, _ = denoising_error(prior, some, timesteps[rows], noise[rows], training.outside_weight)
            loss = error.sum() / training.batch / training.accumulate
            loss.backward()
            total += loss.item()
    trained = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    norm = float(torch.nn.utils.clip_grad_norm_(trained, training.clip))
    if not (isfinite(norm) and isfinite(total)):
        where = f"personalization, step {step}"
        raise FloatingPointError(f"{where}: loss {total}, gradient norm {norm}; lower the learning rates")
    optimizer.step()
    return total

"""Personalization (RefFusion section 4.1): the prior learns the reference, as a whole and in crops, by LoRA."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import ceil, cos, isfinite, pi
from pathlib import Path

import torch

from reffusion import trace
from reffusion.params.personalize import Params
from reffusion.prior import diffusion, lora
from reffusion.prior.crops import PROMPTS, Batch, Picture, draw_samples
from reffusion.prior.denoising import denoising_error, latent_shape, spread_timesteps
from reffusion.prior.model import Prior
from reffusion.prior.threads import Threads
from reffusion.prior.validation import held_out, measured
from reffusion.seeding import generator as seeded

# PAPER leaves open: both; RealFill's.
WEIGHT_DECAY = 1e-2  # AdamW's
CLIP = 1.0  # the largest norm of the gradient
MEASURED_FROM = 4  # steps from which the error is measured in each doubling


def learning_rate_factor(step: int, steps: int, warm_up: int, schedule: str) -> float:
    """What the base learning rate is multiplied with: a linear warm-up, then constant or half a cosine down to 0.

    PAPER leaves open: the schedule (default constant, without warm-up).
    """
    if step < warm_up:
        return (step + 1) / warm_up
    if schedule == "constant":
        return 1.0
    return 0.5 * (1 + cos(pi * (step - warm_up) / max(steps - warm_up, 1)))


def personalize(
    prior: Prior,
    trained: dict[str, list[torch.nn.Parameter]],
    references: Sequence[Picture],
    settings: Params,
    folder: Path,
    photographs: Sequence[tuple[torch.Tensor, torch.Tensor]] = (),
) -> None:
    """Train the prior's LoRA in place; resumes from `folder`'s checkpoint, bit for bit on one thread of the CPU.

    Args:
        trained: what `lora.add` returned.
        references: see `draw_samples`.
        folder: gets trace.jsonl (`held_out.measured`, with the clock stopped) and checkpoints.
        photographs: see `held_out.held_out`; nothing is learnt from them.
    Raises:
        ValueError: samples larger than the prior's native size.
        FloatingPointError: a loss or gradient is not finite; names the step.
    """
    chosen, steps = settings.optimizer, settings.steps
    _refuse_size(prior, _side(prior, settings))
    rates = (chosen.lr_unet, chosen.lr_text)
    groups = [{"params": trained[part], "lr": rate} for part, rate in zip(("unet", "text"), rates, strict=True)]
    optimizer = torch.optim.AdamW(groups, betas=chosen.betas, weight_decay=WEIGHT_DECAY, fused=True)
    state, start, seconds = trace.load_checkpoint(folder), 0, 0.0
    if state is not None:
        lora.load_state(prior, state["lora"])
        optimizer.load_state_dict(state["optimizer"])
        start, seconds = state["step"], state["seconds"]
    log, checkpoints = trace.Trace(folder, seconds, start), trace.Checkpoints(folder, settings.checkpoint_seconds)
    held = held_out(references, photographs, prior.native_size, settings.seed)
    references = [replace(each, image=each.image.to(prior.device)) for each in references]
    threads = Threads(steps - start, prior.device)

    def measure(step: int) -> None:
        end = {"reason": "finished"} if step == steps else {}
        with log.paused():
            log.log(step, **measured(prior, held, settings.seed, threads.map), **end)

    with threads:
        for step in trace.progress(steps, "personalize", start):
            if trace.log_spaced(step, steps, per_octave=1, first=MEASURED_FROM):
                measure(step)
            factor = learning_rate_factor(step, steps, chosen.warm_up, chosen.schedule)
            for group, rate in zip(optimizer.param_groups, rates, strict=True):
                group["lr"] = rate * factor
            with threads.step():
                train_step(prior, optimizer, references, settings, step, threads)
            if checkpoints.due:
                done = {"optimizer": optimizer.state_dict(), "step": step + 1, "seconds": log.seconds}
                checkpoints.save(lambda done=done: done | {"lora": lora.state(prior)})
        measure(steps)
    lora.set_dropout(prior, False)


def _side(prior: Prior, settings: Params) -> int:
    """Side of a sample in pixels."""
    return settings.samples.size or prior.native_size


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
    settings: Params,
    step: int,
    threads: Threads | None = None,
) -> float:
    """One optimiser step; the mean loss. Its draws depend on `step`, not on what was drawn before.

    Args:
        threads: share out the samples; None: one takes all.

    Raises:
        FloatingPointError: naming the step; the weights are as before it.
    """
    lora.set_dropout(prior, True)
    samples, size, count = settings.samples, _side(prior, settings), settings.optimizer.batch
    draw = seeded(settings.seed, "personalize", step, 0)
    batch = draw_samples(references, prior.native_size, size, count, samples, draw)
    timesteps = spread_timesteps(count, prior.timesteps, draw)
    noise = torch.randn(count, *latent_shape(prior, size), generator=draw)
    # LoRA's dropout takes no generator of its own: seed the global one from the step's, and draw in order.
    torch.manual_seed(int(torch.randint(2**62, (), generator=draw)))
    shared = threads if threads is not None and not settings.lora.dropout else None
    of_unet, of_text = (group["params"] for group in optimizer.param_groups)
    text = diffusion.embed_text(prior, list(PROMPTS))
    told = text.detach().requires_grad_()

    def graded(rows: torch.Tensor) -> tuple[torch.Tensor, tuple[torch.Tensor | None, ...]]:
        some = Batch(*(tensor[rows] for tensor in batch))
        error, _ = denoising_error(prior, some, told, timesteps[rows], noise[rows], samples.outside_weight)
        loss = error.sum() / count
        return loss.detach(), torch.autograd.grad(loss, [told, *of_unet], allow_unused=True)

    most = min(prior.rows_graded or count, ceil(count / (shared.now if shared else 1)))
    parts = torch.arange(count).chunk(ceil(count / most))
    losses, gradients = zip(*(shared.map(graded, parts) if shared else map(graded, parts)), strict=True)
    of_told, *found = map(_summed, zip(*gradients, strict=True))
    found += torch.autograd.grad(text, of_text, of_told, allow_unused=True)
    trained = [*of_unet, *of_text]
    for parameter, gradient in zip(trained, found, strict=True):
        parameter.grad = gradient
    total = float(sum(losses))
    norm = float(torch.nn.utils.clip_grad_norm_(trained, CLIP))
    if not (isfinite(norm) and isfinite(total)):
        where = f"personalization, step {step}"
        raise FloatingPointError(f"{where}: loss {total}, gradient norm {norm}; lower the learning rates")
    optimizer.step()
    return total


def _summed(parts: Iterable[torch.Tensor | None]) -> torch.Tensor | None:
    """Gradients of one parameter, from each part of a batch; None where it takes no part."""
    some = [part for part in parts if part is not None]
    return torch.stack(some).sum(0) if some else None

"""Personalization (RefFusion section 4.1): LoRA fine-tuning of the prior on the reference, as a whole and in crops."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from math import cos, inf, isfinite, pi
from pathlib import Path

import torch

from reffusion import trace
from reffusion.kernels.compiled import torch_on_one_thread
from reffusion.params.personalize import Params
from reffusion.prior import diffusion, lora
from reffusion.prior.crops import Batch, Picture, draw_samples
from reffusion.prior.denoising import denoising_error, latent_shape, spread_timesteps
from reffusion.prior.model import Prior
from reffusion.prior.validation import make_held_out, measure_errors
from reffusion.seeding import generator as seeded

# PAPER leaves open: both values; these are those of RealFill.
WEIGHT_DECAY = 1e-2  # of AdamW
MAX_GRADIENT_NORM = 1.0  # maximum norm of the gradient
FIRST_MEASURED_STEP = 4  # from this step on, errors are measured each time the number of steps doubles


def learning_rate_factor(step: int, steps: int, warm_up: int, schedule: str) -> float:
    """Return the factor on the learning rate: a linear warm-up, then 1 or a cosine decay to 0.

    PAPER leaves open: the schedule (default constant, without warm-up).

    Args:
        step: Number of the step, from 0.
        steps: Number of steps of the training.
        warm_up: Number of steps of the warm-up.
        schedule: "constant" or "cosine".
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
    """Train the prior's LoRA in place, from the start or from the checkpoint in `folder`.

    The training ends early if the error "clean_latent_mse" falls by less than the share `settings.least_gain` while the
    number of steps doubles; 0 rules this out. On the CPU a resumed training equals an unbroken one bit for bit.

    Args:
        prior: The prior with LoRA layers attached.
        trained: The parameters returned by `lora.attach`.
        references: The pictures to learn, see `draw_samples`.
        settings: Parameters of the stage `personalize`.
        folder: Receives checkpoints and trace.jsonl with the errors of `validation.measure_errors`. The time of these
            measurements is not counted in "seconds" of the trace.
        photographs: Photographs in which errors are measured, see `validation.make_held_out`. The prior is not trained
            on them.

    Raises:
        ValueError: Samples are larger than the prior's native size, or no multiple of its factor.
        FloatingPointError: A loss or gradient is not finite; the message names the step.
    """
    options, steps = settings.optimizer, settings.steps
    _check_size(prior, _sample_size(prior, settings))
    rates = (options.lr_unet, options.lr_text)
    groups = [{"params": trained[part], "lr": rate} for part, rate in zip(("unet", "text"), rates, strict=True)]
    optimizer = torch.optim.AdamW(groups, betas=options.betas, weight_decay=WEIGHT_DECAY, fused=True)
    state, start, seconds, error = trace.load_checkpoint(folder), 0, 0.0, inf
    if state is not None:
        lora.load_state(prior, state["lora"])
        optimizer.load_state_dict(state["optimizer"])
        start, seconds, error = state["step"], state["seconds"], state["error"]
    log, checkpoints = trace.Trace(folder, seconds, start), trace.Checkpoints(folder, settings.checkpoint_seconds)
    validation_set = make_held_out(references, photographs, prior.native_size, settings.seed)
    references = [replace(each, image=each.image.to(prior.device)) for each in references]

    def measure(step: int, previous: float = inf) -> tuple[float, bool]:
        with log.pause():
            errors = measure_errors(prior, validation_set, settings.prompts.texts, settings.seed)
            error = errors["clean_latent_mse"]
            is_settled = step < steps and error > (1 - settings.least_gain) * previous and settings.least_gain > 0
            reason = "settled" if is_settled else "finished" if step == steps else ""
            log.log(step, **errors, **({"reason": reason} if reason else {}))
        return error, is_settled

    # The embedded prior's tensors are so small that a second thread delays.
    with torch_on_one_thread() if prior.device.type == "cpu" else nullcontext():
        for step in trace.progress(steps, "personalize", start):
            if trace.is_log_step(step, steps, per_octave=1, first=FIRST_MEASURED_STEP):
                error, is_settled = measure(step, error if step > FIRST_MEASURED_STEP else inf)
                if is_settled:
                    break
            factor = learning_rate_factor(step, steps, options.warm_up, options.schedule)
            for group, rate in zip(optimizer.param_groups, rates, strict=True):
                group["lr"] = rate * factor
            train_step(prior, optimizer, references, settings, step)
            if checkpoints.due:
                progress_state = {"optimizer": optimizer.state_dict(), "step": step + 1, "seconds": log.seconds}
                progress_state |= {"error": error}
                checkpoints.save(lambda progress_state=progress_state: progress_state | {"lora": lora.state(prior)})
        else:
            measure(steps)
    lora.set_dropout(prior, False)


def _sample_size(prior: Prior, settings: Params) -> int:
    """Return the side of a training sample in pixels."""
    return settings.samples.size or prior.native_size


def _check_size(prior: Prior, size: int) -> None:
    if not 0 < size <= prior.native_size or size % prior.factor:
        raise ValueError(
            f"samples of {size} px: the size must be a multiple of {prior.factor} "
            f"up to the prior's native {prior.native_size} px"
        )


def train_step(
    prior: Prior, optimizer: torch.optim.Optimizer, references: Sequence[Picture], settings: Params, step: int
) -> float:
    """Take one optimizer step, and return the mean loss of the batch before this step.

    Random draws depend only on `settings.seed` and on `step`. LoRA dropout stays on, and torch's global generator is
    seeded.

    Args:
        prior: The prior with LoRA layers attached.
        optimizer: Holds the LoRA's parameters of the UNet and of the text encoder, as two groups in this order.
        references: The pictures to learn.
        settings: Parameters of the stage `personalize`.
        step: Number of the step, from 0.

    Raises:
        FloatingPointError: Loss or gradient is not finite; the message names the step. The weights are unchanged.
    """
    lora.set_dropout(prior, True)
    samples, size, count = settings.samples, _sample_size(prior, settings), settings.optimizer.batch
    generator = seeded(settings.seed, "personalize", step, 0)
    batch = draw_samples(references, prior.native_size, size, count, samples, generator)
    timesteps = spread_timesteps(count, prior.timesteps, generator)
    noise = torch.randn(count, *latent_shape(prior, size), generator=generator)
    # LoRA's dropout takes no generator, so the global one is seeded from that of the step.
    torch.manual_seed(int(torch.randint(2**62, (), generator=generator)))
    unet_parameters, text_parameters = (group["params"] for group in optimizer.param_groups)
    text = diffusion.embed_text(prior, settings.prompts.texts)
    detached_text = text.detach().requires_grad_()

    def loss_and_gradients(rows: torch.Tensor) -> tuple[torch.Tensor, tuple[torch.Tensor | None, ...]]:
        part = Batch(*(tensor[rows] for tensor in batch))
        error, _ = denoising_error(prior, part, detached_text, timesteps[rows], noise[rows], samples.outside_weight)
        loss = error.sum() / count
        return loss.detach(), torch.autograd.grad(loss, [detached_text, *unet_parameters], allow_unused=True)

    parts = torch.arange(count).split(prior.rows_with_grad or count)
    losses, gradients = zip(*map(loss_and_gradients, parts), strict=True)
    text_gradients, *parameter_gradients = map(_sum_gradients, zip(*gradients, strict=True))
    parameter_gradients += torch.autograd.grad(text, text_parameters, text_gradients, allow_unused=True)
    trained = [*unet_parameters, *text_parameters]
    for parameter, gradient in zip(trained, parameter_gradients, strict=True):
        parameter.grad = gradient
    total = float(sum(losses))
    norm = float(torch.nn.utils.clip_grad_norm_(trained, MAX_GRADIENT_NORM))
    if not (isfinite(norm) and isfinite(total)):
        where = f"personalization, step {step}"
        raise FloatingPointError(f"{where}: loss {total}, gradient norm {norm}; lower the learning rates")
    optimizer.step()
    return total


def _sum_gradients(parts: Iterable[torch.Tensor | None]) -> torch.Tensor | None:
    """Return the sum of one parameter's gradients over the parts of a batch; None if no part has one."""
    present = [part for part in parts if part is not None]
    return torch.stack(present).sum(0) if present else None

"""Distillation (RefFusion section 4): several terms on one set of Gaussians, each confined to those it may reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from reffusion import seeding, trace
from reffusion.distill.confinement import Sight, region_of, strays
from reffusion.distill.depth_term import Estimator
from reffusion.distill.steps import Job, Settings, job_of, step_of
from reffusion.gaussians.densify import densify, prune
from reffusion.gaussians.optimize import GaussianOptimizer
from reffusion.prior.model import Prior
from reffusion.splat.rasterizer import render
from reffusion.types import PARAMETERS, Camera, Gaussians


def distill(
    initial: Gaussians,
    masked: Tensor,
    sights: Sequence[Sight],
    holes: Sequence[tuple[Camera, Tensor, Tensor]],
    prior: Prior | None,
    text: Tensor | None,
    settings: Settings,
    folder: Path,
    estimator: Estimator | None = None,
) -> tuple[Gaussians, Tensor]:
    """Optimise an initialization; resumes from `folder`'s checkpoint, bit for bit on the CPU.

    Args:
        initial, masked: the Gaussians and their labels [N] bool; everything else is on their device.
        sights: the training views; only those with pixels to repaint are distilled and judged by the critic.
        holes: (camera, image [H, W, 3] in [0, 1], hole [H, W] bool) of each reference.
        prior: adapted to the reference; None where there is neither SDS nor the depth term.
        text: [3, L, D], hidden states of the global, the local and the empty prompt.
        folder: gets trace.jsonl and checkpoints. A line of the trace: reconstruction and lift (those terms' values),
            reference_psnr (in the references' holes), sds_gradient_mean and _max (norm of the weighted SDS gradient
            per masked Gaussian in that step; none where its view was too far from a reference), depth (the last depth
            term's value), depth_skipped_<reason> (how often it was left out so far), adversarial (the generator's
            loss), critic_loss, critic_slope (R1 before its weight), gaussians, masked_gaussians.
        estimator: of the depth term; None where there is none.
    Returns:
        The Gaussians, detached, and their labels.
    Raises:
        FloatingPointError: a value or gradient is not finite; names step, term and view.
        ValueError: a term lacks what it needs: a prior, an estimator, a hole in a reference.
    """
    job = job_of(sights, holes, prior, text, estimator, settings, initial, masked)
    optimizer = GaussianOptimizer(initial, masked, settings.rates, settings.masked_pace, epsilon=settings.epsilon)
    region = region_of(initial.means, masked) if settings.confined and masked.any() else None
    run = _Run.begun(optimizer, job, trace.load_checkpoint(folder))
    log = trace.Trace(folder, run.seconds, run.step + bool(run.step))  # a line is numbered by the steps done
    if run.step == 0:
        _write_line(log, run, {})

    for step in trace.progress(settings.iterations, "distill", run.step):
        line = step_of(optimizer, step, job)
        run.step = done = step + 1
        if settings.densify_every and done % settings.densify_every == 0:
            _densify(optimizer, settings, done)
        if region is not None and (done % settings.region_every == 0 or done == settings.iterations):
            optimizer.select(~strays(region, optimizer.gaussians.means.detach(), optimizer.masked))
        if run.patience.due(done, settings.iterations, per_octave=4):
            end = _write_line(log, run, line)
            if end and end["reason"] != "finished":
                best = {name: run.best[name] for name in PARAMETERS}
                return replace(optimizer.gaussians, **best), run.best["masked"]
        if log.seconds - run.seconds > settings.checkpoint_seconds:
            run.seconds = log.seconds
            trace.save_checkpoint(folder, run.state_dict())
    return optimizer.gaussians.map(Tensor.detach), optimizer.masked


@dataclass
class _Run:
    """What a distillation continues from.

    Attributes:
        best: the Gaussians' parameters and labels where reference_psnr was best; None where an early end is not asked.
        step, seconds: steps done so far; seconds spent at the last checkpoint.
    """

    optimizer: GaussianOptimizer
    job: Job
    patience: trace.Patience
    best: dict[str, Tensor] | None = None
    step: int = 0
    seconds: float = 0.0

    @classmethod
    def begun(cls, optimizer: GaussianOptimizer, job: Job, state: dict[str, Any] | None) -> _Run:
        """From the start, or from a checkpoint's state."""
        settings = job.settings
        run = cls(optimizer, job, trace.Patience(settings.patience, settings.stop_gain, settings.stop_drop))
        if state is not None:
            optimizer.load_state_dict(state["optimizer"])
            if job.adversary is not None:
                job.adversary.load_state_dict(state["adversary"])
            job.tally.update(state["tally"])
            run.patience.load_state_dict(state["patience"])
            run.step, run.seconds, run.best = state["step"], state["seconds"], state["best"]
        return run

    def state_dict(self) -> dict[str, Any]:
        adversary = self.job.adversary
        return {
            "optimizer": self.optimizer.state_dict(),
            "adversary": None if adversary is None else adversary.state_dict(),
            "tally": self.job.tally,
            "patience": self.patience.state_dict(),
            "step": self.step,
            "seconds": self.seconds,
            "best": self.best,
        }


def _write_line(log: trace.Trace, run: _Run, line: dict[str, float]) -> dict[str, Any]:
    """A line of the trace, written with the clock stopped; what it says of the end, {} while the work goes on."""
    optimizer, job = run.optimizer, run.job
    with log.paused():
        psnr = reference_psnr(optimizer.gaussians, job.holes)
        end = run.patience.ends(run.step, job.settings.iterations, psnr)
        log.log(run.step, reference_psnr=psnr, **line, **job.tally, **_counts(optimizer), **end)
        if run.patience.watching and run.patience.best_at == run.step:
            run.best = _copy(optimizer)
    return end


def _counts(optimizer: GaussianOptimizer) -> dict[str, int]:
    return {"gaussians": len(optimizer.masked), "masked_gaussians": int(optimizer.masked.sum())}


def _copy(optimizer: GaussianOptimizer) -> dict[str, Tensor]:
    """The Gaussians' parameters and labels as they are now."""
    tensors = {name: getattr(optimizer.gaussians, name) for name in PARAMETERS} | {"masked": optimizer.masked}
    return {name: tensor.detach().clone() for name, tensor in tensors.items()}


def _densify(optimizer: GaussianOptimizer, settings: Settings, done: int) -> None:
    """Clone or split masked Gaussians that are pulled hard on the screen; only they have been observed."""
    if done > settings.densify_until * settings.iterations or not optimizer.masked.any():
        return
    slopes = (optimizer.slope_sum / optimizer.slope_count.clamp(min=1))[optimizer.masked]
    threshold = settings.densify_slope
    if settings.densify_rule == "share":
        threshold = float(slopes.kthvalue(max(1, round((1 - settings.densify_share) * len(slopes)))).values)
    threshold = max(threshold, torch.finfo(slopes.dtype).tiny)  # what is not pulled at all stays single
    noise = seeding.generator(settings.seed, "distill", "densify", done)
    densify(optimizer, threshold, settings.split_above, settings.budget, noise)
    prune(optimizer, settings.least_opacity, float("inf"))


@torch.no_grad()
def reference_psnr(gaussians: Gaussians, holes: Sequence[tuple[Camera, Tensor, Tensor]]) -> float:
    """PSNR in dB over the pixels of all the references' holes."""
    squared = [(render(gaussians, c).color.clamp(0, 1) - image)[hole].square().flatten() for c, image, hole in holes]
    return trace.decibels(float(torch.cat(squared).mean()))

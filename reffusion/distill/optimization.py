"""Distillation (RefFusion section 4): several terms on one set of Gaussians, each confined to those it may reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from reffusion import seeding, trace
from reffusion.distill.confinement import TrainView, changed_region, region_of
from reffusion.distill.depth_term import Estimator
from reffusion.distill.perceptual import Distance
from reffusion.distill.steps import Job, job_of, step_of
from reffusion.gaussians.densify import densify, prune
from reffusion.gaussians.optimize import GaussianOptimizer, Rates
from reffusion.geometry import cameras_extent
from reffusion.io.ply import save_ply
from reffusion.params.distill import LearningRates, Params
from reffusion.prior.model import Prior
from reffusion.splat.rasterizer import render
from reffusion.types import Camera, Gaussians

GROW_SCALE3D = 0.01  # standard deviation from which a Gaussian is split, not cloned
DENSIFIED = 0.05  # share of the masked Gaussians that are cloned or split each time
CAP_MAX = 2_000_000  # most Gaussians
PRUNE_OPA = 0.005  # fainter Gaussians are pruned when others are added
SNAPSHOTS = 4  # parts of the run, after each but the last of which the masked Gaussians are kept
AVERAGED = 2 / 3  # of the steps of a run that adds no Gaussian, from which on their mean is what it ends with
REGION_EVERY = 50  # steps between prunings of Gaussians that changed region


def distill(
    initial: Gaussians,
    masked: Tensor,
    views: Sequence[TrainView],
    holes: Sequence[tuple[Camera, Tensor, Tensor]],
    prior: Prior | None,
    text: Tensor | None,
    settings: Params,
    folder: Path,
    estimator: Estimator | None = None,
    distance: Distance | None = None,
    rates: Rates | None = None,
) -> tuple[Gaussians, Tensor]:
    """Optimise an initialization; resumes from `folder`'s checkpoint, bit for bit on the CPU.

    Args:
        initial, masked: the Gaussians and their labels [N] bool; everything else is on their device.
        views: the training views; only those with pixels to repaint are distilled and judged by the critic.
        holes: (camera, image [H, W, 3] in [0, 1], hole [H, W] bool) of each reference.
        prior: adapted to the reference; None where there is neither SDS nor the depth term.
        text: [3, L, D], hidden states of the global, the local and the empty prompt.
        folder: gets trace.jsonl, checkpoints, and snapshots/ of the masked Gaussians. A line of the trace:
            reconstruction and lift (those terms' values), reference_psnr (in the references' holes),
            sds_gradient_mean and _max (norm of the weighted SDS gradient per masked Gaussian; none where its view was
            too far from a reference), depth (the last depth term's value), depth_skipped_<reason> (how often so far),
            adversarial (the generator's loss), critic_loss, critic_slope (R1 unweighted), gaussians, masked_gaussians.
        estimator: of the depth term; None where there is none.
        distance: of patches, for the perceptual loss of lifted pictures.
        rates: Adam's step sizes; None: 3DGS's, by `settings.lr.means_unit`.
    Returns:
        The Gaussians, detached, and their labels.
    Raises:
        FloatingPointError: a value or gradient is not finite; names step, term and view.
        ValueError: a term lacks what it needs: a prior, an estimator, a hole in a reference.
    """
    job = job_of(views, holes, prior, text, settings, initial, masked, estimator, distance)
    rates = rates or rates_of(settings.lr, [view.camera for view in views])
    optimizer = GaussianOptimizer(initial, masked, rates, masked_factors(settings.lr), epsilon=settings.lr.epsilon)
    region = region_of(initial.means, masked) if settings.confined and masked.any() else None
    run = _Run.begun(optimizer, job, trace.load_checkpoint(folder))
    checkpoints = trace.Checkpoints(folder, settings.checkpoint_seconds)
    log = trace.Trace(folder, run.seconds, run.step + bool(run.step))  # a line is numbered by the steps done
    if run.step == 0:
        _write_line(log, run, {})

    for step in trace.progress(settings.iterations, "distill", run.step):
        line = step_of(optimizer, step, job)
        run.step = done = step + 1
        _densify_where_due(optimizer, settings, done)
        average(optimizer, settings, done)
        if region is not None and (done % REGION_EVERY == 0 or done == settings.iterations):
            optimizer.select(~changed_region(region, optimizer.gaussians.means.detach(), optimizer.masked))
        if trace.log_spaced(done, settings.iterations, per_octave=4):
            _write_line(log, run, line)
        _save_snapshot(optimizer, folder, done, settings.iterations)
        if checkpoints.due:
            run.seconds = log.seconds
            checkpoints.save(run.state_dict)
    return optimizer.gaussians.map(Tensor.detach), optimizer.masked


def _densify_where_due(optimizer: GaussianOptimizer, settings: Params, done: int) -> None:
    every, last = settings.densify.every, settings.densify.stop * settings.iterations
    if every and done % every == 0 and done <= last:
        _densify(optimizer, seeding.generator(settings.seed, "distill", "densify", done))


def average(optimizer: GaussianOptimizer, settings: Params, done: int) -> None:
    """A run that adds no Gaussian ends with the mean of those after its last steps."""
    if not settings.densify.every and done > AVERAGED * settings.iterations:
        optimizer.remember()
    if done == settings.iterations:
        optimizer.take_mean()


def _save_snapshot(optimizer: GaussianOptimizer, folder: Path, done: int, steps: int) -> None:
    """The masked Gaussians after each part of the run but the last, to look at: folder/snapshots/<steps done>.ply."""
    part, masked = SNAPSHOTS * done // steps, optimizer.masked
    if SNAPSHOTS * (done - 1) // steps < part < SNAPSHOTS and masked.any():
        path = folder / "snapshots" / f"{done}.ply"
        save_ply(path, optimizer.gaussians.map(lambda parameter: parameter.detach()[masked].cpu()))


def rates_of(lr: LearningRates, cameras: Sequence[Camera]) -> Rates:
    """3DGS's step sizes for these views."""
    return Rates().in_units_of(cameras_extent(cameras)) if lr.means_unit == "cameras" else Rates()


def masked_factors(lr: LearningRates) -> dict[str, float]:
    """Parameter -> factor on the step sizes of masked Gaussians."""
    shape = lr.masked * lr.shape
    factors = {"means": shape, "quaternions": shape, "log_scales": shape, "sh": lr.masked}
    return factors | {"opacity_logits": lr.masked * lr.opacities}


@dataclass
class _Run:
    """What a distillation continues from.

    Attributes:
        step, seconds: steps done so far; seconds spent at the last checkpoint.
    """

    optimizer: GaussianOptimizer
    job: Job
    step: int = 0
    seconds: float = 0.0

    @classmethod
    def begun(cls, optimizer: GaussianOptimizer, job: Job, state: dict[str, Any] | None) -> _Run:
        """From the start, or from a checkpoint's state."""
        run = cls(optimizer, job)
        if state is not None:
            optimizer.load_state_dict(state["optimizer"])
            if job.adversary is not None:
                job.adversary.load_state_dict(state["adversary"])
            job.tally.update(state["tally"])
            run.step, run.seconds = state["step"], state["seconds"]
        return run

    def state_dict(self) -> dict[str, Any]:
        adversary = self.job.adversary
        return {
            "optimizer": self.optimizer.state_dict(),
            "adversary": None if adversary is None else adversary.state_dict(),
            "tally": self.job.tally,
            "step": self.step,
            "seconds": self.seconds,
        }


def _write_line(log: trace.Trace, run: _Run, line: dict[str, float]) -> None:
    """A line of the trace, written with the clock stopped."""
    optimizer, job, last = run.optimizer, run.job, run.job.settings.iterations
    end = {"reason": "finished"} if run.step == last else {}
    with log.paused():
        shown = [hole for hole in job.holes if hole[2].any()]
        line = line | ({"reference_psnr": reference_psnr(optimizer.gaussians, shown)} if shown else {})
        log.log(run.step, **line, **job.tally, **_counts(optimizer), **end)


def _counts(optimizer: GaussianOptimizer) -> dict[str, int]:
    return {"gaussians": len(optimizer.masked), "masked_gaussians": int(optimizer.masked.sum())}


def _densify(optimizer: GaussianOptimizer, noise: torch.Generator) -> None:
    """Clone or split the share of the masked Gaussians pulled hardest on the screen; only they have been observed."""
    if not optimizer.masked.any():
        return
    pulls = (optimizer.grad2d_sum / optimizer.grad2d_count.clamp(min=1))[optimizer.masked]
    threshold = float(pulls.kthvalue(max(1, round((1 - DENSIFIED) * len(pulls)))).values)
    threshold = max(threshold, torch.finfo(pulls.dtype).tiny)  # what is not pulled at all stays single
    densify(optimizer, threshold, GROW_SCALE3D, CAP_MAX, noise)
    prune(optimizer, PRUNE_OPA, float("inf"))


@torch.no_grad()
def reference_psnr(gaussians: Gaussians, holes: Sequence[tuple[Camera, Tensor, Tensor]]) -> float:
    """PSNR in dB over the pixels of all the references' holes."""
    squared = [(render(gaussians, c).color.clamp(0, 1) - image)[hole].square().flatten() for c, image, hole in holes]
    return trace.decibels(float(torch.cat(squared).mean()))

"""3DGS optimization of a whole scene from its training views; pixels can be excluded by weights of 0."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from reffusion import trace
from reffusion.fit.exposure import Exposures
from reffusion.fit.step import (
    average,
    coarse_steps,
    control_density,
    degree_at,
    learning_rates,
    squared_error,
    step,
)
from reffusion.fit.view_loader import check_sizes, iterate_views, to_tensors
from reffusion.gaussians.optimize import GaussianOptimizer, Rates
from reffusion.params.fit import Params
from reffusion.splat.rasterizer import render
from reffusion.types import PARAMETERS, Camera, Gaussians

PLACED_RATE_FACTOR = 0.1  # factor on the learning rate of positions, for Gaussians whose positions are known
# After step 1, the first step with a line in the trace: rendering the held-out views takes as long as several steps.
FIRST_TRACED_STEP = 16


def fit(
    cameras: Sequence[Camera],
    images: Mapping[str, np.ndarray],
    initial: Gaussians,
    settings: Params,
    *,
    folder: Path,
    weights: Mapping[str, np.ndarray] | None = None,
    held_out: Sequence[Camera] = (),
    rates: Rates | None = None,
    gains: np.ndarray | None = None,
    placed: Tensor | None = None,
    spent: float = 0.0,
) -> Gaussians:
    """Optimize the initial Gaussians so that their renderings match the views, and return the result.

    If `folder` holds a checkpoint, the fit resumes from it, and ends with the same bits as without the interruption.

    Args:
        cameras: the V views that supervise.
        images: view name -> uint8 [H, W, 3], for `cameras` and `held_out`.
        initial: the initial Gaussians; the computation runs on their device. When a fit resumes, the checkpoint's
            Gaussians take their place, and only their device and `antialiased` matter.
        settings: the parameters of the stage `fit`.
        folder: receives trace.jsonl, checkpoints and, if exposures are fitted, exposures.json. A line of the trace
            holds "loss" (mean of the steps since the last line), "psnr" in dB (of the mean squared error of these
            steps), "gaussians" (their number) and "psnr_held_out" in dB (mean PSNR of the held-out views, rendered
            without exposures).
        weights: view name -> [H, W], weight of each pixel. Pixels of weight 0, and only these, influence nothing. A
            view without an entry has weight 1 everywhere.
        held_out: views that are evaluated for the trace, and do not supervise.
        rates: Adam's learning rates; None takes those of `settings.lr`.
        gains: [V, 3], initial brightness of `cameras` from which exposures are fitted; None fits no exposures.
        placed: [N] bool, True for the Gaussians of `initial` whose positions are known. Their positions move with
            `PLACED_RATE_FACTOR` times the learning rate. None: all False.
        spent: seconds already spent on making `initial`; "seconds" in the trace, which is cumulative, starts from this
            value.

    Returns:
        The Gaussians, detached. Their number differs from that of `initial` if the schedule densifies or prunes.

    Raises:
        ValueError: there is no view, an image is missing, or an image or the weights differ in size from their camera
            (all are checked before any computation); or pruning removed all Gaussians.
        FloatingPointError: a loss, gradient or parameter is infinite or NaN. The message names the step and the view.
    """
    weights = weights or {}
    _check_views(cameras, held_out, images, weights)
    state = trace.load_checkpoint(folder)
    run = _Run.create(
        initial, placed, cameras, gains, settings, rates or learning_rates(settings.lr, cameras), state, spent
    )
    optimizer = run.optimizer
    log = trace.Trace(folder, run.seconds, run.iteration + 1 if run.iteration else 0)
    checkpoints = trace.Checkpoints(folder, settings.checkpoint_seconds)
    trace_inputs = (held_out, images, settings)
    if run.iteration == 0:
        _write_line(log, run, *trace_inputs)
    steps, coarse = range(run.iteration, settings.iterations), coarse_steps(settings)
    for i, (camera, target, counts) in zip(
        trace.progress(settings.iterations, "fit", run.iteration),
        iterate_views(cameras, images, weights, steps, settings.seed, coarse, optimizer.masked.device),
        strict=True,
    ):
        run.count(*step(optimizer, run.exposures, camera, target, counts, settings, i))
        control_density(optimizer, cameras, run.started_with, settings, run.iteration)
        average(optimizer, settings, run.iteration)
        is_line_due = trace.is_log_step(run.iteration, settings.iterations, first=FIRST_TRACED_STEP)
        is_checkpoint_due = checkpoints.due and run.iteration < settings.iterations
        _check_gaussians(optimizer.gaussians, i, camera, check_values=is_line_due or is_checkpoint_due)
        if is_line_due:
            _write_line(log, run, *trace_inputs)
        if is_checkpoint_due:
            checkpoints.save(lambda: run.state_dict() | {"seconds": log.seconds})
    return run.finish(folder)


def _check_views(
    cameras: Sequence[Camera],
    held_out: Sequence[Camera],
    images: Mapping[str, np.ndarray],
    weights: Mapping[str, np.ndarray],
) -> None:
    """Raise ValueError if there is no view to fit, or if an image or weights differ in size from their camera."""
    if not cameras:
        raise ValueError("a fit needs at least one view")
    check_sizes(cameras, images, weights)
    check_sizes(held_out, images, {})


@dataclass
class _Run:
    """State of a fit; a checkpoint stores it, so that a later process can resume.

    Attributes:
        optimizer: the Gaussians and their Adam moments.
        exposures: the exposures of the views; None if they are not fitted.
        started_with: number of Gaussians at the start of the fit.
        seconds: time spent before the fit began or, when it was resumed, up to the checkpoint.
        iteration: number of steps done.
        loss, error: sums of the losses and of the mean squared errors of the steps since the last line of the trace.
        steps: number of these steps.
    """

    optimizer: GaussianOptimizer
    exposures: Exposures | None
    started_with: int
    seconds: float
    iteration: int = 0
    loss: float = 0.0
    error: float = 0.0
    steps: int = 0

    _NUMBERS = ("started_with", "seconds", "iteration", "loss", "error", "steps")

    @classmethod
    def create(
        cls,
        initial: Gaussians,
        placed: Tensor | None,
        cameras: Sequence[Camera],
        gains: np.ndarray | None,
        settings: Params,
        rates: Rates,
        state: dict[str, Any] | None,
        spent: float,
    ) -> _Run:
        """Make the state of a new fit, or restore it from a checkpoint.

        Args:
            initial, placed, cameras, gains, settings, rates, spent: as for `fit`.
            state: what `state_dict` returned, with the current "seconds"; None starts a new fit.
        """
        names, device = [camera.name for camera in cameras], initial.means.device
        exposures = None if gains is None else Exposures(names, device, gains)
        optimizer = GaussianOptimizer(initial, placed, rates, {"means": PLACED_RATE_FACTOR}, settings.lr.betas)
        run = cls(optimizer, exposures, len(initial), spent)
        if state is not None:
            optimizer.load_state_dict(state["optimizer"])
            if exposures is not None:
                exposures.load_state_dict(state["exposures"])
            for name in cls._NUMBERS:
                setattr(run, name, state[name])
        return run

    def count(self, loss: float, error: float) -> None:
        """Count one step, with its loss and its mean squared error."""
        self.iteration, self.steps = self.iteration + 1, self.steps + 1
        self.loss, self.error = self.loss + loss, self.error + error

    def finish(self, folder: Path) -> Gaussians:
        """Write the exposures, if they are fitted, to `folder`/exposures.json, and return the detached Gaussians."""
        if self.exposures is not None:
            self.exposures.save(folder)
        return self.optimizer.gaussians.map(Tensor.detach)

    def state_dict(self) -> dict[str, Any]:
        """Return the state from which `create` restores this one."""
        state = {"optimizer": self.optimizer.state_dict(), "exposures": self.exposures and self.exposures.state_dict()}
        return state | {name: getattr(self, name) for name in self._NUMBERS}


def _write_line(
    log: trace.Trace,
    run: _Run,
    held_out: Sequence[Camera],
    images: Mapping[str, np.ndarray],
    settings: Params,
) -> None:
    """Write a line of the trace and reset the sums of `run`; the time of this call does not count in "seconds"."""
    with log.pause():
        end = {"reason": "finished"} if run.iteration == settings.iterations else {}
        log.log(run.iteration, **_trace_values(run, held_out, images, settings), **end)
    run.loss, run.error, run.steps = 0.0, 0.0, 0


def _trace_values(
    run: _Run, held_out: Sequence[Camera], images: Mapping[str, np.ndarray], settings: Params
) -> dict[str, Any]:
    """Return a trace line's values: number of Gaussians, loss and PSNR (dB) since the last line, held-out PSNR."""
    line: dict[str, Any] = {"gaussians": len(run.optimizer.gaussians)}
    if run.steps:
        line = {"loss": run.loss / run.steps, "psnr": trace.decibels(run.error / run.steps)} | line
    if not held_out:
        return line
    degree, gaussians = degree_at(settings, run.iteration), run.optimizer.gaussians.map(Tensor.detach)
    psnr = []
    for camera in held_out:
        image = render(gaussians, camera, sh_degree=degree).color.clamp(0, 1)
        _, target, _ = to_tensors(camera, images[camera.name], None, gaussians.means.device)
        psnr.append(trace.decibels(squared_error(image, target, None)))
    return line | {"psnr_held_out": sum(psnr) / len(psnr)}


def _check_gaussians(gaussians: Gaussians, step: int, camera: Camera, check_values: bool) -> None:
    """Raise ValueError if no Gaussian is left, FloatingPointError if a parameter is checked and not finite."""
    if not len(gaussians):
        remedy = "raise densify.prune_scale3d"
        raise ValueError(f"fit, step {step}: pruning left no Gaussian: {remedy}")
    for name in PARAMETERS if check_values else ():
        if not torch.isfinite(getattr(gaussians, name).detach()).all():
            raise FloatingPointError(f"fit, step {step}, view '{camera.name}': the Gaussians' {name} are not finite")

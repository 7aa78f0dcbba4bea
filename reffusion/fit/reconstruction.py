"""3DGS optimisation of a whole scene from its training views: what `fit` runs, and any baseline that masks pixels."""

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
from reffusion.fit.step import adapt, average, coarse_steps, degree_at, rates_of, sparse_steps, squared_error, step
from reffusion.fit.view_loader import check_sizes, sample, samples
from reffusion.gaussians.optimize import GaussianOptimizer, Rates
from reffusion.params.fit import Params
from reffusion.splat.rasterizer import render
from reffusion.types import PARAMETERS, Camera, Gaussians

KNOWN_PLACE = 0.1  # of a step's length, by which Gaussians move whose places are known
FIRST_MOMENT = 16  # of the trace, after the start: measuring held-out views takes as long as several steps


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
    impl: str = "auto",
) -> Gaussians:
    """Optimise `initial` until its renders look like the views; resumes from `folder`'s checkpoint, bit for bit.

    Args:
        images: view name -> uint8 [H, W, 3], for `cameras` and `held_out`.
        initial: the Gaussians to start from; the work is done on their device. Where there is a checkpoint, only their
            degree, device and way of being drawn still matter.
        folder: gets trace.jsonl (loss, psnr since the last, gaussians, psnr_held_out), checkpoints, exposures.json.
        weights: view name -> [H, W], how much each pixel counts; pixels of weight 0, and they alone, influence nothing.
            A view without an entry counts as a whole.
        held_out: views that are only measured. rates: Adam's step sizes where they are not those of `settings.lr`.
        gains: [V, 3], of `cameras`: exposures are fitted, and start from these; None: they are not.
        placed: [N] bool, of `initial`: Gaussians whose places are known. They move `KNOWN_PLACE` as far as the others.
        spent: seconds that making `initial` took; the trace counts from there.

    Raises:
        ValueError: no view, or an image or mask of another size than its camera; before any work.
        FloatingPointError: a loss, gradient or parameter became infinite or NaN; names the step and the view.
    """
    weights = weights or {}
    _refuse_misfits(cameras, held_out, images, weights)
    state = trace.load_checkpoint(folder)
    run = _Run.begun(initial, placed, cameras, gains, settings, rates or rates_of(settings.lr, cameras), state, spent)
    optimizer = run.optimizer
    log = trace.Trace(folder, run.seconds, run.iteration + 1 if run.iteration else 0)
    centers = torch.tensor(np.stack([camera.center for camera in cameras]), dtype=torch.float32)
    checkpoints, measured = trace.Checkpoints(folder, settings.checkpoint_seconds), (held_out, images, settings, impl)
    if run.iteration == 0:
        _write_line(log, run, *measured)
    steps, until = range(run.iteration, settings.iterations), (coarse_steps(settings), sparse_steps(settings))
    for i, (camera, target, counts) in zip(
        trace.progress(settings.iterations, "fit", run.iteration),
        samples(cameras, images, weights, steps, settings.seed, *until, optimizer.masked.device),
        strict=True,
    ):
        run.count(*step(optimizer, run.exposures, camera, target, counts, settings, i, impl))
        adapt(optimizer, centers, run.started_with, settings, run.iteration)
        average(optimizer, settings, run.iteration)
        line_due = trace.log_spaced(run.iteration, settings.iterations, first=FIRST_MOMENT)
        save_due = checkpoints.due and run.iteration < settings.iterations
        _check(optimizer.gaussians, i, camera, values=line_due or save_due)
        if line_due:
            _write_line(log, run, *measured)
        if save_due:
            checkpoints.save(lambda: run.state_dict() | {"seconds": log.seconds})
    return run.finished(folder)


def _refuse_misfits(
    cameras: Sequence[Camera],
    held_out: Sequence[Camera],
    images: Mapping[str, np.ndarray],
    weights: Mapping[str, np.ndarray],
) -> None:
    if not cameras:
        raise ValueError("a fit needs at least one view")
    check_sizes(cameras, images, weights)
    check_sizes(held_out, images, {})


@dataclass
class _Run:
    """What a fit continues from.

    Attributes:
        started_with: Gaussians at the start. iteration, seconds: done and spent so far.
        loss, error, steps: sums over the steps since the last line of the trace, and their number.
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
    def begun(
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
        """From the start, or from a checkpoint's state."""
        names, device = [camera.name for camera in cameras], initial.means.device
        exposures = None if gains is None else Exposures(names, device, gains)
        optimizer = GaussianOptimizer(initial, placed, rates, {"means": KNOWN_PLACE}, settings.lr.betas)
        run = cls(optimizer, exposures, len(initial), spent)
        if state is not None:
            optimizer.load_state_dict(state["optimizer"])
            if exposures is not None:
                exposures.load_state_dict(state["exposures"])
            for name in cls._NUMBERS:
                setattr(run, name, state[name])
        return run

    def count(self, loss: float, error: float) -> None:
        """One step more, of this loss and mean squared error."""
        self.iteration, self.steps = self.iteration + 1, self.steps + 1
        self.loss, self.error = self.loss + loss, self.error + error

    def finished(self, folder: Path) -> Gaussians:
        """What was fitted; exposures are saved."""
        if self.exposures is not None:
            self.exposures.save(folder)
        return self.optimizer.gaussians.map(Tensor.detach)

    def state_dict(self) -> dict[str, Any]:
        state = {"optimizer": self.optimizer.state_dict(), "exposures": self.exposures and self.exposures.state_dict()}
        return state | {name: getattr(self, name) for name in self._NUMBERS}


def _write_line(
    log: trace.Trace,
    run: _Run,
    held_out: Sequence[Camera],
    images: Mapping[str, np.ndarray],
    settings: Params,
    impl: str,
) -> None:
    """A line of the trace, written with the clock stopped."""
    with log.paused():
        end = {"reason": "finished"} if run.iteration == settings.iterations else {}
        log.log(run.iteration, **_summary(run, held_out, images, settings, impl), **end)
    run.loss, run.error, run.steps = 0.0, 0.0, 0


def _summary(
    run: _Run, held_out: Sequence[Camera], images: Mapping[str, np.ndarray], settings: Params, impl: str
) -> dict[str, Any]:
    """A line of the trace; without steps since the last line there is no loss and no training PSNR."""
    line: dict[str, Any] = {"gaussians": len(run.optimizer.gaussians)}
    if run.steps:
        line = {"loss": run.loss / run.steps, "psnr": trace.decibels(run.error / run.steps)} | line
    if not held_out:
        return line
    degree, gaussians = degree_at(settings, run.iteration), run.optimizer.gaussians.map(Tensor.detach)
    psnr = []
    for camera in held_out:
        image = render(gaussians, camera, impl=impl, sh_degree=degree).color.clamp(0, 1)
        _, target, _ = sample(camera, images[camera.name], None, gaussians.means.device)
        psnr.append(trace.decibels(squared_error(image, target, None)))
    return line | {"psnr_held_out": sum(psnr) / len(psnr)}


def _check(gaussians: Gaussians, step: int, camera: Camera, values: bool) -> None:
    """Refuse to go on without Gaussians, or, where `values` are looked at, with some that are not finite."""
    if not len(gaussians):
        remedy = "raise densify.prune_scale3d"
        raise ValueError(f"fit, step {step}: pruning left no Gaussian: {remedy}")
    for name in PARAMETERS if values else ():
        if not torch.isfinite(getattr(gaussians, name).detach()).all():
            raise FloatingPointError(f"fit, step {step}, view '{camera.name}': the Gaussians' {name} are not finite")

"""The distillation loop (RefFusion section 4): Adam on a weighted sum of terms, each confined to its own Gaussians.

    L = L_reconstruction + lambda_SDS L_SDS + lambda_depth L_depth + lambda_adversarial L_adversarial      (Eq. 5)

term             pixels                                          Gaussians
reconstruction   outside C, I and shadows; all if clean          unmasked (or all that show there); all if clean
SDS              whole view and patches, the hole repainted      masked (or all)
depth            the hole                                        masked, all but spherical harmonics
adversarial      patches around the hole                         masked (or all), spherical harmonics only
reference        the reference's hole (not in the paper)         masked (or all)
lift             the hole, or patches around it (for baselines)  masked
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from reffusion import seeding, trace
from reffusion.distill.densification import densify_masked
from reffusion.distill.overlap_worker import OverlapWorker
from reffusion.distill.regions import build_region, has_changed_region
from reffusion.distill.terms import adversarial, depth, lift, reconstruction, reference, sds
from reffusion.distill.terms.term import Term, TermInputs
from reffusion.distill.train_view import ReferenceHole
from reffusion.gaussians.optimize import GaussianOptimizer, Rates
from reffusion.geometry import Degenerate, cameras_extent
from reffusion.io.ply import save_ply
from reffusion.kernels.compiled import torch_on_one_thread
from reffusion.params.distill import LearningRates, Params
from reffusion.splat.rasterizer import render
from reffusion.types import PARAMETERS, Camera, Gaussians

TERMS = sds, depth, adversarial, reference, lift, reconstruction  # in the order in which their gradients are added
SNAPSHOTS = 4  # parts of the run; the masked Gaussians are saved at the end of each but the last
AVERAGED_FROM = 2 / 3  # fraction of a run without densification after which the Gaussians of all steps are averaged
REGION_EVERY = 50  # steps between prunings of Gaussians that changed region


@dataclass(frozen=True)
class Objective:
    """The weighted sum of terms that a distillation minimises.

    Attributes:
        terms: those that are on, in the order in which their gradients are added.
        latest: what every line of the trace repeats: last values of terms that are not computed in every step, and how
            often views were skipped. It changes from step to step, and is part of checkpoints.
        worker: computes background terms.
    """

    terms: Sequence[Term]
    references: Sequence[ReferenceHole]
    settings: Params
    latest: dict[str, float]
    worker: OverlapWorker


def build_objective(inputs: TermInputs, settings: Params) -> Objective:
    """The objective of a distillation.

    Raises:
        ValueError: a term lacks what it needs.
    """
    terms = [term for module in TERMS if (term := module.build(inputs, settings)) is not None]
    # A GPU does one thing after another.
    overlaps = not inputs.masked_means.is_cuda and all(term.runs_apart or term.allows_overlap for term in terms)
    overlaps = overlaps and any(term.runs_apart for term in terms)
    return Objective(terms, inputs.references, settings, {}, OverlapWorker(torch.get_num_threads() if overlaps else 1))


def distill(
    initial: Gaussians, masked: Tensor, inputs: TermInputs, settings: Params, folder: Path, rates: Rates | None = None
) -> tuple[Gaussians, Tensor]:
    """Optimises an initialization. Resumes from the checkpoint in `folder`, bit for bit on the CPU.

    Args:
        initial, masked: the Gaussians and their labels [N] bool; everything else is on their device.
        inputs: what the terms are built from.
        folder: gets trace.jsonl, checkpoints, and snapshots/ of the masked Gaussians. A line of the trace:
            reconstruction and lift (those terms' values), reference_psnr (in the references' holes),
            sds_gradient_mean and _max (norm of the weighted SDS gradient per masked Gaussian; none if the view is too
            far from every reference), depth (the last depth term's value), depth_skipped_<reason> (how often so far),
            adversarial (the generator's loss), critic_loss, critic_slope (R1 unweighted), gaussians, masked_gaussians.
        rates: Adam's step sizes; None: 3DGS's, by `settings.lr.means_unit`.
    Returns:
        The Gaussians, detached, and their labels.
    Raises:
        FloatingPointError: a value or gradient is not finite; names step, term and view.
        ValueError: a term lacks what it needs: a prior, an estimator, a hole in a reference.
    """
    objective = build_objective(inputs, settings)
    rates = rates or rates_of(settings.lr, [view.camera for view in inputs.views])
    optimizer = GaussianOptimizer(initial, masked, rates, masked_factors(settings.lr), epsilon=settings.lr.epsilon)
    region = build_region(initial.means, masked) if settings.confined and masked.any() else None
    run = _Run.start_or_resume(optimizer, objective, trace.load_checkpoint(folder))
    checkpoints = trace.Checkpoints(folder, settings.checkpoint_seconds)
    log = trace.Trace(folder, run.seconds, run.step + bool(run.step))  # a line is numbered by the steps done
    if run.step == 0:
        _write_line(log, run, {})

    for step in trace.progress(settings.iterations, "distill", run.step):
        line = take_step(optimizer, step, objective)
        run.step = done = step + 1
        if _densifies_after(settings, done):
            densify_masked(optimizer, seeding.generator(settings.seed, "distill", "densify", done))
        average(optimizer, settings, done)
        if region is not None and (done % REGION_EVERY == 0 or done == settings.iterations):
            optimizer.select(~has_changed_region(region, optimizer.gaussians.means.detach(), optimizer.masked))
        if trace.log_spaced(done, settings.iterations, per_octave=4):
            _write_line(log, run, line)
        _save_snapshot(optimizer, folder, done, settings.iterations)
        if checkpoints.due:
            run.seconds = log.seconds
            checkpoints.save(run.state_dict)
    return optimizer.gaussians.map(Tensor.detach), optimizer.masked


def take_step(optimizer: GaussianOptimizer, step: int, objective: Objective) -> dict[str, float]:
    """One step of Adam along the gradient of the weighted sum. Returns what the terms log."""
    background, foreground = [], []
    for term in objective.terms:
        (background if term.runs_apart else foreground).append(term)
    gaussians, masked = optimizer.gaussians, optimizer.masked
    apart = gaussians.map(lambda p: p.detach().requires_grad_())  # accumulates the gradient of the terms that run apart
    with objective.worker.overlap(lambda: [_add_gradient(term, step, apart, masked) for term in background]) as result:
        parts = [_add_gradient(term, step, gaussians, masked) for term in foreground]
    parts = [part for part in (*result(), *parts) if part is not None]
    for name in PARAMETERS:
        parameter, gradient = getattr(gaussians, name), getattr(apart, name).grad
        if gradient is not None:
            parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient

    moved, line = torch.zeros_like(masked), {}
    for part in parts:
        moved |= part.moved
        line |= part.log
        objective.latest.update(part.latest)
        if part.skipped:
            objective.latest[part.skipped] = objective.latest.get(part.skipped, 0) + 1
        if part.screen_gradient is not None and objective.settings.densify.every:
            optimizer.observe(*part.screen_gradient)
    with torch_on_one_thread():
        optimizer.step(step / objective.settings.iterations, visible=moved)
    return line


class _Contribution(NamedTuple):
    """What a term contributes to a step beside its gradient.

    Attributes:
        moved: [N] bool, the Gaussians that it may move: those it reaches that are in its rendering.
        log, latest: see `TermValue`.
        skipped: key of the trace by which skipped views are counted; empty if the view was not skipped.
        screen_gradient: arguments of `GaussianOptimizer.observe`.
    """

    moved: Tensor
    log: dict[str, float]
    latest: Mapping[str, float] = {}
    skipped: str = ""
    screen_gradient: tuple[Tensor, Tensor, int, int] | None = None


def _add_gradient(term: Term, step: int, gaussians: Gaussians, masked: Tensor) -> _Contribution | None:
    """Adds the gradient of a weighted term to the Gaussians' `.grad`. None if this step is without it."""
    if step % term.every or (term.fills_hole and not masked.any()):
        return None
    view = term.select_view(step // term.every)
    if view is None:
        return None
    reached, label = term.reaches(masked, view), term.name.lower()
    with torch_on_one_thread() if term.uses_one_thread else nullcontext(), _name_failure(step, term, view.camera):
        try:
            value = term.loss(gaussians, reached, view, step)
        except Degenerate as error:
            reason = error.reason.replace(" ", "_")
            return _Contribution(torch.zeros_like(masked), {}, skipped=f"{label}_skipped_{reason}")
        _backward(term.weight * value.loss, gaussians)
    log, radii, observed = dict(value.log), value.rendering.radii, None
    if term.runs_apart:
        norms = _gradient_norms(gaussians, masked)
        log |= {f"{label}_gradient_mean": float(norms.mean()), f"{label}_gradient_max": float(norms.max())}
    if value.probe is not None:
        assert value.probe.grad is not None
        observed = value.probe.grad, radii * masked, view.camera.width, view.camera.height
    return _Contribution(reached & (radii > 0), log, value.latest, screen_gradient=observed)


def _backward(loss: Tensor, gaussians: Gaussians) -> None:
    if not torch.isfinite(loss):
        raise FloatingPointError(f"the loss is {float(loss.detach())}")
    loss.backward()
    for name in PARAMETERS:
        gradient = getattr(gaussians, name).grad
        if gradient is not None and not torch.isfinite(gradient.sum()):
            raise FloatingPointError(f"the gradient of the Gaussians' {name} is not finite")


@contextmanager
def _name_failure(step: int, term: Term, camera: Camera) -> Iterator[None]:
    """Adds step, term and view to the message of a FloatingPointError."""
    try:
        yield
    except FloatingPointError as error:
        raise FloatingPointError(f"distill, step {step}, {term.name}, view '{camera.name}': {error}") from None


def _gradient_norms(gaussians: Gaussians, masked: Tensor) -> Tensor:
    """[M]: the norm of each masked Gaussian's accumulated gradient, over all of its parameters."""
    total = torch.zeros(int(masked.sum()), device=masked.device)
    for name in PARAMETERS:
        gradient = getattr(gaussians, name).grad
        if gradient is not None:
            total += gradient[masked].reshape(len(total), -1).square().sum(1)
    return total.sqrt()


def _densifies_after(settings: Params, done: int) -> bool:
    every, last = settings.densify.every, settings.densify.stop * settings.iterations
    return bool(every) and done % every == 0 and done <= last


def average(optimizer: GaussianOptimizer, settings: Params, done: int) -> None:
    """Lets a run without densification end with the mean of the Gaussians after its last steps.

    Args:
        done: the number of steps so far.
    """
    if not settings.densify.every and done > AVERAGED_FROM * settings.iterations:
        optimizer.remember()
    if done == settings.iterations:
        optimizer.apply_mean()


def rates_of(lr: LearningRates, cameras: Sequence[Camera]) -> Rates:
    """3DGS's step sizes, in the unit that `lr.means_unit` names."""
    return Rates().in_units_of(cameras_extent(cameras)) if lr.means_unit == "cameras" else Rates()


def masked_factors(lr: LearningRates) -> dict[str, float]:
    """Parameter -> factor on the step sizes of masked Gaussians."""
    shape = lr.masked * lr.shape
    factors = {"means": shape, "quaternions": shape, "log_scales": shape, "sh": lr.masked}
    return factors | {"opacity_logits": lr.masked * lr.opacities}


@dataclass
class _Run:
    """The state of a distillation, as checkpoints keep it.

    Attributes:
        step, seconds: steps done so far; seconds spent at the last checkpoint.
    """

    optimizer: GaussianOptimizer
    objective: Objective
    step: int = 0
    seconds: float = 0.0

    @classmethod
    def start_or_resume(cls, optimizer: GaussianOptimizer, objective: Objective, state: dict[str, Any] | None) -> _Run:
        """A run at its start, or at a checkpoint's `state`."""
        run = cls(optimizer, objective)
        if state is not None:
            optimizer.load_state_dict(state["optimizer"])
            for term in objective.terms:
                if term.state is not None:
                    term.state.load_state_dict(state["terms"][term.name])
            objective.latest.update(state["latest"])
            run.step, run.seconds = state["step"], state["seconds"]
        return run

    def state_dict(self) -> dict[str, Any]:
        return {
            "optimizer": self.optimizer.state_dict(),
            "terms": {t.name: t.state.state_dict() for t in self.objective.terms if t.state is not None},
            "latest": self.objective.latest,
            "step": self.step,
            "seconds": self.seconds,
        }


def _write_line(log: trace.Trace, run: _Run, line: dict[str, float]) -> None:
    """Writes a line of the trace with its clock stopped.

    Args:
        line: what the terms log.
    """
    optimizer, objective = run.optimizer, run.objective
    end = {"reason": "finished"} if run.step == objective.settings.iterations else {}
    counts = {"gaussians": len(optimizer.masked), "masked_gaussians": int(optimizer.masked.sum())}
    with log.paused():
        measured = [reference for reference in objective.references if reference.hole.any()]
        if measured:
            line = line | {"reference_psnr": _reference_psnr(optimizer.gaussians, measured)}
        log.log(run.step, **line, **objective.latest, **counts, **end)


@torch.no_grad()
def _reference_psnr(gaussians: Gaussians, references: Sequence[ReferenceHole]) -> float:
    """PSNR in dB over the pixels of all the references' holes."""
    squared = [
        (render(gaussians, camera).color.clamp(0, 1) - image)[hole].square().flatten()
        for camera, image, hole in references
    ]
    return trace.decibels(float(torch.cat(squared).mean()))


def _save_snapshot(optimizer: GaussianOptimizer, folder: Path, done: int, steps: int) -> None:
    """Saves the masked Gaussians after each part of the run but the last, as folder/snapshots/<steps done>.ply."""
    part, masked = SNAPSHOTS * done // steps, optimizer.masked
    if SNAPSHOTS * (done - 1) // steps < part < SNAPSHOTS and masked.any():
        path = folder / "snapshots" / f"{done}.ply"
        save_ply(path, optimizer.gaussians.map(lambda parameter: parameter.detach()[masked].cpu()))

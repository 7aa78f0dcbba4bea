"""The distillation loop (RefFusion section 4): Adam on a weighted sum of terms, each confined to its own Gaussians.

    L = L_reconstruction + lambda_SDS L_SDS + lambda_depth L_depth + lambda_adversarial L_adversarial      (Eq. 5)

term             pixels                                          Gaussians
reconstruction   outside C and I (clean: all), no shadow         unmasked (or all that show there); all if clean
SDS              whole view and patches, the hole repainted      masked (or all)
depth            the hole                                        masked, all but spherical harmonics
adversarial      patches around the hole                         masked (or all), spherical harmonics only
reference        the reference's hole (not in the paper)         masked (or all)
lift             the hole, or patches around it (for baselines)  masked

C is the consistent mask (the object), I is the invent mask (the pixels to invent), and the hole of a view consists of
the pixels that are repainted. A view is clean if the object is absent from it. Masked Gaussians are those that the
initialization added; all others are unmasked.
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

# In the order in which their gradients are added. SDS comes first, because its own gradient is logged.
TERMS = sds, depth, adversarial, reference, lift, reconstruction
SNAPSHOTS = 4  # parts of the run; the masked Gaussians are saved at the end of each but the last
DENSIFIED_UNTIL = 0.5  # fraction of a run after which no Gaussian is added, as in 3DGS
AVERAGED_FROM = 2 / 3  # fraction of a run without densification after which the Gaussians of all steps are averaged
REGION_EVERY = 50  # steps between prunings of Gaussians that changed region


@dataclass(frozen=True)
class Objective:
    """The weighted sum of terms that the distillation minimizes.

    Attributes:
        terms: The terms that are on, in the order in which their gradients are added.
        references: The references, on whose holes the PSNR in the trace is measured.
        settings: Parameters of the stage `distill`.
        latest: Values that are repeated in every line of the trace: the last values of terms that are not computed in
            every step, and the numbers of skipped views. They change from step to step, and checkpoints contain them.
    """

    terms: Sequence[Term]
    references: Sequence[ReferenceHole]
    settings: Params
    latest: dict[str, float]


def build_objective(inputs: TermInputs, settings: Params) -> Objective:
    """Build the objective of a distillation from its inputs.

    Args:
        inputs: What the scene provides for the terms.
        settings: Parameters of the stage `distill`.

    Raises:
        ValueError: A term lacks an input that it needs.
    """
    terms = [term for module in TERMS if (term := module.build(inputs, settings)) is not None]
    return Objective(terms, inputs.references, settings, {})


def distill(
    initial: Gaussians, masked: Tensor, inputs: TermInputs, settings: Params, folder: Path, rates: Rates | None = None
) -> tuple[Gaussians, Tensor]:
    """Optimize an initialization, from the start or from the checkpoint in `folder`.

    On the CPU a resumed run ends with the same bits as an unbroken one. A line of the trace contains: reconstruction
    and lift (the values of these terms), reference_psnr (in the holes of the references), sds_gradient_mean and
    sds_gradient_max (norm of the weighted SDS gradient per masked Gaussian; absent if the view is too far from every
    reference), depth (the last value of the depth term), depth_skipped_<reason> (number of views skipped so far),
    adversarial (the generator's loss), critic_loss, critic_slope (R1 without its weight), gaussians and
    masked_gaussians (numbers of Gaussians).

    Args:
        initial: The Gaussians of the initialization. All tensors of the inputs are on their device.
        masked: bool [N], True for masked Gaussians (those that the initialization added).
        inputs: What the scene provides for the terms.
        settings: Parameters of the stage `distill`.
        folder: Receives trace.jsonl, checkpoints, and snapshots of the masked Gaussians in snapshots/.
        rates: Step sizes of Adam; None takes those of 3DGS (`rates_of`). In either case the step sizes of masked
            Gaussians are multiplied by the factors in `settings.lr` (`masked_factors`).

    Returns:
        The optimized Gaussians, detached, and their labels, bool [M]. M differs from N if Gaussians were densified or
            pruned. Without densification the Gaussians are the mean over the last third of the run (see `average`).

    Raises:
        FloatingPointError: A value or a gradient is not finite. The message names step, term and view.
        ValueError: A term lacks an input: a prior, a depth estimator, or a hole in a reference.
    """
    objective = build_objective(inputs, settings)
    cameras = [view.camera for view in inputs.views]
    rates = rates or rates_of(settings.lr, cameras)
    size_unit = cameras_extent(cameras) if settings.lr.means_unit == "cameras" else 1.0
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
            draws = seeding.generator(settings.seed, "distill", "densify", done)
            densify_masked(optimizer, int(masked.sum()), settings.densify, size_unit, draws)
        average(optimizer, settings, done)
        if region is not None and (done % REGION_EVERY == 0 or done == settings.iterations):
            optimizer.select(~has_changed_region(region, optimizer.gaussians.means.detach(), optimizer.masked))
        if trace.is_log_step(done, settings.iterations, per_octave=4):
            _write_line(log, run, line)
        _save_snapshot(optimizer, folder, done, settings.iterations)
        if checkpoints.due:
            run.seconds = log.seconds
            checkpoints.save(run.state_dict)
    return optimizer.gaussians.map(Tensor.detach), optimizer.masked


def take_step(optimizer: GaussianOptimizer, step: int, objective: Objective) -> dict[str, float]:
    """Take one step of Adam against the gradient of the weighted sum, and return the values that the terms log.

    Args:
        optimizer: Holds the Gaussians, which are changed, and their accumulated screen-space gradients.
        step: Number of the step, from 0.
        objective: The weighted sum. Its `latest` is updated.
    """
    moved, line = torch.zeros_like(optimizer.masked), {}
    for term in objective.terms:
        part = _add_gradient(term, step, optimizer.gaussians, optimizer.masked)
        if part is None:
            continue
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
    """The contribution of a term to a step, apart from its gradient.

    Attributes:
        moved: bool [N], the Gaussians that the step may move for this term: those that it reaches and that are in its
            rendering.
        log, latest: See `TermValue`.
        skipped: Key of the trace under which skipped views are counted. It is empty if the view was not skipped.
        screen_gradient: Arguments of `GaussianOptimizer.observe`; None if the term does not drive densification.
    """

    moved: Tensor
    log: dict[str, float]
    latest: Mapping[str, float] = {}
    skipped: str = ""
    screen_gradient: tuple[Tensor, Tensor, int, int] | None = None


def _add_gradient(term: Term, step: int, gaussians: Gaussians, masked: Tensor) -> _Contribution | None:
    """Add the gradient of a weighted term to the Gaussians' `.grad`; return None if it is not computed in this step."""
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
            # The view does not determine the loss: no gradient is added, and the view counts as skipped.
            reason = error.reason.replace(" ", "_")
            return _Contribution(torch.zeros_like(masked), {}, skipped=f"{label}_skipped_{reason}")
        _backward(term.weight * value.loss, gaussians)
    log, radii, observed = dict(value.log), value.rendering.radii, None
    if term.logs_gradient:
        norms = _gradient_norms(gaussians, masked)
        log |= {f"{label}_gradient_mean": float(norms.mean()), f"{label}_gradient_max": float(norms.max())}
    if value.probe is not None:
        assert value.probe.grad is not None
        observed = value.probe.grad, radii * masked, view.camera.width, view.camera.height
    return _Contribution(reached & (radii > 0), log, value.latest, screen_gradient=observed)


def _backward(loss: Tensor, gaussians: Gaussians) -> None:
    """Add the loss's gradient to `.grad`. Raises FloatingPointError if the loss or a gradient is not finite."""
    if not torch.isfinite(loss):
        raise FloatingPointError(f"the loss is {float(loss.detach())}")
    loss.backward()
    for name in PARAMETERS:
        gradient = getattr(gaussians, name).grad
        if gradient is not None and not torch.isfinite(gradient.sum()):
            raise FloatingPointError(f"the gradient of the Gaussians' {name} is not finite")


@contextmanager
def _name_failure(step: int, term: Term, camera: Camera) -> Iterator[None]:
    """Add step, term and view to the message of a FloatingPointError that is raised inside this context."""
    try:
        yield
    except FloatingPointError as error:
        raise FloatingPointError(f"distill, step {step}, {term.name}, view '{camera.name}': {error}") from None


def _gradient_norms(gaussians: Gaussians, masked: Tensor) -> Tensor:
    """Return [M], the norm of each masked Gaussian's accumulated gradient, over all of its parameters."""
    total = torch.zeros(int(masked.sum()), device=masked.device)
    for name in PARAMETERS:
        gradient = getattr(gaussians, name).grad
        if gradient is not None:
            total += gradient[masked].reshape(len(total), -1).square().sum(1)
    return total.sqrt()


def _densifies_after(settings: Params, done: int) -> bool:
    """Return whether the Gaussians are densified after `done` steps."""
    every, last = settings.densify.every, DENSIFIED_UNTIL * settings.iterations
    return bool(every) and done % every == 0 and done <= last


def average(optimizer: GaussianOptimizer, settings: Params, done: int) -> None:
    """Average the Gaussians over the steps after the share `AVERAGED_FROM` of a run.

    Call this function after each step: it adds the Gaussians to the running mean. After the last step the mean replaces
    the Gaussians. A run with densification is not averaged.

    Args:
        optimizer: Holds the Gaussians and their running mean.
        settings: Parameters of the stage `distill`.
        done: Number of steps so far.
    """
    if not settings.densify.every and done > AVERAGED_FROM * settings.iterations:
        optimizer.remember()
    if done == settings.iterations:
        optimizer.apply_mean()


def rates_of(lr: LearningRates, cameras: Sequence[Camera]) -> Rates:
    """Return the default step sizes of 3DGS, without the factors in `lr` (`masked_factors` returns these).

    If `lr.means_unit` is "cameras", the step sizes of positions are multiplied by the extent of the cameras.
    """
    return Rates().in_units_of(cameras_extent(cameras)) if lr.means_unit == "cameras" else Rates()


def masked_factors(lr: LearningRates) -> dict[str, float]:
    """Return parameter name -> factor on the step size of masked Gaussians; unmasked Gaussians have the factor 1."""
    shape = lr.masked * lr.shape
    factors = {"means": shape, "quaternions": shape, "log_scales": shape, "sh": lr.masked}
    return factors | {"opacity_logits": lr.masked * lr.opacities}


@dataclass
class _Run:
    """The state of a distillation, as checkpoints contain it.

    Attributes:
        optimizer: Holds the Gaussians.
        objective: The weighted sum.
        step: Number of steps so far.
        seconds: Time spent up to the last checkpoint.
    """

    optimizer: GaussianOptimizer
    objective: Objective
    step: int = 0
    seconds: float = 0.0

    @classmethod
    def start_or_resume(cls, optimizer: GaussianOptimizer, objective: Objective, state: dict[str, Any] | None) -> _Run:
        """Return a run at its start, or at a checkpoint.

        Args:
            state: The state in the checkpoint (see `state_dict`), which is restored into `optimizer` and the terms of
                `objective`. None starts a new run.
        """
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
        """Return the state from which `start_or_resume` continues."""
        return {
            "optimizer": self.optimizer.state_dict(),
            "terms": {t.name: t.state.state_dict() for t in self.objective.terms if t.state is not None},
            "latest": self.objective.latest,
            "step": self.step,
            "seconds": self.seconds,
        }


def _write_line(log: trace.Trace, run: _Run, line: dict[str, float]) -> None:
    """Write one line of the trace, with the values `line` of the last step; the time that this takes is not counted."""
    optimizer, objective = run.optimizer, run.objective
    end = {"reason": "finished"} if run.step == objective.settings.iterations else {}
    counts = {"gaussians": len(optimizer.masked), "masked_gaussians": int(optimizer.masked.sum())}
    with log.pause():
        measured = [reference for reference in objective.references if reference.hole.any()]
        if measured:
            line = line | {"reference_psnr": _reference_psnr(optimizer.gaussians, measured)}
        log.log(run.step, **line, **objective.latest, **counts, **end)


@torch.no_grad()
def _reference_psnr(gaussians: Gaussians, references: Sequence[ReferenceHole]) -> float:
    """Return the PSNR in dB over the pixels in the holes of all references together."""
    squared = [
        (render(gaussians, camera).color.clamp(0, 1) - image)[hole].square().flatten()
        for camera, image, hole in references
    ]
    return trace.decibels(float(torch.cat(squared).mean()))


def _save_snapshot(optimizer: GaussianOptimizer, folder: Path, done: int, steps: int) -> None:
    """Save the masked Gaussians as folder/snapshots/<done>.ply, if one of `SNAPSHOTS` parts of the run ends here."""
    part, masked = SNAPSHOTS * done // steps, optimizer.masked
    # No snapshot is saved at the end of the last part, where the result is saved.
    if SNAPSHOTS * (done - 1) // steps < part < SNAPSHOTS and masked.any():
        path = folder / "snapshots" / f"{done}.ply"
        save_ply(path, optimizer.gaussians.map(lambda parameter: parameter.detach()[masked].cpu()))

"""Cases of the optimisation: all Gaussians pruned, too large learning rates, gradients of any size."""

from __future__ import annotations

import json
import math
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from lab.stability import frames
from lab.stability.cases import EPS32, EXACT, Case, nan_safe_max
from lab.stability.splatting import camera, cloud
from reffusion import seeding, trace
from reffusion.distill.loop import distill
from reffusion.distill.terms.term import TermInputs
from reffusion.distill.train_view import ReferenceHole, TrainView
from reffusion.fit.reconstruction import fit
from reffusion.fit.start import initial_gaussians
from reffusion.gaussians.densify import densify, prune
from reffusion.gaussians.optimize import GaussianOptimizer, Rates
from reffusion.io.ply import load_ply, save_ply
from reffusion.params import distill as distilling
from reffusion.params.fit import Densify, Params, SphericalHarmonics
from reffusion.splat.rasterizer import render
from reffusion.types import PARAMETERS, Gaussians

STOPS = "neither recovered nor stopped by name, or wrote NaN"


def psnr(gaussians: Gaussians) -> float:
    """Return the PSNR in dB of the Gaussians over the views of `frames`."""
    scene, pictures = frames.normalized_scene(1.0, 0.0), frames.render_photographs()
    error = np.mean([(render(gaussians, view).color.clamp(0, 1).numpy() - pictures[name] / 255.0) ** 2
                     for name, view in scene.cameras.items()])  # fmt: skip
    return float(-10 * math.log10(error))


def is_trace_finite(folder: Path) -> bool:
    """Return True if all numbers of the trace in a folder are finite."""
    values = [v for line in trace.read_trace(folder / "trace.jsonl") for v in line.values() if not isinstance(v, str)]
    return all(math.isfinite(v) for v in values)


def names_step_and_term(error: FloatingPointError, term: str) -> bool:
    """Return True if the message of an error names a step and the term."""
    return "step" in str(error) and term in str(error)


def fast_fit_fails(factor: float) -> float:
    """Return 0 if a fit with too large learning rates either improves the PSNR or stops with a clear error, else 1.

    A clear error names the step and the term that failed. For factors above 100, no improvement is required. All values
    and the trace must be finite.

    Args:
        factor: factor on the usual learning rates.
    """
    scene = frames.normalized_scene(1.0, 0.0)
    start = initial_gaussians(scene.points, scene.point_colors, 0, 1000, seeding.generator(0))
    usual = Rates(means=2e-3, means_last=2e-4, log_scales=1.5e-2, sh_dc=1.5e-2)
    settings = Params(iterations=60, random_background=False).changed({"sh.degree": 0, "densify.every": 10})
    rates = frames.scale_rates(usual, factor)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            result = fit(
                list(scene.cameras.values()), frames.render_photographs(), start, settings, folder=folder, rates=rates
            )
        except FloatingPointError as error:
            return float(not (names_step_and_term(error, "reconstruction") and is_trace_finite(folder)))
        finite = all(torch.isfinite(getattr(result, n)).all() for n in PARAMETERS)
        return float(not (finite and is_trace_finite(folder) and (psnr(result) > psnr(start) or factor > 100)))


def fast_distillation_fails(factor: float) -> float:
    """Return 0 if a distillation with too large learning rates improves the PSNR or stops with a clear error, else 1.

    A clear error names the step and the term that failed. All values and the trace must be finite. The terms are
    reconstruction and reference. About half of the Gaussians are masked and start in gray.

    Args:
        factor: factor on the usual learning rates.
    """
    scene, fitted, _ = frames.fit_scene(1.0, 0.0)
    masked = fitted.means[:, 0] > 0
    start = replace(fitted, sh=torch.where(masked[:, None, None], 0.0, fitted.sh))
    pictures = {name: torch.from_numpy(p).float() / 255 for name, p in frames.render_photographs().items()}
    whole = torch.ones(frames.HEIGHT, frames.WIDTH, dtype=torch.bool)
    views = [TrainView(view, pictures[n], whole, ~whole, clean=False) for n, view in scene.cameras.items()]
    off, rates = {"weight": 0}, frames.scale_rates(Rates(means=2e-3), factor)
    settings = distilling.Params(
        iterations=40, sds=off, depth=off, adversarial=off, reference={"weight": 1}, lr={"epsilon": 1e-6}
    )
    holes = [ReferenceHole(scene.cameras["v2"], pictures["v2"], whole)]
    inputs = TermInputs(views, holes, start.means[masked])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            result, _ = distill(start, masked, inputs, settings, folder, rates)
        except FloatingPointError as error:
            return float(not (names_step_and_term(error, "re") and is_trace_finite(folder)))
        finite = all(torch.isfinite(getattr(result, n)).all() for n in PARAMETERS)
        return float(not (finite and is_trace_finite(folder) and psnr(result) > psnr(start)))


def empty_scene_errors() -> float:
    """Count the violations after all Gaussians were pruned.

    Renders must then show the background, optimizer steps must do nothing, and saved files must have no Gaussians.
    """
    optimizer, view = GaussianOptimizer(cloud()), camera()
    removed = prune(optimizer, 1.1, math.inf)
    picture = render(optimizer.gaussians, view, background=torch.full((3,), 0.25))
    picture.color.sum().backward()
    optimizer.step(0.5, visible=picture.radii > 0)
    grown = densify(optimizer, 0.0, 0.01, 100, seeding.generator(0))
    with tempfile.TemporaryDirectory() as folder:
        save_ply(Path(folder) / "none.ply", optimizer.gaussians)
        again = len(load_ply(Path(folder) / "none.ply"))
    good = removed == 8, (picture.color == 0.25).all(), not picture.alpha.any(), grown == again == 0
    return float(sum(not x for x in good))


def refuse_empty_fit() -> float:
    """Return 0 if a fit whose pruning removes all Gaussians stops with an error that names the step, else 1."""
    scene = frames.normalized_scene(1.0, 0.0)
    start = initial_gaussians(scene.points, scene.point_colors, 0, 1000, seeding.generator(0))
    densify = Densify(start=0.0, stop=1.0, every=4, prune_scale3d=1e-9, grow_grad2d=1e9)
    settings = Params(iterations=8, sh=SphericalHarmonics(degree=0), densify=densify)
    with tempfile.TemporaryDirectory() as folder:
        try:
            fit(list(scene.cameras.values()), frames.render_photographs(), start, settings, folder=Path(folder))
        except ValueError as error:
            return float(not ("step 3" in str(error) and "no Gaussian" in str(error)))
    return 1.0


def count_unpruned() -> float:
    """Count the Gaussians with log-scales of 100 and more that pruning does not remove as too large.

    The exponentials of such log-scales overflow. The number is negative if pruning removes other Gaussians, too.
    """
    gaussians = cloud()
    gaussians.log_scales[:4] = torch.tensor([100.0, 1e3, 1e4, 1e30])[:, None]
    optimizer = GaussianOptimizer(gaussians)
    prune(optimizer, 0.0, 1e3)
    return float(len(optimizer.gaussians) - 4)


def first_step_excess() -> float:
    """Return by how much Adam's first step exceeds the step size, relative to it: the most over gradients of any size.

    Gradients are 1e-25 to 1e18. The first step should move no coordinate by more than the step size.
    """
    worst = 0.0
    for size in (1e-25, 1e-15, 1e-8, 1.0, 1e8, 1e18):
        optimizer = GaussianOptimizer(cloud(degree=0), rates=Rates(means=1e-3, means_last=1e-3))
        before = optimizer.gaussians.means.detach().clone()
        optimizer.gaussians.means.grad = torch.full_like(before, size)
        optimizer.step(0.0)
        moved = (optimizer.gaussians.means.detach() - before).abs().max().item()
        worst = nan_safe_max(worst, moved / 1e-3 - 1 if math.isfinite(moved) else math.inf)
    return worst


def broken_gradient_errors() -> float:
    """Count the violations for NaN and infinite gradients: they must raise an error and change no parameter.

    The error must name the parameter.
    """
    wrong = 0
    for value in (math.nan, math.inf):
        optimizer = GaussianOptimizer(cloud())
        before = json.dumps(optimizer.gaussians.log_scales.tolist())
        optimizer.gaussians.log_scales.grad = torch.full((8, 3), value)
        try:
            optimizer.step(0.0)
            wrong += 1
        except FloatingPointError as error:
            wrong += "log_scales" not in str(error)
        wrong += json.dumps(optimizer.gaussians.log_scales.tolist()) != before
    return float(wrong)


CASES = (
    *(Case(f"learning rates {factor:g} times too large, fit", STOPS, EXACT, partial(fast_fit_fails, factor))
      for factor in (10.0, 1e6)),
    Case("learning rates 10 times too large, distillation", STOPS, EXACT, partial(fast_distillation_fails, 10.0)),
    Case("all Gaussians pruned", "properties that do not hold", EXACT, empty_scene_errors),
    Case("all Gaussians pruned in a fit", "refusals without step and cause", EXACT, refuse_empty_fit),
    Case("log-scales whose exponential is infinite", "Gaussians not pruned", EXACT, count_unpruned),
    # A mean of order one is rounded to 2^-24, against a step of 1e-3; Adam's own arithmetic rounds some ten times.
    Case("gradients of 1e-25 to 1e18", "how much longer than a step size, relative", 2e3 * EPS32 + 16 * EPS32,
         first_step_excess),
    Case("gradients that are not numbers", "unnamed, or something moved", EXACT, broken_gradient_errors),
)  # fmt: skip

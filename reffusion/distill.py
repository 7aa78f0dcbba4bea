"""Distillation (RefFusion section 4): reconstruction and multi-scale SDS on one set of Gaussians, each confined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import log10
from pathlib import Path

import torch
from torch import Tensor

from reffusion import trace
from reffusion.confinement import (
    Distillation,
    Sight,
    gradient_norms,
    reconstruction_term,
    reference_term,
    region_of,
    sds_term,
    strays,
)
from reffusion.densify import densify, prune
from reffusion.optimize import GaussianOptimizer, Rates
from reffusion.prior import Prior
from reffusion.splat import render
from reffusion.types import PARAMETERS, Camera, Gaussians


@dataclass(frozen=True)
class Settings:
    """How distillation runs; moments as parts of the run in [0, 1].

    Attributes:
        iterations: optimisation steps, each with one view for SDS and one for reconstruction.
        seed: of views, windows, timesteps, noise and splits.
        sds_weight: lambda of the SDS term; 0 leaves it out.
        sds: the choices within that term.
        reconstruction_every: steps between two with a reconstruction term; 0: never.
        reference_weight: of the reference's own pixels in its hole (paper: 0).
        densify_every: steps between densifications of masked Gaussians; 0: never.
        densify_share: share of the masked Gaussians cloned or split each time.
        densify_until: part of the run after which no Gaussian is added.
        split_above: standard deviation from which a Gaussian is split, not cloned.
        budget: most Gaussians.
        least_opacity: fainter ones are pruned when others are added.
        region_every: steps between prunings of Gaussians that changed region.
        stop_drop: stop when the reference's PSNR falls so many dB under its best, and give the best; 0: never.
        patience, stop_gain: the same when in so many twentieths of the run it has not gained so many dB; 0: never.
        rates: Adam's step sizes.
        masked_pace: parameter -> factor on them for masked Gaussians.
        epsilon: Adam's; against it a gradient is large or small. At 3DGS's 1e-15 a Gaussian that hardly anything but
            SDS reaches takes full steps, however small lambda is.
        checkpoint_seconds: seconds of work between checkpoints.
    """

    iterations: int
    seed: int = 0
    sds_weight: float = 1e-3
    sds: Distillation = field(default_factory=Distillation)
    reconstruction_every: int = 1
    reference_weight: float = 0.0
    densify_every: int = 0
    densify_share: float = 0.05
    densify_until: float = 0.5
    split_above: float = 0.01
    budget: int = 2_000_000
    least_opacity: float = 0.005
    region_every: int = 50
    stop_drop: float = 0.0
    patience: int = 0
    stop_gain: float = 0.0
    rates: Rates = field(default_factory=Rates)
    masked_pace: Mapping[str, float] = field(default_factory=dict)
    epsilon: float = 1e-15
    checkpoint_seconds: float = 10.0


def distill(
    initial: Gaussians,
    masked: Tensor,
    sights: Sequence[Sight],
    holes: Sequence[tuple[Camera, Tensor, Tensor]],
    prior: Prior | None,
    text: Tensor | None,
    settings: Settings,
    folder: Path,
) -> tuple[Gaussians, Tensor]:
    """Optimise an initialization; resumes from `folder`'s checkpoint, bit for bit on the CPU.

    Args:
        initial, masked: the Gaussians and their labels [N] bool; everything else is on their device.
        sights: the training views; only those with pixels to repaint are distilled.
        holes: (camera, image [H, W, 3] in [0, 1], hole [H, W] bool) of each reference.
        prior: adapted to the reference; None where `settings.sds_weight` is 0.
        text: [3, L, D], hidden states of the global, the local and the empty prompt.
        folder: gets trace.jsonl and checkpoints. A line of the trace: reconstruction (that term's value),
            reference_psnr (in the references' holes), sds_gradient_mean and _max (norm of the weighted SDS gradient
            per masked Gaussian in that step), gaussians, masked_gaussians.
    Returns:
        The Gaussians, detached, and their labels.
    Raises:
        FloatingPointError: a value or gradient is not finite; names step, term and view.
    """
    optimizer = GaussianOptimizer(initial, masked, settings.rates, settings.masked_pace, epsilon=settings.epsilon)
    region = region_of(initial.means, masked) if masked.any() else None
    distilled = [sight for sight in sights if sight.repaint.any()] if settings.sds_weight > 0 else []
    if distilled and (prior is None or text is None):
        raise ValueError("distillation with sds_weight > 0 needs a prior and its prompts' embeddings")
    state = trace.load_checkpoint(folder)
    start, seconds, best, patience = (
        0,
        0.0,
        None,
        trace.Patience(settings.patience, settings.stop_gain, settings.stop_drop),
    )
    if state is not None:
        optimizer.load_state_dict(state["optimizer"])
        patience.load_state_dict(state["patience"])
        start, seconds, best = (state[k] for k in ("step", "seconds", "best"))
    log, saved = trace.Trace(folder, seconds, start + bool(start)), seconds  # a line is numbered by the steps done
    if start == 0:
        with log.paused():
            psnr, best = reference_psnr(optimizer.gaussians, holes), _copy(optimizer) if patience.watching else None
            patience.ends(0, settings.iterations, psnr)
            log.log(0, reference_psnr=psnr, **_counts(optimizer))

    for step in trace.progress(settings.iterations, "distill", start):
        line = _step(optimizer, step, distilled, sights, holes, prior, text, settings)
        done = step + 1
        if settings.densify_every and done % settings.densify_every == 0:
            _densify(optimizer, settings, done)
        if region is not None and (done % settings.region_every == 0 or done == settings.iterations):
            optimizer.select(~strays(region, optimizer.gaussians.means.detach(), optimizer.masked))
        if patience.due(done, settings.iterations, per_octave=4):
            with log.paused():
                psnr = reference_psnr(optimizer.gaussians, holes)
                end = patience.ends(done, settings.iterations, psnr)
                log.log(done, reference_psnr=psnr, **line, **_counts(optimizer), **end)
                if patience.watching and patience.best_at == done:
                    best = _copy(optimizer)
            if end and end["reason"] != "finished":
                return replace(optimizer.gaussians, **{name: best[name] for name in PARAMETERS}), best["masked"]
        if log.seconds - saved > settings.checkpoint_seconds:
            saved = log.seconds
            state = {"optimizer": optimizer.state_dict(), "step": done, "seconds": saved}
            trace.save_checkpoint(folder, state | {"best": best, "patience": patience.state_dict()})
    return optimizer.gaussians.map(Tensor.detach), optimizer.masked


def _counts(optimizer: GaussianOptimizer) -> dict[str, int]:
    return {"gaussians": len(optimizer.masked), "masked_gaussians": int(optimizer.masked.sum())}


def _copy(optimizer: GaussianOptimizer) -> dict[str, Tensor]:
    """The Gaussians' parameters and labels as they are now."""
    tensors = {name: getattr(optimizer.gaussians, name) for name in PARAMETERS} | {"masked": optimizer.masked}
    return {name: tensor.detach().clone() for name, tensor in tensors.items()}


def _step(
    optimizer: GaussianOptimizer,
    step: int,
    distilled: Sequence[Sight],
    sights: Sequence[Sight],
    holes: Sequence[tuple[Camera, Tensor, Tensor]],
    prior: Prior | None,
    text: Tensor | None,
    settings: Settings,
) -> dict[str, float]:
    """The terms of one step, one after another, then one step of Adam; what there is to log."""
    gaussians, masked = optimizer.gaussians, optimizer.masked
    moved, line = torch.zeros_like(masked), {}
    if distilled and masked.any():
        sight = _drawn(distilled, step, settings.seed, "sds")
        probe = torch.zeros(len(masked), 2, device=masked.device, requires_grad=True)
        draw = trace.generator(settings.seed, "distill", "sds", step)
        try:
            loss, rendering = sds_term(gaussians, masked, sight, prior, text, settings.sds, draw, probe)
        except FloatingPointError as error:
            raise FloatingPointError(f"distill, step {step}, SDS, view '{sight.camera.name}': {error}") from None
        _backward(settings.sds_weight * loss, gaussians, step, "SDS", sight.camera)
        norms = gradient_norms(gaussians, masked)
        line |= {"sds_gradient_mean": float(norms.mean()), "sds_gradient_max": float(norms.max())}
        if settings.densify_every:
            optimizer.observe(probe.grad, rendering.radii * masked, sight.camera.width, sight.camera.height)
        moved |= masked & (rendering.radii > 0)
    if settings.reference_weight > 0 and masked.any():
        camera, image, hole = holes[step % len(holes)]
        loss, rendering = reference_term(gaussians, masked, camera, image, hole)
        _backward(settings.reference_weight * loss, gaussians, step, "reference", camera)
        moved |= masked & (rendering.radii > 0)
    if settings.reconstruction_every and step % settings.reconstruction_every == 0:
        sight = _drawn(sights, step // settings.reconstruction_every, settings.seed, "reconstruction")
        loss, rendering = reconstruction_term(gaussians, masked, sight)
        _backward(loss, gaussians, step, "reconstruction", sight.camera)
        line["reconstruction"] = float(loss.detach())
        moved |= (rendering.radii > 0) & (~masked | sight.clean)
    optimizer.step(step / settings.iterations, visible=moved)
    return line


def _drawn(sights: Sequence[Sight], turn: int, seed: int, label: str) -> Sight:
    """Every view once an epoch, in an order of the epoch's own."""
    order = torch.randperm(len(sights), generator=trace.generator(seed, "distill", label, turn // len(sights)))
    return sights[int(order[turn % len(sights)])]


def _backward(loss: Tensor, gaussians: Gaussians, step: int, term: str, camera: Camera) -> None:
    where = f"distill, step {step}, {term}, view '{camera.name}'"
    if not torch.isfinite(loss):
        raise FloatingPointError(f"{where}: the loss is {float(loss)}")
    loss.backward()
    for name in PARAMETERS:
        gradient = getattr(gaussians, name).grad
        if gradient is not None and not torch.isfinite(gradient.sum()):
            raise FloatingPointError(f"{where}: the gradient of the Gaussians' {name} is not finite")


def _densify(optimizer: GaussianOptimizer, settings: Settings, done: int) -> None:
    """Clone or split the masked Gaussians pulled hardest on the screen; only they have been observed."""
    if done > settings.densify_until * settings.iterations or not optimizer.masked.any():
        return
    slopes = (optimizer.slope_sum / optimizer.slope_count.clamp(min=1))[optimizer.masked]
    least = torch.finfo(slopes.dtype).tiny
    threshold = max(float(slopes.kthvalue(max(1, round((1 - settings.densify_share) * len(slopes)))).values), least)
    noise = trace.generator(settings.seed, "distill", "densify", done)
    densify(optimizer, threshold, settings.split_above, settings.budget, noise)
    prune(optimizer, settings.least_opacity, float("inf"))


@torch.no_grad()
def reference_psnr(gaussians: Gaussians, holes: Sequence[tuple[Camera, Tensor, Tensor]]) -> float:
    """PSNR in dB over the pixels of all the references' holes."""
    squared = [(render(gaussians, c).color.clamp(0, 1) - image)[hole].square().flatten() for c, image, hole in holes]
    return -10 * log10(max(float(torch.cat(squared).mean()), 1e-10))

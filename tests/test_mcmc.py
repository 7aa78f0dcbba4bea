"""Relocation and growth as sampling: the picture stays, labels follow, Adam starts afresh."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from test_fit import SETTINGS, ring_of_cameras, run, start, truth

from reffusion.gaussians import mcmc
from reffusion.gaussians.optimize import GaussianOptimizer
from reffusion.seeding import generator
from reffusion.splat.rasterizer import render
from reffusion.types import PARAMETERS


def test_copies_draw_what_one_drew():
    opacity = torch.tensor([0.05, 0.3, 0.9, 0.999]).repeat_interleave(4)
    copies = torch.tensor([1, 2, 7, 51]).repeat(4)
    each, shrink = mcmc.shared(opacity, copies)
    assert torch.isfinite(shrink).all() and ((shrink > 0) & (shrink <= 1.0001)).all()
    torch.testing.assert_close(1 - (1 - each.double()) ** copies, opacity.double(), atol=2e-5, rtol=0)
    torch.testing.assert_close(shrink[copies == 1], torch.ones(4))
    # What a line through the centre gathers: the integral of 1 - (1 - o' exp(-x^2 / 2 f^2))^c is that of o exp(-x^2/2).
    x = torch.linspace(-8, 8, 4001, dtype=torch.float64)
    for o, c, e, f in zip(opacity, copies, each, shrink, strict=True):
        together = 1 - (1 - e.double() * torch.exp(-0.5 * (x / f.double()) ** 2)) ** c
        alone = o.double() * torch.exp(-0.5 * x**2)
        assert together.sum() == pytest.approx(float(alone.sum()), rel=2e-4)


def test_growing_hardly_changes_the_picture_and_keeps_labels():
    camera, gaussians = ring_of_cameras()[0], truth()
    optimizer = GaussianOptimizer(gaussians, torch.arange(len(gaussians)) % 3 == 0)
    before = render(gaussians, camera).color
    count = len(gaussians) // 5
    assert mcmc.grow(optimizer, count, 0.005, generator(0, "grow")) == count
    grown = optimizer.gaussians
    assert len(grown) == len(gaussians) + count == len(optimizer.masked)
    home = torch.cdist(grown.means.detach(), gaussians.means).argmin(1)
    assert torch.equal(optimizer.masked, home % 3 == 0), "a Gaussian carries the label of the place it joined"
    change = (render(grown, camera).color - before).square().mean().detach()
    assert change < 0.01 * before.var(), float(change / before.var())


def test_the_faint_are_moved_and_start_afresh():
    gaussians = truth()
    with torch.no_grad():
        gaussians.opacity_logits[::4] = -9.0
    optimizer = GaussianOptimizer(gaussians)
    for name in PARAMETERS:
        getattr(optimizer._first, name).fill_(1.0)
    dead = len(gaussians.opacity_logits[::4])
    assert mcmc.relocate(optimizer, 0.005, generator(0, "relocate")) == dead
    assert (optimizer.gaussians.opacity_logits.detach().sigmoid() > 0.0049).all()
    places = {tuple(m) for m in gaussians.means.tolist()}
    assert {tuple(m) for m in optimizer.gaussians.means.detach().tolist()} <= places
    assert (optimizer._first.means[::4] == 0).all() and (optimizer._first.means != 0).any()
    assert mcmc.relocate(optimizer, 0.0, generator(0, "again")) == 0


def test_noise_follows_the_covariance_and_spares_the_opaque():
    gaussians = truth()
    with torch.no_grad():
        gaussians.opacity_logits[:5] = 8.0
        gaussians.opacity_logits[5:] = -9.0
    optimizer = GaussianOptimizer(gaussians)
    mcmc.explore(optimizer, 0.0, generator(0, "noise"))
    moved = optimizer.gaussians.means.detach() - gaussians.means
    assert (moved[:5].abs() < 1e-12).all() and (moved[5:].norm(dim=1) > 0).all()
    flat = GaussianOptimizer(
        replace(
            gaussians,
            log_scales=torch.tensor([0.0, 0.0, -9.0]).repeat(len(gaussians), 1),
            quaternions=torch.zeros_like(gaussians.quaternions),
        )
    )
    mcmc.explore(flat, 0.0, generator(0, "noise"))
    moved = (flat.gaussians.means.detach() - gaussians.means)[5:].abs().mean(0)
    assert moved[2] < 1e-6 * moved[0]


def test_a_fit_by_sampling_reaches_its_budget_and_repeats(tmp_path):
    settings = replace(SETTINGS, densify_by="mcmc", opacity_weight=0.01, scale_weight=0.01, iterations=60)
    first, again = (run(tmp_path / name, settings=settings) for name in "ab")
    assert len(start()) < len(first) <= settings.budget
    assert all(torch.equal(getattr(first, name), getattr(again, name)) for name in PARAMETERS)

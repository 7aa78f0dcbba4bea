"""The reconstruction term: photographs supervise the Gaussians outside the hole."""

from __future__ import annotations

import torch
from torch import Tensor

from reffusion.distill.terms.term import Term, TermInputs, TermValue, cycle_through
from reffusion.distill.train_view import TrainView
from reffusion.gaussians.optimize import confine, reconstruction_loss
from reffusion.params.distill import Params
from reffusion.splat.rasterizer import render
from reffusion.types import Gaussians, Rendering


def build(inputs: TermInputs, settings: Params) -> Term | None:
    """Build the reconstruction term. Return None if it never runs or no photograph may supervise.

    Its gradient reaches the unmasked Gaussians, or with `reconstruction.reaches: shown` or `confined: false` all. In a
    clean view, from which the object is absent, it reaches all Gaussians, because such a view shows the true
    background.
    """
    views = [view for view in inputs.views if view.supervises.any()]
    if not settings.reconstruction.every or not views:
        return None
    spares_masked = settings.confined and settings.reconstruction.reaches == "unmasked"

    def reaches(masked: Tensor, view: TrainView) -> Tensor:
        return torch.ones_like(masked) if view.clean or not spares_masked else ~masked

    def loss(gaussians: Gaussians, reached: Tensor, view: TrainView, step: int) -> TermValue:
        value, rendering = evaluate_reconstruction(gaussians, reached, view)
        return TermValue(value, rendering, {"reconstruction": float(value.detach())})

    return Term(
        "reconstruction",
        weight=1.0,
        select_view=cycle_through(views, settings.seed, "reconstruction"),
        reaches=reaches,
        loss=loss,
        every=settings.reconstruction.every,
        fills_hole=False,
        uses_one_thread=True,
    )


def evaluate_reconstruction(gaussians: Gaussians, reached: Tensor, view: TrainView) -> tuple[Tensor, Rendering]:
    """Return 0.8 L1 + 0.2 D-SSIM over the pixels whose photograph may supervise, and the rendering.

    The sum over these pixels is divided by the number of all pixels of the view (see `reconstruction_loss`).

    Args:
        gaussians: All Gaussians of the scene.
        reached: bool [N], True for the Gaussians that get a gradient.
        view: A training view.
    """
    rendering = render(confine(gaussians, reached), view.camera)
    return reconstruction_loss(rendering.color, view.picture, view.supervises), rendering

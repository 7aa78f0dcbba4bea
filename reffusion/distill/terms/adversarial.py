"""The adversarial term: patches of the rendered views must look like patches of the reference (section 4.3)."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from reffusion import seeding
from reffusion.distill.adversary import Adversary
from reffusion.distill.discriminator import gather_patches
from reffusion.distill.display_range import clamp_to_display
from reffusion.distill.terms.term import Term, TermInputs, TermValue, cycle_through, reach_hole
from reffusion.distill.train_view import TrainView
from reffusion.gaussians.optimize import confine
from reffusion.params.distill import Params
from reffusion.prior.windows import enlarge_to_fit, windows_around
from reffusion.splat.rasterizer import render
from reffusion.types import Gaussians, Rendering


def build(inputs: TermInputs, settings: Params) -> Term | None:
    """The term with its critic; None if its weight is 0 or no view has a hole.

    In each step the real patches come from one reference and the fake ones from one training view. The gradient
    reaches the spherical harmonics of the masked Gaussians, or of all with `adversarial.reaches: all`.

    Raises:
        ValueError: no reference has a hole.
    """
    adversarial = settings.adversarial
    if adversarial.weight == 0 or not inputs.hole_views:
        return None
    references = [reference for reference in inputs.references if reference.hole.any()]
    if not references:
        raise ValueError("the adversarial term takes its real patches around a reference's hole; there is none")
    adversary = Adversary(adversarial, settings.seed, inputs.masked_means.device)
    next_view = cycle_through(inputs.hole_views, settings.seed, "adversarial")

    def loss(gaussians: Gaussians, reached: Tensor, view: TrainView, step: int) -> TermValue:
        _, image, hole = references[step % len(references)]
        draws = seeding.generator(settings.seed, "distill", "adversarial", step)
        return TermValue(*evaluate_adversarial(gaussians, reached, view, image, hole, adversary, draws))

    return Term(
        "adversarial",
        weight=adversarial.weight,
        select_view=lambda step: None if step < adversarial.start * settings.iterations else next_view(step),
        reaches=reach_hole(settings, everywhere=adversarial.reaches == "all"),
        loss=loss,
        uses_one_thread=True,
        state=adversary,
    )


def evaluate_adversarial(
    gaussians: Gaussians,
    reached: Tensor,
    view: TrainView,
    image: Tensor,
    hole: Tensor,
    adversary: Adversary,
    generator: torch.Generator,
) -> tuple[Tensor, Rendering, dict[str, float]]:
    """Trains the critic for one step, then judges the view's patches by it.

    PAPER leaves open: how the patches are drawn. A masked pixel is drawn first, as for SDS (`windows.window_around`).
    All fake patches of a step come from one training view, and all real ones from one reference. A view or reference
    that is smaller than a patch is enlarged until one fits.

    Args:
        reached: [N] bool, the Gaussians whose spherical harmonics the gradient reaches. It reaches nothing else.
        view: with at least one pixel to repaint: patches lie around those.
        image: [H, W, 3] in [0, 1], a reference. hole: [H, W] bool, the pixels it was made for, at least one.
        adversary: its critic takes a step.
        generator: on the CPU; draws the windows.
    Returns:
        The generator's loss, the rendering, and what to log.
    Raises:
        FloatingPointError: see `Adversary.train_step`.
    """
    choices = adversary.choices
    shaded = replace(gaussians.map(Tensor.detach), sh=confine(gaussians, reached).sh)
    rendering = render(shaded, view.camera)
    real = draw_patches(image, hole, choices.patches, choices.size, generator)
    fake = draw_patches(clamp_to_display(rendering.color), view.repaint, choices.patches, choices.size, generator)
    log = adversary.train_step(real, fake)
    loss = adversary.generator_loss(fake)
    return loss, rendering, {"adversarial": float(loss.detach()), **log}


def draw_patches(image: Tensor, mask: Tensor, count: int, size: int, generator: torch.Generator) -> Tensor:
    """[count, 3, size, size] in [-1, 1]: random patches of an image that contain a masked pixel; differentiable.

    Args:
        image: [H, W, 3] in [0, 1]. mask: [H, W] bool.
    """
    view = enlarge_to_fit(image.permute(2, 0, 1) * 2 - 1, size)
    mask = enlarge_to_fit(mask.to(view)[None], size)[0] > 1e-4
    return gather_patches(view, windows_around(mask.cpu(), size, count, generator), size)

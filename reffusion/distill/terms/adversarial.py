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
    """Build the adversarial term with its critic. Return None if its weight is 0 or no view has a hole.

    In each step the real patches come from one reference and the fake ones from one training view. The gradient reaches
    the spherical harmonics of the masked Gaussians, or with `adversarial.reaches: all` or `confined: false` those of
    all Gaussians.

    Raises:
        ValueError: No reference has a hole.
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
        select_view=next_view,
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
    """Train the critic for one step, then evaluate the adversarial loss of patches of one view.

    PAPER leaves open: how the patches are drawn. A masked pixel is drawn first, as for SDS.
    All fake patches of a step come from one training view, and all real ones from one reference. A view or reference
    that is smaller than a patch is enlarged until a patch fits.

    Args:
        gaussians: All Gaussians of the scene.
        reached: bool [N], True for the Gaussians whose spherical harmonics get a gradient. Nothing else gets one.
        view: A training view with at least one pixel to repaint. The fake patches lie around such pixels.
        image: [H, W, 3] in [0, 1], a reference.
        hole: bool [H, W], True at the pixels that the reference invents, at least one. The real patches lie around
            them.
        adversary: The critic, which takes a step.
        generator: Draws the windows, on the CPU.

    Returns:
        The generator's loss, the rendering, and values for the trace: "adversarial" (this loss) and the values of
            `Adversary.train_step`.

    Raises:
        FloatingPointError: See `Adversary.train_step`.
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
    """Draw random patches of an image that contain a masked pixel, [count, 3, size, size] in [-1, 1]; differentiable.

    Args:
        image: [H, W, 3] in [0, 1].
        mask: bool [H, W], with at least one True pixel.
        count: Number of patches.
        size: Side of a patch in pixels.
        generator: Draws the windows, on the CPU.
    """
    view = enlarge_to_fit(image.permute(2, 0, 1) * 2 - 1, size)
    mask = enlarge_to_fit(mask.to(view)[None], size)[0] > 1e-4
    return gather_patches(view, windows_around(mask.cpu(), size, count, generator), size)

"""The reference term: the reference's own pixels supervise its hole. Not in the paper."""

from __future__ import annotations

from torch import Tensor

from reffusion.distill.terms.term import Term, TermInputs, TermValue, reach_hole
from reffusion.distill.train_view import ReferenceHole
from reffusion.gaussians.optimize import confine, reconstruction_loss
from reffusion.metrics.image_metrics import Box, mask_box
from reffusion.params.distill import Params
from reffusion.splat.rasterizer import render
from reffusion.types import Camera, Gaussians, Rendering


def build(inputs: TermInputs, settings: Params) -> Term | None:
    """Build the reference term, which takes the references in turn. Return None if its weight is 0.

    Its gradient reaches the masked Gaussians, or with `reference.reaches: all` or `confined: false` all that show in
    the hole.

    Raises:
        ValueError: There is no reference.
    """
    if settings.reference.weight == 0:
        return None
    if not inputs.references:
        raise ValueError("distillation with reference.weight > 0 needs a reference")

    def loss(gaussians: Gaussians, reached: Tensor, reference: ReferenceHole, step: int) -> TermValue:
        return TermValue(*evaluate_reference(gaussians, reached, *reference))

    return Term(
        "reference",
        weight=settings.reference.weight,
        select_view=lambda turn: inputs.references[turn % len(inputs.references)],
        reaches=reach_hole(settings, everywhere=settings.reference.reaches == "all"),
        loss=loss,
        uses_one_thread=True,
    )


def evaluate_reference(
    gaussians: Gaussians, reached: Tensor, camera: Camera, image: Tensor, hole: Tensor
) -> tuple[Tensor, Rendering]:
    """Return the reconstruction loss over a reference's hole, and the rendering of the part of the view around it.

    Only the bounding box of the hole is rendered, or the whole view if the hole is empty. The loss is scaled to the
    value that it would have if the whole view were rendered, where the sum over the hole is divided by the number of
    all pixels.

    PAPER leaves open: whether the reference supervises directly. In the paper it only initializes and personalizes.

    Args:
        gaussians: All Gaussians of the scene.
        reached: bool [N], True for the Gaussians that get a gradient.
        camera: The camera of the reference.
        image: [H, W, 3] in [0, 1], the reference.
        hole: bool [H, W], True at the pixels that the reference invents.
    """
    box = mask_box(hole.cpu().numpy(), dilation=0) or Box(0, 0, camera.width, camera.height)
    part = camera.cropped(box.left, box.top, box.right - box.left, box.bottom - box.top)
    rendering = render(confine(gaussians, reached), part)
    loss = reconstruction_loss(rendering.color, box.crop(image), box.crop(hole))
    return loss * (part.width * part.height / hole.numel()), rendering

"""The SDS term: multi-scale score distillation makes views more probable under the adapted prior (section 4.2)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from reffusion import seeding
from reffusion.distill.display_range import clamp_to_display
from reffusion.distill.sds import anneal, draw_timesteps, sds_gradient, sds_loss
from reffusion.distill.terms.term import Term, TermInputs, TermValue, cycle_through, reach_hole
from reffusion.distill.train_view import ReferenceHole, TrainView
from reffusion.gaussians.optimize import confine
from reffusion.geometry import angle_between_views
from reffusion.params.distill import Params, SdsTerm
from reffusion.prior import diffusion
from reffusion.prior.model import Prior
from reffusion.prior.windows import enlarge_to_fit, two_scale_masks, two_scales, window_around
from reffusion.splat.rasterizer import render
from reffusion.types import Camera, Gaussians, Rendering

T_LOW = 0.02  # PAPER leaves open: the lowest timestep of SDS, as a fraction of the schedule. This is threestudio's


def build(inputs: TermInputs, settings: Params) -> Term | None:
    """Build the SDS term. Return None if SDS is off, or if no view has a hole and is near enough to a reference.

    All views with a hole and with known pixels beside it take turns. A view that is too far from every reference is
    left out in its turn. The gradient reaches the masked Gaussians, or with `sds.reaches: all` or `confined: false`
    all that show in the view.

    Raises:
        ValueError: There is no prior, or its prompts are not embedded.
    """
    sds = settings.sds
    if not sds.is_on or not inputs.hole_views:
        return None
    prior, text = inputs.prior, inputs.text
    if prior is None or text is None:
        raise ValueError("distillation with sds.weight > 0 needs a prior and its prompts' embeddings")
    shows_known = lambda view: not two_scale_masks(view.repaint, [], prior.native_size).all()
    views = [view for view in inputs.hole_views if shows_known(view)]
    cameras = [reference.camera for reference in inputs.references]
    near = views_near_references(views, cameras, inputs.masked_means, sds.max_angle)
    if not near:
        return None
    next_view = cycle_through(views, settings.seed, "sds")

    def select_view(turn: int) -> TrainView | None:
        view = next_view(turn)
        return view if view.camera.name in near else None

    def loss(gaussians: Gaussians, reached: Tensor, view: TrainView, step: int) -> TermValue:
        probe = torch.zeros(len(reached), 2, device=reached.device, requires_grad=True)
        draws = seeding.generator(settings.seed, "distill", "sds", step)
        progress = step / settings.iterations
        value, rendering = evaluate_sds(gaussians, reached, view, prior, text, sds, draws, probe, progress=progress)
        return TermValue(value, rendering, probe=probe)

    return Term(
        "SDS",
        weight=sds.weight,
        select_view=select_view,
        reaches=reach_hole(settings, everywhere=sds.reaches == "all"),
        loss=loss,
        uses_one_thread=not inputs.masked_means.is_cuda,
        logs_gradient=True,
    )


def views_near_references(
    views: Sequence[TrainView], references: Sequence[Camera], means: Tensor, max_angle: float
) -> frozenset[str]:
    """Return the names of the views whose direction differs by at most `max_angle` from that of some reference.

    The angle is that between the directions to both cameras, as seen from the median of `means`, the middle of the
    hole.

    Args:
        views: The views to choose from.
        references: The cameras of the references, at least one unless all views are returned.
        means: [M, 3], centers of the masked Gaussians. If M = 0, all views are returned.
        max_angle: Degrees. With 180 all views are returned.
    """
    if max_angle >= 180 or len(means) == 0:
        return frozenset(view.camera.name for view in views)
    middle = means.detach().median(0).values.double().cpu().numpy()
    angles = {view.camera.name: angle_between_views(middle, view.camera, references) for view in views}
    return frozenset(name for name, angle in angles.items() if angle <= max_angle)


def describe_sds_views(
    sds: SdsTerm, means: Tensor, views: Sequence[TrainView], references: Sequence[ReferenceHole]
) -> str:
    """Return a phrase that says how many of the views with a hole are near enough to a reference to be distilled.

    Args:
        sds: Parameters of the SDS term.
        means: [M, 3], centers of the masked Gaussians.
        views: The training views.
        references: The references.
    """
    with_hole = [view for view in views if view.repaint.any()]
    near = views_near_references(with_hole, [each.camera for each in references], means, sds.max_angle)
    degrees = f"{sds.max_angle:g} degrees"
    return f"SDS in {len(near)} of {len(with_hole)} views: those within {degrees} of a reference"


def evaluate_sds(
    gaussians: Gaussians,
    reached: Tensor,
    view: TrainView,
    prior: Prior,
    text: Tensor,
    sds: SdsTerm,
    generator: torch.Generator,
    probe: Tensor | None = None,
    t_low: float = T_LOW,
    progress: float = 0.0,
) -> tuple[Tensor, Rendering]:
    """Return the SDS loss L_global + mean(L_local) of one view, and the rendering.

    Only the gradient of this loss has a meaning, not its value (see `sds_loss`). The whole view and its patches are one
    batch of the UNet.

    PAPER leaves open: what conditions the UNet. Here the condition is the photograph where the photograph may
    supervise, and elsewhere the rendering itself (background that other views see behind the object), with the hole
    masked as in `diffusion.conditioning`. No gradient flows through this condition.

    Args:
        gaussians: All Gaussians of the scene.
        reached: bool [N], True for the Gaussians that get a gradient.
        view: A training view with at least one pixel to repaint, and at least one other pixel.
        prior: The adapted prior.
        text: [3, L, D], the embeddings of the global, the local and the empty prompt.
        sds: Parameters of the SDS term.
        generator: Draws windows, timesteps and noise, on the CPU.
        probe: [N, 2], see `splat.render`. Its gradient is zero for Gaussians that are not reached. None: no probe.
        t_low: Lowest timestep, as a fraction of the schedule.
        progress: The finished share of the run, in [0, 1], on which the highest timestep depends.

    Raises:
        FloatingPointError: The prior's prediction is not finite.
    """
    size = prior.native_size
    probe = None if probe is None else probe * reached[:, None]
    rendering = render(confine(gaussians, reached), view.camera, probe=probe)
    color = clamp_to_display(rendering.color)
    rendered = enlarge_to_fit(color.permute(2, 0, 1) * 2 - 1, size)
    known = torch.where(view.supervises[..., None], view.picture, color.detach())
    known = enlarge_to_fit(known.permute(2, 0, 1) * 2 - 1, size)
    hole = enlarge_to_fit(view.repaint.to(rendered)[None], size)[0] > 1e-4

    windows = [window_around(hole.cpu(), size, generator) for _ in range(sds.patches)]
    masks = two_scale_masks(hole, windows, size)
    reduce = lambda image: two_scales(image, windows, size)
    pictures = reduce(known)
    levels = diffusion.measure_levels(prior, pictures, masks)
    latents = diffusion.encode(prior, levels.normalize(reduce(rendered)))
    condition = diffusion.conditioning(prior, levels.normalize(pictures), masks)
    prompts = torch.cat([text[:1], text[1:2].expand(sds.patches, -1, -1)])
    empty = text[2:].expand(len(latents), -1, -1)

    count = len(latents)
    t_high = anneal(sds.t_high, sds.t_high_last, progress)
    timesteps = draw_timesteps(count, prior.timesteps, t_low, t_high, generator).to(latents.device)
    noise = torch.randn(latents.shape, generator=generator).to(latents)
    gradient = sds_gradient(
        latents,
        lambda noisy, t: diffusion.predict_with_guidance(prior, noisy, t, condition, prompts, empty, sds.guidance),
        timesteps,
        noise,
        prior.alphas_cumprod,
        weighting=sds.weighting,
        keep_contrast=sds.keep_contrast,
        mask=condition[:, :1] if sds.hole_only else None,
    )
    if not torch.isfinite(gradient).all():
        raise FloatingPointError(f"the prior's answer at timesteps {timesteps.tolist()} is not finite")
    # The gain enters the gradient of the latents, and once more their gradient in the rendering.
    return sds_loss(latents, gradient / levels.gain.square(), sds.reduction), rendering

"""The terms of distillation and the Gaussians each may reach (RefFusion section 4.3), and the region they belong to.

term             pixels                                        Gaussians
reconstruction   outside the consistent mask; all if clean     unmasked (or all that show there); all if clean
SDS              whole view and patches, the hole repainted    masked (or all)
depth            the hole (`depth_term`)                       masked, all but spherical harmonics
adversarial      patches around the hole                       masked, spherical harmonics only
reference        the reference's hole (not in the paper)       masked (or all)
lift             the hole, or patches around it (a baseline's) masked
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from reffusion.distill.adversary import Adversary
from reffusion.distill.discriminator import gathered
from reffusion.distill.sds import draw_timesteps, sds_gradient, sds_loss
from reffusion.gaussians.optimize import confine, reconstruction_loss
from reffusion.metrics.image_metrics import Box, mask_box
from reffusion.params.distill import Sds
from reffusion.prior import diffusion
from reffusion.prior.model import Prior
from reffusion.prior.windows import enlarged, two_scale_masks, two_scales, window_around, windows_around
from reffusion.splat.rasterizer import render
from reffusion.types import PARAMETERS, Camera, Gaussians, Rendering

T_LOW = 0.02  # PAPER leaves open: SDS's lowest timestep, as a part of the schedule; threestudio's


@dataclass(frozen=True)
class TrainView:
    """A training view as distillation uses it.

    Attributes:
        camera: the view.
        photo: [H, W, 3] uint8, which of hundreds of views takes a quarter of the room, or float32 in [0, 1].
        supervises: [H, W] bool, the pixels whose photo may be reconstructed: outside C, all of a clean view.
        repaint: [H, W] bool, what is made up, and the UNet repaints; empty where the view is not distilled.
        clean: the object is absent from this view.
        lifted: [H, W, 3] float32 in [0, 1], the view inpainted in 2D; None where it was not.
    """

    camera: Camera
    photo: Tensor
    supervises: Tensor
    repaint: Tensor
    clean: bool
    lifted: Tensor | None = None

    @property
    def picture(self) -> Tensor:
        """The photo, [H, W, 3] float32 in [0, 1]."""
        return self.photo / 255 if self.photo.dtype == torch.uint8 else self.photo


def reconstruction_term(
    gaussians: Gaussians, masked: Tensor, view: TrainView, probe: Tensor | None = None
) -> tuple[Tensor, Rendering]:
    """(1 - 0.2) L1 + 0.2 D-SSIM where the photo may supervise; the gradient reaches unmasked Gaussians only.

    In a clean view it reaches all: what is seen there behind the object is true.
    """
    select = torch.ones_like(masked) if view.clean else ~masked
    rendering = render(confine(gaussians, select), view.camera, probe=probe)
    return reconstruction_loss(rendering.color, view.picture, view.supervises), rendering


def reference_term(
    gaussians: Gaussians, masked: Tensor, camera: Camera, image: Tensor, hole: Tensor
) -> tuple[Tensor, Rendering]:
    """The same loss on the reference's hole; the gradient reaches the Gaussians of `masked` only: the labels, or all
    that show there where `reference.reaches` says so.

    PAPER leaves open: whether the reference supervises directly; it only initialises and personalises there.

    Args:
        image: [H, W, 3] in [0, 1], the reference. hole: [H, W] bool, the pixels it stands for.
    Returns:
        The loss, as of the whole view, and the rendering of the part of it that holds the hole.
    """
    box = mask_box(hole.cpu().numpy(), dilation=0) or Box(0, 0, camera.width, camera.height)
    part = camera.cropped(box.left, box.top, box.right - box.left, box.bottom - box.top)
    rendering = render(confine(gaussians, masked), part)
    loss = reconstruction_loss(rendering.color, box.crop(image), box.crop(hole))
    return loss * (part.width * part.height / hole.numel()), rendering


def sds_term(
    gaussians: Gaussians,
    masked: Tensor,
    view: TrainView,
    prior: Prior,
    text: Tensor,
    sds: Sds,
    generator: torch.Generator,
    probe: Tensor | None = None,
    t_low: float = T_LOW,
) -> tuple[Tensor, Rendering]:
    """L_global + mean(L_local) of one view, all samples in one UNet batch; it reaches the Gaussians of
    `masked` only: the labels, or all that show there where `sds.reaches` says so.

    PAPER leaves open: what conditions the UNet. The photo where it is trusted, elsewhere the render itself (background
    that other views saw through the object), the hole blanked; without gradient.

    Args:
        view: with at least one pixel to repaint.
        text: [3, L, D], the hidden states of the global, the local and the empty prompt.
        generator: on the CPU; windows, timesteps and noise come from it.
        probe: [N, 2], see `splat.render`; its gradient is zero for unmasked Gaussians too.
        t_low: lowest timestep, as a part of the schedule.
    Raises:
        FloatingPointError: the prior's answer is not finite.
    """
    size = prior.native_size
    reached = None if probe is None else probe * masked[:, None]
    rendering = render(confine(gaussians, masked), view.camera, probe=reached)
    color = displayed(rendering.color)
    drawn = enlarged(color.permute(2, 0, 1) * 2 - 1, size)
    shown = torch.where(view.supervises[..., None], view.picture, color.detach())
    shown = enlarged(shown.permute(2, 0, 1) * 2 - 1, size)
    hole = enlarged(view.repaint.to(drawn)[None], size)[0] > 1e-4

    windows = [window_around(hole.cpu(), size, generator) for _ in range(sds.patches)]
    masks = two_scale_masks(hole, windows, size)
    condition = diffusion.conditioning(prior, two_scales(shown, windows, size), masks)
    latents = diffusion.encode(prior, two_scales(drawn, windows, size))
    prompts = torch.cat([text[:1], text[1:2].expand(sds.patches, -1, -1)])
    empty = text[2:].expand(len(latents), -1, -1)

    count = len(latents)
    timesteps = draw_timesteps(count, prior.timesteps, t_low, sds.t_high, generator).to(latents.device)
    noise = torch.randn(latents.shape, generator=generator).to(latents)
    gradient = sds_gradient(
        latents,
        lambda noisy, t: diffusion.guided(prior, noisy, t, condition, prompts, empty, sds.guidance),
        timesteps,
        noise,
        prior.alphas_cumprod,
        weighting=sds.weighting,
        keep_contrast=sds.keep_contrast,
        mask=condition[:, :1] if sds.hole_only else None,
    )
    if not torch.isfinite(gradient).all():
        raise FloatingPointError(f"the prior's answer at timesteps {timesteps.tolist()} is not finite")
    return sds_loss(latents, gradient, sds.reduction), rendering


def displayed(color: Tensor) -> Tensor:
    """Colours of any value as a picture has them, in [0, 1]; a gradient that leads back from outside passes.

    PAPER leaves open: colours above 1, which harmonics can add up to and no prior or critic was ever shown. A plain
    clamp would leave them there for good; to let every gradient pass would drive white on without end.
    """
    return _Displayed.apply(color)


class _Displayed(torch.autograd.Function):
    @staticmethod
    def forward(ctx, color: Tensor) -> Tensor:
        ctx.save_for_backward(color)
        return color.clamp(0, 1)

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor) -> Tensor:
        (color,) = ctx.saved_tensors
        outwards = ((color > 1) & (gradient < 0)) | ((color < 0) & (gradient > 0))
        return torch.where(outwards, 0.0, gradient)


def adversarial_term(
    gaussians: Gaussians,
    masked: Tensor,
    view: TrainView,
    image: Tensor,
    hole: Tensor,
    adversary: Adversary,
    generator: torch.Generator,
) -> tuple[Tensor, Rendering, dict[str, float]]:
    """The critic learns to tell a reference's patches from a view's, then says what it makes of the view's.

    The gradient reaches the spherical harmonics of masked Gaussians only.

    PAPER leaves open: how the patches are drawn. A masked pixel first, as for SDS (`sds.window_around`); all fake ones
    in one training view, another in each step; all real ones in one reference. A view or reference that is smaller
    than a patch is enlarged until one fits.

    Args:
        view: with at least one pixel to repaint: patches lie around those.
        image: [H, W, 3] in [0, 1], a reference. hole: [H, W] bool, what it stands for, at least one pixel.
        adversary: its critic takes a step.
        generator: on the CPU; the windows come from it.
    Returns:
        The generator's loss, the rendering, and what to log.
    Raises:
        FloatingPointError: see `Adversary.learn`.
    """
    choices = adversary.choices
    shaded = replace(gaussians.map(Tensor.detach), sh=confine(gaussians, masked).sh)
    rendering = render(shaded, view.camera)
    real = patches_around(image, hole, choices.patches, choices.size, generator)
    fake = patches_around(displayed(rendering.color), view.repaint, choices.patches, choices.size, generator)
    said = adversary.learn(real, fake)
    loss = adversary.loss(fake)
    return loss, rendering, {"adversarial": float(loss.detach()), **said}


def patches_around(image: Tensor, mask: Tensor, count: int, size: int, generator: torch.Generator) -> Tensor:
    """[count, 3, size, size] in [-1, 1]: patches of [H, W, 3] in [0, 1] that show a masked pixel; differentiable."""
    view = enlarged(image.permute(2, 0, 1) * 2 - 1, size)
    mask = enlarged(mask.to(view)[None], size)[0] > 1e-4
    return gathered(view, windows_around(mask.cpu(), size, count, generator), size)


def gradient_norms(gaussians: Gaussians, masked: Tensor) -> Tensor:
    """[M]: for each masked Gaussian the norm of the gradient gathered so far, over all of its parameters."""
    total = torch.zeros(int(masked.sum()), device=masked.device)
    for name in PARAMETERS:
        gradient = getattr(gaussians, name).grad
        if gradient is not None:
            total += gradient[masked].reshape(len(total), -1).square().sum(1)
    return total.sqrt()


@dataclass(frozen=True)
class Region:
    """The part of space the masked Gaussians belong to, as voxels of a grid around them.

    Attributes:
        origin: [3], the grid's lowest corner. voxel: its pitch.
        home: [X, Y, Z] bool, within reach of a masked Gaussian of the initialization.
        foreign: [X, Y, Z] bool, held by masked Gaussians of the initialization and by no unmasked one.
    """

    origin: Tensor
    voxel: float
    home: Tensor
    foreign: Tensor


def region_of(means: Tensor, masked: Tensor, resolution: int = 32, reach: int = 2) -> Region:
    """The region of an initialization.

    PAPER leaves open: the region whose border Gaussians must not cross. The masked Gaussians of the initialization
    stand on the surfaces to be invented, so they mark it: `resolution` voxels along the diagonal of their box, and
    `reach` voxels around each as the room they may move in.

    Args:
        means: [N, 3]; masked: [N] bool with at least one True.
    """
    inside = means[masked]
    low, high = inside.amin(0), inside.amax(0)
    voxel = max(float((high - low).norm()) / resolution, 1e-6)
    origin = low - (reach + 0.5) * voxel
    shape = [int(n) + 1 for n in ((high - origin) / voxel + reach + 0.5).long()]

    def occupied(points: Tensor) -> Tensor:
        grid = torch.zeros(shape, dtype=torch.bool, device=means.device)
        cells, within = _cells(points, origin, voxel, shape)
        grid[tuple(cells[within].T)] = True
        return grid

    def grown(grid: Tensor, cells: int) -> Tensor:
        return F.max_pool3d(grid.float()[None], 2 * cells + 1, stride=1, padding=cells)[0] > 0

    core, others = occupied(inside), occupied(means[~masked])
    return Region(origin, voxel, grown(core, reach), core & ~grown(others, 1))


def changed_region(region: Region, means: Tensor, masked: Tensor) -> Tensor:
    """[N] bool: masked Gaussians that have left the region, unmasked ones that have entered it; both are pruned."""
    cells, within = _cells(means, region.origin, region.voxel, region.home.shape)
    home, foreign = torch.zeros_like(masked), torch.zeros_like(masked)
    home[within] = region.home[tuple(cells[within].T)]
    foreign[within] = region.foreign[tuple(cells[within].T)]
    return torch.where(masked, ~home, foreign)


def _cells(points: Tensor, origin: Tensor, voxel: float, shape) -> tuple[Tensor, Tensor]:
    """([N, 3] long grid cells, [N] bool inside the grid)."""
    cells = ((points - origin) / voxel).floor().long()
    return cells, ((cells >= 0) & (cells < torch.tensor(list(shape), device=cells.device))).all(1)

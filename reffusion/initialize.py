"""From a completed view to new Gaussians: depth behind the object, then a disk for each pixel of the reference."""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage

from reffusion import depth as completion
from reffusion import geometry, splat
from reffusion.types import Camera, Gaussians, Reference


@torch.no_grad()
def depth_behind(
    remaining: Gaussians,
    reference: Reference,
    hole: np.ndarray,
    *,
    explained: float = 0.5,
    margin: float = 0.01,
    ring: float = 0.08,
    stiffness: float = 100.0,
    edge: float = 0.1,
    most_unknowns: int = 60_000,
    smoothness: float = 128.0,
    sigma_spatial: float = 8.0,
    sigma_luma: float = 8.0,
    sigma_chroma: float = 8.0,
) -> np.ndarray:
    """Depth [H, W] float64 of the scene without the object, completed in `hole` along the reference's picture.

    The completion's misfit on known pixels is then spread by the bilateral solver, so that the new surface meets the
    remaining one at the rim. PAPER leaves open: the depth model; without one the surroundings are continued, and no
    alignment is due.

    Args:
        remaining: the Gaussians left.
        reference: gives the view and the guide.
        hole: bool [H, W], pixels whose depth is made up.
        explained: alpha from which the rendered depth is known.
        margin: known pixels nearer to the hole are left out, fraction of the width: their depth is half the object's.
        ring, stiffness, edge, most_unknowns: see `depth.complete`.
        smoothness, sigma_spatial, sigma_luma, sigma_chroma: see `depth.bilateral_solve`.

    Raises:
        ValueError: naming the view, where too little is known around the hole.
    """
    drawn = splat.render(remaining, reference.camera, sh_degree=0)
    depth, alpha = drawn.depth.double().cpu().numpy(), drawn.alpha.cpu().numpy()
    known = (alpha > explained) & (depth > 0) & ~grown(hole, margin)
    disparity = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)
    try:
        fitted = completion.complete(
            disparity, known, reference.image, ring=ring, stiffness=stiffness, edge=edge,
            most_unknowns=most_unknowns, keep=False,
        )  # fmt: skip
        solved = completion.refine(
            fitted, disparity, known.astype(np.float64), reference.image, smoothness=smoothness,
            sigma_spatial=sigma_spatial, sigma_luma=sigma_luma, sigma_chroma=sigma_chroma,
        )  # fmt: skip
    except ValueError as error:
        raise ValueError(f"reference {reference.camera.name}: {error}") from error
    # Beyond infinity there is nothing: the farthest known surface stands in.
    result = 1.0 / np.maximum(solved, 0.5 * disparity[known].min())
    return np.where(known, depth, result)


def grown(mask: np.ndarray, fraction: float) -> np.ndarray:
    """`mask` and all pixels within `fraction` of the image's width of it."""
    if not mask.any():
        return mask
    return ndimage.distance_transform_edt(~mask) <= fraction * mask.shape[1]


@torch.no_grad()
def share_of(gaussians: Gaussians, labels: torch.Tensor, camera: Camera) -> np.ndarray:
    """[H, W] in [0, 1): blended share of the labelled Gaussians."""
    features = labels[:, None].to(gaussians.means.dtype)
    return splat.render(gaussians, camera, features=features, sh_degree=0).features[..., 0].cpu().numpy()


@torch.no_grad()
def match_colors(
    gaussians: Gaussians, labels: torch.Tensor, image: np.ndarray, pixels: np.ndarray, camera: Camera, steps: int
) -> Gaussians:
    """The labelled Gaussians' constant colours, corrected until the view shows `image` on `pixels`.

    Each step gives a Gaussian the mean residual of the pixels it is blended into, by weight: this undoes the blur that
    the footprints lay over the picture.

    Args:
        image: [H, W, 3] uint8; pixels: bool [H, W]; labels: bool [N]; steps: corrections.
    """
    target = torch.from_numpy(image).float() / 255
    chosen = torch.from_numpy(pixels)[..., None].float()
    for _ in range(steps):
        residual = (target - splat.render(gaussians, camera).color) * chosen
        gathered = splat.accumulate(gaussians, camera, torch.cat([residual, chosen], -1))
        seen = labels & (gathered[:, 3] > 1e-3)
        sh = gaussians.sh.clone()
        sh[seen, 0] += gathered[seen, :3] / gathered[seen, 3:] / geometry.SH_0
        sh[seen, 0] = sh[seen, 0].clamp(-0.5 / geometry.SH_0, 0.5 / geometry.SH_0)
        gaussians = Gaussians(
            gaussians.means, gaussians.quaternions, gaussians.log_scales, gaussians.opacity_logits, sh
        )
    return gaussians

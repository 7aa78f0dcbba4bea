"""The coverage of a view by the training views: which of its pixels show a point that some training view saw.

Only these pixels can be checked against photographs; the content of the other pixels is a guess.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy import ndimage

from reffusion import geometry
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

COVERED = 0.8  # alpha below which a pixel counts as unseen, because the fit has no surface there
SPECKS = 5  # px, side of the median filter that removes single wrong pixels
LONGEST = 256  # px, larger side at which training views are rendered

PROTOCOL = (
    "a pixel is seen where the fit to the photographs covers it (alpha of at least "
    f"{COVERED}) at a point that falls into the frame of a training view, outside its mask, and lies no more than "
    f"{geometry.SAME_IF_COARSE:.0%} of its depth behind what the fit shows there; then a median over {SPECKS} x "
    f"{SPECKS} px. What a fit put into free space counts as seen: that is the fit's fault, not the capture's. "
    "`unseen_share`: of the pixels outside the mask; `psnr_outside_seen`: `psnr_outside` of the seen ones"
)


class CoverageView(NamedTuple):
    """The surfaces that a training view saw, at reduced resolution.

    Attributes:
        camera: the camera at this resolution.
        depth: [H, W], camera z of the rendered surface; 0 where nothing is rendered.
        hidden: bool [H, W], True at pixels that show the object to be removed.
    """

    camera: Camera
    depth: np.ndarray
    hidden: np.ndarray


def render_coverage_views(
    gaussians: Gaussians, cameras: Sequence[Camera], masks: Mapping[str, np.ndarray]
) -> list[CoverageView]:
    """Return depth and object mask of each training view, reduced to at most `LONGEST` px in width and height.

    Args:
        gaussians: the fitted Gaussians with the object, because the object hides the surfaces behind it.
        cameras: the training views.
        masks: view name -> bool [H, W] at full size, True at pixels that show the object. A view without an entry does
            not show the object.
    """
    views = []
    for camera in cameras:
        small = camera.shrunk(LONGEST)
        hidden = np.zeros((small.height, small.width), bool)
        if camera.name in masks:
            centers = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in (small.width, small.height))), -1)
            scale = np.array([camera.width / small.width, camera.height / small.height])
            hidden, _ = geometry.sample_nearest(masks[camera.name], centers * scale)
        views.append(CoverageView(small, _render_depth(gaussians, small)[0], hidden))
    return views


def unseen_pixels(gaussians: Gaussians, camera: Camera, seen_by: Sequence[CoverageView]) -> np.ndarray:
    """Return bool [H, W], the pixels of a view that show no point that any training view saw.

    `PROTOCOL` defines which points a training view saw. Pixels without a surface are unseen, too.

    Args:
        gaussians: the Gaussians from which the training views were rendered.
        camera: the view, not necessarily a training view.
        seen_by: the training views.
    """
    depth, alpha = _render_depth(gaussians, camera)
    pixels = np.flatnonzero(depth > 0)
    points = geometry.unproject(np.where(depth > 0, depth, 1.0), camera).reshape(-1, 3)[pixels]
    missed = np.ones(depth.shape, bool)
    # The nearest view comes first, because it saw most of the points. Each view tests only the points still unseen.
    for view in sorted(seen_by, key=lambda v: float(np.linalg.norm(v.camera.center - camera.center))):
        if not len(pixels):
            break
        uv, z = geometry.project(points, view.camera)
        surface, framed = geometry.sample_nearest(view.depth, uv)
        hidden, _ = geometry.sample_nearest(view.hidden, uv)
        is_seen = framed & ~hidden & (z < (1 + geometry.SAME_IF_COARSE) * surface)
        missed.flat[pixels[is_seen]] = False
        pixels, points = pixels[~is_seen], points[~is_seen]
    return ndimage.median_filter(missed | (alpha < COVERED), SPECKS)


@torch.no_grad()
def _render_depth(gaussians: Gaussians, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Render a view, and return its depth (camera z, 0 where nothing is rendered) and alpha, both [H, W]."""
    rendered = rasterizer.render(gaussians, camera, sh_degree=0)
    return rendered.depth.double().cpu().numpy(), rendered.alpha.cpu().numpy()

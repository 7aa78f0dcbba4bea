"""Which pixels of a view show what some training view saw: those can be held to account, the others are guesses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy import ndimage

from reffusion import geometry
from reffusion.background.backdrop import reduced
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

TOLERANCE = 0.1  # relative depth by which a point may lie behind what a training view shows, and still be seen there
COVERED = 0.8  # alpha under which a fit shows nothing that it learnt anywhere
SPECKS = 5  # px a side of the median filter that removes what single pixels claim
LONGEST = 256  # px a side at which training views are looked at

PROTOCOL = (
    "a pixel is seen where the fit to the photographs covers it (alpha of at least "
    f"{COVERED}) at a point that falls into the frame of a training view, outside its mask, and lies no more than "
    f"{TOLERANCE:.0%} of its depth behind what the fit shows there; then a median over {SPECKS} x {SPECKS} px. What a "
    "fit put into free space counts as seen: that is the fit's fault, not the capture's. `unseen_share`: of the pixels "
    "outside the mask; `psnr_outside_seen`: `psnr_outside` of the seen ones"
)


class SeenView(NamedTuple):
    """A training view, small.

    Attributes:
        camera: of the size of the other two.
        depth: [H, W] camera z of what it shows, 0 where nothing is.
        hidden: bool [H, W], where it shows the object that is to go.
    """

    camera: Camera
    depth: np.ndarray
    hidden: np.ndarray


def seen_views(gaussians: Gaussians, cameras: Sequence[Camera], masks: Mapping[str, np.ndarray]) -> list[SeenView]:
    """The training views as a fit shows them.

    Args:
        gaussians: the fit, object included, for that is what stood before the rest.
        masks: view name -> bool [H, W], the object; none where a view has no entry.
    """
    found = []
    for camera in cameras:
        small = reduced(camera, LONGEST)
        hidden = np.zeros((small.height, small.width), bool)
        if camera.name in masks:
            centers = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in (small.width, small.height))), -1)
            scale = np.array([camera.width / small.width, camera.height / small.height])
            hidden, _ = geometry.sample_nearest(masks[camera.name], centers * scale)
        found.append(SeenView(small, _depth(gaussians, small)[0], hidden))
    return found


def unseen(gaussians: Gaussians, camera: Camera, seen_by: Sequence[SeenView]) -> np.ndarray:
    """bool [H, W]: the pixels of a view at which it shows what none of the training views saw; see `PROTOCOL`.

    Args:
        gaussians: the fit that the training views were drawn of.
    """
    depth, alpha = _depth(gaussians, camera)
    places = np.flatnonzero(depth > 0)
    points = geometry.unproject(np.where(depth > 0, depth, 1.0), camera).reshape(-1, 3)[places]
    missed = np.ones(depth.shape, bool)
    # From the nearest on: it has seen most, and only the rest is looked for in the others.
    for view in sorted(seen_by, key=lambda v: float(np.linalg.norm(v.camera.center - camera.center))):
        if not len(places):
            break
        uv, z = geometry.project(points, view.camera)
        surface, framed = geometry.sample_nearest(view.depth, uv)
        hidden, _ = geometry.sample_nearest(view.hidden, uv)
        found = framed & ~hidden & (z < (1 + TOLERANCE) * surface)
        missed.flat[places[found]] = False
        places, points = places[~found], points[~found]
    return ndimage.median_filter(missed | (alpha < COVERED), SPECKS)


@torch.no_grad()
def _depth(gaussians: Gaussians, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Camera z, 0 where nothing is, and alpha, [H, W] both."""
    drawn = rasterizer.render(gaussians, camera, sh_degree=0)
    return drawn.depth.double().cpu().numpy(), drawn.alpha.cpu().numpy()

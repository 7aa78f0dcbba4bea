"""Initial Gaussians for a fit to few photographs: on surfaces found by multi-view stereo from the sparse points.

PAPER leaves open: how few views are reconstructed. A fit from points alone explains one or two photographs by floaters
in front of the cameras, which then fill other views.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy import ndimage

from reffusion.depth.multiview_depth import estimate_multiview_depth
from reffusion.depth.sparse_to_dense import NORMAL_NEIGHBORS, SparsePoints
from reffusion.gaussians.sheets import Sheets, sheet_gaussians
from reffusion.params.fit import Params
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

MAX_VIEWS = 8  # training views up to which surfaces beat points; with 25 photographs of a table they were torn
STEPS_SHARE = 0.2  # of the steps of a normal fit: the surfaces exist already, and more steps only bend them
MIN_ALPHA, OCCLUSION_RATIO = 0.7, 1.05  # a pixel with this alpha, up to this relative depth, is covered already
NEIGHBORHOOD_PX = 3  # px, side of the square in which nearer surfaces are searched


@torch.no_grad()
def gaussians_on_surfaces(
    cameras: Sequence[Camera],
    images: Mapping[str, np.ndarray],
    points: np.ndarray,
    colors: np.ndarray,
    hidden: Mapping[str, np.ndarray],
    params: Params,
) -> Gaussians | None:
    """Gaussians on the surfaces seen by the training views; None if there are too few sparse points.

    The first pass adds the pixels that other views confirm, each view only where the ones before it leave gaps. The
    second pass adds the pixels that are neither confirmed nor refuted, in the same way.

    Args:
        cameras: the training views.
        images: view name -> uint8 [H, W, 3].
        points: [P, 3] sparse points.
        colors: [P, 3] uint8.
        hidden: view name -> bool [H, W], pixels to be ignored.
        params: sets the degree of spherical harmonics, the device and antialiasing.
    """
    if len(points) <= NORMAL_NEIGHBORS:
        return None
    view_depths = estimate_multiview_depth(SparsePoints.of(points, colors), cameras, images, hidden, params.seed)
    result = None
    usable_cameras = [camera for camera in cameras if camera.name in view_depths]
    passes = [(camera, view_depths[camera.name].confirmed) for camera in usable_cameras]
    passes += [
        (camera, ~view_depths[camera.name].confirmed & ~view_depths[camera.name].refuted) for camera in usable_cameras
    ]
    for camera, pixels in passes:
        depth = view_depths[camera.name].depth
        missing = pixels & ~is_beside_nearer(depth) & np.logical_not(hidden.get(camera.name, False))
        if result is not None:
            rendering = rasterizer.render(result, camera, sh_degree=0)
            rendered_depth, is_covered = rendering.depth.cpu().numpy(), rendering.alpha.cpu().numpy() >= MIN_ALPHA
            missing &= ~(is_covered & (rendered_depth < OCCLUSION_RATIO * depth))
        added = sheet_gaussians(images[camera.name], depth, missing, camera, (params.sh.degree + 1) ** 2, Sheets())
        added = replace(added.map(lambda p: p.to(params.device)), antialiased=params.antialiased)
        result = added if result is None else result.zip_map(added, lambda a, b: torch.cat([a, b]))
    return result


def is_beside_nearer(depth: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels of a depth map next to a nearer surface, whose colour bleeds into them."""
    return depth > OCCLUSION_RATIO * ndimage.minimum_filter(depth, NEIGHBORHOOD_PX)


def shorten_schedule(params: Params) -> Params:
    """The parameters of a fit from surfaces: fewer steps, and no densification."""
    steps = max(1, round(STEPS_SHARE * params.iterations))
    return params.changed({"iterations": steps, "densify.stop": 0.0, "densify.start": 0.0, "densify.reset_every": 0.0})

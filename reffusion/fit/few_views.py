"""Initial Gaussians for a fit to few photographs: on surfaces found by multi-view stereo from the sparse points.

PAPER leaves open: how a scene with few views is reconstructed. A fit that starts from sparse points alone explains one
or two photographs by floaters in front of the cameras. These floaters then fill other views.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from reffusion.depth.multiview_depth import estimate_multiview_depth
from reffusion.depth.sparse_to_dense import NORMAL_NEIGHBORS, SparsePoints
from reffusion.gaussians.sheets import sheet_gaussians
from reffusion.gaussians.surfels import is_beside_nearer
from reffusion.params.fit import Params
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

# Number of training views up to which a start on surfaces gives a better fit than a start from points. With 25
# photographs of a table the surfaces were not connected.
MAX_VIEWS = 8
STEPS_SHARE = 0.2  # of the steps of a normal fit: the surfaces exist already, and more steps only bend them
# A pixel counts as covered if the Gaussians so far have at least this alpha there, and a depth less than this multiple
# of the pixel's own.
MIN_ALPHA, OCCLUSION_RATIO = 0.7, 1.05


@torch.no_grad()
def gaussians_on_surfaces(
    cameras: Sequence[Camera],
    images: Mapping[str, np.ndarray],
    points: np.ndarray,
    colors: np.ndarray,
    hidden: Mapping[str, np.ndarray],
    params: Params,
) -> Gaussians | None:
    """Place Gaussians on the surfaces that the training views show, as found by multi-view stereo.

    The first pass over the views adds Gaussians for the pixels whose depth another view confirms, in each view only
    where the Gaussians of earlier views leave gaps. The second pass adds, in the same way, the pixels whose depth is
    neither confirmed nor refuted (refuted: a confirmed pixel of another view sees past the surface). Pixels beside a
    nearer surface are left out, because the color of the nearer surface bleeds into them.

    Args:
        cameras: the training views.
        images: view name -> uint8 [H, W, 3], with equal exposure.
        points: [P, 3] sparse points.
        colors: [P, 3] uint8, their colors.
        hidden: view name -> bool [H, W], True for pixels to be ignored; a view without an entry has none.
        params: sets the seed, the degree of spherical harmonics, the device and antialiasing.

    Returns:
        Gaussians in two sheets (see `gaussians.sheets`), or None if there are too few sparse points in the scene or in
        every view.
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
        missing = pixels & ~is_beside_nearer(depth, OCCLUSION_RATIO) & np.logical_not(hidden.get(camera.name, False))
        if result is not None:
            rendering = rasterizer.render(result, camera, sh_degree=0)
            rendered_depth, is_covered = rendering.depth.cpu().numpy(), rendering.alpha.cpu().numpy() >= MIN_ALPHA
            missing &= ~(is_covered & (rendered_depth < OCCLUSION_RATIO * depth))
        added = sheet_gaussians(images[camera.name], depth, missing, camera, (params.sh.degree + 1) ** 2)
        added = replace(added.map(lambda p: p.to(params.device)), antialiased=params.antialiased)
        result = added if result is None else result.zip_map(added, lambda a, b: torch.cat([a, b]))
    return result


def shorten_schedule(params: Params) -> Params:
    """Return the parameters of a fit that starts on surfaces: `STEPS_SHARE` of the steps, no density control."""
    steps = max(1, round(STEPS_SHARE * params.iterations))
    return params.changed({"iterations": steps, "densify.stop": 0.0, "densify.start": 0.0, "densify.reset_every": 0.0})

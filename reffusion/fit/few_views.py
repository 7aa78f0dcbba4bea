"""The Gaussians a fit to few photographs starts from: what they show, on the surfaces between the sparse points.

PAPER leaves open: how few views are reconstructed. A fit from points alone explains a photograph or two by blobs before
the cameras; pictures of other views are made of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy import ndimage

from reffusion.depth.multiview_depth import agreed
from reffusion.depth.sparse_to_dense import NORMAL_FROM, SparsePoints
from reffusion.gaussians.sheets import Sheets, surface
from reffusion.params.fit import Params
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

MOST = 8  # training views, up to which they are ahead of points; of 25 photographs of a table they made shreds
STEPS = 0.2  # of a fit's: the surfaces are there, and more steps only bend them
COVERED, BEFORE = 0.7, 1.05  # alpha from which, and relative depth up to which, a pixel shows what is there already
STAINED = 3  # px, side of the square that is looked at for something nearer


@torch.no_grad()
def surfaces(
    cameras: Sequence[Camera],
    images: Mapping[str, np.ndarray],
    points: np.ndarray,
    colors: np.ndarray,
    hidden: Mapping[str, np.ndarray],
    params: Params,
) -> Gaussians | None:
    """What photographs agree on: all that the first view shows of it, and of each further one what those before it do
    not; then the rest likewise. None where the scene has too few sparse points for that.

    Args:
        cameras: the training views. images: view name -> uint8 [H, W, 3].
        points: [P, 3] sparse points; colors: [P, 3] uint8.
        hidden: view name -> bool [H, W], pixels that are not looked at.
        params: gives degree, device and way of being drawn.
    """
    if len(points) <= NORMAL_FROM:
        return None
    told, found = agreed(SparsePoints.of(points, colors), cameras, images, hidden, params.seed), None
    looked = [camera for camera in cameras if camera.name in told]
    passes = [(camera, told[camera.name].sure) for camera in looked]
    passes += [(camera, ~told[camera.name].sure & ~told[camera.name].wrong) for camera in looked]
    for camera, pixels in passes:
        depth = told[camera.name].depth
        wanted = pixels & ~beside_nearer(depth) & np.logical_not(hidden.get(camera.name, False))
        if found is not None:
            drawn = rasterizer.render(found, camera, sh_degree=0)
            there, thick = drawn.depth.cpu().numpy(), drawn.alpha.cpu().numpy() >= COVERED
            wanted &= ~(thick & (there < BEFORE * depth))
        added = surface(images[camera.name], depth, wanted, camera, (params.sh.degree + 1) ** 2, Sheets())
        added = replace(added.map(lambda p: p.to(params.device)), antialiased=params.antialiased)
        found = added if found is None else found.zipped(added, lambda a, b: torch.cat([a, b]))
    return found


def beside_nearer(depth: np.ndarray) -> np.ndarray:
    """bool [H, W], pixels of a depth map next to something nearer, by whose colour they are stained."""
    return depth > BEFORE * ndimage.minimum_filter(depth, STAINED)


def gently(params: Params) -> Params:
    """The parameters of a fit from surfaces: fewer steps, nothing added."""
    steps = max(1, round(STEPS * params.iterations))
    return params.changed({"iterations": steps, "densify.stop": 0.0, "densify.start": 0.0, "densify.reset_every": 0.0})

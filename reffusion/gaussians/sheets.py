"""A textured surface as Gaussians: two sheets of disks, with one disk per pixel in each.

Opaque neighboring Gaussians cannot show a sharp picture from all sides. On a slanted surface each Gaussian occludes the
near side of the next one behind it. So the texture appears shifted away from the camera by a third of the Gaussians'
spacing, and between opposite views by twice this distance. Fainter Gaussians reduce the shift; the more opaque second
sheet behind them keeps the surface closed. See docs/method.md#initialization.

PAPER leaves open: scale and opacity of the initial Gaussians.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import torch

from reffusion.gaussians.surfels import surface_gaussians
from reffusion.types import Camera, Gaussians

SPREAD, OPACITY = 0.3, 0.4  # of the first sheet: standard deviation in pixels of the view, opacity
OFFSET_PX = 1.0  # px: distance of the second sheet behind the first one
# Of the second sheet. Its Gaussians are wider so that they leave no gaps, which a nearer view would show as a grid. The
# colors of the first sheet compensate for the blur.
UNDER_SPREAD, UNDER_OPACITY = 0.6, 0.8


def sheet_gaussians(
    image: np.ndarray, depth: np.ndarray, pixels: np.ndarray, camera: Camera, sh_count: int
) -> Gaussians:
    """Return the Gaussians of both sheets for the chosen pixels: first the front sheet, then the sheet behind it.

    Args:
        image, depth, pixels, camera, sh_count: as for `surface_gaussians`.
    """
    sheet = partial(surface_gaussians, image, depth, pixels, camera, sh_count=sh_count)
    front = sheet(spread=SPREAD, opacity=OPACITY)
    back = sheet(spread=UNDER_SPREAD, opacity=UNDER_OPACITY, offset_px=OFFSET_PX)
    return front.zip_map(back, lambda a, b: torch.cat([a, b]))

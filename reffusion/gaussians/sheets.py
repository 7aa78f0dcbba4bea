"""A textured surface as Gaussians: two sheets of disks, with one disk per pixel in each."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from reffusion.gaussians.surfels import surface_gaussians
from reffusion.types import Camera, Gaussians


@dataclass(frozen=True)
class Sheets:
    """Settings of the Gaussians on a surface: a first sheet of faint ones, and a more opaque second sheet behind it.

    Opaque neighboring Gaussians cannot show a sharp picture from all sides. On a slanted surface each Gaussian
    occludes the near side of the next one behind it. So the texture appears shifted away from the camera by a third of
    the Gaussians' spacing, and between opposite views by twice this distance. Fainter Gaussians reduce the shift; the
    second sheet keeps the surface closed. See docs/method.md#initialization.

    PAPER leaves open: scale and opacity of the initial Gaussians.

    Attributes:
        spread: standard deviation of the first sheet's Gaussians, in pixels of the view whose pixels they show.
        thickness: standard deviation along the normal, divided by the smaller of the two within the surface.
        grazing: cosine of the angle between normal and viewing direction below which Gaussians are not stretched
            further.
        opacity: opacity of the first sheet's Gaussians, in (0, 1).
        offset_px: distance of the second sheet behind the first one, in pixels; 0: there is no second sheet.
        under_spread, under_opacity: `spread` and `opacity` of the second sheet. Its Gaussians are wider so that they
            leave no gaps, which a nearer view would show as a grid. The colors of the first sheet compensate for the
            blur.
        color_steps: number of corrections of the colors, see `reffusion.initialize.unprojection.match_colors`.
        view_dependent: True makes the colors change with the viewing direction, as the colors of the surface around
            the hole do, see `reffusion.initialize.view_dependent_color`.
    """

    spread: float = 0.3
    thickness: float = 0.1
    grazing: float = 0.15
    opacity: float = 0.4
    offset_px: float = 1.0
    under_spread: float = 0.6
    under_opacity: float = 0.8
    color_steps: int = 5
    view_dependent: bool = False


def sheet_gaussians(
    image: np.ndarray, depth: np.ndarray, pixels: np.ndarray, camera: Camera, sh_count: int, settings: Sheets
) -> Gaussians:
    """Return the Gaussians of both sheets for the chosen pixels: first the front sheet, then the sheet behind it.

    With `offset_px` = 0 there is only the front sheet. `color_steps` and `view_dependent` of the settings are not used
    here.

    Args:
        image, depth, pixels, camera, sh_count: as for `surface_gaussians`.
    """
    shape = partial(surface_gaussians, sh_count=sh_count, thickness=settings.thickness, grazing=settings.grazing)
    sheet = partial(shape, image, depth, pixels, camera)
    front = sheet(spread=settings.spread, opacity=settings.opacity)
    if not settings.offset_px:
        return front
    back = sheet(spread=settings.under_spread, opacity=settings.under_opacity, offset_px=settings.offset_px)
    return front.zip_map(back, lambda a, b: torch.cat([a, b]))

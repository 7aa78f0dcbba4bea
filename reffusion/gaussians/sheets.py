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
    """Settings of the Gaussians on a surface: a sheet of faint ones, and a second, more opaque sheet behind it.

    Opaque neighbouring Gaussians cannot show a sharp picture from all sides: each occludes part of the next one, so
    that only its far side is visible. The texture appears shifted away from the camera by a third of their spacing, and
    by twice that between opposite views. Fainter Gaussians reduce the shift; the second sheet keeps the surface closed.
    Figures are in docs/method.md#initialization.

    PAPER leaves open: scale and opacity of the initial Gaussians.

    Attributes:
        spread: standard deviation of the first sheet's Gaussians, in pixels of the reference.
        thickness: standard deviation along the normal, relative to that within the surface.
        grazing: cosine of the viewing angle below which Gaussians are not stretched further.
        opacity: of the first sheet.
        offset_px: distance of the second sheet behind the first, in pixels (0: no second sheet).
        under_spread, under_opacity: of the second sheet. Its Gaussians are wider so that they leave no gaps, which a
            nearer view would show as a grid; the colours of the first sheet compensate for the blur.
        color_steps: corrections of the colours, see `reffusion.initialize.unprojection.match_colors`.
        view_dependent: make colours depend on the direction as those around them do, see
            `reffusion.initialize.view_dependent_color`.
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
    """Gaussians of both sheets for the chosen `pixels`; arguments as `surface_gaussians`."""
    shape = partial(surface_gaussians, sh_count=sh_count, thickness=settings.thickness, grazing=settings.grazing)
    sheet = partial(shape, image, depth, pixels, camera)
    front = sheet(spread=settings.spread, opacity=settings.opacity)
    if not settings.offset_px:
        return front
    back = sheet(spread=settings.under_spread, opacity=settings.under_opacity, offset_px=settings.offset_px)
    return front.zip_map(back, lambda a, b: torch.cat([a, b]))

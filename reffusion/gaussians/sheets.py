"""A surface that shows one picture, as Gaussians: two sheets of disks, one for each pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from reffusion.gaussians.surfels import surface_gaussians
from reffusion.types import Camera, Gaussians


@dataclass(frozen=True)
class Sheets:
    """How Gaussians lie on a surface: a sheet of thin ones, and a second, opaque one behind it.

    Opaque Gaussians next to each other cannot show a sharp picture from all sides: the nearer one hides part of the
    next, so that each is seen on its far side only. What is painted on them seems to slide away from the camera by a
    third of their distance, and so twice that between opposite views. The fainter they are, the less; the second sheet
    keeps the surface closed. docs/initialization.md has figures.

    PAPER leaves open: scale and opacity of the initial Gaussians.

    Attributes:
        spread: standard deviation of new Gaussians, pixels of the reference.
        thickness: their deviation along the normal over that within the surface.
        grazing: least cosine to the view at which they are stretched.
        opacity: of the first sheet.
        sunk: how far behind it the second lies, in pixels (0: there is none).
        under_spread, under_opacity: the second's. Wider Gaussians than the first's leave no gaps between them, which a
            nearer view would show as a grid; what that blurs the colours of the first make up for.
        color_steps: corrections of the colours, see `filling.match_colors`.
        gloss: whether they change with the direction as what is around them does, see
            `reffusion.initialize.view_dependent_color`.
    """

    spread: float = 0.3
    thickness: float = 0.1
    grazing: float = 0.15
    opacity: float = 0.4
    sunk: float = 1.0
    under_spread: float = 0.6
    under_opacity: float = 0.8
    color_steps: int = 5
    gloss: bool = False


def surface(
    image: np.ndarray, depth: np.ndarray, pixels: np.ndarray, camera: Camera, sh_count: int, how: Sheets
) -> Gaussians:
    """Both sheets, see `surface_gaussians`."""
    shown = (image, depth, pixels, camera)
    shape = {"sh_count": sh_count, "thickness": how.thickness, "grazing": how.grazing}
    sheet = surface_gaussians(*shown, **shape, spread=how.spread, opacity=how.opacity)
    if not how.sunk:
        return sheet
    under = surface_gaussians(*shown, **shape, spread=how.under_spread, opacity=how.under_opacity, sunk=how.sunk)
    return sheet.zipped(under, lambda a, b: torch.cat([a, b]))

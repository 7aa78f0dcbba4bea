"""Renders of a view by the Gaussians of several stages, with the view's exposure, and inpainted in 2D where asked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from reffusion.background.visibility import OPAQUE
from reffusion.fit import exposure
from reffusion.inpaint.classical import Painter
from reffusion.io.images import to_uint8
from reffusion.metrics import consistency, rows
from reffusion.metrics.consistency import RenderedView
from reffusion.morphology import dilate
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians


class ViewRenders(NamedTuple):
    """One view.

    Attributes:
        by_stage: stage -> uint8 [H, W, 3], the render of its Gaussians.
        result: the view as the result shows it, inpainted in 2D where asked.
    """

    by_stage: dict[str, np.ndarray]
    result: RenderedView


@dataclass(frozen=True)
class ViewRenderer:
    """Renders views.

    Attributes:
        gaussians: stage -> Gaussians; "fit" is among them.
        result: the stage whose Gaussians are the result.
        painter: inpaints the renders of the result inside the mask; None: nothing does.
        exposures: view -> [3, 4], see `fit.exposure`; empty where none were fitted.
    """

    gaussians: dict[str, Gaussians]
    result: str
    painter: Painter | None
    exposures: dict[str, np.ndarray]

    @torch.no_grad()
    def render(self, camera: Camera, mask: np.ndarray, photo: np.ndarray | None) -> ViewRenders:
        """The renders of a view.

        Args:
            mask: bool [H, W], the object.
            photo: uint8 [H, W, 3], which sets the exposure; None: the exposure of the neighbouring photographs.

        Raises:
            ValueError: a render holds values that are not finite.
        """
        matrix = self._view_exposure(camera, mask, photo)
        renders = {stage: _render(each, camera, matrix) for stage, each in self.gaussians.items()}
        picture, depth = renders[self.result]
        if self.painter:
            picture, depth = self.painter.paint(picture, mask), consistency.continue_surrounding_depth(depth, mask)
        by_stage = {stage: color for stage, (color, _) in renders.items()}
        return ViewRenders(by_stage, RenderedView(camera, picture, depth, mask, matrix))

    def _view_exposure(self, camera: Camera, mask: np.ndarray, photo: np.ndarray | None) -> np.ndarray | None:
        """[3, 4], see `exposure.PROTOCOL`; None where all photographs are exposed alike."""
        matrix = self.exposures.get(camera.name)
        if matrix is None or photo is None:
            return matrix
        rendered = rasterizer.render(self.gaussians["fit"], camera)
        color = exposure.apply_exposure(rendered.color, matrix).cpu().numpy()
        outside = ~dilate(mask, rows.OUTSIDE_MARGIN)
        return exposure.match_exposure(matrix, color, photo, outside & (rendered.alpha.cpu().numpy() > OPAQUE))


def _render(gaussians: Gaussians, camera: Camera, matrix: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """uint8 [H, W, 3] and camera z [H, W] float64, 0 where alpha is too low for a depth.

    Scores are of 8-bit pictures, which anyone can open.
    """
    rendered = rasterizer.render(gaussians, camera)
    color = exposure.apply_exposure(rendered.color, matrix).clamp(0, 1).cpu().numpy()
    if not np.isfinite(color).all():
        raise ValueError(f"view {camera.name}: its render holds values that are not finite")
    depth, alpha = rendered.depth.double().cpu().numpy(), rendered.alpha.cpu().numpy()
    return to_uint8(color), np.where(alpha > consistency.SOLID, depth, 0.0)

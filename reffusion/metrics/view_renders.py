"""Rendering of a view from the Gaussians of several stages, with the view's exposure and optional 2D inpainting."""

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
    """The renderings of one view.

    Attributes:
        by_stage: name of a stage -> uint8 [H, W, 3], the rendering of the stage's Gaussians, never inpainted.
        result: the rendering of the resulting scene, inpainted in 2D inside the mask if the renderer has a painter.
    """

    by_stage: dict[str, np.ndarray]
    result: RenderedView


@dataclass(frozen=True)
class ViewRenderer:
    """Renderer of views from the Gaussians of several stages.

    Attributes:
        gaussians: name of a stage -> Gaussians; it contains "fit".
        result: name of the stage whose Gaussians are the resulting scene.
        painter: 2D inpainter that fills the mask in the renderings of the resulting scene; None for no 2D inpainting.
        exposures: view -> affine color map [3, 4] (see `fit.exposure`); empty if no exposures were fitted.
    """

    gaussians: dict[str, Gaussians]
    result: str
    painter: Painter | None
    exposures: dict[str, np.ndarray]

    @torch.no_grad()
    def render(self, camera: Camera, mask: np.ndarray, photo: np.ndarray | None) -> ViewRenders:
        """Render a view from the Gaussians of all stages.

        Args:
            mask: bool [H, W], the object.
            photo: uint8 [H, W, 3], the view's photograph. The view's entry in `exposures` is adjusted so that the
                rendering of "fit" is as bright as the photograph outside the mask. None to use the entry as it is (for
                a test view it is interpolated from nearby photographs). A view without an entry is rendered without
                exposure, also with a photograph.

        Raises:
            ValueError: a rendering has values that are not finite.
        """
        matrix = self._view_exposure(camera, mask, photo)
        renders = {stage: _render(each, camera, matrix) for stage, each in self.gaussians.items()}
        picture, depth = renders[self.result]
        if self.painter:
            picture, depth = self.painter.paint(picture, mask), consistency.continue_surrounding_depth(depth, mask)
        by_stage = {stage: color for stage, (color, _) in renders.items()}
        return ViewRenders(by_stage, RenderedView(camera, picture, depth, mask, matrix))

    def _view_exposure(self, camera: Camera, mask: np.ndarray, photo: np.ndarray | None) -> np.ndarray | None:
        """Return the view's affine color map [3, 4], adjusted to a given photograph; None without an entry."""
        # None without an entry in `exposures`; see `exposure.PROTOCOL`.
        matrix = self.exposures.get(camera.name)
        if matrix is None or photo is None:
            return matrix
        rendered = rasterizer.render(self.gaussians["fit"], camera)
        color = exposure.apply_exposure(rendered.color, matrix).cpu().numpy()
        outside = ~dilate(mask, rows.OUTSIDE_MARGIN)
        return exposure.match_exposure(matrix, color, photo, outside & (rendered.alpha.cpu().numpy() > OPAQUE))


def _render(gaussians: Gaussians, camera: Camera, matrix: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Render a view, uint8 [H, W, 3], and its camera z, float64 [H, W]; raises ValueError if a color is not finite."""
    rendered = rasterizer.render(gaussians, camera)
    # `matrix` [3, 4] is the exposure to apply, or None.
    color = exposure.apply_exposure(rendered.color, matrix).clamp(0, 1).cpu().numpy()
    if not np.isfinite(color).all():
        raise ValueError(f"view {camera.name}: its render holds values that are not finite")
    depth, alpha = rendered.depth.double().cpu().numpy(), rendered.alpha.cpu().numpy()
    # The scores are computed from the 8-bit picture, so that they can be recomputed from the saved files. The depth is
    # 0 where alpha is too low for one.
    return to_uint8(color), np.where(alpha > consistency.SOLID, depth, 0.0)

"""Multi-view consistency: whether a rendered view shows the same colours of a surface as the next view."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates

from reffusion import geometry
from reffusion.depth.completion import complete
from reffusion.fit.exposure import undo_exposure
from reffusion.types import Camera

TOLERANCE = 0.02  # relative depth by which a point may lie behind the other view's surface and still be visible
SOLID = 0.5  # alpha above which a rendered depth is used

PROTOCOL = (
    "each rendered view and the next by name (the last has none): the mask's pixels, unprojected by rendered depth "
    f"(alpha over {SOLID}), are looked up in the next view bilinearly; compared are those that fall into its frame and "
    f"lie no more than {TOLERANCE:.0%} behind its rendered depth; mean absolute difference of the 8-bit pictures over "
    "pixels and channels, in [0, 1], 0 is consistent; `consistency_share`: compared pixels over the mask's; means over "
    "the pairs. Blur and holes are consistent too: read it beside the other scores"
)


class RenderedView(NamedTuple):
    """A rendered view.

    Attributes:
        camera: the view.
        picture: uint8 [H, W, 3].
        depth: [H, W] camera z; 0 where alpha is too low for a depth.
        mask: bool [H, W], the pixels to compare.
        exposure: [3, 4], the exposure of the picture, see `fit.exposure`; None: that of the Gaussians.
    """

    camera: Camera
    picture: np.ndarray
    depth: np.ndarray
    mask: np.ndarray
    exposure: np.ndarray | None = None

    @property
    def unexposed_color(self) -> np.ndarray:
        """[H, W, 3] in [0, 1] with the exposure removed, so that views of different exposures can be compared."""
        return undo_exposure(self.picture / 255.0, self.exposure)


def reprojected_color_difference(first: RenderedView, second: RenderedView) -> tuple[float | None, float | None]:
    """Mean absolute colour difference in [0, 1] between the masked pixels of `first` and the same points in `second`,
    and the share of the mask's pixels that could be compared.

    Both are None for an empty mask; the difference is None too where no pixel can be compared. A point farther behind
    the surface of `second` than the relative depth `TOLERANCE` counts as occluded there.
    """
    mask_pixels = int(first.mask.sum())
    if not mask_pixels:
        return None, None
    chosen = first.mask & (first.depth > 0)
    points = geometry.unproject(np.where(chosen, first.depth, 1.0), first.camera)[chosen]
    uv, z = geometry.project(points, second.camera)
    surface, _ = geometry.sample_nearest(second.depth, uv)
    with np.errstate(invalid="ignore"):  # points behind the camera have no pixel
        framed = ((uv >= 0.5) & (uv <= np.array([second.camera.width, second.camera.height]) - 0.5)).all(-1)
    visible = framed & ((surface == 0) | (z <= (1 + TOLERANCE) * surface))
    if not visible.any():
        return None, 0.0
    (column, row), color = uv[visible].T - 0.5, second.unexposed_color
    in_second = np.stack([map_coordinates(color[..., c], (row, column), order=1) for c in range(3)], -1)
    in_first = first.unexposed_color[chosen][visible]
    return float(np.abs(in_first - in_second).mean()), float(visible.sum() / mask_pixels)


def continue_surrounding_depth(depth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Depth [H, W] whose masked pixels continue the surrounding disparity smoothly; 0 where too little is known.

    For pictures that were inpainted in 2D, which have no depth of their own.
    """
    known = (depth > 0) & ~mask
    if not known.any():
        return np.zeros(depth.shape)
    disparity = np.divide(1.0, depth, out=np.zeros(depth.shape), where=known)
    try:
        disparity = complete(disparity, ~mask)
    except ValueError:
        return np.where(mask, 0.0, depth)
    usable = disparity > 0.1 * disparity[known].min()  # none beyond ten times the farthest known depth
    return np.where(mask, np.divide(1.0, disparity, out=np.zeros(depth.shape), where=usable), depth)

"""Multi-view consistency: how much the colors of the same surface points differ in two rendered views."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates

from reffusion import geometry
from reffusion.depth.completion import complete
from reffusion.fit.exposure import undo_exposure
from reffusion.types import Camera

SOLID = 0.5  # alpha above which a rendered depth is used

PROTOCOL = (
    "each rendered view and the next by name (the last has none): the mask's pixels, unprojected by rendered depth "
    f"(alpha over {SOLID}), are looked up in the next view bilinearly; compared are those that fall into its frame and "
    f"lie no more than {geometry.SAME_SURFACE:.0%} behind its rendered depth; mean absolute difference of the 8-bit "
    "pictures over pixels and channels, in [0, 1], 0 is consistent; `consistency_share`: compared pixels over the "
    "mask's; means over the pairs. Blur and holes are consistent too: read it beside the other scores"
)


class RenderedView(NamedTuple):
    """A rendered view and the pixels to compare.

    Attributes:
        camera: camera of the view.
        picture: uint8 [H, W, 3], the rendering.
        depth: [H, W], camera z; 0 where alpha is too low for a depth.
        mask: bool [H, W], True = the pixel is compared.
        exposure: [3, 4], the affine color map that was applied to the Gaussians' colors in the picture (see
            `fit.exposure`); None if none was applied.
    """

    camera: Camera
    picture: np.ndarray
    depth: np.ndarray
    mask: np.ndarray
    exposure: np.ndarray | None = None

    @property
    def unexposed_color(self) -> np.ndarray:
        """The picture [H, W, 3] without its exposure, so that views with different exposures can be compared.

        Values are relative to 255; without the exposure some may be outside [0, 1].
        """
        return undo_exposure(self.picture / 255.0, self.exposure)


def reprojected_color_difference(first: RenderedView, second: RenderedView) -> tuple[float | None, float | None]:
    """Compare the colors of the masked pixels of `first` with the colors of the same surface points in `second`.

    The pixels are unprojected by the depth of `first` and projected into `second`. Pixels without a depth, and points
    outside the frame of `second`, are not compared. A point that lies farther behind the surface of `second` than the
    relative depth `geometry.SAME_SURFACE` is occluded in `second` and not compared. A point at which `second` has no
    depth is compared. The mask of `second` is not used.

    Returns:
        The mean absolute difference over pixels and channels (colors in [0, 1], exposures undone), and the share in
        [0, 1] of the mask's pixels that were compared. Both are None if the mask is empty. The difference is None and
        the share 0 if no pixel can be compared.
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
    visible = framed & ((surface == 0) | (z <= (1 + geometry.SAME_SURFACE) * surface))
    if not visible.any():
        return None, 0.0
    (column, row), color = uv[visible].T - 0.5, second.unexposed_color
    in_second = np.stack([map_coordinates(color[..., c], (row, column), order=1) for c in range(3)], -1)
    in_first = first.unexposed_color[chosen][visible]
    return float(np.abs(in_first - in_second).mean()), float(visible.sum() / mask_pixels)


def continue_surrounding_depth(depth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Replace the depth in the mask by a smooth continuation of the surrounding disparity.

    This gives a depth to pictures that were inpainted in 2D, since 2D inpainting makes no depth.

    Args:
        depth: [H, W], camera z; 0 where unknown. Only known pixels outside the mask determine the continuation.
        mask: bool [H, W], True = the pixel was inpainted.

    Returns:
        Depth [H, W], equal to `depth` outside the mask. It is 0 in the mask if the surroundings do not determine a
        continuation, and at masked pixels that would be farther than ten times the farthest known depth. It is 0
        everywhere if no depth is known outside the mask.
    """
    known = (depth > 0) & ~mask
    if not known.any():
        return np.zeros(depth.shape)
    disparity = np.divide(1.0, depth, out=np.zeros(depth.shape), where=known)
    try:
        disparity = complete(disparity, known)
    except ValueError:
        return np.where(mask, 0.0, depth)
    usable = disparity > 0.1 * disparity[known].min()  # at most ten times the farthest known depth
    return np.where(mask, np.divide(1.0, disparity, out=np.zeros(depth.shape), where=usable), depth)

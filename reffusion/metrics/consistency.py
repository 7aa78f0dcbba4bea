"""Multi-view consistency: does a view show what its neighbour shows of the same surface?"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates

from reffusion import geometry
from reffusion.depth.completion import complete
from reffusion.fit.exposure import undo_exposure
from reffusion.types import Camera

TOLERANCE = 0.02  # relative depth by which a point may lie behind the neighbour's surface and still be visible
SOLID = 0.5  # alpha from which a rendered depth means anything

PROTOCOL = (
    "each rendered view and the next by name (the last has none): the mask's pixels, unprojected by rendered depth "
    f"(alpha over {SOLID}), are looked up in the next view bilinearly; compared are those that fall into its frame and "
    f"lie no more than {TOLERANCE:.0%} behind its rendered depth; mean absolute difference of the 8-bit pictures over "
    "pixels and channels, in [0, 1], 0 is consistent; `consistency_share`: compared pixels over the mask's; means over "
    "the pairs. Blur and holes are consistent too: read it beside the other scores"
)


class Shown(NamedTuple):
    """A rendered view.

    Attributes:
        camera: the view.
        picture: uint8 [H, W, 3].
        depth: [H, W] camera z; 0 where nothing is, or too little to have a depth.
        mask: bool [H, W], the pixels to compare.
        exposed: [3, 4], the exposure that it was drawn with, see `fit.exposure`; None: the Gaussians' own.
    """

    camera: Camera
    picture: np.ndarray
    depth: np.ndarray
    mask: np.ndarray
    exposed: np.ndarray | None = None

    @property
    def color(self) -> np.ndarray:
        """[H, W, 3] in [0, 1] as the Gaussians are exposed, so that views of other exposures can be compared."""
        return undo_exposure(self.picture / 255.0, self.exposed)


def difference(first: Shown, second: Shown, tolerance: float = TOLERANCE) -> tuple[float | None, float | None]:
    """Mean absolute difference in [0, 1] of `first` in its mask and `second` where it shows the same points, and the
    share of the mask that could be compared; None for an empty mask, the difference also where nothing is comparable.

    A point is hidden from the second view where it lies more than `tolerance` (relative) behind the surface seen there.
    """
    asked = int(first.mask.sum())
    if not asked:
        return None, None
    chosen = first.mask & (first.depth > 0)
    points = geometry.unproject(np.where(chosen, first.depth, 1.0), first.camera)[chosen]
    uv, z = geometry.project(points, second.camera)
    surface, _ = geometry.sample_nearest(second.depth, uv)
    with np.errstate(invalid="ignore"):  # a point behind the camera has no place in its picture
        framed = ((uv >= 0.5) & (uv <= np.array([second.camera.width, second.camera.height]) - 0.5)).all(-1)
    seen = framed & ((surface == 0) | (z <= (1 + tolerance) * surface))
    if not seen.any():
        return None, 0.0
    (column, row), color = uv[seen].T - 0.5, second.color
    there = np.stack([map_coordinates(color[..., c], (row, column), order=1) for c in range(3)], -1)
    here = first.color[chosen][seen]
    return float(np.abs(here - there).mean()), float(seen.sum() / asked)


def depth_through(depth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Depth [H, W] with that in the mask replaced: the surroundings' disparity continued smoothly; 0 where too little
    is known around it. For pictures inpainted in 2D, which have no depth of their own.
    """
    known = (depth > 0) & ~mask
    if not known.any():
        return np.zeros(depth.shape)
    disparity = np.divide(1.0, depth, out=np.zeros(depth.shape), where=known)
    try:
        disparity = complete(disparity, ~mask)
    except ValueError:
        return np.where(mask, 0.0, depth)
    usable = disparity > 0.1 * disparity[known].min()  # beyond ten times the farthest depth it is none
    return np.where(mask, np.divide(1.0, disparity, out=np.zeros(depth.shape), where=usable), depth)

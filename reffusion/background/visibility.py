"""The visibility test: what each training view shows at points in space.

A view shows a surface at a point (seen), sees past the point (free), has something in front of the point (occluded), or
shows the object in the point's direction (masked).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
import torch

from reffusion import geometry, morphology
from reffusion.background.visibility_kernel import SEEN, UNIT_RATIO, count_in_view
from reffusion.gaussians.surfels import surface_normals
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians, Rendering

OPAQUE = 0.9  # alpha from which a pixel shows a surface
ROUGHNESS = 0.006  # of the image's width: half the side of the window of `depth_range`
# At least this share of the views that could see a surface must show the surface. This condition excludes artifacts
# that a fit puts below surfaces.
OBSERVED_SHARE = 0.25
MASK_MARGIN = 0.004  # of the image's width: pixels this close to a mask mix object and background, and do not count
_TINY = 1e-30  # least divisor, so that there is no division by a depth of 0


@dataclass(frozen=True)
class DepthView:
    """The depth that a training view shows, rendered with the object, and the mask of the object in this view.

    Attributes:
        camera: the view.
        depth: [H, W] float32, camera z of the visible surface; 0 where nothing opaque is visible.
        near_ratio: [H, W] uint16, the nearest depth around each pixel (`depth_range`) divided by `depth`, times
            `UNIT_RATIO`. The ratios take half the memory of depth maps, which matters for hundreds of views.
        far_ratio: [H, W] uint16, `depth` divided by the farthest depth around each pixel, times `UNIT_RATIO`.
        masked: bool [H, W], True at pixels where the photograph shows the object, and in a margin around them.
    """

    camera: Camera
    depth: np.ndarray
    near_ratio: np.ndarray
    far_ratio: np.ndarray
    masked: np.ndarray

    @classmethod
    def from_range(
        cls, camera: Camera, depth: np.ndarray, local_range: tuple[np.ndarray, np.ndarray], masked: np.ndarray
    ) -> Self:
        """Construct a DepthView from depth maps.

        Args:
            depth: [H, W], camera z of the visible surface.
            local_range: the nearest and the farthest depth around each pixel, [H, W] both, see `depth_range`.
            masked: bool [H, W], see the attribute.
        """
        nearest, farthest = local_range
        known = np.maximum(depth, _TINY)
        near_ratio = np.rint(UNIT_RATIO * np.minimum(nearest / known, 1))
        far_ratio = np.rint(UNIT_RATIO * np.minimum(known / np.maximum(farthest, _TINY), 1))
        return cls(camera, depth.astype(np.float32), near_ratio.astype(np.uint16), far_ratio.astype(np.uint16), masked)

    @classmethod
    def from_depth(cls, camera: Camera, depth: np.ndarray, mask: np.ndarray) -> Self:
        """Construct a DepthView from a depth map, float32 [H, W], and the object's mask, bool [H, W]."""
        return cls.from_range(camera, depth, depth_range(depth), morphology.dilate(mask, MASK_MARGIN))

    @property
    def nearest(self) -> np.ndarray:
        """[H, W] float32, the nearest depth around each pixel (`depth_range`); 0 where nothing is visible."""
        return self.depth * (self.near_ratio / np.float32(UNIT_RATIO))

    @property
    def farthest(self) -> np.ndarray:
        """[H, W] float32, the farthest depth around each pixel (`depth_range`); 0 where nothing is visible."""
        return self.depth * (UNIT_RATIO / np.maximum(self.far_ratio, 1).astype(np.float32))


@torch.no_grad()
def render_depth_views(
    gaussians: Gaussians, cameras: Sequence[Camera], masks: Mapping[str, np.ndarray]
) -> list[DepthView]:
    """Render the depth of every view.

    Args:
        gaussians: the whole scene with the object, as the photographs show it.
        cameras: the views.
        masks: view name -> bool [H, W], True at pixels that show the object; all False for a view that was photographed
            without the object.
    """
    depths = ((camera, opaque_depth(rasterizer.render(gaussians, camera, sh_degree=0))) for camera in cameras)
    return [DepthView.from_depth(camera, depth, masks[camera.name]) for camera, depth in depths]


def opaque_depth(rendering: Rendering) -> np.ndarray:
    """Return float32 [H, W], the camera z of the visible surface; 0 where nothing opaque is visible."""
    return torch.where(rendering.alpha > OPAQUE, rendering.depth, 0).cpu().numpy()


def depth_range(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest and the farthest depth in a small window around each pixel, float32 [H, W] both.

    The range is narrow on a smooth surface, and wide at depth edges and on rough surfaces such as grass.

    Args:
        depth: [H, W], 0 where unknown. Unknown pixels do not contribute; at an unknown pixel the nearest depth is 0.
    """
    window = morphology.square(morphology.to_pixels(ROUGHNESS, depth.shape[1]))
    nearest = cv2.erode(np.where(depth > 0, depth, np.inf).astype(np.float32), window)
    return np.where(depth > 0, nearest, 0), cv2.dilate(depth.astype(np.float32), window)


def with_photographed_depth(depth: np.ndarray, camera: Camera, views: Sequence[DepthView]) -> np.ndarray:
    """Return a depth map that holds `depth` in the object's mask, and the depth with the object outside the mask.

    The mask is that of the view, with its margin (`DepthView.masked`).

    Outside the mask the photograph supervised the depth. The object's Gaussians extend a little beyond the mask, so
    without them the pixels beside the mask would have the depth of the surface behind these Gaussians.

    Args:
        depth: [H, W], rendered without the object.
        camera: the view. If it is not among `views`, `depth` is returned as it is.
        views: depth of the training views, rendered with the object.

    Returns:
        [H, W], float64 if the view is among `views`. At pixels outside the mask where the view shows nothing opaque,
        `depth` stays.
    """
    for view in views:
        if view.camera.name == camera.name:
            return np.where(~view.masked & (view.depth > 0), view.depth, depth).astype(np.float64)
    return depth


@dataclass(frozen=True)
class Visibility:
    """The visibility of P points: how many views classify a point as seen, free, occluded or masked.

    A view counts in at most one of the four numbers of a point. The four arrays have the type int64.

    Attributes:
        seen: [P], number of views that show a surface at the point. If normals were given to `count_views`, only views
            on the side of the normal count.
        free: [P], number of views that see past the point to a farther surface.
        occluded: [P], number of views in which a surface lies in front of the point. If normals were given, only views
            on the side of the normal count.
        masked: [P], number of views whose mask of the object contains the point's projection.
    """

    seen: np.ndarray
    free: np.ndarray
    occluded: np.ndarray
    masked: np.ndarray

    @property
    def is_observed(self) -> np.ndarray:
        """bool [P], True if at least one view shows the point, and at least a quarter of the views that could see it.

        The views that could see the point are those in which it is seen or occluded.
        """
        return self.seen >= np.maximum(1, OBSERVED_SHARE * (self.seen + self.occluded))

    @property
    def is_empty(self) -> np.ndarray:
        """bool [P], True if at least two views see past the point, and more views than show a surface at the point."""
        return (self.free >= 2) & (self.free > self.seen)


def count_views(points: np.ndarray, views: Sequence[DepthView], normals: np.ndarray | None = None) -> Visibility:
    """Classify points in every view by comparing their depth with the depth that the view shows.

    A point is seen only if it lies on the view's surface, up to `geometry.SAME_SURFACE`. A point clearly in front of
    the surface is free, and a point behind the surface is occluded. A point in the mask of the object is only masked.

    Args:
        points: [P, 3], world coordinates.
        views: depth of the training views, rendered with the object.
        normals: [P, 3], normals of the surface on which the points lie, towards the side of interest; None if every
            side counts. Views on the other side count neither as seen nor as occluded: the underside of a table is no
            evidence of its top, and a vase that occludes its own far side is no evidence against the far side.
    """
    counts = np.zeros((4, len(points)), np.int64)
    for view in views:
        _count_view(view, points, normals, counts)
    return Visibility(*counts)


def is_seen(view: DepthView, points: np.ndarray) -> np.ndarray:
    """Return bool [P], True for those of the world points [P, 3] at which the view shows a surface outside its mask."""
    counts = np.zeros((4, len(points)), np.int64)
    _count_view(view, points, None, counts)
    return counts[SEEN] > 0


def _count_view(view: DepthView, points: np.ndarray, normals: np.ndarray | None, counts: np.ndarray) -> None:
    """Classify points in one view, and add 1 to the counts [4, P] in place, see `visibility_kernel.count_in_view`."""
    maps = view.depth, view.near_ratio, view.far_ratio, view.masked
    count_in_view(points, normals, view.camera, maps, (geometry.SAME_SURFACE, geometry.OTHER_SURFACE), counts)


def smooth_surface(depth: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface of a rendered depth map: world points and unit normals towards the camera, [H, W, 3] both.

    The depth map is median-filtered first, because rendered Gaussians make a surface rough.

    Args:
        depth: [H, W], camera z; 0 where unknown. There the result is meaningless.
        camera: the view.
    """
    smooth = cv2.medianBlur(depth.astype(np.float32), 5).astype(np.float64)
    return geometry.unproject(smooth, camera), surface_normals(smooth, camera)

"""What the training views know of points in space: on a visible surface, in free space, occluded, or behind the
mask."""

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
from reffusion.types import Camera, Gaussians

OPAQUE = 0.9  # alpha from which a pixel shows a surface
SURFACE = 0.02  # relative depth: a point this close to a view's depth, on either side, lies on its surface
FREE = 0.03  # relative depth by which a view must see past a point for the point to be in free space
ROUGHNESS = 0.006  # of the image's width: radius in which the range of a view's depth is taken
OBSERVED_SHARE = 0.25  # of the views that face a surface, those that must show it: a fit puts artifacts below surfaces
MASK_MARGIN = 0.004  # of the image's width: pixels this close to a mask mix object and background, and do not count
_TINY = 1e-30  # of depth, so that a depth of 0 is no division by zero


@dataclass(frozen=True)
class DepthView:
    """The depth that a training view shows, and where its photograph shows the object.

    Attributes:
        camera: the view.
        depth: [H, W] float32, camera z of the visible surface; 0 where nothing opaque is visible.
        near_ratio, far_ratio: [H, W] uint16, the local depth range (`depth_range`): the nearest depth over `depth`, and
            `depth` over the farthest, in units of 1 / `UNIT_RATIO`. They take half the memory of depth maps, which
            matters for hundreds of views.
        masked: bool [H, W], pixels that show the object, with a margin.
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
        """A view of this depth, with the nearest and the farthest depth around each pixel, [H, W] both."""
        nearest, farthest = local_range
        known = np.maximum(depth, _TINY)
        near_ratio = np.rint(UNIT_RATIO * np.minimum(nearest / known, 1))
        far_ratio = np.rint(UNIT_RATIO * np.minimum(known / np.maximum(farthest, _TINY), 1))
        return cls(camera, depth.astype(np.float32), near_ratio.astype(np.uint16), far_ratio.astype(np.uint16), masked)

    @property
    def nearest(self) -> np.ndarray:
        """[H, W] float32, the nearest depth around each pixel; 0 where nothing is visible."""
        return self.depth * (self.near_ratio / np.float32(UNIT_RATIO))

    @property
    def farthest(self) -> np.ndarray:
        """[H, W] float32, the farthest depth around each pixel; 0 where nothing is visible."""
        return self.depth * (UNIT_RATIO / np.maximum(self.far_ratio, 1).astype(np.float32))


@torch.no_grad()
def render_depth_views(
    gaussians: Gaussians, cameras: Sequence[Camera], masks: Mapping[str, np.ndarray], margin: float = MASK_MARGIN
) -> list[DepthView]:
    """Render the depth of every view.

    Args:
        gaussians: the whole scene with the object, as the photographs show it.
        masks: view name -> bool [H, W], pixels that show the object (all False in a clean view).
        margin: dilation of the masks, as a fraction of the image's width.
    """
    views = []
    for camera in cameras:
        rendering = rasterizer.render(gaussians, camera, sh_degree=0)
        depth = torch.where(rendering.alpha > OPAQUE, rendering.depth, 0).cpu().numpy().astype(np.float32)
        masked = morphology.dilate(masks[camera.name], margin)
        views.append(DepthView.from_range(camera, depth, depth_range(depth), masked))
    return views


def depth_range(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest and the farthest depth around each pixel of a depth map [H, W] in which 0 is unknown.

    The range is narrow on a smooth surface, and wide at depth edges and on rough surfaces such as grass.
    """
    window = morphology.square(morphology.to_pixels(ROUGHNESS, depth.shape[1]))
    nearest = cv2.erode(np.where(depth > 0, depth, np.inf).astype(np.float32), window)
    return np.where(depth > 0, nearest, 0), cv2.dilate(depth.astype(np.float32), window)


def with_photographed_depth(depth: np.ndarray, camera: Camera, views: Sequence[DepthView]) -> np.ndarray:
    """[H, W] float64: `depth`, rendered without the object, replaced outside the mask by what the view shows with it.

    The photograph supervised these pixels. Without the object's blurred rim they would show what lies behind it.
    """
    for view in views:
        if view.camera.name == camera.name:
            return np.where(~view.masked & (view.depth > 0), view.depth, depth).astype(np.float64)
    return depth


@dataclass(frozen=True)
class Visibility:
    """How many views classify each of P points as what.

    Attributes:
        seen: [P], views that show a surface at the point. With normals: a surface that faces them.
        free: [P], views that see past the point onto something farther.
        occluded: [P], views in which something stands before the point. With normals: views that the surface faces.
        masked: [P], views that see the object in the point's direction.
    """

    seen: np.ndarray
    free: np.ndarray
    occluded: np.ndarray
    masked: np.ndarray

    @property
    def is_observed(self) -> np.ndarray:
        """bool [P]: at least one view, and a quarter of those that could see the surface, show it."""
        return self.seen >= np.maximum(1, OBSERVED_SHARE * (self.seen + self.occluded))

    @property
    def is_empty(self) -> np.ndarray:
        """bool [P]: at least two views see past the point, and more than show a surface there."""
        return (self.free >= 2) & (self.free > self.seen)


def count_views(points: np.ndarray, views: Sequence[DepthView], normals: np.ndarray | None = None) -> Visibility:
    """Classify points [P, 3] in every view.

    The test is two-sided: a point in front of or behind a view's surface is not seen by that view.

    Args:
        normals: [P, 3], normals of the surface on which the points lie, towards the side in question. Views from the
            other side do not count: the underside of a table is no evidence of its top, and a vase that occludes its
            own far side is no evidence against it.
    """
    counts = np.zeros((4, len(points)), np.int64)
    for view in views:
        _count_view(view, points, normals, counts)
    return Visibility(*counts)


def is_seen(view: DepthView, points: np.ndarray) -> np.ndarray:
    """bool [P]: the view shows a surface at the points [P, 3]."""
    counts = np.zeros((4, len(points)), np.int64)
    _count_view(view, points, None, counts)
    return counts[SEEN] > 0


def _count_view(view: DepthView, points: np.ndarray, normals: np.ndarray | None, counts: np.ndarray) -> None:
    maps = view.depth, view.near_ratio, view.far_ratio, view.masked
    count_in_view(points, normals, view.camera, maps, (SURFACE, FREE), counts)


def smooth_surface(depth: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """World points and unit normals towards the camera, [H, W, 3] both, of a rendered depth map [H, W], median-filtered
    against the roughness of splats."""
    smooth = cv2.medianBlur(depth.astype(np.float32), 5).astype(np.float64)
    return geometry.unproject(smooth, camera), surface_normals(smooth, camera)

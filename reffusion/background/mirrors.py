"""Mirror images of symmetric things beside the object.

A *thing* is a connected part of the scene beside the removed object. If a plane of mirror symmetry maps the thing onto
itself, the part of the thing that the photographs show also tells how the part looks that no photograph shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from reffusion import morphology
from reffusion.background.visibility import DepthView, count_views, smooth_surface
from reffusion.depth.inpaint_depth import inpaint_depth
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

COVERED = 0.5  # alpha above which a pixel shows a thing's mirror image
GAP = 0.01  # of the image's width: gaps of this radius in the observed part of a thing are closed in `is_observed`
WINDOW = 0.025  # of the image's width: gaps of this radius in the observed part of a thing are closed in its depth
DEEPER = 1.02  # a place of up to radius `WINDOW` that is deeper than its surroundings by this factor is such a gap


@dataclass(frozen=True)
class MirrorImage:
    """The mirror image of a thing, rendered in a view.

    Attributes:
        depth: [H, W] float64, camera z of the mirror image; inf at pixels without mirror image.
        plausible_depth: [H, W] float64, equal to `depth` where photographs show the part of the thing that is mirrored
            and the views do not see past the mirror image (`Visibility.is_empty`); inf elsewhere.
        is_observed: bool [H, W], True where photographs show the part of the thing that is mirrored, so that `picture`
            has reliable colors.
        picture: [H, W, 3] uint8, the mirror image.
    """

    depth: np.ndarray
    plausible_depth: np.ndarray
    is_observed: np.ndarray
    picture: np.ndarray


@dataclass(frozen=True)
class Mirror:
    """A connected part of the scene beside the object (a thing), and its plane of mirror symmetry.

    The photographs do not contradict this symmetry.

    Attributes:
        thing: the Gaussians of the thing.
        normal: [3], unit normal of the mirror plane.
        offset: the mirror plane is normal . x = offset.
    """

    thing: Gaussians
    normal: np.ndarray
    offset: float

    def reflect(self, points: np.ndarray) -> np.ndarray:
        """Return the mirror images of world points [..., 3]."""
        return reflect_points(points, self.normal, self.offset)

    def reflect_camera(self, camera: Camera) -> Camera:
        """Return the mirror image of a camera.

        The mirrored camera sees the thing as the given one sees the thing's mirror image, with left and right swapped.
        """
        swap, turn = np.diag([-1.0, 1.0, 1.0, 1.0]), np.eye(4)
        turn[:3, :3] -= 2 * np.outer(self.normal, self.normal)
        turn[:3, 3] = 2 * self.offset * self.normal
        return replace(camera, cx=camera.width - camera.cx, world_to_camera=swap @ camera.world_to_camera @ turn)

    @torch.no_grad()
    def render(self, camera: Camera, pixels: np.ndarray, views: Sequence[DepthView]) -> MirrorImage:
        """Render the mirror image of the thing.

        Args:
            camera: the view.
            pixels: bool [H, W], True at the pixels for which `plausible_depth` and `is_observed` are computed.
            views: depth of the training views, rendered with the object.
        """
        mirrored = self.reflect_camera(camera)
        rendering = rasterizer.render(self.thing, mirrored)
        depth = torch.where(rendering.alpha > COVERED, rendering.depth, 0).double().cpu().numpy()
        picture = (rendering.color / rendering.alpha.clamp_min(COVERED)[..., None]).clamp(0, 1).cpu().numpy()
        rows, columns = np.nonzero(pixels[:, ::-1] & (depth > 0))
        points, normals = (each[rows, columns] for each in smooth_surface(depth, mirrored))
        facing = reflect_points(normals, self.normal, 0.0)
        possible, observed = np.zeros((2, *depth.shape), bool)
        possible[rows, columns] = ~count_views(self.reflect(points), views, facing).is_empty
        observed[rows, columns] = count_views(points, views, normals).is_observed
        observed &= depth < DEEPER * _fill_pits(depth, WINDOW)
        whole = morphology.close_mask(observed, WINDOW)
        depth = np.where(whole & ~observed, inpaint_depth(depth, observed), depth) if observed.any() else depth
        flip = lambda values: np.ascontiguousarray(values[:, ::-1])
        image_depth = flip(np.where(depth > 0, depth, np.inf))
        plausible = np.where(flip(whole & possible), image_depth, np.inf)
        is_observed = flip(morphology.close_mask(observed, GAP))
        return MirrorImage(image_depth, plausible, is_observed, flip((picture * 255 + 0.5).astype(np.uint8)))


def reflect_points(points: np.ndarray, normal: np.ndarray, offset: float) -> np.ndarray:
    """Return the mirror images of points [..., 3] in the plane normal . x = offset."""
    return points - 2 * (points @ normal - offset)[..., None] * normal


def render_mirrors(
    mirrors: Sequence[Mirror], camera: Camera, pixels: np.ndarray, views: Sequence[DepthView]
) -> MirrorImage:
    """Render all mirror images into one view: each pixel shows the nearest plausible image, else the nearest image.

    The arguments are those of `Mirror.render`. A mirror image is plausible where `plausible_depth` is finite. Without
    mirrors, the depth is inf everywhere.
    """
    nowhere = np.full(pixels.shape, np.inf)
    found = MirrorImage(nowhere, nowhere, np.zeros_like(pixels), np.zeros((*pixels.shape, 3), np.uint8))
    for mirror in mirrors:
        image = mirror.render(camera, pixels, views)
        first = (image.plausible_depth < found.plausible_depth) | (
            np.isinf(found.plausible_depth) & (image.depth < found.depth)
        )
        found = MirrorImage(
            np.where(first, image.depth, found.depth),
            np.where(first, image.plausible_depth, found.plausible_depth),
            np.where(first, image.is_observed, found.is_observed),
            np.where(first[..., None], image.picture, found.picture),
        )
    return found


def _fill_pits(depth: np.ndarray, fraction: float) -> np.ndarray:
    """Return a depth map without pits of a radius up to `fraction` of its width; unknown pixels (0) get its maximum."""
    radius = morphology.to_pixels(fraction, depth.shape[1])
    return cv2.morphologyEx(np.where(depth > 0, depth, depth.max()), cv2.MORPH_OPEN, morphology.disk(radius))

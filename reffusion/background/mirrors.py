"""Mirror images of things beside the object: what no photograph shows of a symmetric thing is like what they show."""

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

COVERED = 0.5  # alpha from which a pixel shows a thing's image
GAP = 0.01  # of the image's width: radius of gaps in the observed part of a thing that are ignored
WINDOW = 0.025  # of the image's width: radius of gaps that the image itself does not have, only its texture
DEEPER = 1.02  # times the depth around a small place, from which the place is such a gap


@dataclass(frozen=True)
class MirrorImage:
    """What a view shows of a thing's mirror image.

    Attributes:
        depth: [H, W] float64 of the whole image; inf elsewhere.
        plausible_depth: [H, W] float64, the same where the mirrored part of the thing is observed and no view sees past
            the image; inf elsewhere.
        is_observed: bool [H, W], where `picture` shows what photographs show of the mirrored part.
        picture: [H, W, 3] uint8.
    """

    depth: np.ndarray
    plausible_depth: np.ndarray
    is_observed: np.ndarray
    picture: np.ndarray


@dataclass(frozen=True)
class Mirror:
    """A thing, and a mirror plane that maps it onto itself as far as photographs tell.

    Attributes:
        thing: its Gaussians.
        normal: [3], unit length. offset: the mirror is the plane normal . x = offset.
    """

    thing: Gaussians
    normal: np.ndarray
    offset: float

    def reflect(self, points: np.ndarray) -> np.ndarray:
        """The mirror images of points [..., 3]."""
        return reflect_points(points, self.normal, self.offset)

    def reflect_camera(self, camera: Camera) -> Camera:
        """The camera's mirror image. It sees the thing as the camera sees the thing's image, with left and right
        swapped."""
        swap, turn = np.diag([-1.0, 1.0, 1.0, 1.0]), np.eye(4)
        turn[:3, :3] -= 2 * np.outer(self.normal, self.normal)
        turn[:3, 3] = 2 * self.offset * self.normal
        return replace(camera, cx=camera.width - camera.cx, world_to_camera=swap @ camera.world_to_camera @ turn)

    @torch.no_grad()
    def render(self, camera: Camera, pixels: np.ndarray, views: Sequence[DepthView]) -> MirrorImage:
        """What a view shows of the thing's mirror image.

        Args:
            pixels: bool [H, W], where photographs are asked whether the image is plausible.
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
    """The images of points [..., 3] in the mirror normal . x = offset."""
    return points - 2 * (points @ normal - offset)[..., None] * normal


def render_mirrors(
    mirrors: Sequence[Mirror], camera: Camera, pixels: np.ndarray, views: Sequence[DepthView]
) -> MirrorImage:
    """What a view shows of all mirror images, at each pixel the nearest plausible one; see `Mirror.render`."""
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
    """[H, W]: a depth map, 0 where unknown, in which small places deeper than their surroundings have the depth of
    these."""
    radius = morphology.to_pixels(fraction, depth.shape[1])
    return cv2.morphologyEx(np.where(depth > 0, depth, depth.max()), cv2.MORPH_OPEN, morphology.disk(radius))

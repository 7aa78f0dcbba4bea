"""References, warped to other views over their surfaces.

New Gaussians that are fitted to one view look right from there only. From other sides their disks are averaged
wrongly, because the nearest ones occlude the others, and fine lines come apart into dots. Therefore the refit also
shows what other views see of a reference: its picture, warped over its surface.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch

from reffusion import geometry
from reffusion.gaussians.surfels import surface_normals
from reffusion.initialize.draft import Draft
from reffusion.morphology import masked_blur, nearest_known, to_pixels
from reffusion.splat import rasterizer
from reffusion.types import Camera, Reference

VIEWS = 12  # views to which a reference is warped, at most
MIN_COVERAGE = 0.15  # a view is used if the reference's n pixels would cover more than this share of n pixels in it
MIN_NEW = 0.9  # share that new Gaussians must have in a pixel
ITERATIONS = 4  # of the intersection of a ray with the surface
MATCH = 0.005  # relative difference from the depth that the view shows, above which it shows another surface
MAX_MOVE = 0.5  # px: larger last steps have not converged
MIN_SCALE = 0.5  # pixels of the reference per pixel of the view, along any direction; with fewer the picture is blurred
FINE = 4  # samples along each side of a pixel, whose mean is the color of the pixel
TONE_BLUR = 0.015  # of the image's width: blur that separates detail from tone


class _Surface(NamedTuple):
    """The surface that a reference shows.

    Attributes:
        camera: the view of the reference.
        depth: [H, W], camera z; 0 where unknown.
        points, normals: [H, W, 3], in the world; the normals have unit length and point toward the camera.
    """

    camera: Camera
    depth: np.ndarray
    points: np.ndarray
    normals: np.ndarray

    def predict_coverage(self, camera: Camera, pixels: np.ndarray) -> float:
        """Return the area in px that `pixels`, bool [H, W], would cover in another view, divided by their number.

        Occlusion is ignored. The result is 0 if the other view sees none of the pixels or only the surface's back.
        """
        points, normals = self.points[pixels], self.normals[pixels]
        uv, z = geometry.project(points, camera)
        inside = geometry.is_in_frame(uv, z, camera)
        if not inside.any():
            return 0.0
        areas = [
            ((view.center - points[inside]) * normals[inside]).sum(1) * view.fx * view.fy / depth[inside] ** 3
            for view, depth in ((self.camera, self.depth[pixels]), (camera, z))
        ]  # in pixels, of one unit of area of the surface
        return float((np.maximum(areas[1], 0) / areas[0]).sum() / len(points))


def warp_references(
    draft: Draft, references: Sequence[Reference], depths: Mapping[str, np.ndarray], cameras: Sequence[Camera]
) -> list[Reference]:
    """Warp each reference to up to `VIEWS` views from very different directions.

    Args:
        draft: the filled scene.
        references: the completed views; those without an entry in `depths`, or with an empty mask, are left out.
        depths: view name -> [H, W], camera z of the surface onto which the reference was unprojected; 0 where unknown.
        cameras: the views to choose from.

    Returns:
        Completed views, in the order of the references. The mask of each marks the pixels that show new Gaussians and
        to which a reference was warped; outside the mask the picture is black.
    """
    warped = []
    for reference in references:
        depth = depths.get(reference.camera.name)
        if depth is None or not (pixels := reference.mask & (depth > 0)).any():
            continue
        points = geometry.unproject(np.where(depth > 0, depth, 1.0), reference.camera)
        surface = _Surface(reference.camera, depth, points, surface_normals(depth, reference.camera))
        for camera in _choose_views(surface, pixels, cameras):
            view = _warp(draft, reference.image, surface, camera)
            if view.mask.any():
                warped.append(view)
    return warped


def _choose_views(surface: _Surface, pixels: np.ndarray, cameras: Sequence[Camera]) -> list[Camera]:
    """Choose up to `VIEWS` views that see the pixels of a surface well, each as far from those before as possible."""
    middle = np.median(surface.points[pixels], axis=0)
    direction = lambda camera: (camera.center - middle) / np.linalg.norm(camera.center - middle)
    left = [each for each in cameras if each.name != surface.camera.name]
    left = [each for each in left if surface.predict_coverage(each, pixels) > MIN_COVERAGE]
    chosen = [surface.camera]
    while left and len(chosen) <= VIEWS:
        nearest = [max(direction(each) @ direction(other) for other in chosen) for each in left]
        chosen.append(left.pop(int(np.argmin(nearest))))
    return chosen[1:]


@torch.no_grad()
def _warp(draft: Draft, image: np.ndarray, surface: _Surface, camera: Camera) -> Reference:
    """Return the view `camera` of a surface's picture, uint8 [H, W, 3]; its mask marks the pixels that show it."""
    is_new = draft.is_new[:, None].to(draft.gaussians.means)
    rendering = rasterizer.render(draft.gaussians, camera, features=is_new)
    assert rendering.features is not None
    shows_new = (rendering.features[..., 0] > MIN_NEW).cpu().numpy()
    uv = _intersect(surface, camera, rendering.depth.double().cpu().numpy(), shows_new)
    mask = _smallest_scale(uv) > MIN_SCALE
    if not mask.any():
        return Reference(camera, np.zeros((*mask.shape, 3), np.uint8), mask)
    # The detail is that of the picture. The tone is that of the rendering, because colors change with the direction
    # (`view_dependent_color`).
    difference = 255 * rendering.color.cpu().numpy() - (picture := _sample_area(image, uv, mask))
    tone = masked_blur(difference, mask, to_pixels(TONE_BLUR, camera.width))
    return Reference(camera, ((picture + tone) * mask[..., None]).clip(0, 255).round().astype(np.uint8), mask)


def _intersect(surface: _Surface, camera: Camera, depth: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return where the rays of another view meet the surface, in px of the surface's view, [h, w, 2]; NaN elsewhere."""
    # Newton's method starts from `depth`, the camera z that the other view shows.
    rays = geometry.pixel_rays(camera)[pixels] @ camera.world_to_camera[:3, :3]
    start = z = depth[pixels]
    position = lambda z: geometry.project(camera.center + z[:, None] * rays, surface.camera)[0]
    uv = position(z)
    for _ in range(ITERATIONS):
        point, inside = geometry.sample_nearest(surface.points, uv)
        known, _ = geometry.sample_nearest(surface.depth > 0, uv)
        normal, _ = geometry.sample_nearest(surface.normals, uv)
        slope = (rays * normal).sum(1)
        faces = inside & known & (slope < 0)
        z = np.where(faces, ((point - camera.center) * normal).sum(1) / np.where(faces, slope, 1.0), z)
        before, uv = uv, position(z)
    # Far from `depth` the other view shows another surface.
    shows_surface = faces & (np.abs(z - start) < MATCH * start) & (np.abs(uv - before) < MAX_MOVE).all(1)
    found = np.full((*depth.shape, 2), np.nan, np.float32)
    found[pixels] = np.where(shows_surface[:, None], uv, np.nan)
    return found


def _smallest_scale(uv: np.ndarray) -> np.ndarray:
    """Return [h, w], how many source pixels a pixel spans in the direction in which it spans fewest; NaN if unknown."""
    # `uv` [h, w, 2] is the position of each pixel in the source, NaN where it has none. The result is NaN where a
    # neighboring pixel has no position.
    down, right = np.gradient(uv, axis=(0, 1))
    square, area = (down**2 + right**2).sum(-1), np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0])
    return np.sqrt((square - np.sqrt(np.maximum(square**2 - 4 * area**2, 0))) / 2)


def _sample_area(image: np.ndarray, uv: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return [h, w, 3] float32, the mean colors under each pixel of the mask, at the positions `uv` in the picture."""
    # Outside the mask the result is meaningless.
    size = (FINE * mask.shape[1], FINE * mask.shape[0])
    fine = cv2.resize(uv[nearest_known(mask)] - np.float32(0.5), size, interpolation=cv2.INTER_LINEAR)
    picture = cv2.remap(image.astype(np.float32), fine, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return cv2.resize(picture, mask.shape[::-1], interpolation=cv2.INTER_AREA)

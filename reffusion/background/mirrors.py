"""What stands beside the object, in a mirror: what nobody saw of it is like what is seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from reffusion.background.visibility import Witness, pixels, smoothed_surface, votes
from reffusion.references.view_ranking import drawn_across
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

HALF = 0.5  # alpha from which a thing's image is there
GAP = 0.01  # of the image's width: the radius of gaps in what is seen of a thing that are of no account
WINDOW = 0.025  # the same, of those that its image does not have, but for their texture
DEEPER = 1.02  # of the depth around, from which a place is such a window


@dataclass(frozen=True)
class Drawn:
    """What a view shows of a thing's mirror image.

    Attributes:
        depth: [H, W] float64 of the whole image, inf where there is none.
        supposed: the same, where the thing itself is seen, and no view looks past its image; inf elsewhere.
        told: bool [H, W], where its picture is that of what is seen; where it is not, in gaps, it is another one.
        picture: [H, W, 3] uint8.
    """

    depth: np.ndarray
    supposed: np.ndarray
    told: np.ndarray
    picture: np.ndarray


@dataclass(frozen=True)
class Mirror:
    """A thing, and a mirror that shows it as it is, so far as photographs tell.

    Attributes:
        thing: its Gaussians.
        normal: [3] of unit length, height: the mirror is at normal . x = height.
    """

    thing: Gaussians
    normal: np.ndarray
    height: float

    def image_of(self, points: np.ndarray) -> np.ndarray:
        """The mirror images of points [..., 3]."""
        return reflected(points, self.normal, self.height)

    def behind(self, camera: Camera) -> Camera:
        """The camera's mirror image. It sees the thing as the camera sees the thing's image, left and right swapped."""
        swap, turn = np.diag([-1.0, 1.0, 1.0, 1.0]), np.eye(4)
        turn[:3, :3] -= 2 * np.outer(self.normal, self.normal)
        turn[:3, 3] = 2 * self.height * self.normal
        return replace(camera, cx=camera.width - camera.cx, world_to_camera=swap @ camera.world_to_camera @ turn)

    @torch.no_grad()
    def drawn(self, camera: Camera, asked: np.ndarray, views: Sequence[Witness]) -> Drawn:
        """What a view shows of the thing's image.

        Args:
            asked: bool [H, W], pixels of which it is asked whether photographs speak for the image.
        """
        across = self.behind(camera)
        image = rasterizer.render(self.thing, across)
        depth = torch.where(image.alpha > HALF, image.depth, 0).double().cpu().numpy()
        picture = (image.color / image.alpha.clamp_min(HALF)[..., None]).clamp(0, 1).cpu().numpy()
        rows, columns = np.nonzero(asked[:, ::-1] & (depth > 0))
        points, normals = (each[rows, columns] for each in smoothed_surface(depth, across))
        facing = reflected(normals, self.normal, 0.0)
        possible, told = np.zeros((2, *depth.shape), bool)
        possible[rows, columns] = ~votes(self.image_of(points), views, facing).empty
        told[rows, columns] = votes(points, views, normals).shown
        told &= depth < DEEPER * _opened(depth, WINDOW)
        whole = _closed(told, WINDOW)
        depth = np.where(whole & ~told, drawn_across(depth, told), depth) if told.any() else depth
        flipped = lambda values: np.ascontiguousarray(values[:, ::-1])
        everywhere = flipped(np.where(depth > 0, depth, np.inf))
        supposed = np.where(flipped(whole & possible), everywhere, np.inf)
        return Drawn(everywhere, supposed, flipped(_closed(told, GAP)), flipped((picture * 255 + 0.5).astype(np.uint8)))


def reflected(points: np.ndarray, normal: np.ndarray, height: float) -> np.ndarray:
    """The images of points [..., 3] in the mirror normal . x = height."""
    return points - 2 * (points @ normal - height)[..., None] * normal


def imaged(mirrors: Sequence[Mirror], camera: Camera, asked: np.ndarray, views: Sequence[Witness]) -> Drawn:
    """What a view shows of all the images, the nearest of those supposed at each pixel; see `Mirror.drawn`."""
    nowhere = np.full(asked.shape, np.inf)
    found = Drawn(nowhere, nowhere, np.zeros_like(asked), np.zeros((*asked.shape, 3), np.uint8))
    for mirror in mirrors:
        each = mirror.drawn(camera, asked, views)
        first = (each.supposed < found.supposed) | (np.isinf(found.supposed) & (each.depth < found.depth))
        found = Drawn(
            np.where(first, each.depth, found.depth),
            np.where(first, each.supposed, found.supposed),
            np.where(first, each.told, found.told),
            np.where(first[..., None], each.picture, found.picture),
        )
    return found


def _closed(mask: np.ndarray, fraction: float) -> np.ndarray:
    """bool [H, W], with gaps closed up to a radius, / image width."""
    disk, reach = _disk(fraction, mask.shape[1])
    padded = np.pad(mask.astype(np.uint8), reach)
    return cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disk)[reach:-reach, reach:-reach] > 0


def _opened(depth: np.ndarray, fraction: float) -> np.ndarray:
    """[H, W] of a depth map, 0 where nothing is shown, that of what is around where it is deeper in a small place."""
    disk, _ = _disk(fraction, depth.shape[1])
    return cv2.morphologyEx(np.where(depth > 0, depth, depth.max()), cv2.MORPH_OPEN, disk)


def _disk(fraction: float, width: int) -> tuple[np.ndarray, int]:
    reach = pixels(fraction, width)
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1)), reach

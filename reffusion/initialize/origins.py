"""The origin of what a view shows in C, the object's pixels, after the object is removed."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from reffusion import geometry
from reffusion.background.model import Background
from reffusion.background.visibility import OPAQUE, is_seen
from reffusion.initialize.draft import EXTRA_VIEW, REFERENCE, Draft
from reffusion.morphology import dilate_square, to_pixels
from reffusion.splat import rasterizer
from reffusion.types import Camera, MaskSet, Rendering

SOURCES = 8  # photographs, at most, with which a view is compared
CONFLICT = 30.0  # levels of 255: mean difference of the channels from which colors are in conflict
STRIDE = 4  # px between the pixels that are compared
BLUR = 0.004  # of the image's width: blur before colors are compared

# Origins of pixels, in the order of the values of `OriginMap.classes`, and the colors of their pictures, RGB.
COLORS = {
    "outside": (0, 0, 0),
    "photographs": (40, 170, 70),
    "conflict": (255, 255, 255),
    "reference": (60, 120, 255),
    "patches": (255, 170, 0),
    "nothing": (220, 30, 50),
}
ORIGINS = tuple(COLORS)


@dataclass(frozen=True)
class OriginMap:
    """The origin of each pixel of a view.

    Attributes:
        classes: uint8 [H, W], index into `ORIGINS`: outside; a surface that other photographs show; conflict, i.e. such
            a surface, or one of a reference, that photographs show in another color; a reference; patches in an extra
            view; nothing, i.e. a surface that no picture shows, or a gap. Pixels outside C that show new Gaussians have
            an origin, too.
        uncovered_share: share in [0, 1] of the pixels of C that show a gap; 0 if C is empty.
    """

    classes: np.ndarray
    uncovered_share: float

    @property
    def picture(self) -> np.ndarray:
        """The origins in colors, uint8 [H, W, 3]."""
        return np.array(list(COLORS.values()), np.uint8)[self.classes]

    @property
    def shares(self) -> dict[str, float]:
        """Origin, except "outside" -> its share in [0, 1] of the pixels that are not outside; 0 without such pixels."""
        counts = np.bincount(self.classes.ravel(), minlength=len(ORIGINS))[1:]
        return {origin: float(count / max(counts.sum(), 1)) for origin, count in zip(ORIGINS[1:], counts, strict=True)}


@torch.no_grad()
def find_origins(draft: Draft, camera: Camera, masks: MaskSet, background: Background | None = None) -> OriginMap:
    """Return the origin of each pixel of a view of the filled scene.

    Args:
        draft: the filled scene.
        camera: the view.
        masks: the view's pixel classes: C, and the pixels of C whose background too few photographs show.
        background: the photographs with which the scene is compared; None to find no conflicts.
    """
    kinds = torch.stack([draft.origin == REFERENCE, draft.origin == EXTRA_VIEW, draft.is_new], -1)
    rendering = rasterizer.render(draft.gaussians, camera, features=kinds.to(draft.gaussians.means))
    assert rendering.features is not None
    reference, patches, new = rendering.features.cpu().numpy().transpose(2, 0, 1)
    gap, mask = rendering.alpha.cpu().numpy() < OPAQUE, masks.consistent
    classes = np.full(gap.shape, ORIGINS.index("nothing"), np.uint8)
    classes[(new <= 0.5) & ~masks.unobserved] = ORIGINS.index("photographs")
    classes[(new > 0.5) & (reference > 0)] = ORIGINS.index("reference")
    if background is not None:
        classes[_find_conflicts(rendering, camera, mask & (patches <= reference), background)] = ORIGINS.index(
            "conflict"
        )
    classes[(new > 0.5) & (patches > reference)] = ORIGINS.index("patches")
    classes[gap] = ORIGINS.index("nothing")
    classes[~mask & ((new <= 0.5) | gap)] = ORIGINS.index("outside")
    return OriginMap(classes, float(gap[mask].mean()) if mask.any() else 0.0)


def _find_conflicts(rendering: Rendering, camera: Camera, pixels: np.ndarray, background: Background) -> np.ndarray:
    """Return bool [H, W], those of `pixels` whose color differs from most photographs that show the surface."""
    grid = np.zeros_like(pixels)
    grid[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE] = True
    rows, columns = np.nonzero(pixels & grid)
    found = np.zeros_like(pixels)
    views = [view for view in background.views if view.camera.name in background.photos]
    if not len(rows) or not views:
        return found
    blur = lambda image: cv2.GaussianBlur(image, (0, 0), to_pixels(BLUR, image.shape[1])).astype(np.float32)
    points = geometry.unproject(rendering.depth.double().cpu().numpy(), camera)[rows, columns]
    own = blur(255 * rendering.color.cpu().numpy())[rows, columns]
    differences = np.full((SOURCES, len(points)), np.nan)
    for number, view in enumerate(views[:: -(-len(views) // SOURCES)]):
        seen = is_seen(view, points)
        color, _ = geometry.sample_nearest(
            blur(background.photos[view.camera.name]), geometry.project(points[seen], view.camera)[0]
        )
        differences[number, seen] = np.abs(color - own[seen]).mean(1)
    found[rows, columns] = (differences > CONFLICT).sum(0) > 0.5 * np.isfinite(differences).sum(0)
    return dilate_square(found, STRIDE // 2) & pixels

"""The origin of what a view shows in C, the object's pixels, after the object is removed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from reffusion.background.visibility import OPAQUE
from reffusion.initialize.draft import EXTRA_VIEW, REFERENCE, Draft
from reffusion.splat import rasterizer
from reffusion.types import Camera, MaskSet

# Origins of pixels, in the order of the values of `OriginMap.classes`, and the colours of their pictures, RGB.
COLORS = {
    "outside": (0, 0, 0),
    "photographs": (40, 170, 70),
    "reference": (60, 120, 255),
    "patches": (255, 170, 0),
    "nothing": (220, 30, 50),
}
ORIGINS = tuple(COLORS)


@dataclass(frozen=True)
class OriginMap:
    """The origin of each pixel of a view.

    Attributes:
        classes: uint8 [H, W], index into `ORIGINS`: outside; a surface that other photographs show; a reference;
            patches in an extra view; nothing, i.e. a surface that no picture shows, or a gap. Pixels outside C that
            show new Gaussians have an origin, too.
        uncovered_share: share in [0, 1] of the pixels of C that show a gap; 0 if C is empty.
    """

    classes: np.ndarray
    uncovered_share: float

    @property
    def picture(self) -> np.ndarray:
        """The origins in colours, uint8 [H, W, 3]."""
        return np.array(list(COLORS.values()), np.uint8)[self.classes]

    @property
    def shares(self) -> dict[str, float]:
        """Origin -> share of the pixels that have one; all 0 if none has."""
        counts = np.bincount(self.classes.ravel(), minlength=len(ORIGINS))[1:]
        return {origin: float(count / max(counts.sum(), 1)) for origin, count in zip(ORIGINS[1:], counts, strict=True)}


@torch.no_grad()
def find_origins(draft: Draft, camera: Camera, masks: MaskSet) -> OriginMap:
    """Return the origin of each pixel of a view of the filled scene.

    Args:
        draft: the filled scene.
        camera: the view.
        masks: the view's pixel classes: C, and the pixels of C whose background no photograph shows.
    """
    kinds = torch.stack([draft.origin == REFERENCE, draft.origin == EXTRA_VIEW, draft.is_new], -1)
    rendering = rasterizer.render(draft.gaussians, camera, features=kinds.to(draft.gaussians.means), sh_degree=0)
    reference, patches, new = rendering.features.cpu().numpy().transpose(2, 0, 1)
    gap, mask = rendering.alpha.cpu().numpy() < OPAQUE, masks.consistent
    classes = np.full(gap.shape, ORIGINS.index("nothing"), np.uint8)
    classes[(new <= 0.5) & ~masks.unobserved] = ORIGINS.index("photographs")
    classes[(new > 0.5) & (reference > 0)] = ORIGINS.index("reference")
    classes[(new > 0.5) & (patches > reference)] = ORIGINS.index("patches")
    classes[gap] = ORIGINS.index("nothing")
    classes[~mask & ((new <= 0.5) | gap)] = ORIGINS.index("outside")
    return OriginMap(classes, float(gap[mask].mean()) if mask.any() else 0.0)

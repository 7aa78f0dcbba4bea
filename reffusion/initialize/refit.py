"""Refit all Gaussians briefly, after the hole is filled, to what is known of the scene without the object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from torch import Tensor

from reffusion.fit.reconstruction import fit
from reffusion.fit.step import REFIT_RATES
from reffusion.metrics.image_metrics import mask_box
from reffusion.params.fit import Densify, LearningRates, Params, SphericalHarmonics
from reffusion.types import Camera, Gaussians, Reference

REFERENCE_SHARE = 1 / 3  # of the steps that show a completed view
CROP_MARGIN = 0.1  # of its size: how far around its completed part a view is rendered
BETAS = (0.8, 0.99)  # Adam's; a short run is better with a short memory


@dataclass(frozen=True)
class Supervision:
    """The pictures to fit to.

    Attributes:
        cameras: the training views.
        photos: view name -> uint8 [H, W, 3].
        hidden: view name -> bool [H, W], where the photograph shows the object, with a margin.
        references: completed views, each valid inside its mask.
    """

    cameras: Sequence[Camera]
    photos: Mapping[str, np.ndarray]
    hidden: Mapping[str, np.ndarray]
    references: Sequence[Reference]


def refit(
    gaussians: Gaussians, has_exact_depth: Tensor, supervision: Supervision, steps: int, seed: int, folder: Path
) -> Gaussians:
    """The Gaussians after `steps` of reconstruction, as many as before and in the same order; resumes from `folder`.

    Photographs supervise outside the masks, completed views inside theirs. This removes what is left of the object's
    blurred rim and of its shadow, and joins old and new surfaces at the seam.

    Args:
        has_exact_depth: [N] bool, Gaussians whose depth came with a reference. They hardly move: disks that drift apart
            leave gaps for nearer views. Estimated depth improves by moving.

    Raises:
        FloatingPointError: see `fit`.
    """
    views, images = list(supervision.cameras), dict(supervision.photos)
    weights = {name: ~mask for name, mask in supervision.hidden.items()}
    repeats = repetitions(supervision)
    for number, (reference, count) in enumerate(zip(supervision.references, repeats, strict=True)):
        camera, image, weight = crop_to_mask(reference)
        for copy in range(count):
            name = f"{camera.name} completed {number}.{copy}"
            views.append(replace(camera, name=name))
            images[name], weights[name] = image, weight
    settings = Params(
        iterations=steps,
        seed=seed,
        sh=SphericalHarmonics(degree=gaussians.sh_degree, every=0.0),
        densify=Densify(stop=0.0, reset_every=0.0),
        lr=LearningRates(betas=BETAS),
    )
    return fit(
        views, images, gaussians, settings, folder=folder, weights=weights, rates=REFIT_RATES, placed=has_exact_depth
    )


def crop_to_mask(reference: Reference) -> tuple[Camera, np.ndarray, np.ndarray]:
    """Camera, picture and weights of the crop around a completed view's mask.

    A pixel has the weight it would have in the whole view. Gaussians outside the crop are not moved by their momentum.
    """
    box, camera = mask_box(reference.mask, CROP_MARGIN), reference.camera
    assert box is not None, f"{camera.name}: nothing of it was completed"
    crop = camera.cropped(box.left, box.top, box.right - box.left, box.bottom - box.top)
    weight = box.crop(reference.mask)
    share = np.float32(weight.size / reference.mask.size)
    return crop, np.ascontiguousarray(box.crop(reference.image)), weight.astype(np.float32) * share


def repetitions(supervision: Supervision) -> list[int]:
    """How often each completed view occurs for one occurrence of each photograph, in proportion to its completed
    pixels: an extra view of a few pixels must not take steps from the reference."""
    sizes = [int(reference.mask.sum()) for reference in supervision.references]
    total = REFERENCE_SHARE / (1 - REFERENCE_SHARE) * len(supervision.cameras)
    return [max(1, round(total * size / max(sum(sizes), 1))) for size in sizes]

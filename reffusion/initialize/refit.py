"""The refit: a short reconstruction after the hole is filled, in which all Gaussians move.

It is supervised by the photographs outside the object and by completed views inside the hole.
"""

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

REFERENCE_SHARE = 1 / 3  # share of the steps that show a completed view
CROP_MARGIN = 0.1  # a completed view is rendered this share of the size of its completed part beyond that part
BETAS = (0.8, 0.99)  # Adam's decay rates; a short run is better with a short memory


@dataclass(frozen=True)
class Supervision:
    """The pictures to which the Gaussians are fitted.

    Attributes:
        cameras: the training views.
        photos: view name -> uint8 [H, W, 3], the photographs.
        hidden: view name -> bool [H, W], the pixels at which the photograph does not supervise: it shows the object
            there (with a margin), or the background there is invented.
        references: completed views, each of which supervises inside its mask.
    """

    cameras: Sequence[Camera]
    photos: Mapping[str, np.ndarray]
    hidden: Mapping[str, np.ndarray]
    references: Sequence[Reference]


def refit(
    gaussians: Gaussians, has_exact_depth: Tensor, supervision: Supervision, steps: int, seed: int, folder: Path
) -> Gaussians:
    """Return the Gaussians after `steps` steps of reconstruction, as many as before and in the same order.

    This removes what is left of the object's blurred rim and of its shadow, and joins remaining and new surfaces at the
    seam. The run resumes from the checkpoint in `folder`, if there is one.

    Args:
        gaussians: the N Gaussians to start from.
        has_exact_depth: bool [N], True for Gaussians that lie on a depth map which came with a reference. Their
            positions hardly move, because disks that drift apart leave gaps that nearer views show. The positions of
            other Gaussians are estimated, and improve by moving.
        supervision: the photographs and completed views.
        steps: number of steps, one view each.
        seed: seed of the order of views and of the random backgrounds.
        folder: receives the trace and the checkpoints.

    Raises:
        FloatingPointError: a loss, gradient or parameter is not finite.
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
    """Crop a completed view, whose mask must not be empty, to the surroundings of its mask.

    The loss is a mean over the pixels of the crop. The weights are therefore scaled by the crop's share of the view, so
    that a pixel counts as much as in the whole view. Gaussians outside the crop are not rendered, and so Adam's
    momentum does not move them.

    Returns:
        The camera of the crop, its picture, uint8 [h, w, 3], and the weights of its pixels, float32 [h, w], which are 0
        outside the mask.
    """
    box, camera = mask_box(reference.mask, CROP_MARGIN), reference.camera
    assert box is not None, f"{camera.name}: nothing of it was completed"
    crop = camera.cropped(box.left, box.top, box.right - box.left, box.bottom - box.top)
    weight = box.crop(reference.mask)
    share = np.float32(weight.size / reference.mask.size)
    return crop, np.ascontiguousarray(box.crop(reference.image)), weight.astype(np.float32) * share


def repetitions(supervision: Supervision) -> list[int]:
    """Return how many times each completed view occurs in a pass that shows every photograph once.

    The numbers are in the order of `supervision.references`. Together the completed views take about `REFERENCE_SHARE`
    of the steps. Each completed view takes a part in proportion to the number of its completed pixels, but occurs at
    least once: an extra view of a few pixels must not take steps from the reference.
    """
    sizes = [int(reference.mask.sum()) for reference in supervision.references]
    total = REFERENCE_SHARE / (1 - REFERENCE_SHARE) * len(supervision.cameras)
    return [max(1, round(total * size / max(sum(sizes), 1))) for size in sizes]

"""After filling: all Gaussians are fitted once more, briefly, to what is known of the scene without the object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from torch import Tensor

from reffusion.fit.reconstruction import fit
from reffusion.fit.step import GENTLE
from reffusion.metrics.image_metrics import mask_box
from reffusion.params.fit import Densify, LearningRates, Params, SphericalHarmonics
from reffusion.types import Camera, Gaussians, Reference

REFERENCE_SHARE = 1 / 3  # of the steps that look at a completed view
REACHED = 0.1  # of its size: how far around what was completed the view is drawn
BETAS = (0.8, 0.99)  # a short run is better off with a short memory


@dataclass(frozen=True)
class Known:
    """The pictures to settle to.

    Attributes:
        cameras: the training views.
        photos: view name -> uint8 [H, W, 3].
        hidden: view name -> bool [H, W], where the photograph shows the object, and a margin around.
        references: completed views, each true within its mask.
    """

    cameras: Sequence[Camera]
    photos: Mapping[str, np.ndarray]
    hidden: Mapping[str, np.ndarray]
    references: Sequence[Reference]


def settle(gaussians: Gaussians, exact: Tensor, known: Known, steps: int, seed: int, folder: Path) -> Gaussians:
    """The Gaussians after `steps` of reconstruction, as many as before and in their order; resumes from `folder`.

    The photographs supervise outside the masks, completed views where they were completed. What is left of the
    object's blurred rim, and what hid in its shadow, is so put right; surfaces old and new grow together at the seam.

    Args:
        exact: [N] bool, Gaussians whose depth was brought. They hardly move: disks that drift apart leave gaps to be
            seen through from nearer by. Where depth is a guess it is better that they may.
    Raises:
        FloatingPointError: see `fit`.
    """
    views, images = list(known.cameras), dict(known.photos)
    weights = {name: ~mask for name, mask in known.hidden.items()}
    for number, (reference, turns) in enumerate(zip(known.references, turns_of(known), strict=True)):
        window, image, counts = around(reference)
        for copy in range(turns):
            name = f"{window.name} completed {number}.{copy}"
            views.append(replace(window, name=name))
            images[name], weights[name] = image, counts
    settings = Params(
        iterations=steps,
        seed=seed,
        sh=SphericalHarmonics(degree=gaussians.sh_degree, every=0.0),
        densify=Densify(stop=0.0, reset_every=0.0),
        lr=LearningRates(betas=BETAS),
    )
    return fit(views, images, gaussians, settings, folder=folder, weights=weights, rates=GENTLE, placed=exact)


def around(reference: Reference) -> tuple[Camera, np.ndarray, np.ndarray]:
    """Camera, picture and weights of the part of a completed view that counts; a pixel pulls as it would in the whole,
    and Gaussians beside it are not moved by what is left of their momentum."""
    box, camera = mask_box(reference.mask, REACHED), reference.camera
    assert box is not None, f"{camera.name}: nothing of it was completed"
    window = camera.cropped(box.left, box.top, box.right - box.left, box.bottom - box.top)
    counts = box.crop(reference.mask)
    share = np.float32(counts.size / reference.mask.size)
    return window, np.ascontiguousarray(box.crop(reference.image)), counts.astype(np.float32) * share


def turns_of(known: Known) -> list[int]:
    """How often each completed view is looked at while each photograph is once: by how much of it was completed, so
    that a few pixels of a further view do not cost the reference its turns."""
    sizes = [int(reference.mask.sum()) for reference in known.references]
    turns = REFERENCE_SHARE / (1 - REFERENCE_SHARE) * len(known.cameras)
    return [max(1, round(turns * size / max(sum(sizes), 1))) for size in sizes]

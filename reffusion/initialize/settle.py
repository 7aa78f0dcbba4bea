"""After filling: all Gaussians are fitted once more, briefly, to what is known of the scene without the object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from reffusion.fit.reconstruction import fit
from reffusion.fit.step import GENTLE
from reffusion.params.fit import Densify, LearningRates, Params, SphericalHarmonics
from reffusion.score.metrics import mask_box
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians, Reference

REFERENCE_SHARE = 1 / 3  # of the steps that look at a completed view
AROUND = 0.75  # of the mask's size: how far around it photographs are looked at
MUCH = 0.5  # share of the pictures in their windows, from which hardly any Gaussian lies outside all
REACHED = 0.1  # the same, of completed views
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


def settle(gaussians: Gaussians, known: Known, steps: int, seed: int, folder: Path) -> Gaussians:
    """The Gaussians after `steps` of reconstruction, as many as before and in their order; resumes from `folder`.

    The photographs supervise outside the masks, completed views where they were completed. What is left of the
    object's blurred rim, and what hid in its shadow, is so put right; surfaces old and new grow together at the seam.

    Raises:
        FloatingPointError: see `fit`.
    """
    looks = [
        _Look(camera, known.photos[camera.name], ~known.hidden[camera.name], _around(known.hidden[camera.name]))
        for camera in known.cameras
    ]
    for number, (reference, turns) in enumerate(zip(known.references, turns_of(known), strict=True)):
        look = _Look(reference.camera, reference.image, reference.mask, _around(reference.mask, REACHED))
        name = f"{reference.camera.name} completed {number}"
        looks += [replace(look, camera=replace(look.camera, name=f"{name}.{copy}")) for copy in range(turns)]
    views = [look.window() for look in looks]
    images = {look.camera.name: look.of(look.image) for look in looks}
    weights = {look.camera.name: look.weights() for look in looks}
    settings = Params(
        iterations=steps,
        seed=seed,
        sh=SphericalHarmonics(degree=gaussians.sh_degree, every=0.0),
        densify=Densify(stop=0.0, reset_every=0.0),
        lr=LearningRates(betas=BETAS),
    )
    # What no window shows would not move, and need not be looked at in each step; if it is much.
    windows = sum(view.width * view.height for view in views) / sum(look.true.size for look in looks)
    shown = _shown(gaussians, views) if windows < MUCH else torch.arange(len(gaussians), device=gaussians.means.device)
    moved = fit(views, images, gaussians.map(lambda p: p[shown]), settings, folder=folder, weights=weights, rates=GENTLE)
    return gaussians.zipped(moved, lambda whole, part: whole.index_put((shown,), part))


@torch.no_grad()
def _shown(gaussians: Gaussians, views: Sequence[Camera]) -> torch.Tensor:
    """[M], indices of the Gaussians that reach any of the views."""
    reached, done = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device), set()
    for view in views:
        place = (view.width, view.height, view.cx, view.cy, view.world_to_camera.tobytes())
        if place not in done:  # completed views come several times
            reached |= rasterizer.render(gaussians, view, sh_degree=0).radii > 0
            done.add(place)
    return torch.nonzero(reached)[:, 0]


@dataclass(frozen=True)
class _Look:
    """A picture [H, W, 3] that counts where `true`, bool [H, W], and the window of it that is looked at: columns and
    rows."""

    camera: Camera
    image: np.ndarray
    true: np.ndarray
    around: tuple[slice, slice]

    def of(self, whole: np.ndarray) -> np.ndarray:
        columns, rows = self.around
        return np.ascontiguousarray(whole[rows, columns])

    def window(self) -> Camera:
        columns, rows = self.around
        return self.camera.cropped(columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start)

    def weights(self) -> np.ndarray:
        """[h, w] float32: a pixel pulls as hard as it would in the whole picture."""
        seen = self.of(self.true)
        return seen.astype(np.float32) * np.float32(seen.size / self.true.size)


def _around(mask: np.ndarray, beyond: float = AROUND) -> tuple[slice, slice]:
    """Columns and rows around the mask, bool [H, W], and so much of its size beyond it; all where it is empty."""
    box = mask_box(mask, beyond)
    if box is None:
        return slice(0, mask.shape[1]), slice(0, mask.shape[0])
    return slice(box.left, box.right), slice(box.top, box.bottom)


def turns_of(known: Known) -> list[int]:
    """How often each completed view is looked at while each photograph is once: by how much of it was completed, so
    that a few pixels of a further view do not cost the reference its turns."""
    sizes = [int(reference.mask.sum()) for reference in known.references]
    turns = REFERENCE_SHARE / (1 - REFERENCE_SHARE) * len(known.cameras)
    return [max(1, round(turns * size / max(sum(sizes), 1))) for size in sizes]

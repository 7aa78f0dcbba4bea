"""Can score distillation gain anything? By what needs no truth: how well the initialization shows photographs.

The embedded prior, adapted to the reference, improves pictures of up to `TAUGHT` dB, at its own size, where whole views
are reduced to `SIDE` px, and spoils better ones (docs/distillation.md). What stands in the hole is not known; just
beside it photographs are, and in the hole renders are some `WORSE` dB worse than there. That tells nothing of what no
reference shows: patches of photographs are a guess.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from reffusion.prior.windows import two_scale_masks, two_scales
from reffusion.splat import rasterizer
from reffusion.trace import decibels
from reffusion.types import Camera, Gaussians, MaskSet

SIDE = 64  # px: the embedded prior's own
TAUGHT = 26.0  # dB
WORSE = 8.5  # dB
BESIDE = 4  # px of the reduced view: how far from the mask
VIEWS = 12  # that are looked at, spread evenly
GUESSED = 0.05  # of what a view's mask hides: 0.19 where SDS gained (`demo-corner`), below 0.03 elsewhere


class Gain(NamedTuple):
    """Whether SDS may gain, in `says` why, and the PSNR in dB beside the hole (None where nothing was compared)."""

    may: bool
    says: str
    beside: float | None


@torch.no_grad()
def estimated(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    sets: Mapping[str, MaskSet],
    photos: Mapping[str, np.ndarray],
    guessed: float = 0.0,
) -> Gain:
    """Of an initialization from references, by the training views in which something is invented.

    Args:
        photos: view name -> uint8 [H, W, 3]; views without one are not looked at.
        guessed: the largest part of a view's mask that no reference covers, and patches fill.
    """
    asked = [camera for camera in cameras if camera.name in photos and sets[camera.name].invent.any()]
    some = [asked[k] for k in np.unique(np.linspace(0, len(asked) - 1, VIEWS).round().astype(int))] if asked else []
    made_up = lambda name: sets[name].consistent | sets[name].invent  # what is put in has nothing removed behind it
    found = [_beside(gaussians, each, made_up(each.name), photos[each.name]) for each in some]
    squared = torch.cat(found) if found else torch.zeros(0)
    if not len(squared):
        return Gain(True, "no photograph tells how good the initialization is", None)
    beside = decibels(float(squared.mean()))
    says = f"beside the hole renders show photographs at {beside:.1f} dB, so about {beside - WORSE:.1f} dB in it"
    if guessed > GUESSED:
        return Gain(True, f"no reference covers {guessed:.0%} of a view's mask, and patches are a guess", beside)
    return Gain(beside - WORSE < TAUGHT, f"{says}; the embedded prior teaches up to {TAUGHT:g} dB", beside)


def _beside(gaussians: Gaussians, camera: Camera, hidden: np.ndarray, photo: np.ndarray) -> Tensor:
    """[N, 3]: squared errors of the pixels of the reduced view that lie beside the mask, bool [H, W]."""
    small = lambda image: two_scales(image.permute(2, 0, 1).float().cpu(), [], SIDE)[0]
    drawn = rasterizer.render(gaussians, camera).color.clamp(0, 1)
    mask = two_scale_masks(torch.from_numpy(hidden), [], SIDE)
    near = (F.max_pool2d(mask, 2 * BESIDE + 1, 1, BESIDE) > mask)[0, 0]
    return (small(drawn) - small(torch.from_numpy(photo) / 255)).square()[:, near].T

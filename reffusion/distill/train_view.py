"""The images that distillation is computed on: training views, and the holes of the references."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from reffusion.types import Camera


@dataclass(frozen=True)
class TrainView:
    """A training view as distillation uses it.

    Attributes:
        camera: the view.
        photo: [H, W, 3], uint8 (a quarter of the memory of float32, with hundreds of views) or float32 in [0, 1].
        supervises: [H, W] bool, the pixels whose photo may supervise: outside C, I and the object's shadow; all of a
            clean view.
        repaint: [H, W] bool, the hole: pixels that are made up, and that the UNet repaints. Empty if the view is not
            distilled.
        clean: the object is absent from this view.
        lifted: [H, W, 3] float32 in [0, 1], the view inpainted in 2D; None if it was not inpainted.
    """

    camera: Camera
    photo: Tensor
    supervises: Tensor
    repaint: Tensor
    clean: bool
    lifted: Tensor | None = None

    @property
    def picture(self) -> Tensor:
        """The photo, [H, W, 3] float32 in [0, 1]."""
        return self.photo / 255 if self.photo.dtype == torch.uint8 else self.photo


class ReferenceHole(NamedTuple):
    """A reference image and the pixels it was made for.

    Attributes:
        image: [H, W, 3] in [0, 1].
        hole: [H, W] bool, the pixels that the reference invents.
    """

    camera: Camera
    image: Tensor
    hole: Tensor

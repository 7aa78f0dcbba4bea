"""The images on which the loss is computed: training views, and references with their holes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from reffusion.types import Camera


@dataclass(frozen=True)
class TrainView:
    """A training view, with the pixels that the terms of the loss use.

    Attributes:
        camera: The camera of the view.
        photo: [H, W, 3], uint8 (a quarter of the memory of float32, with hundreds of views) or float32 in [0, 1].
        supervises: bool [H, W], True at pixels whose photograph may supervise: outside the consistent mask C (the
            object), the invent mask I (the pixels to invent), the object's shadow and the pixels that the scene
            ignores. In a clean view C and I do not matter. In a view without a photograph no pixel may supervise.
        repaint: bool [H, W], True in the hole: the pixels that are invented and that the UNet repaints. It is all False
            if the view is not distilled, such as a clean view.
        clean: True if the object is absent from this view.
        lifted: [H, W, 3] float32 in [0, 1], the view inpainted in 2D by the stage `lift`; None if there is no such
            image.
    """

    camera: Camera
    photo: Tensor
    supervises: Tensor
    repaint: Tensor
    clean: bool
    lifted: Tensor | None = None

    @property
    def picture(self) -> Tensor:
        """Return the photograph, [H, W, 3] float32 in [0, 1]."""
        return self.photo / 255 if self.photo.dtype == torch.uint8 else self.photo


class ReferenceHole(NamedTuple):
    """A reference (a view completed in 2D) and the pixels that it completes.

    Attributes:
        camera: The camera of the view.
        image: [H, W, 3] in [0, 1], the completed view.
        hole: bool [H, W], True at the pixels that the reference invents.
    """

    camera: Camera
    image: Tensor
    hole: Tensor

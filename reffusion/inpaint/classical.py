"""Deterministic 2D inpainting: OpenCV's methods, and the network LaMa from a local TorchScript file.

Nothing is downloaded. Holes are bool [H, W], True for the pixels to fill.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from reffusion.io.images import fitting_size

SIZE_MULTIPLE = 8  # px: LaMa halves an image three times
FSR_SIDE = 160  # px, longer side to which images are reduced for FSR: larger ones take longer and get no sharper
TELEA_RADIUS = 5  # px, radius around each pixel from which Telea's method takes colors


@dataclass(frozen=True)
class Painter:
    """A 2D inpainter.

    Attributes:
        name: the method and its weights, so that a table of results can say what filled the holes.
        paint: function (image uint8 [H, W, 3], hole bool [H, W]) -> uint8 [H, W, 3]. The result equals the image
            outside the hole, and does not depend on the image inside the hole.
    """

    name: str
    paint: Callable[[np.ndarray, np.ndarray], np.ndarray]


def load_classical() -> Painter:
    """Return OpenCV's FSR as a painter, or Telea's method if FSR is missing in this OpenCV or does not work."""
    return Painter(f"OpenCV FSR fast, {FSR_SIDE} px", fsr) if _fsr_works() else _TELEA


def load_lama(file: Path, device: str = "cpu") -> Painter:
    """Load LaMa from a TorchScript file.

    Raises:
        ValueError: the file is no TorchScript module.
    """
    try:
        module = torch.jit.load(file, map_location=device).eval()
    except (RuntimeError, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise ValueError(f"LaMa: {file} is no TorchScript module ({reason}); big-lama.pt is one") from error
    return Painter(f"LaMa ({file.name})", lambda image, hole: lama(module, image, hole, device))


@torch.no_grad()
def lama(module: torch.nn.Module, image: np.ndarray, hole: np.ndarray, device: str = "cpu") -> np.ndarray:
    """Return the image, uint8 [H, W, 3], with its hole filled by one forward pass of LaMa.

    Args:
        module: takes an image [1, 3, H, W] in [0, 1] and a mask [1, 1, H, W], which is 1 in the hole. The sides of both
            are multiples of 8. The module returns an image of the same size in [0, 1].
        image: uint8 [H, W, 3], of any size; it is padded.
        hole: bool [H, W], the pixels to fill.
        device: the device of the module.

    Raises:
        ValueError: the module's output has another shape than its input, or is not finite.
    """
    height, width = hole.shape
    padding = (0, -width % SIZE_MULTIPLE, 0, -height % SIZE_MULTIPLE)
    known = torch.from_numpy(blank_hole(image, hole)).to(device).permute(2, 0, 1)[None] / 255
    mask = torch.from_numpy(hole).to(device, torch.float32)[None, None]
    known, mask = (F.pad(tensor, padding, mode="replicate") for tensor in (known, mask))
    answer = module(known, mask)
    if answer.shape != known.shape or not torch.isfinite(answer).all():
        raise ValueError(f"LaMa: the module's answer to {list(known.shape)} is {list(answer.shape)}, or not finite")
    picture = (answer[0, :, :height, :width].clamp(0, 1) * 255).round().byte().permute(1, 2, 0).cpu().numpy()
    return paste_hole(image, picture, hole)


def fsr(image: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """Return the image, uint8 [H, W, 3], with its hole filled by OpenCV's frequency selective reconstruction (FSR).

    The hole is filled in an image whose longer side is at most `FSR_SIDE` px; this content is then enlarged.
    """
    if not hole.any():
        return image.copy()
    size = fitting_size(hole.shape[1], hole.shape[0], FSR_SIDE)
    # Without the weights the zeros in the hole would darken the pixels around it.
    weight = cv2.resize((~hole).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    small = cv2.resize(blank_hole(image, hole).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    small = np.round(small / np.maximum(weight, 1e-3)[..., None]).clip(0, 255).astype(np.uint8)
    known = np.where(weight < 1 - 1e-4, 0, 255).astype(np.uint8)
    small[known == 0] = 0
    painted = np.zeros_like(small)
    cv2.xphoto.inpaint(small, known, painted, cv2.xphoto.INPAINT_FSR_FAST)
    return paste_hole(image, cv2.resize(painted, hole.shape[::-1], interpolation=cv2.INTER_CUBIC), hole)


def telea(image: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """Return the image, uint8 [H, W, 3], with its hole filled by OpenCV's fast marching method (Telea, 2004)."""
    painted = cv2.inpaint(blank_hole(image, hole), hole.astype(np.uint8), TELEA_RADIUS, cv2.INPAINT_TELEA)
    return paste_hole(image, painted, hole)


_TELEA = Painter(f"OpenCV Telea, radius {TELEA_RADIUS} px", telea)


def _fsr_works() -> bool:
    """Return whether FSR fills a small hole in a uniform image."""
    hole = np.zeros((16, 16), bool)
    hole[6:10, 6:10] = True
    try:
        return bool((fsr(np.full((16, 16, 3), 90, np.uint8), hole) > 0).all())
    except (AttributeError, cv2.error):  # OpenCV without contrib modules, or built without this one
        return False


def blank_hole(image: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """Return a copy of the image, uint8 [H, W, 3], with zeros in the hole, bool [H, W]."""
    return np.where(hole[..., None], np.uint8(0), image)


def paste_hole(image: np.ndarray, painted: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """Return a new array [H, W, 3], the colors of `painted` inside the hole, bool [H, W], and of `image` outside."""
    return np.where(hole[..., None], painted, image)

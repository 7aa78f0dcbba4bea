"""Loading of 2D inpainters, and use of the feed-forward networks LaMa and MI-GAN from files on this machine.

A network of fixed input size gets a resized crop around the hole; any other network gets the whole image. (MI-GAN's
published pipeline takes images of any size, and crops and resizes them itself.) Holes are bool [H, W], True for the
pixels to fill.
"""

from __future__ import annotations

import cv2
import numpy as np

from reffusion.inpaint import classical, onnx_model
from reffusion.inpaint.classical import Painter
from reffusion.inpaint.onnx_model import Network
from reffusion.params.inpainter import Inpainter
from reffusion.weights import painters
from reffusion.weights.published import PAINTERS

DTYPES = {"lama": "float32", "migan": "uint8"}  # type of the images that the ONNX models take


def load_inpainter(inpainter: Inpainter, device: str = "cpu") -> Painter | None:
    """Load an inpainter that needs only an image and a hole: "lama", "migan" or "fsr" (OpenCV).

    The kind "auto" is replaced by the best feed-forward inpainter on this machine, or else by "exemplar".

    Args:
        inpainter: the setting.
        device: runs TorchScript files (.pt, LaMa only). ONNX files (.onnx) run on the CPU.

    Returns:
        None for the kinds that need more than an image and a hole: "exemplar" needs the scene, "diffusion" the prior,
        and those of `SEED_KINDS` a seed.

    Raises:
        ValueError: the file is missing, is not the only one, or is of another kind; or onnxruntime is missing.
    """
    inpainter = painters.resolve_inpainter(inpainter)
    if inpainter.kind == "fsr":
        return classical.load_classical()
    if inpainter.kind not in PAINTERS:
        return None
    file = painters.find_file(inpainter)
    if file.suffix == ".pt":
        return classical.load_lama(file, device)
    network, name = onnx_model.load(file, DTYPES[inpainter.kind]), f"{PAINTERS[inpainter.kind].name} ({file.name})"
    return Painter(name, lambda image, hole: run_network(network, image, hole))


def run_network(network: Network, image: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """Return a copy of the image, uint8 [H, W, 3], with its hole, bool [H, W], filled by the network.

    Pixels outside the hole are unchanged. Raises ValueError as `Network.paint` does.
    """
    if not hole.any():
        return image.copy()
    crop = crop_around(hole, network.side) if network.side else (slice(None), slice(None))
    inner = hole[crop]
    # The hole is prefilled smoothly, because from a black hole black would reach the rim: by resizing, or where a
    # pipeline blends its output with its input (MI-GAN's does so over 3 px).
    prefilled = classical.telea(image[crop], inner)
    height, width = inner.shape
    padded = (max(height, width),) * 2 if network.side else (_round_up(height), _round_up(width))
    padding = ((0, padded[0] - height), (0, padded[1] - width))
    prefilled, mask = np.pad(prefilled, (*padding, (0, 0)), "symmetric"), np.pad(inner, padding, "symmetric")
    size = (network.side, network.side) if network.side else padded
    answer = resize(network.paint(resize(prefilled, size), resize_hole(mask, size)), padded)
    result = image.copy()
    result[crop] = answer[:height, :width]
    return classical.paste_hole(image, result, hole)


def crop_around(hole: np.ndarray, side: int) -> tuple[slice, slice]:
    """Return the rows and columns of a square crop around the hole, bool [H, W], which must not be empty.

    The side of the square is twice the longer side of the hole's bounding box and at least `side` px, but at most the
    shorter side of the image. If the hole is longer than the shorter side of the image, the crop is a rectangle that
    takes all of this shorter side.
    """
    spans = [np.flatnonzero(hole.any(axis)) for axis in (1, 0)]
    longest = max(int(span[-1] - span[0]) + 1 for span in spans)
    length = max(longest, min(max(2 * longest, side), *hole.shape))

    def within(span: np.ndarray, size: int) -> slice:
        first = int(np.clip((span[0] + span[-1] + 1 - length) // 2, 0, max(size - length, 0)))
        return slice(first, min(first + length, size))

    return within(spans[0], hole.shape[0]), within(spans[1], hole.shape[1])


def _round_up(length: int) -> int:
    """Return the smallest multiple of `SIZE_MULTIPLE` that is not less than `length`, in px."""
    return length + -length % classical.SIZE_MULTIPLE


def resize(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return the picture, uint8 [H, W, 3], resized to `size` (height, width)."""
    method = cv2.INTER_AREA if size[0] < picture.shape[0] else cv2.INTER_CUBIC
    return picture if size == picture.shape[:2] else cv2.resize(picture, size[::-1], interpolation=method)


def resize_hole(hole: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return the hole, bool [H, W], resized to `size` (height, width). A pixel that holds any part of it is True."""
    method = cv2.INTER_AREA if size[0] < hole.shape[0] else cv2.INTER_LINEAR
    return cv2.resize(hole.astype(np.float32), size[::-1], interpolation=method) > 0

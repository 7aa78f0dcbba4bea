"""Loads 2D inpainters, and runs the feed-forward ones from a file on this machine: LaMa and MI-GAN.

A network of fixed input size gets a crop around the hole, resized; any other the whole image. (MI-GAN's published
pipeline takes any size, and crops and resizes itself.)
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

DTYPES = {"lama": "float32", "migan": "uint8"}  # of the ONNX models' images


def load_inpainter(inpainter: Inpainter, device: str = "cpu") -> Painter | None:
    """Loads the inpainter of kind "lama", "migan" or "fsr" (OpenCV), or the one that "auto" stands for.

    TorchScript (.pt, LaMa only) runs on `device`, ONNX (.onnx) on the CPU.

    Returns:
        None for the kinds that need more than an image and a hole: "exemplar" the scene, "diffusion" the prior.
    Raises:
        ValueError: no such file or several, no onnxruntime, or a file of another kind.
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
    """The image, uint8 [H, W, 3], with its hole, bool [H, W], filled by the network; nothing else changes."""
    if not hole.any():
        return image.copy()
    crop = crop_around(hole, network.side) if network.side else (slice(None), slice(None))
    inner = hole[crop]
    # The hole is prefilled smoothly, so that no black reaches the rim: by resizing, or where a pipeline blends its
    # answer with its input (MI-GAN's does over 3 px).
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
    """Rows and columns of a square around the hole, bool [H, W].

    Its side is twice the longer side of the hole's bounding box and at least `side` px, but at most the image's shorter
    side. If the hole is longer than that, the crop is a rectangle that takes all of the shorter side.
    """
    spans = [np.flatnonzero(hole.any(axis)) for axis in (1, 0)]
    longest = max(int(span[-1] - span[0]) + 1 for span in spans)
    length = max(longest, min(max(2 * longest, side), *hole.shape))

    def within(span: np.ndarray, size: int) -> slice:
        first = int(np.clip((span[0] + span[-1] + 1 - length) // 2, 0, max(size - length, 0)))
        return slice(first, min(first + length, size))

    return within(spans[0], hole.shape[0]), within(spans[1], hole.shape[1])


def _round_up(length: int) -> int:
    """The next multiple of `SIZE_MULTIPLE`, in px."""
    return length + -length % classical.SIZE_MULTIPLE


def resize(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The picture, uint8 [H, W, 3], resized to (height, width)."""
    method = cv2.INTER_AREA if size[0] < picture.shape[0] else cv2.INTER_CUBIC
    return picture if size == picture.shape[:2] else cv2.resize(picture, size[::-1], interpolation=method)


def resize_hole(hole: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The hole, bool [H, W], resized to (height, width): a pixel is set if it holds any part of the hole."""
    method = cv2.INTER_AREA if size[0] < hole.shape[0] else cv2.INTER_LINEAR
    return cv2.resize(hole.astype(np.float32), size[::-1], interpolation=method) > 0

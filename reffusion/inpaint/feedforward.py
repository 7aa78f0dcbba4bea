"""Feed-forward 2D inpainters from a file on this machine: LaMa and MI-GAN.

A network of fixed size is shown the hole's surroundings, scaled to that size; another one the whole picture. (MI-GAN's
published pipeline takes any size, and cuts and scales itself.)
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from reffusion.inpaint import classical, onnx_model
from reffusion.inpaint.classical import Painter
from reffusion.inpaint.onnx_model import Network
from reffusion.weights import painters
from reffusion.weights.published import PAINTERS

DTYPES = {"lama": "float32", "migan": "uint8"}


def load(inpainter: str, source: str | Path = "", device: str = "cpu") -> Painter:
    """The inpainter "lama" or "migan" from a file, or the folder of one, by default the published one: TorchScript
    (.pt, LaMa's only) on `device`, ONNX (.onnx) on the CPU.

    Raises:
        ValueError: no such file or several, no onnxruntime, or a file of something else.
    """
    file = painters.file_of(inpainter, source)
    if file.suffix == ".pt":
        return classical.load(file, device)
    network = onnx_model.load(file, DTYPES[inpainter])
    return Painter(f"{PAINTERS[inpainter].name} ({file.name})", lambda image, hole: painted(network, image, hole))


def load_by_name(inpainter: str, device: str = "cpu") -> Painter:
    """ "fsr", or the published "lama" or "migan"."""
    return classical.load_classical() if inpainter == "fsr" else load(inpainter, "", device)


def painted(network: Network, image: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """The picture, uint8 [H, W, 3], with its hole, bool [H, W], as the network fills it, and nothing else changed."""
    if not hole.any():
        return image.copy()
    place = around(hole, network.side) if network.side else (slice(None), slice(None))
    inner = hole[place]
    # Smoothly filled, so that no black reaches the rim: by scaling, or where a pipeline blends its answer with what it
    # was given (MI-GAN's does over 3 px).
    shown = classical.telea(image[place], inner)
    height, width = inner.shape
    whole = (max(height, width),) * 2 if network.side else (_divisible(height), _divisible(width))
    beyond = ((0, whole[0] - height), (0, whole[1] - width))
    shown, mask = np.pad(shown, (*beyond, (0, 0)), "symmetric"), np.pad(inner, beyond, "symmetric")
    size = (network.side, network.side) if network.side else whole
    answer = scaled(network.paint(scaled(shown, size), scaled_hole(mask, size)), whole)
    result = image.copy()
    result[place] = answer[:height, :width]
    return classical.paste_hole(image, result, hole)


def around(hole: np.ndarray, side: int) -> tuple[slice, slice]:
    """Rows and columns of a square around all of the hole, bool [H, W]: twice as long as the hole and at least `side`
    px, as far as the picture has it. Where the hole is longer than the picture's shorter side, no square: all of that.
    """
    spans = [np.flatnonzero(hole.any(axis)) for axis in (1, 0)]
    longest = max(int(span[-1] - span[0]) + 1 for span in spans)
    length = max(longest, min(max(2 * longest, side), *hole.shape))

    def within(span: np.ndarray, size: int) -> slice:
        first = int(np.clip((span[0] + span[-1] + 1 - length) // 2, 0, max(size - length, 0)))
        return slice(first, min(first + length, size))

    return within(spans[0], hole.shape[0]), within(spans[1], hole.shape[1])


def _divisible(length: int) -> int:
    return length + -length % classical.MULTIPLE


def scaled(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The picture, uint8 [H, W, 3], at another size (height, width)."""
    way = cv2.INTER_AREA if size[0] < picture.shape[0] else cv2.INTER_CUBIC
    return picture if size == picture.shape[:2] else cv2.resize(picture, size[::-1], interpolation=way)


def scaled_hole(hole: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The hole, bool [H, W], at another size (height, width): every pixel that has any part of it."""
    way = cv2.INTER_AREA if size[0] < hole.shape[0] else cv2.INTER_LINEAR
    return cv2.resize(hole.astype(np.float32), size[::-1], interpolation=way) > 0

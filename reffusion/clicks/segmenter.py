"""One interface to promptable segmentation networks: SAM through transformers, a distilled SAM through onnxruntime.

Both take a square picture and prompts in its pixels, and answer with several masks: of a part, and of the whole.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from reffusion.clicks.marks import Clicks

# Mean and standard deviation of ImageNet's pixels, with which these networks are trained.
MEAN, DEVIATION = np.array((0.485, 0.456, 0.406), np.float32), np.array((0.229, 0.224, 0.225), np.float32)
NEGATIVE, POSITIVE, UPPER_LEFT, LOWER_RIGHT = 0, 1, 2, 3  # SAM's labels of points and of a box's corners


@dataclass(frozen=True)
class Segmenter:
    """A promptable segmentation network.

    Attributes:
        name: for messages.
        side: of its square input, px.
        encode: float32 [1, 3, side, side], normalised -> features of the picture.
        decode: (features, points float32 [K, 2] px of the input, labels [K]) -> (logits float32 [M, h, w] of the whole
            square, estimated IoU [M]); the last mask is that of the largest object.
    """

    name: str
    side: int
    encode: Callable[[np.ndarray], Any]
    decode: Callable[[Any, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class ImageFeatures:
    """The network's features of a picture, independent of prompts; computing them takes most of the time.

    Attributes:
        values: whatever the network's `decode` takes.
        shape: (height, width) of the picture; size: the same inside the network's square input.
    """

    values: Any
    shape: tuple[int, int]
    size: tuple[int, int]


@dataclass(frozen=True)
class Prompt:
    """What a mask shall contain, in pixels of the picture.

    Attributes:
        clicks: points on the object, and on what is not.
        box: (left, top, right, bottom) around the object; None: unknown.
    """

    clicks: Clicks
    box: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class Candidate:
    """A mask, bool [H, W], and the IoU that the network expects of it."""

    mask: np.ndarray
    score: float


def encode_image(segmenter: Segmenter, image: np.ndarray) -> ImageFeatures:
    """Encode a picture, uint8 [H, W, 3]: its larger side is scaled to the network's; it is padded below and to the
    right."""
    shape = image.shape[:2]
    height, width = (max(1, round(side * segmenter.side / max(shape))) for side in shape)
    resampling = cv2.INTER_AREA if segmenter.side < max(shape) else cv2.INTER_LINEAR
    square = np.zeros((segmenter.side, segmenter.side, 3), np.float32)
    scaled = cv2.resize(image, (width, height), interpolation=resampling)
    square[:height, :width] = (scaled.astype(np.float32) / 255 - MEAN) / DEVIATION
    values = segmenter.encode(np.ascontiguousarray(square.transpose(2, 0, 1)[None]))
    return ImageFeatures(values, (shape[0], shape[1]), (height, width))


def predict_masks(segmenter: Segmenter, features: ImageFeatures, prompt: Prompt) -> list[Candidate]:
    """The network's masks for a prompt, from parts of an object to the whole.

    Raises:
        ValueError: the prompt is empty.
        FloatingPointError: the network's answer is not finite.
    """
    points = [prompt.clicks.points]
    labels = [np.where(prompt.clicks.positive, POSITIVE, NEGATIVE)]
    if prompt.box is not None:
        points.append(np.reshape(prompt.box, (2, 2)))
        labels.append(np.array([UPPER_LEFT, LOWER_RIGHT]))
    if not sum(map(len, labels)):
        raise ValueError("a prompt without clicks and box")
    scale = np.array(features.size[::-1]) / features.shape[::-1]
    at = (np.concatenate(points) * scale).astype(np.float32)
    logits, scores = segmenter.decode(features.values, at, np.concatenate(labels).astype(np.int64))
    if not np.isfinite(logits).all():
        raise FloatingPointError(f"{segmenter.name}: its answer is not finite")
    return [
        Candidate(_to_picture(each, segmenter.side, features) > 0, float(q))
        for each, q in zip(logits, scores, strict=True)
    ]


def _to_picture(logits: np.ndarray, side: int, features: ImageFeatures) -> np.ndarray:
    """float32 [H, W]: logits [h, w] of the square input at the picture's pixels."""
    height, width = features.size
    square = cv2.resize(logits.astype(np.float32), (side, side), interpolation=cv2.INTER_LINEAR)
    inside = np.ascontiguousarray(square[:height, :width])
    return cv2.resize(inside, features.shape[::-1], interpolation=cv2.INTER_LINEAR)

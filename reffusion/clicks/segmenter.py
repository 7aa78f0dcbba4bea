"""Common interface of two promptable segmentation networks: SAM of transformers, and a distilled SAM in ONNX files.

Both networks take a square picture and a prompt in pixels of this square. Both answer with several masks, from a part
of an object to the whole object.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from reffusion.clicks.marks import Clicks

# Mean and standard deviation of ImageNet's pixels, by which the inputs of these networks are normalized.
MEAN, DEVIATION = np.array((0.485, 0.456, 0.406), np.float32), np.array((0.229, 0.224, 0.225), np.float32)
NEGATIVE, POSITIVE, UPPER_LEFT, LOWER_RIGHT = 0, 1, 2, 3  # SAM's labels of points and of a box's corners


@dataclass(frozen=True)
class Segmenter:
    """A promptable segmentation network.

    Attributes:
        name: name of the network for messages.
        side: side of the square input, px.
        encode: normalized picture float32 [1, 3, side, side] -> features of the picture.
        decode: (features, points float32 [K, 2] in pixels of the input, labels int [K]: NEGATIVE, POSITIVE, UPPER_LEFT
            or LOWER_RIGHT) -> (logits float32 [M, h, w] of M masks of the whole square, > 0 on the object, expected IoU
            [M]). The masks go from a part to the whole; the last one is that of the largest object.
    """

    name: str
    side: int
    encode: Callable[[np.ndarray], Any]
    decode: Callable[[Any, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class ImageFeatures:
    """The network's features of a picture. They do not depend on a prompt, and computing them takes most of the time.

    Attributes:
        values: the features that `encode` returns and `decode` takes.
        shape: (height, width) of the picture, px.
        size: (height, width) of the picture inside the network's square input, px.
    """

    values: Any
    shape: tuple[int, int]
    size: tuple[int, int]


@dataclass(frozen=True)
class Prompt:
    """A prompt for the network: clicks and a box, in pixels of the picture.

    Attributes:
        clicks: points on the object and on the background; may be empty if there is a box.
        box: (left, top, right, bottom) around the object; None for no box.
    """

    clicks: Clicks
    box: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class Candidate:
    """A mask that the network proposes.

    Attributes:
        mask: bool [H, W], True = the object.
        score: the network's own estimate of the IoU between this mask and the true one.
    """

    mask: np.ndarray
    score: float


def encode_image(segmenter: Segmenter, image: np.ndarray) -> ImageFeatures:
    """Compute the network's features of a picture.

    The picture is scaled so that its larger side fills the network's square input, and padded with zeros below or to
    the right.

    Args:
        image: uint8 [H, W, 3].
    """
    shape = image.shape[:2]
    height, width = (max(1, round(side * segmenter.side / max(shape))) for side in shape)
    resampling = cv2.INTER_AREA if segmenter.side < max(shape) else cv2.INTER_LINEAR
    square = np.zeros((segmenter.side, segmenter.side, 3), np.float32)
    scaled = cv2.resize(image, (width, height), interpolation=resampling)
    square[:height, :width] = (scaled.astype(np.float32) / 255 - MEAN) / DEVIATION
    values = segmenter.encode(np.ascontiguousarray(square.transpose(2, 0, 1)[None]))
    return ImageFeatures(values, (shape[0], shape[1]), (height, width))


def predict_masks(segmenter: Segmenter, features: ImageFeatures, prompt: Prompt) -> list[Candidate]:
    """Return the network's masks for a prompt, ordered from a part of the object to the whole object.

    Raises:
        ValueError: the prompt has neither clicks nor a box.
        FloatingPointError: the logits of the network's masks are not finite.
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
    """Resample logits [h, w] of the network's square input of `side` px to the picture's pixels [H, W]."""
    height, width = features.size
    square = cv2.resize(logits.astype(np.float32), (side, side), interpolation=cv2.INTER_LINEAR)
    inside = np.ascontiguousarray(square[:height, :width])
    return cv2.resize(inside, features.shape[::-1], interpolation=cv2.INTER_LINEAR)

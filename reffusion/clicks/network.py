"""Turns clicks into a mask by a SAM network, loaded through transformers, where its weights are on this machine.

The network's own processor would need torchvision; the few lines of it that are needed are here in plain torch.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, pad

from reffusion.clicks.marks import Clicks
from reffusion.weights import local

SOURCE = "facebook/sam-vit-base"
KIND = "sam"
# mean and standard deviation of ImageNet's pixels, with which the network was trained
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class Segmenter:
    """A frozen network in evaluation mode; `model` is transformers' SamModel, `side` the side of its square input."""

    model: nn.Module
    side: int


@dataclass(frozen=True)
class ImageFeatures:
    """The image embedding of a picture, independent of clicks; computing it takes most of the time.

    Attributes:
        features: [1, C, h, w].
        shape: (height, width) of the picture; size: the same at the network's input size.
    """

    features: Tensor
    shape: tuple[int, int]
    size: tuple[int, int]


def load_segmenter(source: str | Path = SOURCE) -> Segmenter | None:
    """The model in a local folder, or of a hub id; None where its weights are not on this machine.

    Raises:
        ValueError: a folder without a model, an incomplete one, or a model of another kind.
    """
    from transformers import AutoConfig, SamModel
    from transformers.utils import logging as transformers_logging

    folder = local.locate(source)
    if folder is None:
        return None
    if not (folder / "config.json").is_file():
        raise ValueError(f"segmentation network {folder}: it lacks config.json; it must be a transformers model folder")
    transformers_logging.disable_progress_bar()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            kind = AutoConfig.from_pretrained(folder).model_type
            if kind != KIND:
                raise ValueError(f"a model of type {kind!r}; those of type {KIND!r} are understood")
            model = SamModel.from_pretrained(folder, dtype=torch.float32)
    except (OSError, ValueError) as error:
        raise ValueError(f"segmentation network {folder}: {str(error).splitlines()[0]}") from error
    return make_segmenter(model)


def make_segmenter(model: nn.Module) -> Segmenter:
    """A Segmenter from a SamModel in memory."""
    config: Any = model.config
    return Segmenter(model.requires_grad_(False).eval(), config.vision_config.image_size)


@torch.no_grad()
def encode_image(segmenter: Segmenter, image: np.ndarray) -> ImageFeatures:
    """Encode a picture, uint8 [H, W, 3]: its larger side is scaled to the network's; below and to the right it is
    padded."""
    shape = image.shape[:2]
    size = tuple(max(1, round(side * segmenter.side / max(shape))) for side in shape)
    values = torch.as_tensor(image).permute(2, 0, 1)[None].float() / 255
    values = interpolate(values, size=size, mode="bilinear", align_corners=False, antialias=True)
    mean, deviation = (values.new_tensor(each).view(1, 3, 1, 1) for each in (MEAN, DEVIATION))
    square = pad((values - mean) / deviation, (0, segmenter.side - size[1], 0, segmenter.side - size[0]))
    return ImageFeatures(segmenter.model.get_image_embeddings(square), shape, size)


@torch.no_grad()
def predict_mask(segmenter: Segmenter, looked: ImageFeatures, clicks: Clicks) -> np.ndarray:
    """bool [H, W], True = the object that clicks are on; empty without a click on the object. A single click may mean a
    part or the whole: the network's answer with the highest score is taken.

    Raises:
        FloatingPointError: the answer is not finite.
    """
    if not clicks.positive.any():
        return np.zeros(looked.shape, bool)
    scale = np.array(looked.size[::-1]) / looked.shape[::-1]
    points = torch.as_tensor(clicks.points * scale, dtype=torch.float32)[None, None]
    labels = torch.as_tensor(clicks.positive.astype(np.int64))[None, None]
    answer = segmenter.model(
        image_embeddings=looked.features, input_points=points, input_labels=labels, multimask_output=len(clicks) == 1
    )
    if not torch.isfinite(answer.pred_masks).all():
        raise FloatingPointError("the segmentation network's answer is not finite")
    best = answer.pred_masks[:, 0, answer.iou_scores[0, 0].argmax()][:, None]
    square = interpolate(best, size=(segmenter.side,) * 2, mode="bilinear", align_corners=False)
    whole = square[..., : looked.size[0], : looked.size[1]]
    return (interpolate(whole, size=looked.shape, mode="bilinear", align_corners=False)[0, 0] > 0).numpy()

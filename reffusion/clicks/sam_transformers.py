"""Segment Anything Model (SAM) of the library transformers, from weights on this machine.

Pictures are prepared in `reffusion.clicks.segmenter`, because the library's own processor needs torchvision.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from reffusion.clicks.segmenter import LOWER_RIGHT, UPPER_LEFT, Segmenter
from reffusion.weights import local
from reffusion.weights.transformers_model import load_model

SOURCE = "facebook/sam-vit-base"
KIND = "sam"


def load_sam(source: str | Path = SOURCE) -> Segmenter | None:
    """Load a SAM from this machine.

    Args:
        source: a folder of transformers, or a hub id.

    Returns:
        The network, or None if `source` is a hub id whose weights are not on this machine.

    Raises:
        ValueError: `source` is neither a folder nor a hub id, or the folder holds no model, an incomplete one, or a
            model of another kind.
    """
    folder = local.locate(source)
    if folder is None:
        return None
    try:
        return wrap_model(load_model(folder, KIND, "SamModel"), str(source))
    except ValueError as error:
        raise ValueError(f"segmentation network {error}") from error


def wrap_model(model: nn.Module, name: str = SOURCE) -> Segmenter:
    """Return a Segmenter that runs a SamModel of transformers which is already in memory.

    The model itself is put into evaluation mode, and its parameters need no gradient from then on.

    Args:
        name: name of the network for messages.
    """
    config: Any = model.config
    model = model.requires_grad_(False).eval()

    @torch.no_grad()
    def encode(square: np.ndarray) -> Tensor:
        return model.get_image_embeddings(torch.as_tensor(square))

    @torch.no_grad()
    def decode(features: Tensor, points: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        corner = np.isin(labels, (UPPER_LEFT, LOWER_RIGHT))
        prompt: dict[str, Tensor] = {}
        if corner.any():
            prompt["input_boxes"] = torch.as_tensor(points[corner].reshape(1, 1, 4))
        if not corner.all():
            prompt["input_points"] = torch.as_tensor(points[~corner])[None, None]
            prompt["input_labels"] = torch.as_tensor(labels[~corner])[None, None]
        answer = model(image_embeddings=features, multimask_output=True, **prompt)
        return answer.pred_masks[0, 0].numpy(), answer.iou_scores[0, 0].numpy()

    return Segmenter(name, config.vision_config.image_size, encode, decode)

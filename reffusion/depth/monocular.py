"""Depth of a single picture by a network of the Depth Anything kind, loaded through transformers.

Its own processor would ask for torchvision; the few lines that it takes are here in plain torch.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from reffusion.weights import local

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet's pixels, which the backbone was fed
KIND = "depth_anything"
FARTHEST = 1e6  # metres: what a metric network puts beyond has no disparity to speak of


@dataclass(frozen=True)
class DepthNetwork:
    """A network on one device, frozen, in evaluation mode.

    Attributes:
        model: transformers' DepthAnythingForDepthEstimation.
        patch: pixels per token, a side; it takes pictures of whole patches.
        side: pixels of the square pictures it was trained on.
        metric: it answers depth in metres, not disparity up to scale and offset.
    """

    model: nn.Module
    patch: int
    side: int
    metric: bool


def load_network(source: str | Path, device: str = "cpu") -> DepthNetwork:
    """The model in a local folder, or a hub id such as depth-anything/Depth-Anything-V2-Small-hf; float32.

    Raises:
        ValueError: not on this machine, a folder without a model, or a model of another kind.
    """
    from transformers import AutoConfig, AutoModelForDepthEstimation
    from transformers.utils import logging as transformers_logging

    cure = "Name a local folder, or leave `depth.model` empty: depth is then continued from the surroundings"
    try:
        folder = local.locate(source)
        if folder is None:
            raise ValueError(local.absent(source))
        if not (folder / "config.json").is_file():
            raise ValueError(f"{folder} lacks config.json; it must be a transformers model folder")
    except ValueError as error:
        raise ValueError(f"depth model {error}. {cure}") from None
    transformers_logging.disable_progress_bar()
    _check_kind(_loaded(folder, cure, lambda: AutoConfig.from_pretrained(folder)), str(source))
    model = _loaded(folder, cure, lambda: AutoModelForDepthEstimation.from_pretrained(folder, dtype=torch.float32))
    return make_network(model, device)


def _loaded(folder: Path, cure: str, load: Callable[[], Any]) -> Any:
    """What transformers loads; its complaint in one line, with what can be done."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return load()
    except (OSError, ValueError) as error:
        raise ValueError(f"depth model {folder}: {str(error).splitlines()[0]} {cure}") from error


def _check_kind(config, name: str) -> None:
    if config.model_type != KIND:
        raise ValueError(
            f"depth model {name}: a model of type {config.model_type!r}; those of type {KIND!r} are understood "
            "(Depth Anything, Depth Anything V2)"
        )


def make_network(model: nn.Module, device: str = "cpu") -> DepthNetwork:
    """A DepthNetwork from a model in memory."""
    _check_kind(model.config, model.config.name_or_path)
    backbone = model.config.backbone_config
    model.requires_grad_(False).eval().to(device)
    metric = model.config.depth_estimation_type == "metric"
    return DepthNetwork(model, model.config.patch_size, backbone.image_size, metric)


@torch.no_grad()
def disparity(network: DepthNetwork, image: Tensor) -> Tensor:
    """What the network says of a picture, near high: [H, W] float32, on the picture's device.

    Up to scale and offset; a metric network's depth is inverted.

    Args:
        image: [3, H, W] in [0, 1].
    Raises:
        ValueError: not a picture of three channels.
        FloatingPointError: the answer is not finite.
    """
    if image.ndim != 3 or image.shape[0] != 3:
        raise ValueError(f"the depth model takes one picture [3, H, W], not {list(image.shape)}")
    device = next(network.model.parameters()).device
    answer = network.model(pixel_values=prepared(network, image).to(device)).predicted_depth[None]
    if network.metric:
        answer = 1 / answer.clamp(1 / FARTHEST, FARTHEST)
    if not torch.isfinite(answer).all():
        raise FloatingPointError("the depth model's answer is not finite")
    size = tuple(image.shape[1:])
    return interpolate(answer, size=size, mode="bilinear", align_corners=False)[0, 0].to(image.device)


def prepared(network: DepthNetwork, image: Tensor) -> Tensor:
    """[1, 3, h, w] of a picture [3, H, W] in [0, 1]: sides near the network's own in whole patches, normalised.

    The proportions stay but for that rounding; of the two sides the one that asks for less resizing is made to fit.
    """
    height, width = image.shape[1:]
    scale = min((network.side / height, network.side / width), key=lambda s: abs(1 - s))
    whole = lambda length: max(1, round(scale * length / network.patch)) * network.patch
    size = whole(height), whole(width)
    resized = interpolate(image.float()[None], size=size, mode="bicubic", align_corners=False, antialias=True)
    mean, deviation = (resized.new_tensor(values).view(1, 3, 1, 1) for values in (MEAN, DEVIATION))
    return (resized.clamp(0, 1) - mean) / deviation

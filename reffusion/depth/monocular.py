"""Monocular depth by a Depth Anything network, loaded through transformers.

Preprocessing is written here in plain torch because the image processor of transformers requires torchvision.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from reffusion.weights import local
from reffusion.weights.transformers_model import load_model

# Of the pixels of ImageNet, on which the backbone was trained.
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
MODEL_TYPE = "depth_anything"  # of Depth Anything and Depth Anything V2
MAX_DEPTH_M = 1e6  # meters: the depth of a metric network is clamped here before it is inverted


@dataclass(frozen=True)
class DepthNetwork:
    """A Depth Anything network on one device, frozen and in evaluation mode.

    Attributes:
        model: DepthAnythingForDepthEstimation of transformers.
        patch: Side of a patch in pixels. The network's input consists of whole patches.
        side: Side of the square training pictures in pixels.
        metric: True if the network's output is depth in meters, False if it is disparity up to scale and offset.
    """

    model: nn.Module
    patch: int
    side: int
    metric: bool


def load_network(source: str | Path, device: str = "cpu") -> DepthNetwork:
    """Load the network, in float32, from a local folder or by its hub id, whose weights must be on this machine.

    Args:
        source: Folder, or hub id such as depth-anything/Depth-Anything-V2-Small-hf.
        device: The device of the network.

    Raises:
        ValueError: The model is not on this machine, the folder has no model, or the model is of another type.
    """
    advice = "Name a local folder, or leave `depth.model` empty: depth is then continued from the surroundings"
    try:
        folder = local.locate(source)
        if folder is None:
            raise ValueError(local.explain_missing(source))
        return make_network(load_model(folder, MODEL_TYPE, "AutoModelForDepthEstimation"), device)
    except ValueError as error:
        raise ValueError(f"depth model {error}. {advice}") from None


def make_network(model: nn.Module, device: str = "cpu") -> DepthNetwork:
    """Build a DepthNetwork from a Depth Anything model in memory. The model is frozen and moved to `device`."""
    config: Any = model.config
    model.requires_grad_(False).eval().to(device)
    metric = config.depth_estimation_type == "metric"
    return DepthNetwork(model, config.patch_size, config.backbone_config.image_size, metric)


@torch.no_grad()
def predict_disparity(network: DepthNetwork, image: Tensor) -> Tensor:
    """Return the disparity of a picture up to scale and offset, [H, W] float32, on the picture's device.

    The output of a metric network is inverted, which gives disparity in 1 / meters.

    Args:
        network: The depth network.
        image: [3, H, W] in [0, 1].

    Raises:
        ValueError: The picture does not have three channels.
        FloatingPointError: The output is not finite.
    """
    if image.ndim != 3 or image.shape[0] != 3:
        raise ValueError(f"the depth model takes one picture [3, H, W], not {list(image.shape)}")
    device = next(network.model.parameters()).device
    output = network.model(pixel_values=preprocess(network, image).to(device)).predicted_depth[None]
    if network.metric:
        output = 1 / output.clamp(1 / MAX_DEPTH_M, MAX_DEPTH_M)
    if not torch.isfinite(output).all():
        raise FloatingPointError("the depth model's answer is not finite")
    size = tuple(image.shape[1:])
    return interpolate(output, size=size, mode="bilinear", align_corners=False)[0, 0].to(image.device)


def preprocess(network: DepthNetwork, image: Tensor) -> Tensor:
    """Return the network's input for a picture: resized to whole patches and normalized, [1, 3, h, w].

    The picture is scaled so that one of its sides has about the size of the training pictures: the side that needs less
    scaling. Both sides are then rounded to whole patches, which changes the aspect ratio slightly.

    Args:
        network: The depth network.
        image: [3, H, W] in [0, 1].
    """
    height, width = image.shape[1:]
    scale = min((network.side / height, network.side / width), key=lambda s: abs(1 - s))
    to_patches = lambda length: max(1, round(scale * length / network.patch)) * network.patch
    size = to_patches(height), to_patches(width)
    resized = interpolate(image.float()[None], size=size, mode="bicubic", align_corners=False, antialias=True)
    mean, deviation = (resized.new_tensor(values).view(1, 3, 1, 1) for values in (MEAN, DEVIATION))
    return (resized.clamp(0, 1) - mean) / deviation

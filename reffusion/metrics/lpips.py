"""LPIPS (Zhang et al., 2018), version 0.1, from weights on this machine. This module downloads nothing.

The weights of a network are one file `<net>.safetensors` (written by `reffusion.weights.lpips_package`), or two files:
the backbone as torchvision saves it, and the published linear weights. If the files are missing, `load` returns the
reason instead of a metric.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from reffusion.weights.local import abbreviate_home, lpips_files, lpips_folders
from reffusion.weights.lpips_package import digest
from reffusion.weights.published import LPIPS

Net = Literal["vgg", "alex"]

NAMES = {"vgg": "lpips_vgg", "alex": "lpips_alex"}  # names of the scores
# Smallest image in px a side: in a smaller one the deepest layer has no cell.
SMALLEST = {"alex": 31, "vgg": 16}

# Layers of torchvision's `features`: (channels, kernel, stride, padding) of a convolution and its ReLU, or "pool".
_ALEX = [(64, 11, 4, 2), "pool", (192, 5, 1, 2), "pool", (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1)]
_VGG = [
    *[(64, 3, 1, 1)] * 2, "pool", *[(128, 3, 1, 1)] * 2, "pool", *[(256, 3, 1, 1)] * 3, "pool",
    *[(512, 3, 1, 1)] * 3, "pool", *[(512, 3, 1, 1)] * 3,
]  # fmt: skip
_LAYERS: dict[str, list[Any]] = {"alex": _ALEX, "vgg": _VGG}
_POOL = {"alex": (3, 2), "vgg": (2, 2)}  # kernel size and stride of max pooling
# Indices in `features` of the ReLUs whose activations are compared.
TAPS = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}
WIDTHS = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}
EPSILON = 1e-10  # added to the norm of a cell's features, as in the published code


class Lpips(nn.Module):
    """The LPIPS distance by one network. Use `from_states` or `load` to build it with weights.

    Attributes:
        net: "alex" (AlexNet) or "vgg" (VGG with 16 layers).
        features: the convolutional backbone; its layers have the same indices as in torchvision.
        linear: the published non-negative weights of the channels of the five compared layers, [C_l] each.
        files: file name -> digest of each file that was read; empty if built from state dicts.
    """

    def __init__(self, net: Net):
        super().__init__()
        self.net, self.files = net, {}
        layers, channels = [], 3
        for layer in _LAYERS[net]:
            if layer == "pool":
                layers.append(nn.MaxPool2d(*_POOL[net]))
            else:
                width, kernel, stride, padding = layer
                layers += [nn.Conv2d(channels, width, kernel, stride, padding), nn.ReLU()]
                channels = width
        self.features = nn.Sequential(*layers)
        self.linear = nn.ParameterList(torch.zeros(width) for width in WIDTHS[net])
        # ImageNet's mean and standard deviation, for inputs in [-1, 1].
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1))
        # Channels last takes two thirds of the time on the CPU.
        self.requires_grad_(False).eval().to(memory_format=torch.channels_last)

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Return the LPIPS distance [B] of two batches of images, [B, 3, H, W] in [-1, 1].

        This is the sum over layers l of the mean over the cells (pixels of the layer) of
        w_l · (f_l(first) - f_l(second))², with features f_l normalized over channels.

        Raises:
            ValueError: the shapes differ, or a side of the images is smaller than `SMALLEST[net]`.
        """
        if first.shape != second.shape:
            raise ValueError(f"LPIPS compares two [B, 3, H, W]; got {tuple(first.shape)} and {tuple(second.shape)}")
        return self.distance(first, self.activations(second))

    def distance(self, images: Tensor, target: list[Tensor]) -> Tensor:
        """Return the LPIPS distance [B] of images from target images whose activations were computed before.

        Args:
            images: [B, 3, H, W] in [-1, 1].
            target: the result of `activations` for the target images.
        """
        pairs = zip(self.activations(images), target, self.linear, strict=True)
        return sum(((a - b).square() * w.float().view(1, -1, 1, 1)).sum(1).mean((1, 2)) for a, b, w in pairs)

    def activations(self, images: Tensor) -> list[Tensor]:
        """Return the activations of the five compared layers, normalized over channels in each cell.

        Args:
            images: [B, 3, H, W] in [-1, 1].

        Returns:
            float32 [B, C_l, H_l, W_l] for each layer l.

        Raises:
            ValueError: `images` has another shape, or a side is smaller than `SMALLEST[net]`.
        """
        if images.dim() != 4 or images.shape[1] != 3:
            raise ValueError(f"LPIPS compares two [B, 3, H, W]; got {tuple(images.shape)}")
        height, width = images.shape[2:]
        if min(height, width) < SMALLEST[self.net]:
            raise ValueError(
                f"LPIPS ({self.net}) needs at least {SMALLEST[self.net]} px a side; the image is {width}x{height} px"
            )
        x = ((images - self.shift) / self.scale).contiguous(memory_format=torch.channels_last)
        tapped = []
        for index, layer in enumerate(self.features):
            x = layer(x)
            if index in TAPS[self.net]:
                # float32, because in half precision squares overflow and EPSILON is 0. Where all features are 0,
                # vector_norm has the gradient 0.
                wide = x.float()
                tapped.append(wide / (torch.linalg.vector_norm(wide, dim=1, keepdim=True) + EPSILON))
        return tapped


def from_states(net: Net, backbone: dict[str, Tensor], linear: dict[str, Tensor]) -> Lpips:
    """Build the metric from two state dicts.

    Args:
        backbone: state dict of torchvision's network, with keys `features.<index>.weight` and `.bias`. Other keys, such
            as the classifier's, are ignored.
        linear: state dict of the published linear weights, with keys `lin<l>.model.1.weight`, [1, C_l, 1, 1] each.

    Raises:
        ValueError: a key is missing or has another shape; the message names the first one.
    """
    model = Lpips(net)
    feature_targets = {f"features.{key}": value for key, value in model.features.state_dict(keep_vars=True).items()}
    linear_targets = {f"lin{i}.model.1.weight": weight for i, weight in enumerate(model.linear)}
    for state, targets, shape in [
        (backbone, feature_targets, lambda p: p.shape),
        (linear, linear_targets, lambda p: (1, len(p), 1, 1)),
    ]:
        for key, parameter in targets.items():
            if key not in state:
                raise ValueError(f"LPIPS ({net}): the weights have no `{key}`")
            if tuple(state[key].shape) != tuple(shape(parameter)):
                raise ValueError(
                    f"LPIPS ({net}): `{key}` has shape {tuple(state[key].shape)}, not {tuple(shape(parameter))}"
                )
            parameter.data.copy_(state[key].reshape(parameter.shape))
    return model


def load(net: Net, folder: str | Path | None = None) -> tuple[Lpips | None, str | None]:
    """Load the metric from weights on this machine.

    Args:
        folder: folder to search first; None to search only the default folders.

    Returns:
        (metric, None), or (None, the reason) if there are no weights.

    Raises:
        ValueError: a file has wrong keys or shapes, or other content than published. The user should replace a damaged
            file, so it is not reported as a missing one.
    """
    files = lpips_files(net, folder)
    if not files:
        searched = ", ".join(abbreviate_home(place) for place in lpips_folders(folder))
        return None, f"no weights of LPIPS ({net}): run `make weights`, or put {net}.safetensors into one of {searched}"
    try:
        if len(files) == 1:
            return _load_whole(net, files[0]), None
        for path in files:
            _check_name(path)
        model = from_states(net, *(torch.load(path, map_location="cpu", weights_only=True) for path in files))
    except Exception as error:
        raise ValueError(f"LPIPS weights {', '.join(map(str, files))} cannot be used: {error}") from error
    model.files = {path.name: _sha256(path)[:16] for path in files}
    return model, None


def _load_whole(net: Net, path: Path) -> Lpips:
    """Build the metric from one file with all weights; raises ValueError if they are not the published ones."""
    from safetensors.torch import load_file

    state = load_file(path)
    content = digest({name: value.numpy() for name, value in state.items()})
    if content != LPIPS.nets[net].digest:
        raise ValueError("it is damaged: remove it, and run `make weights`")
    model = from_states(net, state, state)
    model.files = {path.name: content}
    return model


def _check_name(path: Path) -> None:
    """Raise ValueError if a file's name ends in eight hexadecimal digits that are not those of its sha256."""
    # The names of torchvision end in eight digits of the hash.
    stated = path.stem.rpartition("-")[2]
    if re.fullmatch("[0-9a-f]{8}", stated) and not _sha256(path).startswith(stated):
        raise ValueError(f"{path.name} is not the file its name says: download it again")


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

"""LPIPS (Zhang et al., 2018), version 0.1, from weights that lie on this machine; nothing is downloaded or made up.

Two files a network: the backbone as torchvision saves it (keys `features.N.weight`), and the published linear
weights (keys `lin0.model.1.weight`). Where either is absent the metric is unavailable, with a reason.

ST-LPIPS (Ghildyal and Liu, 2022) is the same formula on a VGG of its own, whose maxima are blurred before they are
thinned out. Its weights, the backbone's too, come with the package stlpips_pytorch, which is read and not imported.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from reffusion.weights.local import at_home, inside_package, lpips_folders
from reffusion.weights.published import LPIPS_PACKAGES

Net = Literal["alex", "vgg", "st"]

BACKBONE_FILES = {"alex": "alexnet-*.pth", "vgg": "vgg16-*.pth"}  # torchvision's names; a hash follows the dash
LINEAR_FILES = {"alex": "alex.pth", "vgg": "vgg.pth"}
NAMES = {"vgg": "lpips_vgg", "alex": "lpips_alex", "st": "stlpips"}  # of the scores
# px a side: anything smaller leaves the deepest layer without a single cell, or nothing to mirror at a border
SMALLEST = {"alex": 31, "vgg": 16, "st": 18}
ST_FILE = ("stlpips_pytorch", "weights/vST0.0/vgg_shift_tolerant.pth")  # package, file inside

# Layers of torchvision's `features`: (channels, kernel, stride, padding) a convolution with its ReLU, "pool" a maximum.
_ALEX = [(64, 11, 4, 2), "pool", (192, 5, 1, 2), "pool", (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1)]
_VGG = [
    *[(64, 3, 1, 1)] * 2,
    "pool",
    *[(128, 3, 1, 1)] * 2,
    "pool",
    *[(256, 3, 1, 1)] * 3,
    "pool",
    *[(512, 3, 1, 1)] * 3,
    "pool",
    *[(512, 3, 1, 1)] * 3,
]
_LAYERS: dict[str, list[Any]] = {"alex": _ALEX, "vgg": _VGG, "st": _VGG}
_POOL = {"alex": (3, 2), "vgg": (2, 2), "st": (2, 1)}  # side and step of a maximum
# Indices in `features` of the ReLUs compared.
TAPS = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29), "st": (3, 9, 17, 25, 33)}
WIDTHS = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512), "st": (64, 128, 256, 512, 512)}


class Blur(nn.Module):
    """Every second cell of [B, C, H, W] after a binomial filter of 3 x 3, the border mirrored 2 cells far."""

    def __init__(self) -> None:
        super().__init__()
        side = torch.tensor([1.0, 2.0, 1.0]) / 4
        self.register_buffer("filter", side.outer(side)[None, None], persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        kernel = self.filter.expand(x.shape[1], 1, 3, 3)
        return F.conv2d(F.pad(x, (2, 2, 2, 2), mode="reflect"), kernel, stride=2, groups=x.shape[1])


class Lpips(nn.Module):
    """The distance of one network. Build it with `from_states` or `load`.

    Attributes:
        net: "alex", "vgg" (16 layers) or "st".
        features: the backbone under torchvision's indices, of "st" under its own.
        linear: five non-negative weights, [C_l] each.
        files: what was read: file name -> first 16 digits of its SHA-256 (empty when built from states).
    """

    def __init__(self, net: Net):
        super().__init__()
        self.net, self.files = net, {}
        layers, channels = [], 3
        for layer in _LAYERS[net]:
            if layer == "pool":
                layers += [nn.MaxPool2d(*_POOL[net]), *([Blur()] if net == "st" else [])]
            else:
                width, kernel, stride, padding = layer
                layers += [nn.Conv2d(channels, width, kernel, stride, padding), nn.ReLU()]
                channels = width
        self.features = nn.Sequential(*layers)
        self.linear = nn.ParameterList(torch.zeros(width) for width in WIDTHS[net])
        # ImageNet's mean and deviation, seen from [-1, 1].
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1))
        self.requires_grad_(False).eval()

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Distance [B] of two batches [B, 3, H, W] in [-1, 1]: sum over layers of the mean over cells of
        w_l · (f_l(first) - f_l(second))², features of unit length over channels.

        Raises ValueError when the shapes differ or an image is smaller than `SMALLEST[net]` a side.
        """
        if first.shape != second.shape or first.dim() != 4 or first.shape[1] != 3:
            raise ValueError(f"LPIPS compares two [B, 3, H, W]; got {tuple(first.shape)} and {tuple(second.shape)}")
        height, width = first.shape[2:]
        if min(height, width) < SMALLEST[self.net]:
            raise ValueError(
                f"LPIPS ({self.net}) needs at least {SMALLEST[self.net]} px a side; the image is {width}x{height} px"
            )
        pairs = zip(self.activations(first), self.activations(second), self.linear, strict=True)
        return sum(((a - b).square() * weight.view(1, -1, 1, 1)).sum(1).mean((1, 2)) for a, b, weight in pairs)

    def activations(self, images: Tensor) -> list[Tensor]:
        """The five tapped layers, each cell's channels at unit length."""
        x, tapped = (images - self.shift) / self.scale, []
        for index, layer in enumerate(self.features):
            x = layer(x)
            if index in TAPS[self.net]:
                tapped.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
        return tapped


def from_states(net: Net, backbone: dict[str, Tensor], linear: dict[str, Tensor]) -> Lpips:
    """The metric from two state dicts: torchvision's (its classifier is ignored) and the linear weights'.

    Raises ValueError naming the first key that is missing or of another shape.
    """
    model = Lpips(net)
    wanted = {f"features.{key}": value for key, value in model.features.state_dict(keep_vars=True).items()}
    wanted_linear = {f"lin{i}.model.1.weight": weight for i, weight in enumerate(model.linear)}
    for state, targets, shape in [
        (backbone, wanted, lambda p: p.shape),
        (linear, wanted_linear, lambda p: (1, len(p), 1, 1)),
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
    """(metric, None), or (None, why it is unavailable).

    Raises ValueError for a file that is there but broken: wrong keys or shapes, or other content than the hash
    in its name says. A damaged file is an error to mend, not an unavailable metric.
    """
    places = lpips_folders(folder)
    found = {}
    for role, pattern in [("backbone", BACKBONE_FILES[net]), ("linear weights", LINEAR_FILES[net])]:
        paths = [path for place in places for path in sorted(place.glob(pattern))]
        if not paths:
            looked = ", ".join(at_home(place) for place in places)
            brings = f"install {' or '.join(LPIPS_PACKAGES)}, " if pattern == LINEAR_FILES[net] else ""
            cures = f"run `make weights`, {brings}or put {pattern} into one of {looked}"
            return None, f"no {role} for LPIPS ({net}): {cures}"
        found[role] = paths[0]
    hashes = {path: _sha256(path) for path in found.values()}
    stated = found["backbone"].stem.rpartition("-")[2]
    if re.fullmatch("[0-9a-f]{8}", stated) and not hashes[found["backbone"]].startswith(stated):
        raise ValueError(f"{found['backbone']} is not the file its name says (hash {stated}): download it again")
    try:
        states = [torch.load(path, map_location="cpu", weights_only=True) for path in found.values()]
        model = from_states(net, *states)
    except Exception as error:
        raise ValueError(f"LPIPS weights {', '.join(map(str, found.values()))} cannot be used: {error}") from error
    model.files = {path.name: digest[:16] for path, digest in hashes.items()}
    return model, None


def load_st() -> tuple[Lpips | None, str | None]:
    """ST-LPIPS: (metric, None), or (None, why it is unavailable). Raises ValueError for a file that is broken."""
    package, below = ST_FILE
    path = inside_package(package, below)
    if path is None:
        return None, f"no weights for ST-LPIPS: `pip install {package}` brings them"
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        model = from_states("st", {re.sub(r"^net\.slice\d\.", "features.", key): v for key, v in state.items()}, state)
    except Exception as error:
        raise ValueError(f"ST-LPIPS weights {path} cannot be used: {error}") from error
    model.files = {path.name: _sha256(path)[:16]}
    return model, None


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

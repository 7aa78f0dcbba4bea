"""What personalization shows the prior (RefFusion section 4.1): the reference, as a whole and in crops.

A sample is an image, a mask to repaint and a prompt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from reffusion.prior.windows import enlarged, two_scale_masks, two_scales, window_around

PROMPTS = ("A photo of sks", "A photo of sks, cropped", "")
GLOBAL, LOCAL, EMPTY = 0, 1, 2


@dataclass(frozen=True)
class Picture:
    """A training picture.

    Attributes:
        image: [3, H, W] float32 in [-1, 1], no side shorter than the prior's native size.
        region: [H, W] bool; of a reference the pixels it stands for, of a scene's view those that must not be used.
    """

    image: Tensor
    region: Tensor


@dataclass(frozen=True)
class Sampling:
    """How a training sample is drawn. Shares are probabilities.

    PAPER leaves open all of these figures. Rectangles (count, side, inversion) and the share of empty prompts are
    RealFill's; half of the samples are local.

    Attributes:
        local_share: of the reference's samples, those that are native-size crops around its mask.
        scene_share: of all samples, crops of the scene's own views that touch none of their masked pixels (paper: 0).
        hole_share: of the reference's samples, those whose mask is the hole itself (paper: 0). That is the mask of the
            job; rectangles leave most of the hole to be seen, and a short training does not get beyond them.
        empty_share: samples whose prompt is replaced by the empty one, so that guidance stays meaningful.
        border: largest share of height or width that a global sample loses at each side.
        rectangles: smallest and largest number of rectangles in a mask.
        side: shortest and longest side of a rectangle, in sides of the sample.
        inverted_share: masks that repaint everything but their rectangles.
    """

    local_share: float = 0.5
    scene_share: float = 0.0
    hole_share: float = 0.0
    empty_share: float = 0.1
    border: float = 0.1
    rectangles: tuple[int, int] = (1, 29)
    side: tuple[float, float] = (0.03, 0.25)
    inverted_share: float = 0.5


class Samples(NamedTuple):
    """images [B, 3, n, n] in [-1, 1]; masks [B, 1, n, n], 1 = repaint; prompts [B] long, indices into PROMPTS."""

    images: Tensor
    masks: Tensor
    prompts: Tensor


def picture(image: Tensor, region: Tensor, size: int) -> Picture:
    """A `Picture` from a uint8 [H, W, 3] image and a bool [H, W] region, enlarged where shorter than `size` pixels."""
    floats = enlarged(image.permute(2, 0, 1).to(torch.float32) / 127.5 - 1, size)
    return Picture(floats, enlarged(region.to(torch.float32)[None], size)[0] > 1e-4)


def _uniform(low: float, high: float, generator: torch.Generator) -> float:
    return low + (high - low) * float(torch.rand((), generator=generator))


def rectangle_mask(size: int, sampling: Sampling, generator: torch.Generator) -> Tensor:
    """[1, size, size] float, 1 = repaint: a union of random rectangles, or everything but them."""
    fewest, most = sampling.rectangles
    mask = torch.zeros(1, size, size)
    for _ in range(int(torch.randint(fewest, most + 1, (), generator=generator))):
        height, width = (max(1, round(_uniform(*sampling.side, generator) * size)) for _ in range(2))
        top, left = (int(torch.randint(size - extent + 1, (), generator=generator)) for extent in (height, width))
        mask[:, top : top + height, left : left + width] = 1
    return 1 - mask if _uniform(0, 1, generator) < sampling.inverted_share else mask


def without_border(source: Picture, border: float, generator: torch.Generator) -> Picture:
    """The picture less a thin strip, drawn for each of its four sides: at most `border` of its height or width."""
    height, width = source.region.shape
    top, bottom = (int(_uniform(0, border, generator) * height) for _ in range(2))
    left, right = (int(_uniform(0, border, generator) * width) for _ in range(2))
    rows, columns = slice(top, height - bottom), slice(left, width - right)
    return Picture(source.image[:, rows, columns], source.region[rows, columns])


def clear_windows(region: Tensor, size: int) -> Tensor:
    """[K, 2] long, the (top, left) of every size x size window of a [H, W] bool region that holds no True pixel."""
    counts = torch.zeros(region.shape[0] + 1, region.shape[1] + 1, dtype=torch.int64)
    counts[1:, 1:] = region.to(torch.int64).cumsum(0).cumsum(1)
    inside = counts[size:, size:] - counts[:-size, size:] - counts[size:, :-size] + counts[:-size, :-size]
    return torch.nonzero(inside == 0)


class Clear(NamedTuple):
    """image [3, H, W]; windows [K, 2] long, (top, left) of its windows without a masked pixel, K > 0."""

    image: Tensor
    windows: Tensor


def clear_views(views: Sequence[Picture], size: int) -> list[Clear]:
    """The views that have a size x size window free of their region, with all such windows."""
    found = (Clear(view.image, clear_windows(view.region, size)) for view in views)
    return [view for view in found if len(view.windows)]


def draw_samples(
    references: Sequence[Picture],
    views: Sequence[Clear],
    native: int,
    size: int,
    count: int,
    sampling: Sampling,
    generator: torch.Generator,
) -> Samples:
    """`count` training samples of side `size`. All the randomness comes from `generator`.

    Args:
        references: what is to be learned; every pixel of them may be used.
        views: the scene's own views for `sampling.scene_share`, their windows of side `size`; none: no such samples.
        native: the side that distillation reduces a whole view to. A global sample is reduced to it as well, and,
            where `size` is smaller, a window of it that shows some of the hole, so that the model learns it in the
            scale it will see.
    """
    images, masks, prompts = [], [], []
    for _ in range(count):
        if views and _uniform(0, 1, generator) < sampling.scene_share:
            view = views[int(torch.randint(len(views), (), generator=generator))]
            top, left = view.windows[int(torch.randint(len(view.windows), (), generator=generator))].tolist()
            image, hole, prompt = view.image[:, top : top + size, left : left + size], None, LOCAL
        else:
            source = references[int(torch.randint(len(references), (), generator=generator))]
            image, hole, prompt = _of_reference(source, native, size, sampling, generator)
        images.append(image)
        as_asked = hole is not None and hole.any() and _uniform(0, 1, generator) < sampling.hole_share
        masks.append(hole if as_asked else rectangle_mask(size, sampling, generator))
        prompts.append(EMPTY if _uniform(0, 1, generator) < sampling.empty_share else prompt)
    return Samples(torch.stack(images), torch.stack(masks), torch.tensor(prompts))


def _of_reference(
    source: Picture, native: int, size: int, sampling: Sampling, generator: torch.Generator
) -> tuple[Tensor, Tensor, int]:
    """A local or global sample of a reference: image [3, size, size], its hole there [1, size, size], prompt."""
    if _uniform(0, 1, generator) < sampling.local_share:
        image, hole, prompt = source.image, source.region[None].to(torch.float32), LOCAL
    else:
        whole = without_border(source, sampling.border, generator)
        image, hole = two_scales(whole.image, [], native)[0], two_scale_masks(whole.region, [], native)[0]
        prompt = GLOBAL
    if hole.shape[-2:] == (size, size):
        return image, hole, prompt
    window = window_around if hole.any() else _window_anywhere  # a border may have been all of the hole
    top, left = window(hole[0] > 0, size, generator)
    return image[:, top : top + size, left : left + size], hole[:, top : top + size, left : left + size], prompt


def _window_anywhere(mask: Tensor, size: int, generator: torch.Generator) -> tuple[int, int]:
    return tuple(int(torch.randint(extent - size + 1, (), generator=generator)) for extent in mask.shape)

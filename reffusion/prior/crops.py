"""What personalization shows the prior (RefFusion section 4.1): the reference, as a whole and in crops.

A sample is an image, a mask to repaint and a prompt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from reffusion.params.personalize import Samples
from reffusion.prior.windows import enlarged, two_scale_masks, two_scales, window_around

PROMPTS = ("A photo of sks", "A photo of sks, cropped", "")
GLOBAL, LOCAL, EMPTY = 0, 1, 2

# PAPER leaves open: all of these figures. Those of the rectangles and the share of empty prompts are RealFill's.
EMPTY_SHARE = 0.1  # of samples whose prompt is replaced by the empty one, so that guidance stays meaningful
BORDER = 0.1  # the largest share of height or width that a global sample loses at each side
RECTANGLES = (1, 29)  # the fewest and the most of a mask
SIDE = (0.03, 0.25)  # the shortest and the longest side of one, in sides of the sample
WHOLE_SHARE = 0.1  # of the masks `realfill` that repaint all
INVERTED_SHARE = 0.5  # of masks that repaint everything but their rectangles


@dataclass(frozen=True)
class Picture:
    """A training picture.

    Attributes:
        image: [3, H, W] float32 in [-1, 1], no side shorter than the prior's native size.
        region: [H, W] bool, the pixels that a reference stands for.
    """

    image: Tensor
    region: Tensor


class Batch(NamedTuple):
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


def rectangle_mask(
    size: int,
    generator: torch.Generator,
    *,
    rectangles: tuple[int, int] = RECTANGLES,
    side: tuple[float, float] = SIDE,
    inverted_share: float = INVERTED_SHARE,
) -> Tensor:
    """[1, size, size] float, 1 = repaint: a union of random rectangles, or everything but them."""
    fewest, most = rectangles
    mask = torch.zeros(1, size, size)
    for _ in range(int(torch.randint(fewest, most + 1, (), generator=generator))):
        height, width = (max(1, round(_uniform(*side, generator) * size)) for _ in range(2))
        top, left = (int(torch.randint(size - extent + 1, (), generator=generator)) for extent in (height, width))
        mask[:, top : top + height, left : left + width] = 1
    return 1 - mask if _uniform(0, 1, generator) < inverted_share else mask


def random_mask(samples: Samples, size: int, generator: torch.Generator) -> Tensor:
    """[1, size, size] float, 1 = repaint, by `samples.masks`."""
    if samples.masks == "realfill" and _uniform(0, 1, generator) < WHOLE_SHARE:
        return torch.ones(1, size, size)
    return rectangle_mask(size, generator)


def without_border(source: Picture, border: float, generator: torch.Generator) -> Picture:
    """The picture less a thin strip, drawn for each of its four sides: at most `border` of its height or width."""
    height, width = source.region.shape
    top, bottom = (int(_uniform(0, border, generator) * height) for _ in range(2))
    left, right = (int(_uniform(0, border, generator) * width) for _ in range(2))
    rows, columns = slice(top, height - bottom), slice(left, width - right)
    return Picture(source.image[:, rows, columns], source.region[rows, columns])


def draw_samples(
    references: Sequence[Picture],
    native: int,
    size: int,
    count: int,
    samples: Samples,
    generator: torch.Generator,
    empty_share: float = EMPTY_SHARE,
) -> Batch:
    """`count` training samples of side `size`. All the randomness comes from `generator`.

    Args:
        references: what is to be learned; every pixel of them may be used.
        native: the side that distillation reduces a whole view to. A global sample is reduced to it as well, and,
            where `size` is smaller, a window of it that shows some of the hole, so that the model learns it in the
            scale it will see.
    """
    images, masks, prompts = [], [], []
    for _ in range(count):
        source = references[int(torch.randint(len(references), (), generator=generator))]
        image, hole, prompt = _of_reference(source, native, size, samples.local_share, generator)
        images.append(image)
        as_asked = hole.any() and _uniform(0, 1, generator) < samples.hole_share
        masks.append(hole if as_asked else random_mask(samples, size, generator))
        prompts.append(EMPTY if _uniform(0, 1, generator) < empty_share else prompt)
    return Batch(torch.stack(images), torch.stack(masks), torch.tensor(prompts))


def _of_reference(
    source: Picture, native: int, size: int, local_share: float, generator: torch.Generator
) -> tuple[Tensor, Tensor, int]:
    """A local or global sample of a reference: image [3, size, size], its hole there [1, size, size], prompt."""
    if _uniform(0, 1, generator) < local_share:
        image, hole, prompt = source.image, source.region[None].to(torch.float32), LOCAL
    else:
        whole = without_border(source, BORDER, generator)
        image, hole = two_scales(whole.image, [], native)[0], two_scale_masks(whole.region, [], native)[0]
        prompt = GLOBAL
    if hole.shape[-2:] == (size, size):
        return image, hole, prompt
    window = window_around if hole.any() else _window_anywhere  # a border may have been all of the hole
    top, left = window(hole[0] > 0, size, generator)
    return image[:, top : top + size, left : left + size], hole[:, top : top + size, left : left + size], prompt


def _window_anywhere(mask: Tensor, size: int, generator: torch.Generator) -> tuple[int, int]:
    return tuple(int(torch.randint(extent - size + 1, (), generator=generator)) for extent in mask.shape)

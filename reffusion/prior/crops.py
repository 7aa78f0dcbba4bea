"""Training samples for personalization (RefFusion section 4.1): the reference, as a whole and in crops.

A sample consists of an image, a mask of pixels to repaint and a prompt. A global sample shows the whole reference, a
local sample shows a crop around its hole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from reffusion.params.personalize import TrainingSamples
from reffusion.prior.windows import enlarge_to_fit, two_scale_masks, two_scales, window_around

GLOBAL, LOCAL, EMPTY = 0, 1, 2  # indices into `params.base.Prompts.texts`

# PAPER leaves open: all of these values. Those of rectangles and empty prompts are RealFill's.
EMPTY_SHARE = 0.1  # of samples get the empty prompt, so that classifier-free guidance stays meaningful
MAX_BORDER = 0.1  # maximum share of height or width that is cropped at each side of a global sample
RECTANGLE_COUNT = (1, 29)  # minimum and maximum number per mask
RECTANGLE_SIDE = (0.03, 0.25)  # minimum and maximum side of a rectangle / side of the sample
INVERTED_SHARE = 0.5  # of masks cover everything except their rectangles


@dataclass(frozen=True)
class Picture:
    """A picture from which training samples are taken.

    Attributes:
        image: [3, H, W] float32 in [-1, 1], no side shorter than the prior's native size.
        region: bool [H, W], True in the hole: the pixels of the reference that were inpainted.
    """

    image: Tensor
    region: Tensor


class Batch(NamedTuple):
    """A batch of training samples.

    Attributes:
        images: [B, 3, n, n] in [-1, 1].
        masks: [B, 1, n, n], 1 = repaint.
        prompts: [B] long, `GLOBAL`, `LOCAL` or `EMPTY`.
    """

    images: Tensor
    masks: Tensor
    prompts: Tensor


def make_picture(image: Tensor, region: Tensor, size: int) -> Picture:
    """Build a `Picture`, enlarged to at least `size` pixels a side.

    Args:
        image: uint8 [H, W, 3].
        region: bool [H, W], True in the hole.
        size: Least side in pixels.
    """
    floats = enlarge_to_fit(image.permute(2, 0, 1).to(torch.float32) / 127.5 - 1, size)
    return Picture(floats, enlarge_to_fit(region.to(torch.float32)[None], size)[0] > 1e-4)


def _uniform(low: float, high: float, generator: torch.Generator) -> float:
    return low + (high - low) * float(torch.rand((), generator=generator))


def rectangle_mask(size: int, generator: torch.Generator) -> Tensor:
    """Draw a mask that is a union of random rectangles or the complement of one: [1, size, size] float, 1 = repaint."""
    fewest, most = RECTANGLE_COUNT
    mask = torch.zeros(1, size, size)
    for _ in range(int(torch.randint(fewest, most + 1, (), generator=generator))):
        height, width = (max(1, round(_uniform(*RECTANGLE_SIDE, generator) * size)) for _ in range(2))
        top, left = (int(torch.randint(size - extent + 1, (), generator=generator)) for extent in (height, width))
        mask[:, top : top + height, left : left + width] = 1
    return 1 - mask if _uniform(0, 1, generator) < INVERTED_SHARE else mask


def crop_border(source: Picture, generator: torch.Generator) -> Picture:
    """Return the picture without a strip of random width at each side.

    A strip takes at most the share `MAX_BORDER` of the picture's height or width.
    """
    height, width = source.region.shape
    top, bottom = (int(_uniform(0, MAX_BORDER, generator) * height) for _ in range(2))
    left, right = (int(_uniform(0, MAX_BORDER, generator) * width) for _ in range(2))
    rows, columns = slice(top, height - bottom), slice(left, width - right)
    return Picture(source.image[:, rows, columns], source.region[rows, columns])


def draw_samples(
    references: Sequence[Picture],
    native: int,
    size: int,
    count: int,
    samples: TrainingSamples,
    generator: torch.Generator,
) -> Batch:
    """Draw `count` random training samples of side `size`.

    Args:
        references: The pictures to learn; all of their pixels may be used.
        native: Side in pixels to which distillation resizes a whole view. Global samples are resized to it, too.
        size: Side of a sample in pixels. If it is smaller than `native`, a global sample is a window of the resized
            view that shows part of the hole, so that its scale is that of distillation.
        count: Number of samples.
        samples: Parameters of the samples.
        generator: The source of randomness, on the CPU.
    """
    images, masks, prompts = [], [], []
    for _ in range(count):
        source = references[int(torch.randint(len(references), (), generator=generator))]
        image, hole, prompt = _sample_of_reference(source, native, size, samples.local_share, generator)
        images.append(image)
        use_hole = hole.any() and not hole.all() and _uniform(0, 1, generator) < samples.hole_share
        masks.append(hole if use_hole else rectangle_mask(size, generator))
        prompts.append(EMPTY if _uniform(0, 1, generator) < EMPTY_SHARE else prompt)
    return Batch(torch.stack(images), torch.stack(masks), torch.tensor(prompts))


def _sample_of_reference(
    source: Picture, native: int, size: int, local_share: float, generator: torch.Generator
) -> tuple[Tensor, Tensor, int]:
    """Draw a sample of a reference: image [3, size, size], hole [1, size, size] (1 = hole), and index of its prompt."""
    if _uniform(0, 1, generator) < local_share:
        image, hole, prompt = source.image, source.region[None].to(torch.float32), LOCAL
    else:
        whole = crop_border(source, generator)
        image, hole = two_scales(whole.image, [], native)[0], two_scale_masks(whole.region, [], native)[0]
        prompt = GLOBAL
    if hole.shape[-2:] == (size, size):
        return image, hole, prompt
    # Cropping may have removed the hole, or all that was known beside it.
    window = window_around if hole.any() and not hole.all() else _window_anywhere
    top, left = window(hole[0] > 0, size, generator)
    return image[:, top : top + size, left : left + size], hole[:, top : top + size, left : left + size], prompt


def _window_anywhere(mask: Tensor, size: int, generator: torch.Generator) -> tuple[int, int]:
    top, left = (int(torch.randint(extent - size + 1, (), generator=generator)) for extent in mask.shape)
    return top, left

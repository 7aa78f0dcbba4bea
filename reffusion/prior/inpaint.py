"""2D inpainting of a view by the prior, at the view's full resolution, coarse to fine, with several candidates."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from reffusion.io.images import to_uint8
from reffusion.prior import diffusion, harmonic_fill
from reffusion.prior.model import Prior
from reffusion.prior.windows import resize
from reffusion.seeding import generator as seeded
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians


@torch.no_grad()
def composite_background(remaining: Gaussians, camera: Camera, photo: np.ndarray, consistent: np.ndarray) -> np.ndarray:
    """Return a view without the object, as far as its background is known, uint8 [H, W, 3].

    Outside C (the consistent mask, which shows the object) this is the photograph. Inside C it is a rendering of the
    remaining Gaussians, which shows the background that other views observed. Where no view observed it, the rendering
    is meaningless.

    Args:
        remaining: The Gaussians without those of the object.
        camera: The camera of the view.
        photo: uint8 [H, W, 3], the photograph.
        consistent: bool [H, W], the mask C.
    """
    rendering = rasterizer.render(remaining, camera).color.cpu().numpy()
    return np.where(consistent[..., None], to_uint8(rendering), photo)


def to_input(picture: np.ndarray) -> Tensor:
    """Convert a picture, uint8 [H, W, 3], to the input of `paint`, float32 [3, H, W] in [-1, 1]."""
    return torch.from_numpy(picture).permute(2, 0, 1) / 127.5 - 1


def to_picture(painted: Tensor) -> np.ndarray:
    """Convert an output of `paint`, [3, H, W] in [-1, 1], to a picture, uint8 [H, W, 3]."""
    return to_uint8((painted.permute(1, 2, 0).cpu().numpy() + 1) / 2)


def level_sizes(height: int, width: int, size: int) -> list[tuple[int, int]]:
    """Return the (height, width) of each refinement level: the shorter side doubles from 2 x `size` to the full view.

    The last level has the size of the view. A view whose shorter side is at most `size` has one level, in which this
    side is `size`.
    """
    shorter = min(height, width)
    sizes, side = [], 2 * size
    while side < shorter:
        sizes.append((round(height * side / shorter), round(width * side / shorter)))
        side *= 2
    factor = max(1.0, size / shorter)
    return [*sizes, (round(height * factor), round(width * factor))]


def windows_over(hole: Tensor, size: int) -> Iterator[tuple[int, int]]:
    """Yield the corner (top, left) of size x size windows that together cover a hole and overlap by half.

    Args:
        hole: bool [H, W], True at the pixels to cover.
        size: Side of a window in pixels, at most min(H, W).
    """
    height, width = hole.shape
    uncovered = hole.clone()
    while uncovered.any():
        rows, columns = torch.nonzero(uncovered, as_tuple=True)
        row = int(rows[0])
        column = int(columns[rows < row + size // 2].min())
        top = min(max(row - size // 4, 0), height - size)
        left = min(max(column - size // 4, 0), width - size)
        yield top, left
        uncovered[top : top + 3 * size // 4, left : left + 3 * size // 4] = False
        if top == height - size:
            uncovered[top:, left : left + 3 * size // 4] = False
        if left == width - size:
            uncovered[top : top + 3 * size // 4, left:] = False
        if top == height - size and left == width - size:
            uncovered[top:, left:] = False


@torch.no_grad()
def paint(
    prior: Prior,
    image: Tensor,
    hole: Tensor,
    *,
    prompt: str,
    seeds: Sequence[int],
    steps: int,
    guidance: float,
    start: float,
    finest: float,
) -> Tensor:
    """Return copies of a view, each with another candidate painted into its hole. All other pixels are unchanged.

    First the whole view is painted at the prior's native size from the noise level `start`. Each finer level
    (`level_sizes`) starts from the enlarged result of the coarser level, and is repainted window by window from the
    noise level `finest`. A window sees the results of its neighbors. The seeds determine the result.

    Args:
        prior: The diffusion prior.
        image: [3, H, W] float32 in [-1, 1]. Pixels inside the hole are ignored.
        hole: bool [H, W], with at least one True pixel.
        prompt: The text prompt.
        seeds: One seed for each candidate.
        steps: Number of sampler steps from pure noise. A lower noise level takes a proportional part of them.
        guidance: γ, the strength of classifier-free guidance.
        start: Initial noise level of the whole view in (0, 1], as a fraction of the schedule (1 = pure noise). Below 1
            noise is added to the harmonic extension of the known pixels into the hole.
        finest: Initial noise level at finer levels.

    Returns:
        [len(seeds), 3, H, W] in [-1, 1], in the order of the seeds, on the prior's device.
    """
    text, empty = diffusion.embed_text(prior, [prompt, ""]).split(1)

    def sample(images: Tensor, mask: Tensor, *place: int, start: float, level: int | str) -> Tensor:
        # Each candidate has its own generator, so that it does not depend on the number of candidates.
        share = max(1, round(steps * start))
        rows = []
        for image, seed in zip(images, seeds, strict=True):
            random = seeded(seed, "inpaint", level, *place)
            rows.append(diffusion.sample(prior, image[None], mask, text, share, random, guidance, empty, start))
        return torch.cat(rows)

    image, hole = image.to(prior.device), hole.to(prior.device)
    return paint_coarse_to_fine(sample, prior.native_size, image, hole, len(seeds), start, finest)


@torch.no_grad()
def paint_coarse_to_fine(
    sample: Callable[..., Tensor], size: int, image: Tensor, hole: Tensor, count: int, start: float, finest: float
) -> Tensor:
    """Return `count` copies of a view whose hole a sampler of square pictures has painted, as `paint` describes.

    Args:
        sample: Function (pictures [count, 3, size, size] in [-1, 1], mask [1, 1, size, size] (1 = repaint), corner of
            the window: top, left; none for the whole view; start=initial noise level, level=number of the level or
            "whole") -> new pictures of the same shape. Their known pixels are not used.
        size: Side in pixels of the sampler's pictures.
        image: [3, H, W] float32 in [-1, 1]. Pixels inside the hole are ignored.
        hole: bool [H, W], with at least one True pixel, on the device of the image.
        count: Number of candidates.
        start, finest: Initial noise levels of the whole view and of finer levels.

    Returns:
        [count, 3, H, W] in [-1, 1], on the device of the image.
    """
    height, width = hole.shape
    known = image[None] * ~hole
    whole_hole = hole.to(torch.float32)[None, None]

    def scaled(shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
        # Dividing by weights keeps the empty hole from darkening the pixels around it.
        weight = resize(1 - whole_hole, *shape)
        return resize(known, *shape) / weight.clamp_min(1e-3), (weight < 1 - 1e-4).to(torch.float32)

    view, mask = scaled((size, size))
    initial = harmonic_fill.harmonic_extension(view, mask)
    painted = sample(initial.expand(count, -1, -1, -1), mask, start=start, level="whole")
    for level, shape in enumerate(level_sizes(height, width, size)):
        view, mask = scaled(shape)
        painted = view * (1 - mask) + resize(painted, *shape) * mask
        _paint_windows(painted, mask, size, partial(sample, start=finest, level=level))
    painted = resize(painted, height, width)
    return image * (1 - whole_hole) + painted * whole_hole


def _paint_windows(painted: Tensor, mask: Tensor, size: int, sample: Callable[..., Tensor]) -> None:
    """Repaint the masked pixels of `painted` [B, 3, h, w] in place, window by window of `size` px, by `sample`."""
    remaining = mask[0, 0] > 0
    # A window sees the results of its neighbors. `sample` gets pictures of a window, `part` [1, 1, size, size] which
    # is 1 at the pixels that are used, top and left, and returns new pictures of the window.
    for top, left in windows_over(remaining.cpu(), size):
        window = (..., slice(top, top + size), slice(left, left + size))
        if not remaining[window].any():
            continue
        part = remaining[window].to(torch.float32)[None, None]
        repainted = sample(painted[window], part, top, left)
        painted[window] = painted[window] * (1 - part) + repainted * part
        remaining[window] = False


@torch.no_grad()
def repaint(
    prior: Prior,
    image: Tensor,
    hole: Tensor,
    text: Tensor,
    random: torch.Generator,
    *,
    start: float,
    finest: float,
    levels: int,
    steps: int,
    guidance: float,
) -> Tensor:
    """Return a view whose hole is repainted from its present content. The smaller `start`, the less the hole changes.

    The whole view is repainted at the prior's native size, then at the first `levels` of the finer sizes of
    `level_sizes`. The change at one size is enlarged and added to the view at the next size, so that the view keeps its
    own detail.

    Args:
        prior: The diffusion prior.
        image: [3, H, W] in [-1, 1].
        hole: bool [H, W], with at least one True pixel.
        text: [3, L, D], the hidden states of the prompt for the whole view, of the prompt for windows, and of the empty
            prompt.
        random: Draws the noise, on the CPU.
        start: Initial noise level of the whole view in (0, 1], as a fraction of the schedule.
        finest: Upper limit of the noise level at finer sizes. From pure noise a window would ignore the whole view.
        levels: Number of finer sizes.
        steps: Number of sampler steps from pure noise. A lower noise level takes a proportional part of them.
        guidance: γ, the strength of classifier-free guidance.

    Returns:
        [3, H, W] in [-1, 1]. Pixels outside the hole are unchanged.
    """
    size, (height, width), device = prior.native_size, hole.shape, prior.device
    view, whole_hole = image.to(device)[None], hole.to(device, torch.float32)[None, None]
    empty = text[2:]

    def sample(prompt: Tensor, begin: float) -> Callable[..., Tensor]:
        share = max(1, round(steps * begin))
        return lambda images, mask, *_: diffusion.sample(
            prior, images, mask, prompt, share, random, guidance, empty, begin
        )

    change = view.new_zeros(1, 3, 1, 1)
    for level, shape in enumerate([(size, size), *level_sizes(height, width, size)[:levels]]):
        small, mask = resize(view, *shape), (resize(whole_hole, *shape) > 1e-4).to(torch.float32)
        painted = (small + resize(change, *shape) * mask).clamp(-1, 1)
        if level == 0:
            painted = painted * (1 - mask) + sample(text[:1], start)(painted, mask) * mask
        else:
            _paint_windows(painted, mask, size, sample(text[1:2], min(start, finest)))
        change = painted - small
    return (view + resize(change, height, width) * whole_hole).clamp(-1, 1)[0]


def seam_score(candidates: Tensor, hole: Tensor) -> Tensor:
    """Return [B], the mean absolute color step across the boundary of the hole; a low value means no visible seam.

    The mean is over channels and over all pairs of neighboring pixels of which one is in the hole.

    PAPER leaves open: how the reference is chosen (the paper: by eye). Here by default the candidate with the lowest
    value is chosen.

    Args:
        candidates: [B, 3, H, W].
        hole: bool [H, W].
    """
    hole = hole.to(candidates.device)
    total, count = candidates.new_zeros(candidates.shape[0]), 0
    for axis in (0, 1):
        length = hole.shape[axis]
        first, second = hole.narrow(axis, 0, length - 1), hole.narrow(axis, 1, length - 1)
        border = first ^ second
        step = candidates.narrow(axis + 2, 1, length - 1) - candidates.narrow(axis + 2, 0, length - 1)
        total = total + (step.abs().mean(1) * border).sum((1, 2))
        count += int(border.sum())
    return total / max(count, 1)

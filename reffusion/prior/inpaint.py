"""A view completed in 2D by the prior, at the view's own resolution: coarse to fine, several candidates."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from reffusion.io.images import to_uint8
from reffusion.prior import diffusion
from reffusion.prior.model import Prior
from reffusion.seeding import generator as seeded
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians


@torch.no_grad()
def background(remaining: Gaussians, camera: Camera, photo: np.ndarray, consistent: np.ndarray) -> np.ndarray:
    """A view as far as it is known without the object, uint8 [H, W, 3]: the photo outside C, in C the remaining
    Gaussians' render, which shows what other views saw and nothing sensible where none did.

    Args:
        remaining: the Gaussians without the object's.
        photo: uint8 [H, W, 3]. consistent: C, bool [H, W].
    """
    drawn = rasterizer.render(remaining, camera).color.cpu().numpy()
    return np.where(consistent[..., None], to_uint8(drawn), photo)


def as_input(picture: np.ndarray) -> Tensor:
    """uint8 [H, W, 3] as `paint` takes it: float32 [3, H, W] in [-1, 1]."""
    return torch.from_numpy(picture).permute(2, 0, 1) / 127.5 - 1


def as_picture(painted: Tensor) -> np.ndarray:
    """[3, H, W] in [-1, 1] -> uint8 [H, W, 3]."""
    return to_uint8((painted.permute(1, 2, 0).cpu().numpy() + 1) / 2)


def resized(image: Tensor, height: int, width: int) -> Tensor:
    """[B, C, H, W] -> [B, C, height, width], bilinear, antialiased where it shrinks."""
    return F.interpolate(image, size=(height, width), mode="bilinear", align_corners=False, antialias=True)


def level_sizes(height: int, width: int, size: int) -> list[tuple[int, int]]:
    """(height, width) of each refinement level: the shorter side doubles from 2 x `size` until the view is full.

    A view whose shorter side is at most `size` is refined once, at the scale where that side is `size`.
    """
    shorter = min(height, width)
    sizes, side = [], 2 * size
    while side < shorter:
        sizes.append((round(height * side / shorter), round(width * side / shorter)))
        side *= 2
    factor = max(1.0, size / shorter)
    return [*sizes, (round(height * factor), round(width * factor))]


def windows_over(hole: Tensor, size: int) -> Iterator[tuple[int, int]]:
    """(top, left) of size x size windows, half overlapping, that cover the True pixels of a [H, W] bool hole."""
    height, width = hole.shape
    left_to_cover = hole.clone()
    while left_to_cover.any():
        rows, columns = torch.nonzero(left_to_cover, as_tuple=True)
        row = int(rows[0])
        column = int(columns[rows < row + size // 2].min())
        top = min(max(row - size // 4, 0), height - size)
        left = min(max(column - size // 4, 0), width - size)
        yield top, left
        left_to_cover[top : top + 3 * size // 4, left : left + 3 * size // 4] = False
        if top == height - size:
            left_to_cover[top:, left : left + 3 * size // 4] = False
        if left == width - size:
            left_to_cover[top : top + 3 * size // 4, left:] = False
        if top == height - size and left == width - size:
            left_to_cover[top:, left:] = False


@torch.no_grad()
def paint(
    prior: Prior,
    image: Tensor,
    hole: Tensor,
    *,
    prompt: str,
    seeds: Sequence[int],
    steps: int,
    start: float,
    guidance: float,
) -> Tensor:
    """Candidates for the pixels of `hole`; all others stay as they are.

    The whole view is painted at the prior's native size from pure noise. Each finer level (`level_sizes`) starts from
    the enlarged coarser one and is repainted window by window from the timestep `start`, every window seeing what
    its neighbours have become. Fully determined by the seeds.

    Args:
        image: [3, H, W] float32 in [-1, 1]; what lies inside the hole is not looked at.
        hole: [H, W] bool, with at least one True pixel.
        seeds: one for each candidate.
        steps: sampler steps from pure noise; a later start takes its share of them.
        start: in (0, 1], where each refinement starts in the schedule (1 = pure noise).
        guidance: the paper's a.
    Returns:
        [len(seeds), 3, H, W] in [-1, 1].
    """
    size, count, device = prior.native_size, len(seeds), prior.device
    height, width = hole.shape
    text, empty = diffusion.embed_text(prior, [prompt, ""]).split(1)
    known = image.to(device)[None] * ~hole.to(device)
    whole_hole = hole.to(device, torch.float32)[None, None]

    def sample(images: Tensor, mask: Tensor, *place: int, start: float, level: int | str) -> Tensor:
        # Each candidate has a generator of its own: its picture does not depend on how many others are asked for.
        share = max(1, round(steps * start))
        rows = []
        for image, seed in zip(images, seeds, strict=True):
            random = seeded(seed, "inpaint", level, *place)
            rows.append(diffusion.sample(prior, image[None], mask, text, share, random, guidance, empty, start))
        return torch.cat(rows)

    def scaled(shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
        # Weights keep the blank inside of the hole from darkening the pixels around it.
        weight = resized(1 - whole_hole, *shape)
        return resized(known, *shape) / weight.clamp_min(1e-3), (weight < 1 - 1e-4).to(torch.float32)

    view, mask = scaled((size, size))
    painted = sample((view * (1 - mask)).expand(count, -1, -1, -1), mask, start=1.0, level="whole")
    for level, shape in enumerate(level_sizes(height, width, size)):
        view, mask = scaled(shape)
        painted = view * (1 - mask) + resized(painted, *shape) * mask
        _paint_windows(painted, mask, size, partial(sample, start=start, level=level))
    painted = resized(painted, height, width)
    return image.to(device) * (1 - whole_hole) + painted * whole_hole


def _paint_windows(painted: Tensor, mask: Tensor, size: int, sample: Callable[..., Tensor]) -> None:
    """Paint `mask` [1, 1, h, w] of `painted` [B, 3, h, w] in place, each window seeing what its neighbours have become.

    `sample(images, part, top, left)` gives the new picture of a window and what of it is to be painted.
    """
    todo = mask[0, 0] > 0
    for top, left in windows_over(todo.cpu(), size):
        here = (..., slice(top, top + size), slice(left, left + size))
        if not todo[here].any():
            continue
        part = todo[here].to(torch.float32)[None, None]
        fresh = sample(painted[here], part, top, left)
        painted[here] = painted[here] * (1 - part) + fresh * part
        todo[here] = False


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
    """A view whose hole is painted anew, beginning with what it shows: the nearer `start` is to 0 the less changes.

    The whole view at the prior's native size, then `levels` of the finer sizes of `paint`. What a level changes is
    enlarged and added to the view at the next, so that the view's own detail is not lost with its size.

    Args:
        image: [3, H, W] in [-1, 1].
        hole: [H, W] bool, with at least one True pixel.
        text: [3, L, D], hidden states of the prompts for the whole view and for windows, and of the empty one.
        random: a CPU generator.
        start: in (0, 1], the timestep from which the whole view is painted, as a part of the schedule.
        finest: the finer levels start no higher; from pure noise a window would forget the whole.
        steps: sampler steps from pure noise; a later start takes its share of them.
        guidance: the paper's a.
    Returns:
        [3, H, W] in [-1, 1]; pixels outside the hole as they were.
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
        small, mask = resized(view, *shape), (resized(whole_hole, *shape) > 1e-4).to(torch.float32)
        painted = (small + resized(change, *shape) * mask).clamp(-1, 1)
        if level == 0:
            painted = painted * (1 - mask) + sample(text[:1], start)(painted, mask) * mask
        else:
            _paint_windows(painted, mask, size, sample(text[1:2], min(start, finest)))
        change = painted - small
    return (view + resized(change, height, width) * whole_hole).clamp(-1, 1)[0]


def seam(candidates: Tensor, hole: Tensor) -> Tensor:
    """[B]: mean absolute colour step between each pixel of the hole and its neighbours outside; low is seamless.

    PAPER leaves open: how its reference is chosen (by eye). The default choice is the candidate of the lowest seam.

    Args:
        candidates: [B, 3, H, W].
        hole: [H, W] bool.
    """
    hole = hole.to(candidates.device)
    total, count = candidates.new_zeros(candidates.shape[0]), 0
    for axis in (0, 1):
        length = hole.shape[axis]
        before, after = hole.narrow(axis, 0, length - 1), hole.narrow(axis, 1, length - 1)
        border = before ^ after
        step = candidates.narrow(axis + 2, 1, length - 1) - candidates.narrow(axis + 2, 0, length - 1)
        total = total + (step.abs().mean(1) * border).sum((1, 2))
        count += int(border.sum())
    return total / max(count, 1)

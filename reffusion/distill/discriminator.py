"""The patch critic of the adversarial term (RefFusion section 4.3): a residual discriminator of StyleGAN2's kind.

The losses are written with f(x) = -log(1 + exp(-x)), the logarithm of the logistic function, and D the critic's score,
large where it takes a patch for real. The critic raises f(D(real)) + f(-D(fake)); the fake patches' maker lowers it.

PAPER leaves open: the discriminator beyond its being StyleGAN2's. Taken: its residual form, equalised learning rates,
the [1, 3, 3, 1] filter before each halving (anti-aliased), minibatch standard deviation over groups of 4.
"""

from __future__ import annotations

from math import sqrt
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

Form = Literal["non-saturating", "saturating"]
SLOPE, GAIN = 0.2, sqrt(2)  # leaky ReLU, and the factor after it that keeps the size of what passes
LAST = 4  # px, the side at which halving ends
MOST_CHANNELS = 512  # however often they are doubled
GROUP = 4  # patches whose deviation is taken together


class Convolution(nn.Module):
    """A square convolution with equalised learning rate: unit normal weights, divided by sqrt(fan-in) when used.

    So every layer's weights are of one size, and a step of the optimiser changes all layers alike.
    """

    def __init__(self, inputs: int, outputs: int, side: int, generator: torch.Generator, stride=1, padding=0):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs, side, side, generator=generator))
        self.bias = nn.Parameter(torch.zeros(outputs))
        self.scale, self.stride, self.padding = 1 / sqrt(inputs * side**2), stride, padding

    def forward(self, x: Tensor) -> Tensor:
        return F.conv2d(x, self.weight * self.scale, self.bias, stride=self.stride, padding=self.padding)


class Linear(nn.Module):
    """A linear map with equalised learning rate, as `Convolution`."""

    def __init__(self, inputs: int, outputs: int, generator: torch.Generator):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs, generator=generator))
        self.bias = nn.Parameter(torch.zeros(outputs))
        self.scale = 1 / sqrt(inputs)

    def forward(self, x: Tensor) -> Tensor:
        return F.linear(x, self.weight * self.scale, self.bias)


class Halving(nn.Module):
    """A residual block: [B, C, size, size] -> [B, C', size / 2, size / 2], size even."""

    def __init__(self, size: int, inputs: int, outputs: int, generator: torch.Generator):
        super().__init__()
        self.first = Convolution(inputs, inputs, 3, generator, padding=1)
        self.second = Convolution(inputs, outputs, 3, generator, stride=2)
        self.skip = Convolution(inputs, outputs, 1, generator)
        self.register_buffer("smooth", binomial(size, padding=2), persistent=False)
        self.register_buffer("halve", binomial(size, padding=1)[::2].contiguous(), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        deep = self.smooth @ leaky(self.first(x)) @ self.smooth.T
        return (leaky(self.second(deep)) + self.skip(self.halve @ x @ self.halve.T)) / sqrt(2)


class Critic(nn.Module):
    """Patches [B, 3, size, size] in [-1, 1] -> scores [B].

    Args:
        size: side of a patch in pixels, 8, 16, 32, ...
        width: channels at that size; doubled with each halving, 512 at most.
        generator: on the CPU; of the first weights.
    Raises:
        ValueError: another size; a batch that is not a multiple of 4 patches (see `with_deviation`).
    """

    def __init__(self, size: int, width: int, generator: torch.Generator):
        super().__init__()
        halvings = (size // LAST).bit_length() - 1
        if halvings < 1 or size != LAST << halvings:
            raise ValueError(f"the side of a critic's patches must be 8, 16, 32, ... px, got {size}")
        channels = [min(width << level, max(width, MOST_CHANNELS)) for level in range(halvings + 1)]
        self.colors = Convolution(3, channels[0], 1, generator)
        self.halvings = nn.ModuleList(
            Halving(size >> level, channels[level], channels[level + 1], generator) for level in range(halvings)
        )
        self.mixed = Convolution(channels[-1] + 1, channels[-1], 3, generator, padding=1)
        self.dense = Linear(channels[-1] * LAST**2, channels[-1], generator)
        self.score = Linear(channels[-1], 1, generator)

    def forward(self, patches: Tensor) -> Tensor:
        x = leaky(self.colors(patches))
        for halving in self.halvings:
            x = halving(x)
        x = leaky(self.mixed(with_deviation(x)))
        return self.score(leaky(self.dense(x.flatten(1))))[:, 0]


def leaky(x: Tensor) -> Tensor:
    return F.leaky_relu(x, SLOPE) * GAIN


def binomial(size: int, padding: int) -> Tensor:
    """[size + 2 padding - 3, size]: convolution of a line with [1, 3, 3, 1] / 8, zeros around it, as a matrix.

    A product with it from either side filters images: on the CPU many times faster than a convolution of each channel.
    """
    matrix = torch.zeros(size + 2 * padding - 3, size + 2 * padding)
    for tap, weight in enumerate((1, 3, 3, 1)):
        matrix.diagonal(tap).fill_(weight / 8)
    return matrix[:, padding:-padding].contiguous()


def with_deviation(features: Tensor, group: int = GROUP) -> Tensor:
    """Minibatch standard deviation: a channel more, [B, C, h, w] -> [B, C + 1, h, w], constant within each group.

    Its value is the standard deviation over the group's patches, averaged over channels and pixels: fake patches that
    are too much alike are seen to be. A group is every (B / group)-th patch, so that neighbours are in different ones.

    Raises:
        ValueError: B is no multiple of `group`.
    """
    batch = len(features)
    if batch % group:
        raise ValueError(f"{batch} patches cannot be split into groups of {group}")
    grouped = features.reshape(group, batch // group, *features.shape[1:])
    # Under the root stands no zero: its slope there is infinite.
    deviation = (grouped.var(0, unbiased=False) + 1e-8).sqrt().mean((1, 2, 3))
    return torch.cat([features, deviation.repeat(group)[:, None, None, None].expand_as(features[:, :1])], dim=1)


def critic_loss(real: Tensor, fake: Tensor) -> Tensor:
    """-mean f(D(real)) - mean f(-D(fake)), from scores of any shape; finite at every finite score."""
    return -F.logsigmoid(real).mean() - F.logsigmoid(-fake).mean()


def generator_loss(fake: Tensor, form: Form = "non-saturating") -> Tensor:
    """What the maker of the fake patches minimises, from their scores.

    PAPER leaves open: which form. "saturating", mean f(-D(fake)), is the critic's own objective: its slope vanishes
    where the critic is sure. "non-saturating", -mean f(D(fake)), has the same fixed point and pulls hardest there.
    """
    if form == "saturating":
        return F.logsigmoid(-fake).mean()
    if form == "non-saturating":
        return -F.logsigmoid(fake).mean()
    raise ValueError(f"the generator's loss must be saturating or non-saturating, got {form!r}")


def gradient_penalty(scores: Tensor, patches: Tensor) -> Tensor:
    """R1: the mean over patches of ||dD / d patch||^2, differentiable in the critic's weights.

    Args:
        scores: [B], the critic's at `patches`. patches: [B, 3, n, n], requiring a gradient.
    """
    (slope,) = torch.autograd.grad(scores.sum(), patches, create_graph=True)
    return slope.square().flatten(1).sum(1).mean()


def gathered(image: Tensor, windows: Tensor, size: int) -> Tensor:
    """Patches of an image in one indexing call: [C, H, W] -> [P, C, size, size], differentiable.

    Args:
        windows: [P, 2] long, (top, left) of each, all of them inside the image.
    """
    return _Gather.apply(image, windows, size)


class _Gather(torch.autograd.Function):
    """Indexing whose gradient is summed patch by patch: that of torch's indexing adds in the order threads arrive."""

    @staticmethod
    def forward(ctx, image: Tensor, windows: Tensor, size: int) -> Tensor:
        ctx.shape, ctx.corners = image.shape, windows.tolist()
        inside = torch.arange(size, device=image.device)
        rows, columns = (windows[:, i, None].to(image.device) + inside for i in (0, 1))
        return image[:, rows[:, :, None], columns[:, None, :]].transpose(0, 1).contiguous()

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor):
        size, total = gradient.shape[-1], gradient.new_zeros(ctx.shape)
        for patch, (top, left) in zip(gradient, ctx.corners, strict=True):
            total[:, top : top + size, left : left + size] += patch
        return total, None, None

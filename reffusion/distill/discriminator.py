"""The patch critic of the adversarial term (RefFusion section 4.3): StyleGAN2's residual discriminator and its losses.

The losses are written with f(x) = -log(1 + exp(-x)), the logarithm of the logistic function, and with the critic's
score D of a patch, which is high if the critic takes the patch for real. The critic maximizes f(D(real)) + f(-D(fake)).
The generator, here the Gaussians, minimizes it.

PAPER leaves open: details of the discriminator beyond StyleGAN2's name. We take its residual form, equalized learning
rates, the anti-aliasing filter [1, 3, 3, 1] before each downsampling, and the minibatch standard deviation over groups
of 4.
"""

from __future__ import annotations

from math import sqrt
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

Form = Literal["non-saturating", "saturating"]
SLOPE = 0.2  # of the leaky ReLU below 0
GAIN = sqrt(2)  # factor after the leaky ReLU, which keeps the variance of activations
LAST_SIZE = 4  # px, the side of the feature maps at which downsampling ends
MAX_CHANNELS = 512
GROUP = 4  # patches in a group of the minibatch standard deviation


class Convolution(nn.Module):
    """A square convolution with equalized learning rate.

    Its weights are standard normal at first, and are divided by sqrt(fan-in) when they are used. So the weights of all
    layers have the same scale, and an optimizer step changes all layers by the same proportion.
    """

    def __init__(self, inputs: int, outputs: int, side: int, generator: torch.Generator, stride=1, padding=0):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs, side, side, generator=generator))
        self.bias = nn.Parameter(torch.zeros(outputs))
        self.scale, self.stride, self.padding = 1 / sqrt(inputs * side**2), stride, padding

    def forward(self, x: Tensor) -> Tensor:
        """Return the convolution, with bias, of `x` [B, inputs, H, W]."""
        return F.conv2d(x, self.weight * self.scale, self.bias, stride=self.stride, padding=self.padding)


class Linear(nn.Module):
    """A linear layer with equalized learning rate, like `Convolution`."""

    def __init__(self, inputs: int, outputs: int, generator: torch.Generator):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs, generator=generator))
        self.bias = nn.Parameter(torch.zeros(outputs))
        self.scale = 1 / sqrt(inputs)

    def forward(self, x: Tensor) -> Tensor:
        """Return the layer's outputs [B, outputs] for `x` [B, inputs]."""
        return F.linear(x, self.weight * self.scale, self.bias)


class DownBlock(nn.Module):
    """A residual block that halves the size: [B, C, size, size] -> [B, C', size / 2, size / 2], for an even size."""

    def __init__(self, size: int, inputs: int, outputs: int, generator: torch.Generator):
        super().__init__()
        self.first = Convolution(inputs, inputs, 3, generator, padding=1)
        self.second = Convolution(inputs, outputs, 3, generator, stride=2)
        self.skip = Convolution(inputs, outputs, 1, generator)
        self.register_buffer("smooth", binomial_filter(size, padding=2), persistent=False)
        self.register_buffer("halve", binomial_filter(size, padding=1)[::2].contiguous(), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Return the sum of the filtered branch and the skip branch at half the size, divided by sqrt(2)."""
        deep = self.smooth @ scaled_leaky_relu(self.first(x)) @ self.smooth.T
        return (scaled_leaky_relu(self.second(deep)) + self.skip(self.halve @ x @ self.halve.T)) / sqrt(2)


class Critic(nn.Module):
    """The discriminator, which maps patches [B, 3, size, size] in [-1, 1] to scores [B].

    Args:
        size: Side of a patch in pixels: 8, 16, 32, ...
        width: Number of channels at full size. It doubles with each downsampling, up to 512.
        generator: Draws the initial weights, on the CPU.

    Raises:
        ValueError: The size is another one, or a batch is not a multiple of 4 patches (see `append_minibatch_std`).
    """

    def __init__(self, size: int, width: int, generator: torch.Generator):
        super().__init__()
        halvings = (size // LAST_SIZE).bit_length() - 1
        if halvings < 1 or size != LAST_SIZE << halvings:
            raise ValueError(f"the side of a critic's patches must be 8, 16, 32, ... px, got {size}")
        channels = [min(width << level, max(width, MAX_CHANNELS)) for level in range(halvings + 1)]
        self.colors = Convolution(3, channels[0], 1, generator)
        self.halvings = nn.ModuleList(
            DownBlock(size >> level, channels[level], channels[level + 1], generator) for level in range(halvings)
        )
        self.mixed = Convolution(channels[-1] + 1, channels[-1], 3, generator, padding=1)
        self.dense = Linear(channels[-1] * LAST_SIZE**2, channels[-1], generator)
        self.score = Linear(channels[-1], 1, generator)

    def forward(self, patches: Tensor) -> Tensor:
        """Return the scores [B] of `patches` [B, 3, size, size] in [-1, 1]; B is a multiple of 4."""
        x = scaled_leaky_relu(self.colors(patches))
        for halving in self.halvings:
            x = halving(x)
        x = scaled_leaky_relu(self.mixed(append_minibatch_std(x)))
        return self.score(scaled_leaky_relu(self.dense(x.flatten(1))))[:, 0]


def scaled_leaky_relu(x: Tensor) -> Tensor:
    """Return the leaky ReLU of `x`, multiplied by `GAIN`."""
    return F.leaky_relu(x, SLOPE) * GAIN


def binomial_filter(size: int, padding: int) -> Tensor:
    """Return the matrix [size + 2 padding - 3, size] that convolves a zero-padded row with [1, 3, 3, 1] / 8.

    An image is filtered by multiplying it with this matrix from both sides. On the CPU this is many times faster than a
    convolution per channel.

    Args:
        size: Length of the row.
        padding: Number of zeros at each end of the row, at least 1.
    """
    matrix = torch.zeros(size + 2 * padding - 3, size + 2 * padding)
    for tap, weight in enumerate((1, 3, 3, 1)):
        matrix.diagonal(tap).fill_(weight / 8)
    return matrix[:, padding:-padding].contiguous()


def append_minibatch_std(features: Tensor) -> Tensor:
    """Append the minibatch standard deviation as a channel: [B, C, h, w] -> [B, C + 1, h, w].

    The channel is constant within a group of patches. Its value is the standard deviation over the group, averaged over
    channels and pixels. By this value the critic recognizes fake patches that are too similar to each other. A group
    consists of every (B / GROUP)-th patch, so consecutive patches are in different groups (if B > GROUP).

    Args:
        features: [B, C, h, w].

    Raises:
        ValueError: B is no multiple of `GROUP`.
    """
    batch = len(features)
    if batch % GROUP:
        raise ValueError(f"{batch} patches cannot be split into groups of {GROUP}")
    grouped = features.reshape(GROUP, batch // GROUP, *features.shape[1:])
    # The offset keeps the square root's derivative finite where all patches are equal.
    deviation = (grouped.var(0, unbiased=False) + 1e-8).sqrt().mean((1, 2, 3))
    return torch.cat([features, deviation.repeat(GROUP)[:, None, None, None].expand_as(features[:, :1])], dim=1)


def critic_loss(real: Tensor, fake: Tensor) -> Tensor:
    """Return the loss of the critic, -mean f(D(real)) - mean f(-D(fake)), which is finite for all finite scores.

    Args:
        real, fake: Scores of real and of fake patches, of any shape.
    """
    return -F.logsigmoid(real).mean() - F.logsigmoid(-fake).mean()


def generator_loss(fake: Tensor, form: Form = "non-saturating") -> Tensor:
    """Return the loss that the generator minimizes.

    The paper prints "saturating", mean f(-D(fake)): the critic's own objective, whose gradient vanishes where the
    critic is certain that a patch is fake. "non-saturating", -mean f(D(fake)), has the same fixed point, and its
    gradient is largest where the critic is certain.

    Args:
        fake: Scores of fake patches, of any shape.
        form: One of the two forms.
    """
    return F.logsigmoid(-fake).mean() if form == "saturating" else -F.logsigmoid(fake).mean()


def gradient_penalty(scores: Tensor, patches: Tensor) -> Tensor:
    """Return the R1 penalty, the mean over patches of ||dD / d patch||^2, differentiable in the critic's weights.

    Args:
        scores: [B], the critic's scores of `patches`.
        patches: [B, 3, n, n] with requires_grad, from which `scores` were computed.
    """
    (slope,) = torch.autograd.grad(scores.sum(), patches, create_graph=True)
    return slope.square().flatten(1).sum(1).mean()


def gather_patches(image: Tensor, windows: Tensor, size: int) -> Tensor:
    """Crop patches from an image in one indexing call: [C, H, W] -> [P, C, size, size], differentiable.

    Args:
        image: [C, H, W].
        windows: long [P, 2], (top, left) of each patch. The patches lie inside the image.
        size: Side of a patch in pixels.
    """
    return _Gather.apply(image, windows, size)


class _Gather(torch.autograd.Function):
    """Indexing with a deterministic gradient, which is summed patch by patch.

    The gradient of torch's own indexing is summed in the order in which threads finish.
    """

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

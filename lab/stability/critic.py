"""Cases of the adversarial term's critic."""

from __future__ import annotations

from functools import cache

import torch

from lab.stability.cases import EPS32, EXACT, Case, nan_safe_max
from reffusion import seeding
from reffusion.distill import discriminator


def critic_error() -> float:
    """Return the largest error of the critic's losses and their slopes at scores of +-1e4.

    At such scores the loss log(1 + e^x) equals its limit max(0, x), and its slope 0 or 1. Errors of losses are relative
    to 1e4.
    """
    worst = 0.0
    for score in (1e4, -1e4):
        for loss, limit, slope in (
            (lambda x: discriminator.critic_loss(x, torch.zeros(4)), max(0.0, -score), -float(score < 0)),
            (lambda x: discriminator.critic_loss(torch.zeros(4), x), max(0.0, score), float(score > 0)),
        ):
            scores = torch.full((4,), score, requires_grad=True)
            value = loss(scores) - torch.tensor(2.0).log()  # the loss of scores of zero
            value.backward()
            worst = nan_safe_max(worst, abs(value.item() - limit) / 1e4, (scores.grad * 4 - slope).abs().max().item())
    return worst


def generator_error() -> float:
    """Return the largest error of the generator's losses, in both forms, and of their slopes at scores of +-1e4.

    Errors of losses are relative to 1e4.
    """
    worst = 0.0
    for form in ("non-saturating", "saturating"):
        for score in (1e4, -1e4):
            scores = torch.full((4,), score, requires_grad=True)
            value = discriminator.generator_loss(scores, form)
            value.backward()
            limit = -max(0.0, score) if form == "saturating" else max(0.0, -score)
            slope = -float(score > 0) if form == "saturating" else -float(score < 0)
            worst = nan_safe_max(worst, abs(value.item() - limit) / 1e4, (scores.grad * 4 - slope).abs().max().item())
    return worst


@cache
def critic() -> discriminator.Critic:
    """Make a small critic for patches of 16 px."""
    return discriminator.Critic(16, 8, seeding.generator(0, "critic"))


def flat_critic_penalty() -> float:
    """Return the largest of the gradient penalty and its gradients for a critic whose weights are all zero.

    Gradients are those with respect to the weights. Such a critic has no slope, so all of them must be 0.
    """
    flat = discriminator.Critic(16, 8, seeding.generator(0))
    for weight in flat.parameters():
        weight.data.zero_()
    patches = torch.rand(4, 3, 16, 16, generator=seeding.generator(1)).requires_grad_()
    penalty = discriminator.gradient_penalty(flat(patches), patches)
    slopes = torch.autograd.grad(penalty, list(flat.parameters()), allow_unused=True)
    values = [penalty.item(), *(slope.abs().max().item() for slope in slopes if slope is not None)]
    return nan_safe_max(*values)


def count_invalid_scores() -> float:
    """Count non-finite scores and gradients of a critic for eight equal patches.

    The standard deviation over equal patches is the root of zero, whose slope is infinite.
    """
    patches = torch.full((8, 3, 16, 16), 0.25, requires_grad=True)
    scores = critic()(patches)
    penalty = discriminator.gradient_penalty(scores, patches)
    slopes = torch.autograd.grad(scores.sum() + penalty, [patches, *critic().parameters()], allow_unused=True)
    return float(sum((~torch.isfinite(x)).sum() for x in (scores, *slopes) if x is not None))


CASES = (
    Case("discriminator logits +-1e4, critic", "relative error of losses and slopes", 8 * EPS32, critic_error),
    Case("discriminator logits +-1e4, generator", "relative error of losses and slopes", 8 * EPS32, generator_error),
    Case("discriminator, zero gradients", "penalty and its largest gradient", EXACT, flat_critic_penalty),
    Case("discriminator, equal patches", "numbers that are not finite", EXACT, count_invalid_scores),
)  # fmt: skip

"""The patch critic (the discriminator of the adversarial loss) and its losses.

Values are compared with closed forms in float64, gradients with finite differences. The critic must learn to separate
two textures.
"""

import numpy as np
import pytest
import torch
from scenes.settings import with_changes

from reffusion.distill.adversary import Adversary
from reffusion.distill.discriminator import (
    Critic,
    append_minibatch_std,
    binomial_filter,
    critic_loss,
    gather_patches,
    generator_loss,
    gradient_penalty,
)
from reffusion.distill.terms.adversarial import draw_patches
from reffusion.params.distill import AdversarialTerm
from reffusion.prior.windows import windows_around
from reffusion.seeding import generator

pytestmark = pytest.mark.integration

SMALL, RATE = AdversarialTerm(patches=16, size=8, width=8), 3e-3


def random_normal(*shape, label=0, dtype=torch.float32):
    return torch.randn(*shape, generator=generator(9, label), dtype=dtype)


# ------------------------------------------------------------------------------------------ losses

LOGITS = torch.tensor([-1e4, -100.0, -30.0, -3.0, -1e-3, 0.0, 0.5, 20.5, 90.0, 1e4])


def log_sigmoid_loss(x):
    """Return f(x) = -log(1 + exp(-x)) and its derivative, computed in float64 without overflow."""
    x = np.asarray(x, np.float64)
    return -np.logaddexp(0, -x), np.exp(-np.logaddexp(0, x))


def test_losses_are_the_papers_at_any_logit():
    f, slope = log_sigmoid_loss(LOGITS)
    g, back = log_sigmoid_loss(-LOGITS)
    forms = {
        "critic, real": (lambda x: critic_loss(x, torch.full_like(x, -1e9)), -f, -slope),
        "critic, fake": (lambda x: critic_loss(torch.full_like(x, 1e9), x), -g, back),
        "non-saturating": (lambda x: generator_loss(x, "non-saturating"), -f, -slope),
        "saturating": (lambda x: generator_loss(x, "saturating"), g, -back),
    }
    for name, (loss, value, derivative) in forms.items():
        for dtype, tolerance in ((torch.float32, 2e-6), (torch.float64, 1e-12)):
            for i, logit in enumerate(LOGITS.to(dtype)):
                x = logit.clone().requires_grad_()
                out = loss(x)
                out.backward()
                assert out.item() == pytest.approx(value[i], rel=tolerance, abs=1e-37), (name, logit)
                assert x.grad.item() == pytest.approx(derivative[i], rel=tolerance, abs=1e-37), (name, logit)


def test_the_saturating_form_vanishes_where_the_critic_is_certain():
    logits = torch.tensor([-2.0, -5.0, -8.0], dtype=torch.float64, requires_grad=True)
    for form, slopes in (("saturating", [0.12, 0.0067, 0.0003]), ("non-saturating", [0.88, 0.993, 0.9997])):
        (gradient,) = torch.autograd.grad(len(logits) * generator_loss(logits, form), logits)
        assert gradient.abs().tolist() == pytest.approx(slopes, rel=0.12)


def test_losses_are_means():
    x = random_normal(7)
    assert critic_loss(x, -x).item() == pytest.approx(-2 * log_sigmoid_loss(x)[0].mean(), rel=1e-5)
    assert generator_loss(x).item() == pytest.approx(-log_sigmoid_loss(x)[0].mean(), rel=1e-5)


def test_penalty_of_a_linear_critic_is_its_weights_square():
    weight = random_normal(3 * 4 * 4, label="w", dtype=torch.float64).requires_grad_()
    patches = random_normal(5, 3, 4, 4, dtype=torch.float64).requires_grad_()
    penalty = gradient_penalty(patches.flatten(1) @ weight + 0.3, patches)
    assert penalty.item() == pytest.approx(float(weight.detach().square().sum()))
    penalty.backward()
    assert torch.allclose(weight.grad, 2 * weight.detach())


def test_penalty_of_the_critic_and_its_slope_by_finite_differences():
    critic = Critic(8, 4, generator(0)).double()
    patches = (0.5 * random_normal(4, 3, 8, 8, dtype=torch.float64)).requires_grad_()
    direct, step = gradient_penalty(critic(patches), patches), 1e-5
    (slope,) = torch.autograd.grad(critic(patches).sum(), patches)
    for k in range(10):
        bump = random_normal(*patches.shape, label=k, dtype=torch.float64)
        with torch.no_grad():
            by_hand = (critic(patches + step * bump) - critic(patches - step * bump)).sum() / (2 * step)
        assert (slope * bump).sum().item() == pytest.approx(by_hand.item(), rel=1e-4)
    assert direct.item() == pytest.approx(slope.flatten(1).norm(dim=1).square().mean().item())
    (second,) = torch.autograd.grad(direct, critic.mixed.weight)
    direction = random_normal(*second.shape, label="d", dtype=torch.float64)
    values = []
    for sign in (1, -1):
        with torch.no_grad():
            critic.mixed.weight += sign * step * direction
        values.append(gradient_penalty(critic(patches), patches).item())
        with torch.no_grad():
            critic.mixed.weight -= sign * step * direction
    assert (second * direction).sum().item() == pytest.approx((values[0] - values[1]) / (2 * step), rel=1e-4)


# ------------------------------------------------------------------------------------------ the critic's parts


def test_scores_at_the_start_are_of_one_size_whatever_the_width():
    """Equalised learning rate: all weights are unit normal, and activations keep their size from layer to layer."""
    sizes = []
    for width in (4, 16, 64):
        scores = []
        for seed in range(12 if width < 64 else 4):
            critic = Critic(16, width, generator(1, seed))
            stds = torch.stack(
                [w.std() for n, w in critic.named_parameters() if n.endswith("weight") and w.numel() > 99]
            )
            assert (stds - 1).abs().max() < 0.25
            with torch.no_grad():
                scores.append(critic(random_normal(8, 3, 16, 16)))
        sizes.append(torch.stack(scores).square().mean().sqrt().item())
    assert max(sizes) < 2 * min(sizes) and 0.2 < min(sizes) and max(sizes) < 2, sizes


def test_minibatch_deviation_against_numpy():
    features = random_normal(12, 5, 3, 3)
    out = append_minibatch_std(features)
    assert (out[:, :5] == features).all() and out.shape == (12, 6, 3, 3)
    for i in range(12):
        members = features.numpy()[i % 3 :: 3]  # patch i belongs to one of three groups of four
        assert len(members) == 4
        assert out[i, 5].numpy() == pytest.approx(np.full((3, 3), members.std(0).mean()), rel=1e-5)
    same = torch.ones(4, 2, 3, 3, requires_grad=True)
    append_minibatch_std(same)[:, 2].sum().backward()
    assert torch.isfinite(same.grad).all(), "equal patches"
    with pytest.raises(ValueError, match="6 patches"):
        append_minibatch_std(random_normal(6, 2, 3, 3))


def test_the_filter_keeps_constants_and_removes_what_halving_would_alias():
    line = torch.ones(16, dtype=torch.float32)
    assert torch.allclose((binomial_filter(16, 2) @ line)[2:-2], torch.ones(13))
    assert torch.allclose((binomial_filter(16, 1) @ line)[1:-1], torch.ones(13))
    fastest = torch.tensor([1.0, -1.0]).repeat(8)
    assert (binomial_filter(16, 2) @ fastest)[2:-2].abs().max() < 1e-6
    values = random_normal(16)
    expected = np.convolve(values.numpy(), np.array([1, 3, 3, 1]) / 8)
    assert np.allclose((binomial_filter(16, 2) @ values).numpy(), expected[1:-1], atol=1e-6)


@pytest.mark.parametrize("size", [8, 16, 32])
def test_shapes_and_seeds(size):
    patches = random_normal(4, 3, size, size)
    one, same, other = (Critic(size, 2, generator(seed))(patches) for seed in (0, 0, 1))
    assert one.shape == (4,) and (one == same).all() and (one != other).all()


@pytest.mark.parametrize("size", [0, 4, 12, 63])
def test_sizes_that_cannot_be_halved_are_refused(size):
    with pytest.raises(ValueError, match=f"got {size}"):
        Critic(size, 2, generator(0))


# ------------------------------------------------------------------------------------------ patches


def test_gathering_is_slicing_and_its_gradient_is_the_finite_differences():
    image = random_normal(3, 11, 13, dtype=torch.float64).requires_grad_()
    windows = torch.tensor([[0, 0], [3, 5], [3, 5], [7, 9], [4, 4]])
    patches = gather_patches(image, windows, 4)
    for patch, (top, left) in zip(patches, windows.tolist(), strict=True):
        assert (patch == image[:, top : top + 4, left : left + 4]).all()
    assert torch.autograd.gradcheck(lambda x: gather_patches(x, windows, 4).square(), image)


def test_windows_show_a_masked_pixel_and_stay_inside():
    mask = torch.rand(20, 31, generator=generator(4)) > 0.97
    windows = windows_around(mask, 8, 200, generator(5))
    assert windows.shape == (200, 2)
    for top, left in windows.tolist():
        assert 0 <= top <= 12 and 0 <= left <= 23 and mask[top : top + 8, left : left + 8].any()
    assert len(windows.unique(dim=0)) > 10
    with pytest.raises(ValueError, match="does not fit"):
        windows_around(mask, 21, 1, generator(0))
    with pytest.raises(ValueError, match="empty mask"):
        windows_around(torch.zeros_like(mask), 8, 1, generator(0))


def test_a_view_smaller_than_a_patch_is_enlarged_and_still_gets_its_gradient():
    image = torch.full((10, 12, 3), 0.75, requires_grad=True)
    mask = torch.zeros(10, 12, dtype=torch.bool)
    mask[4, 5] = True
    patches = draw_patches(image, mask, 4, 16, generator(0))
    assert patches.shape == (4, 3, 16, 16) and torch.allclose(patches, torch.tensor(0.5))
    patches.sum().backward()
    assert image.grad[4, 5].ne(0).all()


def test_patches_lie_between_black_at_minus_one_and_white_at_one():
    image = torch.tensor([0.0, 0.5, 1.0]).expand(9, 9, 3)
    patches = draw_patches(image, torch.ones(9, 9, dtype=torch.bool), 4, 8, generator(0))
    assert (patches == torch.tensor([-1.0, 0.0, 1.0])[:, None, None]).all()


# ------------------------------------------------------------------------------------------ learning


def checker_patches(count, fine, label):
    """Return checkered patches of equal mean and deviation, with cells of one pixel or of four pixels."""
    period = 1 if fine else 4
    cells = torch.arange(8) // period
    board = ((cells[:, None] + cells) % 2).float() * 2 - 1
    signs = torch.randint(2, (count, 1, 1, 1), generator=generator(label)).float() * 2 - 1
    return 0.5 * signs * board + 0.05 * random_normal(count, 3, 8, 8, label=label)


@pytest.mark.parametrize("penalized", ["real", "fake"])
@pytest.mark.parametrize("form", ["non-saturating", "saturating"])
def test_the_critic_separates_two_textures_and_its_slope_leads_to_the_real_one(penalized, form):
    adversary = Adversary(with_changes(SMALL, form=form, penalized=penalized), seed=0, rate=RATE)
    history = [
        adversary.train_step(checker_patches(16, True, (step, 0)), checker_patches(16, False, (step, 1)))
        for step in range(20)
    ]
    assert history[-1]["critic_loss"] < 0.3 < 1 < history[0]["critic_loss"] and history[-1]["critic_slope"] > 0
    real, fake = checker_patches(16, True, "r"), checker_patches(16, False, "f")
    with torch.no_grad():
        assert (adversary.critic(real) > 0).all() and (adversary.critic(fake) < 0).all()
    fake.requires_grad_()
    start = adversary.generator_loss(fake)
    (slope,) = torch.autograd.grad(start, fake)
    assert all(weights.grad is None or weights.requires_grad for weights in adversary.critic.parameters())
    with torch.no_grad():
        nearer = fake - 0.5 * slope / slope.square().mean().sqrt()
        assert adversary.generator_loss(nearer) < start
        assert adversary.critic(nearer).mean() > adversary.critic(fake).mean()
        assert ((nearer - fake) * fake.sign()).mean() < 0, "the coarse texture is not taken away"


def test_the_penalty_holds_the_critics_slope_down():
    slopes = {}
    for penalty in (0.0, 10.0):
        adversary = Adversary(with_changes(SMALL, penalty=penalty, penalized="real"), seed=0, rate=RATE)
        for step in range(15):
            metrics = adversary.train_step(checker_patches(16, True, (step, 0)), checker_patches(16, False, (step, 1)))
        assert ("critic_slope" in metrics) == (penalty > 0)
        patches = checker_patches(16, True, "r").requires_grad_()
        slopes[penalty] = gradient_penalty(adversary.critic(patches), patches).item()
    assert slopes[10.0] < 0.3 * slopes[0.0]


def test_generator_loss_leaves_the_critics_weights_alone_and_learning_leaves_the_patches():
    adversary, fake = Adversary(SMALL, seed=0, rate=RATE), random_normal(16, 3, 8, 8).requires_grad_()
    before = [weights.detach().clone() for weights in adversary.critic.parameters()]
    adversary.generator_loss(fake).backward()
    assert fake.grad.ne(0).any() and all(weights.grad is None for weights in adversary.critic.parameters())
    fake.grad = None
    adversary.train_step(random_normal(16, 3, 8, 8, label=1), fake)
    assert fake.grad is None
    assert all((a != b).any() for a, b in zip(before, adversary.critic.parameters(), strict=True))


def test_an_adversary_continues_from_its_state_bit_for_bit():
    def trained(adversary, steps):
        return [
            adversary.train_step(checker_patches(16, True, (s, 0)), checker_patches(16, False, (s, 1))) for s in steps
        ]

    whole = Adversary(SMALL, seed=3, rate=RATE)
    history = trained(whole, range(6))
    first, second = Adversary(SMALL, seed=3, rate=RATE), Adversary(SMALL, seed=4, rate=RATE)
    trained(first, range(3))
    second.load_state_dict(first.state_dict())
    assert trained(second, range(3, 6)) == history[3:]
    for a, b in zip(whole.critic.parameters(), second.critic.parameters(), strict=True):
        assert (a == b).all()


def test_a_nan_patch_stops_the_critic_before_it_changes():
    adversary = Adversary(SMALL, seed=0, rate=RATE)
    before = [weights.detach().clone() for weights in adversary.critic.parameters()]
    with pytest.raises(FloatingPointError, match="critic's loss"):
        adversary.train_step(random_normal(16, 3, 8, 8), torch.full((16, 3, 8, 8), float("nan")))
    assert all((a == b).all() for a, b in zip(before, adversary.critic.parameters(), strict=True))

"""Score distillation (SDS) on a distribution whose score is known, and the two scales (whole views and patches)."""

import pytest
import torch

from reffusion.distill.sds import anneal, draw_timesteps, match_contrast, sds_gradient, sds_loss
from reffusion.prior.crops import Picture
from reffusion.prior.denoising import held_out_samples
from reffusion.prior.windows import enlarge_to_fit, resize, two_scale_masks, two_scales, window_around
from reffusion.seeding import generator

ABAR = torch.cos(torch.linspace(0.05, 1.5, 100, dtype=torch.float64)) ** 2
MEAN, VARIANCE = 0.7, 0.25


def perfect_denoiser(noisy, t):
    """Return the posterior means of the noise and of the clean latent for independent normal data."""
    a, s = ABAR[t].sqrt().view(-1, 1, 1, 1), (1 - ABAR[t]).sqrt().view(-1, 1, 1, 1)
    eps = s * (noisy - a * MEAN) / (a**2 * VARIANCE + s**2)
    return eps, (noisy - s * eps) / a


def expected_gradient(latent, t, weighting):
    """Return the expectation over the noise of w(t) (eps_theta - eps) in closed form."""
    a2 = ABAR[t]
    mean = (1 - a2).sqrt() * a2.sqrt() * (latent - MEAN) / (a2 * VARIANCE + 1 - a2)
    return (
        mean
        * {"one": 1.0, "sigma2": 1 - a2, "alpha_sigma2": a2.sqrt() * (1 - a2), "x0": ((1 - a2) / a2).sqrt()}[weighting]
    )


@pytest.mark.parametrize("weighting", ["x0", "sigma2", "alpha_sigma2", "one"])
def test_mean_gradient_converges_to_the_closed_form_as_one_over_root_n(weighting):
    latent, t, counts = torch.tensor(2.0, dtype=torch.float64), 60, (100, 1_000, 10_000)
    errors = []
    for count in counts:
        noise = torch.randn(40, count, 1, 1, 1, generator=generator(0, weighting, count), dtype=torch.float64)
        means = [
            sds_gradient(
                latent.expand_as(n), perfect_denoiser, torch.full((count,), t), n, ABAR, weighting=weighting
            ).mean()
            for n in noise
        ]
        errors.append((torch.stack(means) - expected_gradient(latent, t, weighting)).square().mean().sqrt())
    rates = [float((errors[i] / errors[i + 1]).log10() / 1.0) for i in range(2)]
    assert all(0.35 < rate < 0.65 for rate in rates), rates
    assert errors[-1] < 0.05 * expected_gradient(latent, t, weighting).abs()


@pytest.mark.parametrize(("weighting", "strong", "weak"), [("sigma2", 0.59, 0.09), ("alpha_sigma2", 0.33, 0.20)])
def test_shares_of_timesteps_with_stable_diffusions_schedule(weighting, strong, weak):
    """Share of the total weight at t >= 600 and t < 300, for errors of the noise that do not depend on t."""
    alpha_bar = torch.cumprod(1 - torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2, 0)
    timesteps, noise = torch.arange(20, 980), torch.zeros(960, 1, 1, 1, dtype=torch.float64)
    wrong_by_one = lambda noisy, t: (torch.ones_like(noisy), noisy)
    weight = sds_gradient(noise, wrong_by_one, timesteps, noise, alpha_bar, weighting=weighting).flatten()
    share = lambda chosen: float(weight[chosen].sum() / weight.sum())
    assert share(timesteps >= 600) == pytest.approx(strong, abs=0.006)
    assert share(timesteps < 300) == pytest.approx(weak, abs=0.006)


def test_descent_along_the_gradient_ends_at_the_mean_of_the_data():
    latent = torch.full((1, 4, 8, 8), -3.0, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([latent], lr=0.05)
    for step in range(400):
        draw = generator(1, step)
        noise = torch.randn(latent.shape, generator=draw, dtype=torch.float64)
        gradient = sds_gradient(
            latent, perfect_denoiser, draw_timesteps(1, 100, 0.02, 0.98, draw), noise, ABAR, weighting="x0"
        )
        optimizer.zero_grad()
        sds_loss(latent, gradient).backward()
        optimizer.step()
    assert abs(float(latent.detach().mean()) - MEAN) < 0.05


def test_weightings_differ_by_a_function_of_the_timestep_only():
    t, draw = torch.tensor([1, 40, 98]), generator(2)
    latents = torch.randn(3, 4, 5, 5, generator=draw, dtype=torch.float64)
    noise = torch.randn(3, 4, 5, 5, generator=draw, dtype=torch.float64)
    one, x0, sigma2 = (
        sds_gradient(latents, perfect_denoiser, t, noise, ABAR, weighting=w) for w in ("one", "x0", "sigma2")
    )
    a2 = ABAR[t].view(-1, 1, 1, 1)
    torch.testing.assert_close(x0, ((1 - a2) / a2).sqrt() * one)
    torch.testing.assert_close(sigma2, (1 - a2) * one)


def test_the_highest_timestep_falls_in_the_first_half():
    assert [anneal(0.98, 0.5, progress) for progress in (0, 0.25, 0.5, 1)] == pytest.approx([0.98, 0.74, 0.5, 0.5])
    assert anneal(0.98, None, 0.7) == 0.98


def fade_contrast(factor, shift=0.2):
    """Return (x0, z, mask); inside the mask, the denoised latent x0 has `factor` times the contrast of the latent z.

    Inside the mask the mean of x0 differs by `shift` from the mean of z. Outside, x0 is independent noise.
    """
    z, other = torch.randn(2, 3, 4, 8, 8, generator=generator(9), dtype=torch.float64)
    mask = torch.zeros(3, 1, 8, 8, dtype=torch.float64)
    mask[:, :, 1:6, 2:7] = 1
    mean = (z * mask).sum((2, 3), keepdim=True) / 25
    return torch.where(mask > 0, mean + shift + factor * (z - mean), other), z, mask


def test_a_faded_answer_gets_the_contrast_of_the_render_and_keeps_its_mean():
    x0, z, mask = fade_contrast(0.6)
    clear = match_contrast(x0, z, mask)
    torch.testing.assert_close(clear * mask, (z + 0.2) * mask)
    torch.testing.assert_close(match_contrast(clear, z, mask), clear)


def test_matching_contrast_keeps_contrast_that_the_prior_adds():
    for factor in (1.0, 1.5, -0.5):  # the same contrast, a stronger one, an inverted one
        x0, z, mask = fade_contrast(factor)
        torch.testing.assert_close(match_contrast(x0, z, mask), x0)


def test_matching_contrast_never_exceeds_the_render_and_stays_bounded():
    draw = generator(10)
    z, mask = torch.randn(1, 4, 8, 8, generator=draw, dtype=torch.float64), torch.ones(1, 1, 8, 8, dtype=torch.float64)
    centered = lambda x: x - x.mean((2, 3), keepdim=True)
    for size in (0.0, 1e-200, 1e-160, 1e-6, 0.3):
        x0 = size * torch.randn(1, 4, 8, 8, generator=draw, dtype=torch.float64)
        clear = match_contrast(x0, z, mask)
        assert (centered(clear).norm(dim=(2, 3)) <= centered(z).norm(dim=(2, 3)) * (1 + 1e-12)).all()
        raised = centered(clear).norm(dim=(2, 3)) > centered(x0).norm(dim=(2, 3)) * (1 + 1e-9)
        along = ((z - clear) * centered(clear)).sum((2, 3))
        assert (along.abs() <= 1e-9)[raised].all(), "the gradient still changes the contrast"
    flat = torch.full_like(z, 0.4)
    torch.testing.assert_close(match_contrast(flat, z, mask), flat)
    assert (match_contrast(flat, z, torch.zeros_like(mask)) == flat).all()


def test_kept_contrast_means_the_same_in_every_weighting():
    t, draw = torch.tensor([1, 40, 98]), generator(11)
    latents, noise = torch.randn(2, 3, 4, 5, 5, generator=draw, dtype=torch.float64)
    one, x0, sigma2 = (
        sds_gradient(latents, perfect_denoiser, t, noise, ABAR, weighting=w, keep_contrast=True)
        for w in ("one", "x0", "sigma2")
    )
    a2 = ABAR[t].view(-1, 1, 1, 1)
    torch.testing.assert_close(x0, ((1 - a2) / a2).sqrt() * one)
    torch.testing.assert_close(sigma2, (1 - a2) * one)
    assert not torch.allclose(x0, sds_gradient(latents, perfect_denoiser, t, noise, ABAR, weighting="x0"))


@pytest.mark.parametrize("patches", [0, 1, 2])
def test_loss_hands_on_the_gradient_global_plus_mean_of_patches(patches):
    latents = torch.randn(1 + patches, 4, 3, 3, generator=generator(4), requires_grad=True)
    gradient = torch.randn(latents.shape, generator=generator(5))
    sds_loss(latents, gradient, "sum").backward()
    share = torch.tensor([1.0] + [1 / max(patches, 1)] * patches).view(-1, 1, 1, 1)
    torch.testing.assert_close(latents.grad, share * gradient)
    latents.grad = None
    sds_loss(latents, gradient, "mean").backward()
    torch.testing.assert_close(latents.grad, share * gradient / 36)


def test_two_scales_cuts_patches_exactly_and_keeps_the_mean_of_the_view():
    image = torch.rand(3, 40, 60, generator=generator(6), dtype=torch.float64)
    scales = two_scales(image, [(0, 0), (24, 44)], 16)
    assert scales.shape == (3, 3, 16, 16)
    assert (scales[1] == image[:, :16, :16]).all() and (scales[2] == image[:, 24:, 44:]).all()
    assert (scales[0].mean((1, 2)) - image.mean((1, 2))).abs().max() < 0.01


def test_two_scales_gradient_reaches_every_pixel_and_matches_differences():
    image = torch.rand(1, 20, 24, generator=generator(7), dtype=torch.float64, requires_grad=True)
    weights = torch.randn(2, 1, 8, 8, generator=generator(8), dtype=torch.float64)
    value = lambda x: (two_scales(x, [(3, 5)], 8) * weights).sum()
    (gradient,) = torch.autograd.grad(value(image), image)
    assert (gradient != 0).float().mean() > 0.95
    for row, column in ((0, 0), (5, 9), (19, 23)):
        step = torch.zeros_like(image)
        step[0, row, column] = 1e-6
        numeric = (value(image + step) - value(image - step)) / 2e-6
        torch.testing.assert_close(gradient[0, row, column], numeric.detach(), rtol=1e-6, atol=1e-9)


def test_a_mask_keeps_the_gradient_inside_it_and_drops_the_rest():
    t, draw = torch.tensor([5, 90]), generator(3)
    latents, noise = torch.randn(2, 2, 4, 6, 6, generator=draw, dtype=torch.float64)
    mask = torch.zeros(2, 1, 6, 6, dtype=torch.float64)
    mask[:, :, 2:5] = 1
    whole = sds_gradient(latents, perfect_denoiser, t, noise, ABAR)
    inside = sds_gradient(latents, perfect_denoiser, t, noise, ABAR, mask=mask)
    assert (inside == whole * mask).all() and (whole != 0).any()
    assert (sds_gradient(latents, perfect_denoiser, t, noise, ABAR, mask=torch.zeros_like(mask)) == 0).all()


def test_a_reduced_mask_covers_every_masked_pixel():
    for seed in range(10):
        draw = generator(9, seed)
        mask = torch.rand(50, 70, generator=draw) > 0.98
        hidden = torch.rand(1, 50, 70, generator=draw)
        other = torch.where(mask, torch.rand(1, 50, 70, generator=draw), hidden)
        small = two_scale_masks(mask, [(7, 9)], 16)
        # Where nothing is repainted, the masked pixels' values must make no difference.
        keep = small == 0
        difference = (two_scales(hidden, [(7, 9)], 16) - two_scales(other, [(7, 9)], 16)).abs()
        assert difference[keep].max() < 1e-4 and (small[1, 0].bool() == mask[7:23, 9:25]).all()


def test_windows_show_the_mask_and_stay_inside():
    mask = torch.zeros(30, 50, dtype=torch.bool)
    mask[2, 1] = mask[29, 49] = mask[15, 20] = True
    seen = {(2, 1): 0, (29, 49): 0, (15, 20): 0}
    for seed in range(60):
        top, left = window_around(mask, 12, generator(10, seed))
        assert 0 <= top <= 18 and 0 <= left <= 38
        inside = mask[top : top + 12, left : left + 12]
        assert inside.any()
        for row, column in seen:
            seen[row, column] += top <= row < top + 12 and left <= column < left + 12
    assert min(seen.values()) > 8, "one part of the mask is hardly ever drawn"
    hole = torch.zeros(1200, 1600, dtype=torch.bool)
    hole[400:700, 600:950] = True  # a window anywhere around a masked pixel would cover .73 of it
    corners = [window_around(hole, 512, generator(11, seed)) for seed in range(200)]
    shares = [float(hole[top : top + 512, left : left + 512].sum() / hole.sum()) for top, left in corners]
    assert sum(shares) / len(shares) == pytest.approx(0.91, abs=0.02)
    with pytest.raises(ValueError, match="empty mask"):
        window_around(torch.zeros(30, 50, dtype=torch.bool), 12, generator(0))
    with pytest.raises(ValueError, match="does not fit"):
        window_around(mask, 31, generator(0))


def test_a_window_always_shows_a_known_pixel():
    hole = torch.zeros(40, 60, dtype=torch.bool)
    hole[5:35, 10:50] = True  # most windows of 12 px inside it show nothing else
    for seed in range(60):
        top, left = window_around(hole, 12, generator(12, seed))
        shown = hole[top : top + 12, left : left + 12]
        assert shown.any() and not shown.all()
    with pytest.raises(ValueError, match="the mask covers the whole view; leave this view out"):
        window_around(torch.ones(30, 50, dtype=torch.bool), 12, generator(0))


def test_personalization_distillation_and_sampler_reduce_a_view_alike():
    image = torch.rand(3, 48, 80, generator=generator(13)) * 2 - 1
    reduced = resize(image[None], 16, 16)[0]
    assert torch.equal(two_scales(image, [], 16)[0], reduced)
    picture = Picture(image, torch.zeros(48, 80, dtype=torch.bool))
    assert torch.equal(held_out_samples([picture], 16, 0).images[0], reduced)


def test_small_views_are_enlarged_until_a_window_fits():
    assert enlarge_to_fit(torch.rand(3, 24, 40), 16).shape == (3, 24, 40)
    assert enlarge_to_fit(torch.rand(3, 24, 40), 48).shape == (3, 48, 80)
    assert min(enlarge_to_fit(torch.rand(3, 33, 47), 64).shape[1:]) == 64


def test_timesteps_reach_both_ends_of_their_range():
    timesteps = draw_timesteps(5000, 1000, 0.02, 0.98, generator(11))
    assert (int(timesteps.min()), int(timesteps.max())) == (20, 979)
    with pytest.raises(ValueError, match="range"):
        draw_timesteps(1, 1000, 0.5, 0.4, generator(0))

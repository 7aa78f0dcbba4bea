"""The study `control`: an exact denoiser recognises views and windows, and predicts the posterior mean of fillings."""

import numpy as np
import pytest
import torch

from lab.studies import exact_prior
from reffusion.prior import denoising, diffusion, windows
from reffusion.prior.crops import GLOBAL, LOCAL, Batch, make_picture
from reffusion.prior.model import load_prior
from reffusion.seeding import generator

SIZE, HEIGHT, WIDTH, VIEWS = 64, 80, 100, 3


@pytest.fixture(scope="module")
def pictures():
    """Fillings [3, K, 3, 80, 100] of the middle of three smooth pictures, and the hole, bool [80, 100]."""
    coarse = torch.rand(VIEWS, 1, 3, 8, 10, generator=generator(0, "control")) * 2 - 1
    whole = torch.stack([windows.resize(each, HEIGHT, WIDTH) for each in coarse])
    hole = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    hole[30:50, 35:60] = True
    offsets = torch.linspace(0, 0.5, exact_prior.FILLINGS).view(1, -1, 1, 1, 1)
    return (whole + offsets * hole).clamp(-1, 1), hole


@pytest.fixture(scope="module")
def exact(pictures):
    """The prior with the exact denoiser, and the embeddings of its prompts."""
    return exact_prior.make_prior(pictures[0])


def predict(pictures, prior, text, shown, corner, t):
    """Return z_0 predicted from the noised filling `shown` (view, number), in a window or (None) the whole view."""
    (fillings, hole), (view, number) = pictures, shown
    places = [] if corner is None else [corner]
    picture = windows.two_scales(fillings[view, number], places, SIZE)[-1:]
    mask = windows.two_scale_masks(hole, places, SIZE)[-1:]
    noise = torch.randn(1, 4, SIZE, SIZE, generator=generator(1, "noise"))
    step = torch.tensor([t])
    noisy = diffusion.add_noise(prior, diffusion.encode(prior, picture), noise, step)
    condition = diffusion.conditioning(prior, picture, mask)
    _, clean = diffusion.predict(prior, noisy, step, condition, text[None])
    return diffusion.decode(prior, clean), picture, mask


@pytest.mark.parametrize("corner", [None, (0, 0), (16, 36), (7, 11)])
@pytest.mark.parametrize("view", range(VIEWS))
def test_with_little_noise_the_filling_that_is_shown_is_predicted(pictures, exact, view, corner):
    prior, text = exact
    prior.unet.personalized = False
    clean, picture, _ = predict(pictures, prior, text[0], (view, 40), corner, 1)
    assert (clean - picture).abs().max() < 1e-3


@pytest.mark.parametrize(
    ("personalized", "prompt", "count"),
    [(True, 0, exact_prior.CLOSE), (True, 2, exact_prior.FILLINGS), (False, 0, exact_prior.FILLINGS)],
)
def test_a_prompt_selects_the_fillings_that_agree_with_the_reference(pictures, exact, personalized, prompt, count):
    prior, text = exact
    prior.unet.personalized = personalized
    clean, _, mask = predict(pictures, prior, text[prompt], (1, 49), None, 999)
    mean = windows.resize(pictures[0][1, :count].mean(0, keepdim=True), SIZE, SIZE)
    assert ((clean - mean) * mask).abs().max() < 0.1  # at the last timestep noise hides which filling it was


def test_fillings_keep_what_is_known(pictures):
    truth, hole = pictures[0][0, 0], pictures[1]
    random = torch.rand(2, 3, HEIGHT, WIDTH, generator=generator(2, "donors")) * 2 - 1
    found = exact_prior.make_fillings(truth, hole, list(random), np.random.default_rng(0))
    assert len(found) == exact_prior.FILLINGS and torch.equal(found[0], truth)
    assert (found - truth)[..., ~hole].abs().max() < 1e-5
    both_ways = 2 * len(random)  # donors, flipped or not
    assert len({each.sum().item() for each in found}) == exact_prior.CLOSE + exact_prior.DISPLACED + both_ways
    assert load_prior(exact_prior.TINY).native_size == SIZE


@torch.no_grad()
def test_the_prior_that_knows_the_reference_predicts_unseen_views_better(pictures, exact):
    """The clean latent's error in the hole is less than half, in whole views and in windows."""
    (fillings, hole), (prior, text) = pictures, exact
    squares = {True: [], False: []}
    for view in range(VIEWS):
        picture = make_picture((fillings[view, 0].permute(1, 2, 0) + 1) * 127.5, hole, SIZE)
        draws = generator(0, "control", view)
        corners = [windows.window_around(picture.region, SIZE, draws)]
        masks = windows.two_scale_masks(picture.region, corners, SIZE)
        batch = Batch(windows.two_scales(picture.image, corners, SIZE), masks, torch.tensor([GLOBAL, LOCAL]))
        noise = torch.randn(2, *denoising.latent_shape(prior, SIZE), generator=draws)
        half = torch.full((2,), prior.timesteps // 2)
        for prior.unet.personalized in squares:
            found = denoising.denoising_error(prior, batch, text, half, noise, outside_weight=0)[1]
            squares[prior.unet.personalized].append(found)
    known, unknown = (torch.stack(squares[which]).mean(0).sqrt() for which in (True, False))
    assert (known < 0.5 * unknown).all()  # three close fillings of fifty

"""The weights of the embedded prior use their prompts: a text encoder that has collapsed fails here."""

from pathlib import Path

import numpy as np
import pytest
import torch

from lab.prior import build, images, train
from reffusion.params.base import Prompts
from reffusion.prior import diffusion
from reffusion.prior.model import load_prior
from reffusion.seeding import generator

TINY = Path(__file__).resolve().parent.parent / "priors" / "tiny"
SIDE = 32  # px
SAMPLES = 200
DRAWS = 8  # of noise and timesteps for each sample, over which its loss is averaged


@pytest.fixture(scope="module")
def pictures():
    """Pictures [200, 3, 32, 32] in [-1, 1] that training never sees, their masks, and right and wrong captions."""
    pool = train.Pool(0, 0, 40, images.bundled_photographs(held_out=True), held_out=True)
    pixels, masks, captions = pool.batch(np.random.default_rng(0), SIDE, 2 * SAMPLES)
    subjects = [caption.removeprefix("A photo of ").removesuffix(", cropped") for caption in captions]
    named = [index for index, subject in enumerate(subjects) if subject not in ("", "sks", "a scene")][:SAMPLES]
    words = lambda index: set(subjects[index].replace(",", "").split()) - {"a", "and", "dark", "bright"}
    shift = lambda index: next(
        other for other in [*named, *named][named.index(index) :] if not words(other) & words(index)
    )
    wrong = [captions[index].replace(subjects[index], subjects[shift(index)]) for index in named]
    return pixels[named], masks[named], [captions[index] for index in named], wrong


def test_the_papers_two_prompts_change_the_prediction(pictures):
    """A text encoder that has collapsed changed predictions by 1e-6 of their rms.

    Of 1 % and more, the model card would have to say that a whole view and a crop no longer look too alike.
    """
    assert 0.003 < measure_change_by_prompts(pictures) < 0.01


def measure_change_by_prompts(pictures) -> float:
    """Return the rms by which the paper's two prompts change predictions, relative to the rms of a prediction."""
    prior, (pixels, masks, *_) = load_prior(TINY), pictures
    pixels, masks = pixels[:16], masks[:16]
    text = diffusion.embed_text(prior, Prompts().texts)
    condition = diffusion.conditioning(prior, pixels, masks)
    t = torch.linspace(0.3, 0.98, 16).mul(prior.timesteps).long()
    noise = torch.randn(16, 4, SIDE, SIDE, generator=generator(0, "prompts"))
    noisy = diffusion.add_noise(prior, diffusion.encode(prior, pixels), noise, t)
    with torch.no_grad():
        whole, crop = (
            diffusion.raw_prediction(prior, noisy, t, condition, words.expand(16, -1, -1)) for words in text[:2, None]
        )
    return float((whole - crop).square().mean().sqrt() / whole.square().mean().sqrt())


@pytest.mark.slow
def test_the_right_caption_explains_a_picture_better_than_a_wrong_one(pictures):
    pixels, masks, right, wrong = pictures
    assert len(right) == SAMPLES and (masks.mean((1, 2, 3)) > 0.65).float().mean() > 0.25
    model, alphas = train.Model(0), build.scheduler().alphas_cumprod
    train.load_weights(model, TINY)
    loss = lambda words, draw: train.losses(model, alphas, (pixels, masks, words), generator(draw, "captions"))
    with torch.no_grad():
        losses = [sum(loss(words, draw) for draw in range(DRAWS)) for words in (right, wrong)]
    assert (losses[0] < losses[1]).float().mean() >= 0.6


def test_guidance_changes_what_is_painted(pictures):
    """Fillings of large holes without guidance and with a = 4 differ by two gray levels or more (rms in the hole)."""
    prior, (pixels, masks, right, _) = load_prior(TINY), pictures
    large = (masks.mean((1, 2, 3)) > 0.65).nonzero().flatten()[:12].tolist()
    text, empty = diffusion.embed_text(prior, [right[k] for k in large]), diffusion.embed_text(prior, [""] * len(large))
    plain, guided = (
        diffusion.sample(prior, pixels[large], masks[large], text, 6, generator(0, "guidance"), guidance, empty)
        for guidance in (0.0, 4.0)
    )
    hole = masks[large].expand_as(plain) > 0
    assert 127.5 * (plain - guided)[hole].square().mean().sqrt() >= 2

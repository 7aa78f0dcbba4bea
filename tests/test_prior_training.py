"""Training the embedded prior: pictures and steps depend on the seed alone; the code is exact, resumes are too."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

TINY = Path(__file__).resolve().parent.parent / "priors" / "tiny"
sys.path.insert(0, str(TINY))

import build  # noqa: E402
import images  # noqa: E402
import train  # noqa: E402


def test_images_depend_on_seed_and_number_only():
    first, again = images.image(3, 7), images.image(3, 7)
    assert np.array_equal(first[0], again[0]) and first[1] == again[1]
    assert not np.array_equal(first[0], images.image(3, 8)[0])
    assert not np.array_equal(first[0], images.image(3, 7, held_out=True)[0])


def test_held_out_photographs_never_train():
    names = {n for n, _ in images.photographs(tuple(n for n in images.PHOTOS if n not in images.HELD_OUT_PHOTOS))}
    assert names and not names & set(images.HELD_OUT_PHOTOS)


def test_masks_cover_between_nothing_and_everything():
    shares = [images.mask(np.random.default_rng(k), 64).mean() for k in range(60)]
    assert min(shares) < 0.2 and max(shares) == 1.0


def test_the_linear_vae_is_linear_in_half_precision_too():
    pixels = torch.rand(2, 3, 40, 40, generator=torch.Generator().manual_seed(0)) * 2 - 1
    vae = build.linear_vae()
    assert (vae.decode(vae.encode(pixels).latent_dist.mean).sample - pixels).abs().max() < 2e-3
    stored = vae.half().float()
    assert (stored.decode(stored.encode(pixels).latent_dist.mean).sample - pixels).abs().max() < 4e-3


@pytest.fixture(scope="module")
def pool():
    return train.Pool(0, 0, size=12)


def steps(pool, count, start=0, state=None):
    torch.set_num_threads(1)
    model, vae, alphas = train.Model(0), build.linear_vae(), build.scheduler().alphas_cumprod
    optimiser = torch.optim.AdamW(model.parameters(), lr=train.PEAK_RATE)
    if state:
        model.load_state_dict(state[0])
        optimiser.load_state_dict(state[1])
    losses = [train.step_once(model, vae, alphas, optimiser, pool, k, 100) for k in range(start, count)]
    return losses, model.state_dict(), optimiser.state_dict()


def test_training_repeats_and_resumes_exactly(pool):
    losses, weights, _ = steps(pool, 4)
    again, same, _ = steps(pool, 4)
    assert losses == again and all(torch.equal(a, b) for a, b in zip(weights.values(), same.values(), strict=True))
    _, half, moments = steps(pool, 2)
    tail, resumed, _ = steps(pool, 4, 2, (half, moments))
    assert tail == losses[2:]
    assert all(torch.equal(a, b) for a, b in zip(weights.values(), resumed.values(), strict=True))

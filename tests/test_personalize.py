"""Personalization of the prior: training samples, loss, validation on photographs, resume, and early errors."""

from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes.networks import small_prior
from scenes.settings import with_changes

from reffusion import trace
from reffusion.io.traces import load_trace
from reffusion.params.base import Prompts
from reffusion.params.personalize import Params, TrainingSamples
from reffusion.prior import crops, denoising, diffusion, lora, validation
from reffusion.prior import personalize as P
from reffusion.prior.windows import two_scale_masks
from reffusion.seeding import generator
from reffusion.trace import load_checkpoint, read_trace

pytestmark = pytest.mark.integration

NATIVE, SIZE = 16, 12
TRAINING = Params(
    steps=4, optimizer={"lr_unet": 1e-3, "lr_text": 1e-4, "batch": 2}, samples={"size": SIZE}, checkpoint_seconds=1e9
)


@pytest.fixture
def fresh_prior():
    return small_prior()


def striped_reference(height=70, width=90):
    """Return a reference, a `Picture` of diagonal stripes with a hole of 30 x 30 px; height and width are in px."""
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    image = torch.stack([128 + 100 * torch.sin((rows + k * columns) / 4) for k in (1, 2, 3)], 2)
    hole = torch.zeros(height, width, dtype=torch.bool)
    hole[20:50, 30:60] = True
    return crops.make_picture(image.to(torch.uint8), hole, NATIVE)


@pytest.mark.parametrize("count", range(12))
def test_photographs_for_validation_are_spread_over_all(count):
    names = ["reference", *(f"photo {k:02}" for k in range(count))]
    chosen = [names.index(name) - 1 for name in validation.choose_photos(names, ["reference"])]
    assert len(chosen) == min(count, validation.PHOTOS) and chosen == sorted(set(chosen))
    steps = np.diff([*chosen, count])
    assert not count or (chosen[0] == 0 and steps.max() - steps.min() <= 1)


def test_pictures_are_enlarged_until_a_crop_fits():
    small = crops.make_picture(torch.zeros(30, 50, 3, dtype=torch.uint8), torch.ones(30, 50, dtype=torch.bool), 64)
    assert small.image.shape == (3, 64, 107) and small.region.shape == (64, 107) and small.region.all()
    assert float(small.image.min()) == -1


def test_rectangle_masks_repaint_something_and_keep_within_their_sides(monkeypatch):
    once = {"RECTANGLE_COUNT": (1, 1), "RECTANGLE_SIDE": (0.25, 0.5), "INVERTED_SHARE": 0.0}
    for seed in range(50):
        with monkeypatch.context() as patched:
            for name, value in once.items():
                patched.setattr(crops, name, value)
            mask = crops.rectangle_mask(64, generator(seed))[0]
        rows, columns = mask.any(1).sum(), mask.any(0).sum()
        assert set(mask.unique().tolist()) == {0.0, 1.0} and mask.sum() == rows * columns
        assert 16 <= rows <= 32 and 16 <= columns <= 32
    inverted = [float(crops.rectangle_mask(64, generator(seed)).mean()) for seed in range(200)]
    assert min(inverted) < 0.1 and max(inverted) > 0.9 and 0.4 < sum(inverted) / 200 < 0.6


def test_global_samples_lose_a_thin_border_only():
    ramp = torch.arange(200.0).expand(3, 100, 200)
    source = crops.Picture(ramp, ramp[0] > 100)
    for seed in range(20):
        cut = crops.crop_border(source, generator(seed))
        height, width = cut.region.shape
        assert 80 <= height <= 100 and 160 <= width <= 200
        assert torch.equal(cut.image[0] > 100, cut.region)


@pytest.mark.parametrize("local_share", [0.0, 1.0])
@pytest.mark.parametrize("size", [SIZE, NATIVE])
def test_samples_masked_by_the_hole_show_it_where_it_is(local_share, size, monkeypatch):
    """In samples whose mask is the hole, the hole's pixels are white: only masked pixels may be white.

    In local samples, which are crops at full resolution, the mask and the white pixels must be equal.
    """
    source = striped_reference()
    source = crops.Picture(torch.where(source.region, 1.0, source.image.clamp(max=0)), source.region)
    chosen = TrainingSamples(local_share=local_share, hole_share=1.0)
    monkeypatch.setattr(crops, "EMPTY_SHARE", 0.0)
    samples = crops.draw_samples([source], NATIVE, size, 40, chosen, generator(5))
    white = samples.images[:, :1]
    assert (samples.masks.flatten(1).sum(1) > 0).all()
    assert (white[samples.masks == 0] <= 1e-5).all()
    if local_share == 1:
        assert torch.equal(white == 1, samples.masks == 1)


def test_local_samples_show_the_hole_in_full_resolution_and_prompts_follow(monkeypatch):
    view = striped_reference()

    def draw_samples(count, size, share, empty):
        monkeypatch.setattr(crops, "EMPTY_SHARE", empty)
        return crops.draw_samples([view], NATIVE, size, count, TrainingSamples(local_share=share), generator(3))

    local = draw_samples(10, SIZE, 1.0, 0.0)
    windows = view.image.unfold(1, SIZE, 1).unfold(2, SIZE, 1).permute(1, 2, 0, 3, 4).flatten(0, 1)
    for image in local.images:
        assert (windows == image).all((1, 2, 3)).any(), "not a crop of the reference"
    whole = draw_samples(10, NATIVE, 0.0, 0.0)
    assert (local.prompts == crops.LOCAL).all() and (whole.prompts == crops.GLOBAL).all()
    mixed = draw_samples(300, SIZE, 0.5, 0.2).prompts
    shares = torch.bincount(mixed, minlength=3) / 300
    torch.testing.assert_close(shares, torch.tensor([0.4, 0.4, 0.2]), atol=0.09, rtol=0)


@pytest.mark.parametrize("kind", ["epsilon", "v_prediction"])
def test_loss_is_the_priors_own_and_its_clean_latent_error_is_predicts(fresh_prior, kind):
    prior, draw = replace(fresh_prior, prediction_type=kind), generator(4)
    samples = crops.draw_samples([striped_reference()], NATIVE, SIZE, 3, TrainingSamples(), draw)
    t, noise = torch.tensor([10, 500, 950]), torch.randn(3, 4, SIZE, SIZE, generator=draw)
    with torch.no_grad():
        words = diffusion.embed_text(prior, Prompts().texts)
        error, clean = denoising.denoising_error(prior, samples, words, t, noise)
        latents = diffusion.encode(prior, samples.images)
        noisy = diffusion.add_noise(prior, latents, noise, t)
        condition = diffusion.conditioning(prior, samples.images, samples.masks)
        eps, x0 = diffusion.predict(prior, noisy, t, condition, words[samples.prompts])
    torch.testing.assert_close(clean, (x0 - latents).square().mean((1, 2, 3)), rtol=1e-3, atol=1e-5)
    if kind == "epsilon":
        torch.testing.assert_close(error, (eps - noise).square().mean((1, 2, 3)))


def test_what_a_mask_leaves_to_be_seen_counts_by_its_weight(fresh_prior):
    draw = generator(5)
    samples = crops.draw_samples([striped_reference()], NATIVE, SIZE, 3, TrainingSamples(), draw)
    t, noise = torch.tensor([10, 500, 950]), torch.randn(3, 4, SIZE, SIZE, generator=draw)
    with torch.no_grad():
        latents = diffusion.encode(fresh_prior, samples.images)
        condition = diffusion.conditioning(fresh_prior, samples.images, samples.masks)
        noisy = diffusion.add_noise(fresh_prior, latents, noise, t)
        words = diffusion.embed_text(fresh_prior, Prompts().texts)
        wrong = diffusion.raw_prediction(fresh_prior, noisy, t, condition, words[samples.prompts])
        wrong = (wrong - diffusion.training_target(fresh_prior, latents, noise, t)).square().mean(1, keepdim=True)
        for weight in (1.0, 0.2, 1e-6):
            error, _ = denoising.denoising_error(fresh_prior, samples, words, t, noise, weight)
            of_each = samples.masks + weight * (1 - samples.masks)
            torch.testing.assert_close(error, (of_each * wrong).sum((1, 2, 3)) / of_each.sum((1, 2, 3)))


def test_learning_rate_warms_up_and_falls():
    factor = lambda step, schedule: P.learning_rate_factor(step, 100, 10, schedule)
    assert factor(0, "cosine") == 0.1 and factor(9, "constant") == 1 and factor(99, "constant") == 1
    assert factor(10, "cosine") == 1 and factor(99, "cosine") < 0.001
    assert P.learning_rate_factor(0, 100, 0, "constant") == 1


def test_training_learns_the_reference_and_logs_it(fresh_prior, tmp_path):
    trained = lora.attach(fresh_prior, 8, 16, 0.1, "attention+conv", 0)
    training = with_changes(TRAINING, steps=60, optimizer={"batch": 4, "lr_unet": 4e-3})
    P.personalize(fresh_prior, trained, [striped_reference()], training, tmp_path)
    records = read_trace(tmp_path / "trace.jsonl")
    assert [records[0]["iteration"], records[-1]["iteration"]] == [0, 60]
    assert records[-1]["target_mse"] < 0.9 * records[0]["target_mse"]
    assert records[-1]["clean_latent_mse"] < records[0]["clean_latent_mse"]
    assert not fresh_prior.unet.training


def test_training_reads_the_prompts_of_the_stage(fresh_prior, tmp_path, monkeypatch):
    used, embed = [], P.diffusion.embed_text
    monkeypatch.setattr(P.diffusion, "embed_text", lambda prior, texts: used.append(list(texts)) or embed(prior, texts))
    trained = lora.attach(fresh_prior, 4, 8, 0.0, "attention", 0)
    training = with_changes(TRAINING, steps=1, prompts={"whole": "a wall", "crop": "a brick"})
    P.personalize(fresh_prior, trained, [striped_reference()], training, tmp_path)
    assert used and all(texts[:2] == ["a wall", "a brick"] for texts in used)


def test_photographs_are_measured_by_and_not_learnt_from(fresh_prior, tmp_path):
    """Photographs serve validation only: the trained weights are the same with and without them.

    The validation hole of a photograph must not overlap the mask of the object.
    """
    reference = striped_reference()
    thing = torch.zeros(70, 90, dtype=torch.bool)
    thing[:, :45] = True
    photograph = reference.image.flip(2)
    held_out = validation.make_held_out([reference], [(photograph, thing)], NATIVE, 0)
    assert len(held_out.pictures) == 2 and not (held_out.holes[1] * two_scale_masks(thing, [], NATIVE)[0]).any()
    assert held_out.holes[1].any() and (held_out.repaint[1] >= held_out.holes[1]).all()

    def learnt(folder, photographs):
        folder.mkdir()
        prior = small_prior()
        trained = lora.attach(prior, 4, 8, 0.0, "attention", 0)
        P.personalize(prior, trained, [reference], TRAINING, folder, photographs)
        return lora.state(prior), read_trace(folder / "trace.jsonl")[-1]

    (alone, row), (measured, also) = learnt(tmp_path / "a", []), learnt(tmp_path / "b", [(photograph, thing)])
    assert all(torch.equal(alone[name], measured[name]) for name in alone)
    assert row["hole_psnr"] == pytest.approx(also["hole_psnr"], abs=3) and "photo_psnr" in also.keys() - row.keys()
    assert {"clean_latent_mse", "crop_latent_mse"} <= row.keys()


@contextmanager
def interrupt_at(step, monkeypatch):
    """Interrupt a training inside the context when it reaches this step, and check that it was."""
    real = P.train_step

    def interrupted(*arguments):
        if arguments[4] == step:
            raise KeyboardInterrupt
        return real(*arguments)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(P, "train_step", interrupted)
        yield


def test_interrupted_training_resumes_to_the_same_weights(tmp_path, monkeypatch):
    monkeypatch.setattr(trace, "WORK_PER_CHECKPOINT", 0)  # a checkpoint after every step

    def trained(folder):
        prior = small_prior()
        trained = lora.attach(prior, 4, 8, 0.1, "attention", 0)
        training = with_changes(TRAINING, optimizer={"schedule": "cosine", "warm_up": 2}, checkpoint_seconds=1e-9)
        P.personalize(prior, trained, [striped_reference()], training, folder)
        return lora.state(prior)

    (tmp_path / "whole").mkdir()
    (tmp_path / "broken").mkdir()
    whole = trained(tmp_path / "whole")
    with interrupt_at(2, monkeypatch):
        trained(tmp_path / "broken")
    assert load_checkpoint(tmp_path / "broken")["step"] == 2
    torch.manual_seed(12345)
    resumed = trained(tmp_path / "broken")
    assert all((resumed[name] == weight).all() for name, weight in whole.items())
    errors = lambda f: [[r["iteration"], r["target_mse"]] for r in read_trace(tmp_path / f / "trace.jsonl")]
    assert errors("whole") == errors("broken")


def test_training_that_gains_little_more_ends_and_resumes_to_the_same_end(tmp_path, monkeypatch):
    monkeypatch.setattr(trace, "WORK_PER_CHECKPOINT", 0)  # a checkpoint after every step

    def train(folder, steps=16, least_gain=0.9):
        folder.mkdir(exist_ok=True)
        prior = small_prior()
        trained = lora.attach(prior, 4, 8, 0.1, "attention", 0)
        training = with_changes(TRAINING, steps=steps, least_gain=least_gain, checkpoint_seconds=1e-9)
        P.personalize(prior, trained, [striped_reference()], training, folder)
        return lora.state(prior), load_trace(folder / "trace.jsonl", "personalize")[""][-1]

    whole, end = train(tmp_path / "whole")
    assert end["reason"] == "settled" and end["iteration"] == 8, "from 4 to 8 steps the error does not fall to a tenth"
    assert train(tmp_path / "never", least_gain=0)[1]["iteration"] == 16
    alone, _ = train(tmp_path / "alone", 8, 0)
    assert all(torch.allclose(alone[name], weight, atol=1e-6) for name, weight in whole.items())
    with interrupt_at(6, monkeypatch):
        train(tmp_path / "broken")
    resumed, end = train(tmp_path / "broken")
    assert end["iteration"] == 8
    assert all(torch.allclose(resumed[name], weight, atol=1e-6) for name, weight in whole.items())


def test_nan_stops_the_training_and_names_the_step(fresh_prior, tmp_path):
    trained = lora.attach(fresh_prior, 4, 8, 0.0, "attention", 0)
    broken = replace(striped_reference(), image=torch.full((3, 70, 90), float("nan")))
    with pytest.raises(FloatingPointError, match="step 0"):
        P.personalize(fresh_prior, trained, [broken], TRAINING, tmp_path)
    assert all(torch.isfinite(w).all() for w in lora.state(fresh_prior).values())
    with pytest.raises(ValueError, match="native 16 px"):
        P.personalize(
            fresh_prior, trained, [striped_reference()], with_changes(TRAINING, samples={"size": 128}), tmp_path
        )

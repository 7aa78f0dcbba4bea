"""Training of the embedded prior: images and training steps depend only on the seed, and runs resume exactly."""

import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import safetensors.torch
import torch
from scenes.networks import save_small_prior

from lab.prior import build, images, train
from lab.prior.photographs import PHOTOGRAPHS, load_photographs, short_name
from lab.prior.rooms import load_rooms

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent
TINY = ROOT / "priors" / "tiny"


def test_the_makefiles_command_is_understood(monkeypatch):
    (command,) = [line.split() for line in (ROOT / "Makefile").read_text().splitlines() if "train --start" in line]
    assert command[1:3] == ["-m", train.__name__]
    monkeypatch.setattr(sys, "argv", ["train.py", *command[3:-2], "--steps", "5"])
    options = train.arguments()
    assert options.steps == 5 and (ROOT / options.start / "model_index.json").exists()
    assert options.out == TINY and options.work == ROOT / "runs" / "prior"


def test_images_depend_on_seed_and_number_only():
    first, again = images.image(3, 7), images.image(3, 7)
    assert np.array_equal(first[0], again[0]) and first[1] == again[1]
    assert not np.array_equal(first[0], images.image(3, 8)[0])
    assert not np.array_equal(first[0], images.image(3, 7, held_out=True)[0])


def test_held_out_photographs_never_train(photographs):
    for load in (images.bundled_photographs, lambda held_out: load_photographs(photographs, held_out)):
        trained, kept = ({picture.tobytes() for _, picture in load(held_out)} for held_out in (False, True))
        assert trained and kept and not trained & kept


def test_a_missing_photograph_is_named(photographs, tmp_path):
    shutil.copytree(photographs, tmp_path / "some")
    (tmp_path / "some" / "Wood.jpg").unlink()
    with pytest.raises(ValueError, match=r"Wood missing; run python -m lab\.prior\.photographs"):
        load_photographs(tmp_path / "some", held_out=False)


def test_images_are_cropped_from_the_given_photographs():
    plain = [("plain", np.full((200, 300, 3), 90, np.uint8))]
    found = [images.image(0, index, plain) for index in range(20)]
    crops = [picture for picture, subject in found if subject == "plain"]
    assert len(crops) > 5 and all(crop.std(axis=(0, 1)).max() == 0 for crop in crops)


def test_masks_are_silhouettes_or_large_or_the_whole_picture():
    shares = np.array([images.mask(np.random.default_rng(k), 64).mean() for k in range(60)])
    assert shares.min() < 0.2
    assert 8 <= (shares == 1).sum() <= 22  # a quarter of them
    assert 12 <= (np.abs(shares - images.LARGE_HOLE) < 0.001).sum() <= 28  # a third of them


def test_captions_name_subject_color_and_scale_or_nothing():
    drawn = [train.draw_caption(np.random.default_rng(k), "brick", k % 2 == 1, "dark red") for k in range(1000)]
    counts = {caption: drawn.count(caption) for caption in set(drawn)}
    assert 70 < counts.pop("") < 130
    subjects = {"brick, dark red": 0, "brick": 0, "sks": 0, "a scene": 0}
    for caption, count in counts.items():
        subjects[caption.removeprefix("A photo of ").removesuffix(", cropped")] += count
    assert 225 < subjects["sks"] + subjects["a scene"] < 315
    assert 60 < subjects["brick"] < 120


@pytest.mark.parametrize(
    ("color", "name"),
    [
        ((20, 20, 22), "dark gray"),
        ((128, 60, 50), "red"),
        ((250, 240, 120), "bright yellow"),
        ((60, 130, 50), "green"),
        ((20, 30, 110), "dark blue"),
        ((130, 40, 140), "purple"),
        ((150, 30, 60), "red"),
    ],
)
def test_colors_are_named_in_words_of_the_tokenizer(color, name):
    assert images.name_color(np.full((20, 3), color, np.uint8)) == name
    assert set(name.split()) <= set(build.WORDS)


def test_rooms_that_are_held_out_never_train(rooms):
    train_rooms, held_out_rooms = (load_rooms(rooms, held_out) for held_out in (False, True))
    assert [place for place, _ in held_out_rooms] == ["a room"] and len(train_rooms) == 2
    assert {place for place, _ in train_rooms} == {"a corner", "a table"}


def test_a_folder_without_rooms_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"no picture of a room; run python -m lab\.prior\.rooms"):
        load_rooms(tmp_path, held_out=False)


def test_an_error_of_the_latents_weighs_the_same_in_every_color():
    """The gradient A^T (z - x0) of the pixels points where the pixels differ: A^T A is a multiple of the identity."""
    kernel = build.analysis()[:3, :, 1, 1]
    product = kernel.T @ kernel
    assert torch.allclose(product, product[0, 0] * torch.eye(3), atol=1e-5)


def test_the_linear_vae_is_linear_in_half_precision_too():
    pixels = torch.rand(2, 3, 40, 40, generator=torch.Generator().manual_seed(0)) * 2 - 1
    vae = build.linear_vae()
    assert (vae.decode(vae.encode(pixels).latent_dist.mean).sample - pixels).abs().max() < 2e-3
    stored = vae.half().float()
    assert (stored.decode(stored.encode(pixels).latent_dist.mean).sample - pixels).abs().max() < 4e-3


def test_training_latents_are_the_vaes():
    pixels = torch.rand(2, 3, 24, 24, generator=torch.Generator().manual_seed(1)) * 2 - 1
    stored = build.linear_vae().encode(pixels).latent_dist.mean
    assert (build.latents(pixels) - stored).abs().max() < 5e-3


def test_timesteps_cover_the_schedule_in_every_batch():
    for seed in range(20):
        t = train.spread_timesteps(8, 1000, torch.Generator().manual_seed(seed))
        assert sorted((t // 125).tolist()) == list(range(8))
    timesteps = torch.cat([train.spread_timesteps(8, 1000, torch.Generator().manual_seed(k)) for k in range(500)])
    assert timesteps.min() < 10 and timesteps.max() > 990


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """Return a folder of small pictures that stand for the photographs."""
    folder = tmp_path_factory.mktemp("photographs")
    for number, each in enumerate(PHOTOGRAPHS):
        picture = np.random.default_rng(number).integers(0, 256, (140, 180, 3), np.uint8)
        cv2.imwrite(str(folder / f"{short_name(each)}.jpg"), picture)
    return folder


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    """Return a folder with a picture of each of three rooms, of which the first is held out."""
    folder = tmp_path_factory.mktemp("rooms")
    for number, name in enumerate(("demo-100-0", "corner-101-0", "table-103-0")):
        picture = np.random.default_rng(number).integers(0, 256, (150, 200, 3), np.uint8)
        cv2.imwrite(str(folder / f"{name}.png"), picture)
    return folder


@pytest.fixture(scope="module")
def pool():
    return train.Pool(0, 0, 12, images.bundled_photographs())


def train_steps(pool, count, start=0, state=None):
    torch.set_num_threads(1)
    model, alphas = train.Model(0), build.scheduler().alphas_cumprod
    optimiser = train.make_optimiser(model)
    if state:
        model.load_state_dict(state[0])
        optimiser.load_state_dict(state[1])
    losses = [train.step_once(model, alphas, optimiser, pool, k, 100) for k in range(start, count)]
    return losses, model.state_dict(), optimiser.state_dict()


def test_training_repeats_and_resumes_exactly(pool):
    losses, weights, _ = train_steps(pool, 4)
    again, same, _ = train_steps(pool, 4)
    assert losses == again and all(torch.equal(a, b) for a, b in zip(weights.values(), same.values(), strict=True))
    _, half, moments = train_steps(pool, 2)
    tail, resumed, _ = train_steps(pool, 4, 2, (half, moments))
    assert tail == losses[2:]
    assert all(torch.equal(a, b) for a, b in zip(weights.values(), resumed.values(), strict=True))


def load_weights(folder):
    return {
        part.name: safetensors.torch.load_file(next(part.glob("*.safetensors")))
        for part in (folder / "unet", folder / "text_encoder")
    }


@pytest.fixture
def train_command(monkeypatch, tmp_path, photographs, rooms):
    """Return a function that runs `train.py` with small batches and returns the exported weights."""
    for name, value in (
        ("POOL", 6),
        ("SMALL", (16, 2)),
        ("LARGE", (16, 2)),
        ("VALIDATION_CROPS", 2),
        ("CHECKPOINT_STEPS", 3),
    ):
        monkeypatch.setattr(train, name, value)

    def run(work, count, *more):
        out = tmp_path / f"{work}-{count}"
        options = ["--steps", str(count), "--threads", "1", "--work", str(tmp_path / work), "--out", str(out), *more]
        options += ["--photographs", str(photographs), "--rooms", str(rooms)]
        monkeypatch.setattr(sys, "argv", ["train.py", *options])
        train.main()
        return load_weights(out)

    return run


def test_a_run_that_was_killed_and_resumed_equals_the_unbroken_one(train_command, monkeypatch):
    unbroken, once = train_command("one", 6), train.step_once

    def killed(*values):
        # Step 4 comes one step after a checkpoint. A new image joins the pool between checkpoint and kill.
        if values[-2] == 4:
            raise KeyboardInterrupt
        return once(*values)

    monkeypatch.setattr(train, "step_once", killed)
    with pytest.raises(KeyboardInterrupt):
        train_command("two", 6)
    monkeypatch.setattr(train, "step_once", once)
    resumed = train_command("two", 6)
    for part, tensors in unbroken.items():
        assert all(torch.equal(value, resumed[part][name]) for name, value in tensors.items()), part


def test_start_begins_with_a_folders_weights(train_command, tmp_path):
    initial = train_command("first", 1)
    after = train_command("start", 1, "--start", str(tmp_path / "first-1"))
    fresh = train_command("anew", 1, "--seed", "1")
    for part, tensors in initial.items():
        # The first warm-up step moves each weight by about the learning rate, 5e-6. The export in half precision
        # rounds a weight to about 1e-3 of its value.
        moved = max(float((after[part][name] - value).abs().max()) for name, value in tensors.items())
        assert moved < 4e-3, part
        assert any(float((fresh[part][name] - value).abs().max()) > 0.05 for name, value in tensors.items())


@pytest.mark.parametrize("lacks", ["all", "other"])
def test_start_refuses_what_does_not_fit(train_command, tmp_path, lacks):
    folder = tmp_path / "given"
    if lacks == "other":
        save_small_prior(folder)
    with pytest.raises(ValueError, match="--start"):
        train_command("refused", 1, "--start", str(folder))

"""The prior: VAE, conversions between eps, v and z_0, sampling, and LoRA files that diffusers reads."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from reffusion.io.lora import save_portable
from reffusion.prior import diffusion, harmonic_fill, lora
from reffusion.prior.model import CONDITIONING, load_prior, make_prior
from reffusion.seeding import generator

TINY = Path(__file__).resolve().parent.parent / "priors" / "tiny"


@pytest.fixture
def tiny_prior():
    return load_prior(TINY)


def random_images(count=2, side=32, seed=0):
    return torch.rand(count, 3, side, side, generator=generator(seed, "pictures")) * 2 - 1


def half_masks(count=2, side=32):
    masks = torch.zeros(count, 1, side, side)
    masks[:, :, :, side // 2 :] = 1
    return masks


def test_sizes_are_read_from_the_folder(tiny_prior):
    assert (tiny_prior.factor, tiny_prior.native_size, tiny_prior.prediction_type) == (1, 64, "v_prediction")


def test_vae_round_trip_is_exact(tiny_prior):
    images = random_images(2, 48)
    assert (diffusion.decode(tiny_prior, diffusion.encode(tiny_prior, images)) - images).abs().max() < 3e-3


def test_encoding_is_linear(tiny_prior):
    a, b = random_images(1, 24, 1), random_images(1, 24, 2)
    middle = diffusion.encode(tiny_prior, (a + b) / 2)
    assert torch.allclose(middle, (diffusion.encode(tiny_prior, a) + diffusion.encode(tiny_prior, b)) / 2, atol=3e-3)


@pytest.mark.parametrize("kind", ["epsilon", "v_prediction"])
def test_predictions_reproduce_the_noisy_latents(tiny_prior, kind):
    from dataclasses import replace

    prior = replace(tiny_prior, prediction_type=kind)
    t, noise = torch.tensor([0, 999]), torch.randn(2, 4, 32, 32, generator=generator(0))
    clean = diffusion.encode(prior, random_images())
    noisy = diffusion.add_noise(prior, clean, noise, t)
    text = diffusion.embed_text(prior, ["A photo of sks", ""])
    condition = diffusion.conditioning(prior, random_images(), half_masks())
    eps, x0 = diffusion.predict(prior, noisy, t, condition, text)
    assert torch.allclose(diffusion.add_noise(prior, x0, eps, t), noisy, atol=1e-4)
    target = diffusion.training_target(prior, clean, noise, t)
    a = diffusion.alpha_bar(prior, t)
    recovered = (
        (noisy - (1 - a).sqrt() * target) / a.sqrt()
        if kind == "epsilon"
        else a.sqrt() * noisy - (1 - a).sqrt() * target
    )
    assert torch.allclose(recovered, clean, atol=2e-4)


def test_conditioning_hides_what_lies_under_the_mask(tiny_prior):
    images, masks = random_images(), half_masks()
    other = torch.where(masks > 0, torch.ones(()), images)
    assert torch.equal(
        diffusion.conditioning(tiny_prior, images, masks), diffusion.conditioning(tiny_prior, other, masks)
    )
    images.requires_grad_(True)
    assert not diffusion.conditioning(tiny_prior, images, masks).requires_grad


def test_a_folder_says_what_the_hole_shows(tiny_prior, tmp_path):
    images, masks = random_images(), half_masks()
    filled = harmonic_fill.harmonic_extension(images, masks)
    assert tiny_prior.fills
    expected = torch.cat([masks, diffusion.encode(tiny_prior, filled)], 1)
    assert torch.equal(diffusion.conditioning(tiny_prior, images, masks), expected)
    folder = tmp_path / "prior"
    shutil.copytree(TINY, folder)
    file = folder / CONDITIONING
    for text in ('{"hole": "grey"}', None):
        file.write_text(text) if text else file.unlink()
        gray = diffusion.conditioning(load_prior(folder), images, masks)
        assert torch.equal(gray, torch.cat([masks, diffusion.encode(tiny_prior, images * (1 - masks))], 1))
    file.write_text('{"hole": "grey", "contrast": 0.5}')
    assert load_prior(folder).contrast == 0.5
    for text in (
        '{"hole": "blue"}',
        '{"hole": "grey", "contrast": -1}',
        '{"hole": "grey", "contrast": []}',
        "{}",
        "[",
        "3",
    ):
        file.write_text(text)
        with pytest.raises(ValueError, match=CONDITIONING):
            load_prior(folder)


def test_sampling_repeats_with_its_seed_and_is_finite(tiny_prior):
    text = diffusion.embed_text(tiny_prior, ["A photo of sks"] * 2)
    run = lambda seed: diffusion.sample(tiny_prior, random_images(), half_masks(), text, 3, generator(seed))
    first, again, other = run(0), run(0), run(1)
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert torch.isfinite(first).all() and first.abs().max() <= 1


def test_guidance_zero_is_the_conditional_prediction(tiny_prior):
    text, empty = diffusion.embed_text(tiny_prior, ["A photo of sks"]), diffusion.embed_text(tiny_prior, [""])
    noisy, t = torch.randn(1, 4, 16, 16, generator=generator(3)), torch.tensor([500])
    condition = diffusion.conditioning(tiny_prior, random_images(1, 16), half_masks(1, 16))
    plain, _ = diffusion.predict(tiny_prior, noisy, t, condition, text)
    without, _ = diffusion.predict(tiny_prior, noisy, t, condition, empty)
    guided, _ = diffusion.predict_with_guidance(tiny_prior, noisy, t, condition, text, empty, 2.0)
    assert torch.allclose(guided, 3 * plain - 2 * without, atol=1e-5)
    with pytest.raises(ValueError, match="empty prompt"):
        diffusion.predict_with_guidance(tiny_prior, noisy, t, condition, text, None, 1.0)


@pytest.mark.integration
@pytest.mark.parametrize("dropout", [0.1, 0.0], ids=["beside the weights", "added to them"])
@pytest.mark.parametrize("layers", ["attention", "attention+conv"])
def test_saved_lora_gives_the_trained_epsilon_in_a_fresh_diffusers_pipeline(tiny_prior, tmp_path, layers, dropout):
    found = lora.attach(tiny_prior, rank=4, alpha=12.0, dropout=dropout, layers=layers, seed=0)
    noise = generator(0, "lora")
    for parameter in found["unet"] + found["text"]:
        parameter.data += 0.1 * torch.randn(parameter.shape, generator=noise)
    noisy, t = torch.randn(1, 4, 16, 16, generator=noise), torch.tensor([400])
    condition = diffusion.conditioning(tiny_prior, random_images(1, 16), half_masks(1, 16))
    trained = diffusion.raw_prediction(
        tiny_prior, noisy, t, condition, diffusion.embed_text(tiny_prior, ["A photo of sks"])
    )
    lora.save(tiny_prior, tmp_path)
    written = (tmp_path / lora.LORA_FILE).read_bytes()
    for _ in range(5):
        lora.save(tiny_prior, tmp_path)
        assert (tmp_path / lora.LORA_FILE).read_bytes() == written, "equal weights, another file"
    with safe_open(tmp_path / lora.LORA_FILE, "pt") as file:
        text = [key for key in file.keys() if key.startswith("text_encoder.")]
    assert text and all(key.startswith("text_encoder.text_model.encoder.layers.") for key in text)

    from diffusers import StableDiffusionInpaintPipeline

    pipe = StableDiffusionInpaintPipeline.from_pretrained(TINY, safety_checker=None, torch_dtype=torch.float32)
    plain = load_prior(TINY)
    base = diffusion.raw_prediction(plain, noisy, t, condition, diffusion.embed_text(plain, ["A photo of sks"]))
    assert (trained - base).abs().max() > 1e-3
    pipe.load_lora_weights(tmp_path)
    fresh = make_prior(pipe.unet, pipe.vae, pipe.text_encoder, pipe.tokenizer, pipe.scheduler)
    loaded = diffusion.raw_prediction(fresh, noisy, t, condition, diffusion.embed_text(fresh, ["A photo of sks"]))
    assert (loaded - trained).abs().max() < 1e-5

    save_portable(tmp_path / lora.LORA_FILE, tmp_path / "out" / "portable.safetensors")
    with safe_open(tmp_path / "out" / "portable.safetensors", "pt") as file:
        assert all(key.startswith(("unet.", "text_encoder.text_model.")) for key in file.keys())
        bare = {key: file.get_tensor(key) for key in file.keys()}
    save_file(bare, tmp_path / "out" / "bare.safetensors")  # without metadata: the update is B A
    for name in ("portable", "bare"):
        pipe.unload_lora_weights()
        pipe.load_lora_weights(tmp_path / "out", weight_name=f"{name}.safetensors")
        loaded = diffusion.raw_prediction(fresh, noisy, t, condition, diffusion.embed_text(fresh, ["A photo of sks"]))
        assert (loaded - trained).abs().max() < 1e-5

    merged = lora.merge(plain, tmp_path)
    again = diffusion.raw_prediction(merged, noisy, t, condition, diffusion.embed_text(merged, ["A photo of sks"]))
    assert (again - trained).abs().max() < 2e-5


def test_lora_added_to_the_weights_has_the_gradients_of_lora_beside_them():
    gradients = []
    for dropout in (0.1, 0.0):  # a dropout of 0 adds LoRA to the weights; in evaluation mode 0.1 has no effect
        prior = load_prior(TINY)
        found = lora.attach(prior, 4, 8.0, dropout, "attention+conv", 0)
        noise = generator(0, "lora")
        for parameter in found["unet"]:
            parameter.data += 0.02 * torch.randn(parameter.shape, generator=noise)
        noisy, condition = (
            torch.randn(2, 4, 16, 16, generator=noise),
            diffusion.conditioning(prior, random_images(2, 16), half_masks(2, 16)),
        )
        text = diffusion.embed_text(prior, ["", "a"])
        output = diffusion.raw_prediction(prior, noisy, torch.tensor([100, 700]), condition, text)
        output.square().sum().backward()
        gradients.append([parameter.grad for parameter in found["unet"]])
    for beside, added in zip(*gradients, strict=True):
        assert torch.allclose(beside, added, rtol=1e-3, atol=1e-4 * float(beside.abs().max()))


def test_lora_state_round_trip(tiny_prior):
    found = lora.attach(tiny_prior, 2, 4.0, 0.0, "attention", 0)
    state = lora.state(tiny_prior)
    for parameter in found["unet"] + found["text"]:
        parameter.data += 1
    lora.load_state(tiny_prior, state)
    assert all(torch.equal(a, b) for a, b in zip(state.values(), lora.state(tiny_prior).values(), strict=True))


def test_the_stock_pipeline_inpaints():
    from diffusers import StableDiffusionInpaintPipeline
    from PIL import Image

    pipe = StableDiffusionInpaintPipeline.from_pretrained(TINY, safety_checker=None, torch_dtype=torch.float32)
    pipe.set_progress_bar_config(disable=True)
    image, mask = Image.new("RGB", (64, 64), (90, 120, 60)), Image.new("L", (64, 64), 255)
    result = pipe("A photo of sks", image=image, mask_image=mask, height=64, width=64, num_inference_steps=2)
    assert result.images[0].size == (64, 64)


def test_clear_errors(tmp_path):
    with pytest.raises(ValueError, match="no such folder"):
        load_prior(tmp_path / "absent")
    (tmp_path / "unet").mkdir()
    with pytest.raises(ValueError, match="lacks vae"):
        load_prior(tmp_path)
    copy = tmp_path / "copy"
    shutil.copytree(TINY, copy)
    config = copy / "scheduler" / "scheduler_config.json"
    config.write_text(json.dumps(json.loads(config.read_text()) | {"prediction_type": "sample"}))
    with pytest.raises(ValueError, match="prediction_type"):
        load_prior(copy)


def test_a_model_with_contrast_paints_a_pale_picture_as_it_paints_the_strong_one(tiny_prior):
    prior = replace(tiny_prior, contrast=0.5)
    text, masks = diffusion.embed_text(prior, [""] * 2), half_masks()
    strong = 0.4 * random_images()
    pale = 0.4 + 0.4 * strong
    paint = lambda images: diffusion.sample(prior, images, masks, text, 3, generator(0), start=0.8)
    assert torch.allclose(paint(pale), 0.4 + 0.4 * paint(strong), atol=2e-3)
    everything = torch.ones_like(masks)
    assert torch.isfinite(diffusion.sample(prior, strong, everything, text, 3, generator(0))).all()
    flat = diffusion.sample(prior, torch.full_like(strong, 0.3), masks, text, 3, generator(0))
    assert (flat - 0.3).abs().max() < 0.2, "errors are small where the surroundings have no contrast"

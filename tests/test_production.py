"""Features for production on a GPU, tested with small models on the CPU.

They are SDXL, batches that are processed in parts, half precision, memory budgets, and two GPU benchmarks.
"""

import gc
import json
import sys
import weakref
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from lab.gpu import check as gpu_check
from lab.gpu import exact as gpu_exact
from lab.gpu import full_size as F
from lab.gpu import random_priors
from lab.gpu import steps as gpu_steps
from reffusion.params.base import Prompts
from reffusion.prior import denoising, diffusion, inpaint, lora, memory
from reffusion.prior.model import Prior, drop_text_encoders, enable_checkpointing, load_prior, pipeline
from reffusion.prior.personalize import train_step
from reffusion.seeding import generator
from reffusion.weights import published

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def sdxl_folder(tmp_path_factory):
    """Return a folder that diffusers wrote, with a small prior with the architecture of SDXL."""
    folder = tmp_path_factory.mktemp("sdxl")
    pipeline(
        replace(random_priors.build_prior(random_priors.shrink(random_priors.SDXL), torch.float32), zero_empty=True)
    ).save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def sdxl_prior(sdxl_folder):
    return load_prior(sdxl_folder)


@pytest.fixture
def sd2_prior():
    return random_priors.build_prior(random_priors.shrink(random_priors.SD2), torch.float32)


def draw_normal(*shape, seed=0):
    return torch.randn(*shape, generator=generator(seed, "test"))


@torch.no_grad()
def epsilon(prior: Prior) -> torch.Tensor:
    """Return the noise that the prior predicts for a fixed input, to be compared before and after saving the LoRA."""
    side = prior.native_size // prior.factor
    noisy, blanked = draw_normal(2, 1, prior.vae.config.latent_channels, side, side)
    condition = torch.cat([torch.ones_like(noisy[:, :1]), blanked], 1)
    text = diffusion.embed_text(prior, [Prompts().whole])
    return diffusion.raw_prediction(prior, noisy, torch.tensor([500]), condition, text)


# ----------------------------------------------------------------------------------------------------------------- SDXL


def test_sdxl_prompts_and_unet_are_those_of_the_stock_pipeline(sdxl_prior):
    assert sdxl_prior.text_encoder_2 is not None and sdxl_prior.zero_empty and sdxl_prior.native_size == 32
    pipe = pipeline(sdxl_prior)
    hidden, empty, pooled, pooled_empty = pipe.encode_prompt("a red chair", device="cpu")
    text = diffusion.embed_text(sdxl_prior, ["a red chair", ""])
    assert torch.allclose(text[0, :-1], hidden[0], atol=1e-5)
    assert torch.allclose(text[0, -1, : pooled.shape[1]], pooled[0], atol=1e-5)
    assert not text[1].any() and not empty.any() and not pooled_empty.any()

    noisy, condition = draw_normal(1, 4, 16, 16), draw_normal(1, 5, 16, 16, seed=1)
    sizes = torch.tensor([[32.0, 32, 0, 0, 32, 32]])
    added = {"text_embeds": pooled, "time_ids": sizes}
    at = torch.tensor([300])
    stock = pipe.unet(torch.cat([noisy, condition], 1), at, encoder_hidden_states=hidden, added_cond_kwargs=added)
    assert torch.allclose(diffusion.raw_prediction(sdxl_prior, noisy, at, condition, text[:1]), stock.sample, atol=1e-5)
    other = diffusion.raw_prediction(sdxl_prior, noisy, at, condition, text[1:])
    assert (other - stock.sample).abs().max() > 1e-4


def test_sdxl_paints_a_reference(sdxl_prior):
    image, hole = torch.rand(3, 40, 50, generator=generator(0, "image")) * 2 - 1, torch.zeros(40, 50, dtype=torch.bool)
    hole[10:30, 15:40] = True
    options = {"prompt": "a red chair", "seeds": [0], "steps": 2, "start": 0.999, "finest": 0.5, "guidance": 1.0}
    painted = inpaint.paint(sdxl_prior, image, hole, **options)
    assert painted.shape == (1, 3, 40, 50) and torch.isfinite(painted).all()
    assert torch.equal(painted[0][:, ~hole], image[:, ~hole])
    other = inpaint.paint(sdxl_prior, image, hole, **options | {"prompt": "a table"})
    assert not torch.equal(other, painted)


def test_sdxl_learns_a_lora_on_its_unet_and_both_text_encoders(sdxl_folder, tmp_path):
    """What is saved changes a fresh SDXL as it changed the trained one, here and in diffusers' own pipeline."""
    prior = load_prior(sdxl_folder)
    texts = Prompts().texts
    before = diffusion.embed_text(prior, texts).detach()
    _, optimizer, training = F.trainer(prior, 5)
    losses = [train_step(prior, optimizer, [F.reference(32)], training, step) for step in range(3)]
    lora.set_dropout(prior, False)
    assert torch.tensor(losses).isfinite().all() and {part.split(".")[0] for part in lora.state(prior)} == {
        "unet",
        "text",
        "text_2",
    }
    changed = [name for name, value in lora.state(prior).items() if "lora_B" in name and value.any()]
    assert {name.split(".")[0] for name in changed} == {"unet", "text", "text_2"}
    lora.save(prior, tmp_path)
    fresh = lora.merge(load_prior(sdxl_folder), tmp_path)
    text = diffusion.embed_text(prior, texts).detach()
    assert (text - before).abs().max() > 1e-5 and torch.allclose(diffusion.embed_text(fresh, texts), text, atol=1e-5)
    noisy, condition, at = draw_normal(1, 4, 16, 16), draw_normal(1, 5, 16, 16, seed=1), torch.tensor([300])
    with torch.no_grad():
        predict = lambda each: diffusion.raw_prediction(each, noisy, at, condition, text[:1])
        assert torch.allclose(predict(fresh), predict(prior), atol=1e-4)
        assert (predict(prior) - predict(load_prior(sdxl_folder))).abs().max() > 1e-5
    pipe = pipeline(load_prior(sdxl_folder))
    pipe.load_lora_weights(tmp_path, weight_name=lora.LORA_FILE)
    hidden = pipe.encode_prompt(texts[0], device="cpu")[0]
    assert torch.allclose(hidden[0], text[0, :-1], atol=1e-5)


# ----------------------------------------------------------------------------------------------------- parts of a batch


def test_a_batch_in_parts_gives_the_same_values_and_gradients(sd2_prior):
    images = draw_normal(3, 3, 32, 32).requires_grad_()
    noisy, condition, at = draw_normal(3, 4, 16, 16), draw_normal(3, 5, 16, 16), torch.tensor([10, 500, 900])
    text = diffusion.embed_text(sd2_prior, Prompts().texts).detach()
    found = []
    for prior in (sd2_prior, replace(sd2_prior, rows=1, rows_with_grad=2), enable_checkpointing(sd2_prior)):
        latents = diffusion.encode(prior, images)
        (gradient,) = torch.autograd.grad((latents * draw_normal(*latents.shape)).sum(), images)
        with torch.no_grad():
            found.append((latents.detach(), gradient, diffusion.raw_prediction(prior, noisy, at, condition, text)))
    for other in found[1:]:
        assert all(torch.allclose(a, b, atol=1e-5) for a, b in zip(found[0], other, strict=True))


def test_a_training_step_in_parts_is_the_same_step():
    after = []
    for rows in (0, 2):
        prior = random_priors.build_prior(random_priors.shrink(random_priors.SD2), torch.float32)
        trained, optimizer, training = F.trainer(prior, 5)
        for part in (prior.unet, prior.text_encoder):  # no dropout: its random draws depend on the split into parts
            for layer in part.modules():
                layer.p = 0.0 if isinstance(layer, torch.nn.Dropout) else getattr(layer, "p", None)
        prior = replace(prior, rows_with_grad=rows)
        loss = train_step(prior, optimizer, [F.reference(32)], training, 0)
        after.append((loss, [p.detach().clone() for part in trained.values() for p in part]))
    assert after[0][0] == pytest.approx(after[1][0], rel=1e-5)
    # Adam's first step has the size of the learning rate and the gradient's sign. The sign of a gradient of almost 0
    # depends on rounding, so a few weights may differ.
    close = [torch.isclose(a, b, atol=2e-5).float().mean() for a, b in zip(after[0][1], after[1][1], strict=True)]
    assert min(close) > 0.97


def test_half_precision_stays_near_and_leaves_the_vae_alone(sd2_prior):
    half = random_priors.build_prior(random_priors.shrink(random_priors.SD2), torch.bfloat16)
    for name in ("unet", "text_encoder"):
        getattr(half, name).load_state_dict(getattr(sd2_prior, name).state_dict())
    half.vae.load_state_dict(sd2_prior.vae.state_dict())
    images, noisy, at = draw_normal(1, 3, 32, 32), draw_normal(1, 4, 16, 16), torch.tensor([999])
    assert torch.equal(diffusion.encode(half, images), diffusion.encode(sd2_prior, images))
    condition = draw_normal(1, 5, 16, 16)
    with torch.no_grad():
        answers = [
            diffusion.predict(p, noisy, at, condition, diffusion.embed_text(p, ["a"])) for p in (sd2_prior, half)
        ]
    (eps, clean), (eps_half, clean_half) = answers
    assert eps_half.dtype == clean_half.dtype == torch.float32
    error = (eps_half - eps).abs().max()
    assert 0 < error < 0.1
    # The formula x0 = (z - s eps) / a runs in float32: the error of x0 is the error of eps times s / a.
    a = diffusion.alpha_bar(sd2_prior, at)
    assert torch.allclose(clean_half - clean, -((1 - a) / a).sqrt() * (eps_half - eps), atol=1e-4)


@pytest.mark.parametrize("dropout", [0.0, 0.1])
def test_a_small_lora_is_not_lost_in_half_precision(sd2_prior, dropout):
    half = random_priors.build_prior(random_priors.shrink(random_priors.SD2), torch.bfloat16)
    half.unet.load_state_dict(sd2_prior.unet.state_dict())
    sd2_prior.unet.load_state_dict(half.unet.state_dict())  # equal weights: both rounded to bfloat16
    noisy, condition, at, text = (
        draw_normal(1, 4, 16, 16),
        draw_normal(1, 5, 16, 16),
        torch.tensor([500]),
        draw_normal(1, 24, 64),
    )
    changes = []
    for prior in (sd2_prior, half):
        found = lora.attach(prior, 4, 4.0, dropout, "attention", 0)
        before = diffusion.raw_prediction(prior, noisy, at, condition, text).detach()
        noise = generator(0, "lora")
        for parameter in found["unet"]:
            parameter.data += 5e-4 * torch.randn(parameter.shape, generator=noise)
        layer = next(m for m in prior.unet.modules() if hasattr(m, "lora_A"))
        x = draw_normal(1, 8, layer.base_layer.in_features, seed=3).to(prior.dtype)
        changes.append((layer(x) - layer.base_layer(x)).float().flatten().detach())
        assert torch.isfinite(diffusion.raw_prediction(prior, noisy, at, condition, text) - before).all()
    exact, rounded = changes
    assert torch.dot(exact, rounded) / exact.norm() / rounded.norm() > 0.65  # 0.41 if LoRA is added to the weights


def test_a_lora_loads_into_diffusers_own_pipeline_of_sd2(sd2_prior, tmp_path):
    """`load_lora_weights` of diffusers loads the saved LoRA of UNet and text encoder into a model of the same weights.

    The predictions and text embeddings then equal those of the trained model.
    """
    before = epsilon(sd2_prior)
    found = lora.attach(sd2_prior, 4, 8.0, 0.1, "attention", 0)
    noise = generator(0, "lora")
    for parameter in found["unet"] + found["text"]:
        parameter.data += 0.1 * torch.randn(parameter.shape, generator=noise)
    trained, words = epsilon(sd2_prior), diffusion.embed_text(sd2_prior, [Prompts().whole])
    lora.save(sd2_prior, tmp_path)
    fresh = random_priors.build_prior(random_priors.shrink(random_priors.SD2), torch.float32)
    pipe = pipeline(fresh)
    pipe.load_lora_weights(tmp_path)
    lora.set_dropout(fresh, False)  # turn dropout off, as new layers are in training mode
    assert (epsilon(fresh) - trained).abs().max() < 1e-5 < (trained - before).abs().max()
    assert (diffusion.embed_text(fresh, [Prompts().whole]) - words).abs().max() < 1e-5


def test_the_order_of_weights_in_memory_changes_nothing(sd2_prior, tmp_path):
    """A UNet in the memory format channels_last, which is used on CUDA, gives the same answers.

    This also holds after a trained and saved LoRA was merged into the UNet.
    """
    lora.attach(sd2_prior, 4, 8.0, 0.0, "attention+conv", 0)
    before = epsilon(sd2_prior)
    sd2_prior.unet.to(memory_format=torch.channels_last)
    assert (epsilon(sd2_prior) - before).abs().max() < 1e-5
    personalized = random_priors.build_prior(random_priors.shrink(random_priors.SD2), torch.float32)
    _, optimizer, training = F.trainer(personalized, 1)
    train_step(personalized, optimizer, [F.reference(32)], training, 0)
    lora.save(personalized, tmp_path)
    fresh = random_priors.build_prior(random_priors.shrink(random_priors.SD2), torch.float32)
    fresh.unet.to(memory_format=torch.channels_last)
    plain = lora.merge(random_priors.build_prior(random_priors.shrink(random_priors.SD2), torch.float32), tmp_path)
    assert (epsilon(lora.merge(fresh, tmp_path)) - epsilon(plain)).abs().max() < 1e-5


def test_the_text_encoder_is_let_go():
    prior = random_priors.build_prior(random_priors.shrink(random_priors.SD2), torch.float32)
    whole, encoder = prior.bytes, weakref.ref(prior.text_encoder)
    text = diffusion.embed_text(prior, Prompts().texts).detach()
    prior = drop_text_encoders(prior)
    gc.collect()
    assert encoder() is None and prior.bytes < whole
    with pytest.raises(ValueError, match="text encoder was dropped"):
        diffusion.embed_text(prior, ["a"])
    answer = diffusion.raw_prediction(
        prior, draw_normal(3, 4, 16, 16), torch.tensor([1, 2, 3]), draw_normal(3, 5, 16, 16), text
    )
    assert torch.isfinite(answer).all()


# --------------------------------------------------------------------------------------------------------------- memory


def test_living_tensors_are_counted():
    def work():
        a = torch.zeros(1000)  # 4000 bytes
        b = a + 1
        del a
        c = b.view(10, 100)  # a view, without memory of its own
        return torch.cat([c, c])  # 8000 bytes, while b still holds 4000

    assert memory.peak_bytes(work, "cpu") == 12_000
    kept = torch.zeros(1000)
    assert memory.peak_bytes(lambda: kept.add_(1), "cpu") == 0


def test_a_budget_chooses_the_parts(sd2_prior):
    assert memory.fit_to_memory(sd2_prior, 0.0, "distill.memory_gb", memory.encode_one_sample) is sd2_prior
    one, answer = (
        memory.peak_bytes(lambda w=w: w(sd2_prior), "cpu")
        for w in (memory.encode_one_sample, memory.inpaint_one_sample)
    )
    budget = (sd2_prior.bytes + 3.5 * one) / memory.USABLE_SHARE / 1e9
    chosen = memory.fit_to_memory(sd2_prior, budget, "distill.memory_gb", memory.encode_one_sample)
    assert chosen.rows_with_grad == 3 and chosen.rows == int(3.5 * one // answer)
    with pytest.raises(ValueError, match=r"distill.memory_gb is 0.001, but the prior takes .* raise it to"):
        memory.fit_to_memory(sd2_prior, 1e-3, "distill.memory_gb", memory.encode_one_sample)
    assert memory.peak_bytes(lambda: memory.encode_one_sample(enable_checkpointing(sd2_prior)), "cpu") < one


def test_measuring_a_training_sample_leaves_no_gradient(sd2_prior):
    trained, _, _ = F.trainer(sd2_prior, 1)
    row = lambda prior: denoising.backward_one_sample(prior, [F.reference(32)], 0)
    assert memory.fit_to_memory(sd2_prior, 1.0, "personalize.memory_gb", row).rows_with_grad > 1
    assert all(p.grad is None and p.requires_grad for part in trained.values() for p in part)


def test_running_out_of_memory_names_the_param():
    with pytest.raises(ValueError, match=r"out of memory: lower distill.memory_gb \(now 20\)"):
        with memory.explain_oom("distill.memory_gb", 20.0):
            torch.empty(2**60, dtype=torch.uint8)
    with pytest.raises(ValueError, match=r"personalize.memory_gb \(now 0: no limit\)"):
        with memory.explain_oom("personalize.memory_gb", 0.0):
            raise torch.OutOfMemoryError("CUDA out of memory")
    with pytest.raises(RuntimeError, match="other"):
        with memory.explain_oom("distill.memory_gb", 20.0):
            raise RuntimeError("other")


# ----------------------------------------------------------------------------------------------------------- benchmarks


def test_published_sizes_are_those_of_the_published_configurations():
    assert random_priors.count_parameters(random_priors.SD2) == published.PUBLISHED[published.SD2].parameters
    assert random_priors.count_parameters(random_priors.SDXL) == published.PUBLISHED[published.SDXL].parameters


def test_memory_is_counted_without_computing():
    shape = random_priors.shrink(random_priors.SD2)
    counted = F.peak_memory(shape, torch.float32)
    made = random_priors.build_prior(shape, torch.float32)
    assert counted["weights"] == pytest.approx(made.bytes / 1e9, abs=1e-6)
    real = memory.peak_bytes(lambda: memory.encode_one_sample(made), "cpu") / 1e9
    assert real <= counted["SDS"] < 2 * real  # the count decomposes attention, which needs more memory
    assert counted["personalization, checkpointing"] < counted["personalization"]


@pytest.mark.slow
def test_gpu_check_keeps_what_it_has(tmp_path, monkeypatch):
    """The benchmark runs at a small size on the CPU, and its part with the critic runs out of memory.

    The report states this failure in one line and has the errors and seconds of all other parts. Its file is complete
    after each part.
    """

    def full(*arguments):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate\n 20.00 GiB")

    written, write = [], gpu_check.write_atomically
    monkeypatch.setattr(gpu_steps, "adversarial_term", full)
    monkeypatch.setattr(gpu_check, "write_atomically", lambda path, text: written.append(text) or write(path, text))
    report = gpu_check.check("cpu", tmp_path)
    parts = report["parts"]
    assert parts["adversarial"] == {
        "failed": "OutOfMemoryError: CUDA out of memory. Tried to allocate 20.00 GiB"
    } and list(parts).index("personalization") < list(parts).index("adversarial")
    against = [name for name in parts if name.startswith("splatting")]
    outputs = {"color", "depth", "alpha", "features", "weights", "gradient of means", "gradient of background"}
    assert len(against) == 3 and all(parts[name]["ok"] and outputs <= parts[name]["errors"].keys() for name in against)
    assert parts["SSIM"]["ok"] and parts["fit"]["ok"]
    steps = ("reconstruction", "reference", "personalization", "SDS", "depth")
    assert all(parts[name]["seconds"] > 0 and parts[name]["peak_gb"] > 0 for name in steps)
    assert set(report["projected_hours"]) == {"fit", "personalize"}, "distill's needs the critic"
    assert len(written) == 2 * len(parts) and [len(json.loads(text)["parts"]) for text in written[::2]][:2] == [1, 2]
    assert json.loads((tmp_path / "gpu_check.json").read_text()) == report
    assert "out of memory" in (tmp_path / "gpu_check.md").read_text()


def test_gpu_check_finds_small_errors():
    truth = {"color": torch.rand(50, 40, 3), "gradient of means": torch.randn(90, 3)}
    flipped = {name: tensor.clone() for name, tensor in truth.items()}
    assert gpu_exact.compare_blocks(flipped, truth)["ok"]
    wrong = flipped | {"color": truth["color"] * (1 + 3e-5)}
    assert gpu_exact.compare_blocks(wrong, truth)["beyond"] == "color"
    wrong = flipped | {"gradient of means": truth["gradient of means"] * 1.001}
    assert gpu_exact.compare_blocks(wrong, truth)["beyond"] == "gradient of means"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_gpu_check_needs_a_gpu(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["gpu_check.py", "--out", str(tmp_path)])
    assert gpu_check.main() == 2
    assert capsys.readouterr().err.count("\n") == 1

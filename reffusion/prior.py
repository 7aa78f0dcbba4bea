"""The inpainting latent diffusion model: load, encode, decode, predict, sample, adapt by LoRA.

The only importer of diffusers, transformers and peft. Works with any Stable-Diffusion-type inpainting folder
(latents C | mask 1 | masked latents C); sizes, factor and prediction type are read from its configuration, so the
embedded prior and SD2-inpainting take the same path. In masks 1 = repaint.
"""

from __future__ import annotations

import itertools
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

LORA_FILE = "pytorch_lora_weights.safetensors"
ATTENTION = ("to_q", "to_k", "to_v", "to_out.0")
TEXT_ATTENTION = ("q_proj", "k_proj", "v_proj", "out_proj")
CONVOLUTIONS = (
    "conv_in",
    "conv1",
    "conv2",
    "conv_shortcut",
    "conv_out",
    "proj_in",
    "proj_out",
    "ff.net.0.proj",
    "ff.net.2",
)


@dataclass(frozen=True)
class Prior:
    """An inpainting diffusion model on one device.

    Attributes:
        unet, vae, text_encoder, tokenizer: diffusers and transformers objects, frozen, in evaluation mode.
        alphas_cumprod: [T] float32, abar_t of the noise schedule.
        prediction_type: "epsilon" or "v_prediction".
        scheduler: the folder's scheduler object; only handed on when a pipeline is built.
    """

    unet: nn.Module
    vae: nn.Module
    text_encoder: nn.Module
    tokenizer: Any
    alphas_cumprod: Tensor
    prediction_type: str
    scheduler: Any

    @property
    def device(self) -> torch.device:
        return self.unet.device

    @property
    def dtype(self) -> torch.dtype:
        return self.vae.dtype

    @property
    def factor(self) -> int:
        """Pixels per latent, a side."""
        return 2 ** (len(self.vae.config.block_out_channels) - 1)

    @property
    def native_size(self) -> int:
        """The side, in pixels, of the images the model was trained on."""
        size = self.unet.config.sample_size
        return self.factor * (size if isinstance(size, int) else min(size))

    @property
    def timesteps(self) -> int:
        return len(self.alphas_cumprod)


def load_prior(source: str | Path, device: str = "cpu", dtype: torch.dtype = torch.float32) -> Prior:
    """The model in a local diffusers folder, or a hub id.

    Raises:
        ValueError: the folder is missing, is no inpainting model, or predicts neither epsilon nor v.
    """
    from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
    from transformers import CLIPTextModel, CLIPTokenizer
    from transformers.utils import logging as transformers_logging

    _check_source(source)
    name = str(source)
    transformers_logging.disable_progress_bar()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            unet = UNet2DConditionModel.from_pretrained(name, subfolder="unet", torch_dtype=dtype)
            vae = AutoencoderKL.from_pretrained(name, subfolder="vae", torch_dtype=dtype)
            text = CLIPTextModel.from_pretrained(name, subfolder="text_encoder", dtype=dtype)
            tokenizer = CLIPTokenizer.from_pretrained(name, subfolder="tokenizer")
            scheduler = DDIMScheduler.from_pretrained(name, subfolder="scheduler")
    except OSError as error:
        raise ValueError(f"prior {name}: {str(error).splitlines()[0]}") from error
    return make_prior(unet, vae, text, tokenizer, scheduler, device, name)


def _check_source(source: str | Path) -> None:
    path = Path(source)
    if path.is_dir():
        missing = [p for p in ("unet", "vae", "text_encoder", "tokenizer", "scheduler") if not (path / p).is_dir()]
        if missing:
            raise ValueError(
                f"prior {path}: the folder lacks {', '.join(missing)}; it must be a diffusers pipeline folder"
            )
    elif path.is_absolute() or str(source).count("/") != 1 or str(source).startswith("."):
        raise ValueError(f"prior {source}: no such folder, and not a hub id of the form owner/name")


def make_prior(
    unet: nn.Module,
    vae: nn.Module,
    text: nn.Module,
    tokenizer: Any,
    scheduler: Any,
    device: str = "cpu",
    name: str = "",
) -> Prior:
    """A Prior from parts already in memory, checked to fit together."""
    channels, given = vae.config.latent_channels, unet.config.in_channels
    if given != 2 * channels + 1:
        raise ValueError(
            f"prior {name}: the UNet takes {given} channels; an inpainting UNet for {channels} latent channels takes "
            f"{2 * channels + 1} (latents, mask, masked latents)"
        )
    kind = scheduler.config.prediction_type
    if kind not in ("epsilon", "v_prediction"):
        raise ValueError(f"prior {name}: prediction_type {kind!r} is not supported; epsilon and v_prediction are")
    for part in (unet, vae, text):
        part.requires_grad_(False).eval().to(device)
    return Prior(unet, vae, text, tokenizer, scheduler.alphas_cumprod.float().to(device), kind, scheduler)


# ---------------------------------------------------------------------------------------------- the model's maps


def embed_text(prior: Prior, prompts: list[str]) -> Tensor:
    """[B, L, D] hidden states of the prompts; differentiable in the text encoder's LoRA."""
    length = min(prior.tokenizer.model_max_length, prior.text_encoder.config.max_position_embeddings)
    ids = prior.tokenizer(
        prompts, padding="max_length", max_length=length, truncation=True, return_tensors="pt"
    ).input_ids
    return prior.text_encoder(ids.to(prior.device)).last_hidden_state


def encode(prior: Prior, images: Tensor) -> Tensor:
    """Images [B, 3, H, W] in [-1, 1] -> latents [B, C, H/f, W/f], the posterior's mean, scaled; differentiable."""
    mean = prior.vae.encode(images.to(prior.dtype)).latent_dist.mean
    return (mean * prior.vae.config.scaling_factor).float()


def decode(prior: Prior, latents: Tensor) -> Tensor:
    """Latents [B, C, h, w] -> images [B, 3, H, W], about [-1, 1]; differentiable."""
    return prior.vae.decode((latents / prior.vae.config.scaling_factor).to(prior.dtype)).sample.float()


@torch.no_grad()
def conditioning(prior: Prior, images: Tensor, masks: Tensor) -> Tensor:
    """What the UNet sees beside the noisy latents: [mask | latents of the image outside the mask], [B, 1 + C, h, w].

    Carries no gradient. `images` [B, 3, H, W] in [-1, 1], `masks` [B, 1, H, W], 1 = repaint.
    """
    hidden = (masks > 0.5).to(images.dtype)
    latents = encode(prior, images * (1 - hidden))
    small = interpolate(hidden, size=latents.shape[-2:], mode="nearest") if prior.factor > 1 else hidden
    return torch.cat([small.float(), latents], 1)


def abar(prior: Prior, t: Tensor) -> Tensor:
    """alpha-bar at timesteps `t` [B], shaped [B, 1, 1, 1]."""
    return prior.alphas_cumprod[t].view(-1, 1, 1, 1)


def add_noise(prior: Prior, latents: Tensor, noise: Tensor, t: Tensor) -> Tensor:
    """z_t = sqrt(abar_t) z_0 + sqrt(1 - abar_t) eps."""
    a = abar(prior, t)
    return a.sqrt() * latents + (1 - a).sqrt() * noise


def raw_prediction(prior: Prior, noisy: Tensor, t: Tensor, condition: Tensor, text: Tensor) -> Tensor:
    """The UNet's own output, eps or v, float32 [B, C, h, w]; for training."""
    inputs = torch.cat([noisy, condition], 1).to(prior.dtype)
    return prior.unet(inputs, t, encoder_hidden_states=text.to(prior.dtype)).sample.float()


def training_target(prior: Prior, latents: Tensor, noise: Tensor, t: Tensor) -> Tensor:
    """What `raw_prediction` should equal: eps, or v = sqrt(abar) eps - sqrt(1 - abar) z_0."""
    if prior.prediction_type == "epsilon":
        return noise
    a = abar(prior, t)
    return a.sqrt() * noise - (1 - a).sqrt() * latents


def predict(prior: Prior, noisy: Tensor, t: Tensor, condition: Tensor, text: Tensor) -> tuple[Tensor, Tensor]:
    """(eps, z_0) predicted from z_t; both float32 [B, C, h, w]."""
    output, a = raw_prediction(prior, noisy, t, condition, text), abar(prior, t)
    if prior.prediction_type == "epsilon":
        return output, (noisy - (1 - a).sqrt() * output) / a.sqrt()
    return a.sqrt() * output + (1 - a).sqrt() * noisy, a.sqrt() * noisy - (1 - a).sqrt() * output


@torch.no_grad()
def sample(
    prior: Prior,
    images: Tensor,
    masks: Tensor,
    text: Tensor,
    steps: int,
    random: torch.Generator,
    guidance: float = 0.0,
    empty: Tensor | None = None,
    start: float = 1.0,
) -> Tensor:
    """Inpaint by deterministic DDIM.

    Args:
        images: [B, 3, H, W] in [-1, 1]; what lies under the mask matters only when `start` < 1.
        masks: [B, 1, H, W], 1 = repaint.
        text, empty: [B, L, D] hidden states; `empty` is needed when `guidance` > 0.
        steps: denoising steps, >= 1.
        random: a CPU generator for the noise.
        guidance: the paper's a: (1 + a) eps(cond) - a eps(empty); libraries' scale is 1 + a.
        start: noise level to begin from as a fraction of the schedule; 1 begins from pure noise.

    Returns:
        [B, 3, H, W] in [-1, 1], the model's whole picture (the caller keeps the pixels it knows).
    """
    if not 0 < start <= 1:
        raise ValueError(f"start must lie in (0, 1], not {start}")
    condition = conditioning(prior, images, masks)
    shape = (len(images), condition.shape[1] - 1, *condition.shape[-2:])
    noise = torch.randn(shape, generator=random).to(images.device)
    first = start * prior.timesteps - 1
    times = torch.linspace(first, 0, steps + 1).round().long().clamp(min=0).tolist()
    batch = torch.full((len(images),), times[0], device=images.device)
    noisy = noise if start == 1 else add_noise(prior, encode(prior, images), noise, batch)
    for now, then in itertools.pairwise(times):
        eps, clean = guided(prior, noisy, torch.full_like(batch, now), condition, text, empty, guidance)
        noisy = clean if then == times[-1] else add_noise(prior, clean, eps, torch.full_like(batch, then))
    return decode(prior, noisy).clamp(-1, 1)


def guided(
    prior: Prior, noisy: Tensor, t: Tensor, condition: Tensor, text: Tensor, empty: Tensor | None, guidance: float
) -> tuple[Tensor, Tensor]:
    """(eps, z_0) under classifier-free guidance (1 + a) eps(cond) - a eps(empty); one UNet batch for both."""
    if guidance == 0:
        return predict(prior, noisy, t, condition, text)
    if empty is None:
        raise ValueError("guidance needs the empty prompt's embedding")
    both = [torch.cat([x, x]) for x in (noisy, t, condition)]
    eps, clean = predict(prior, *both, torch.cat([text, empty]))
    (eps, eps_empty), (clean, clean_empty) = eps.chunk(2), clean.chunk(2)
    return (1 + guidance) * eps - guidance * eps_empty, (1 + guidance) * clean - guidance * clean_empty


# ---------------------------------------------------------------------------------------------- LoRA


def add_lora(
    prior: Prior, rank: int, alpha: float, dropout: float, layers: str, seed: int
) -> dict[str, list[nn.Parameter]]:
    """Attach fresh LoRA layers to UNet and text encoder, in place.

    Args:
        rank, alpha, dropout: of every layer; the change of a weight is alpha / rank * B A.
        layers: "attention" (the paper's), or "attention+conv" (UNet convolutions and feed-forward layers too).
        seed: of the layers' initial values.

    Returns:
        {"unet": parameters, "text": parameters}, float32, requiring gradients.
    """
    from peft import LoraConfig

    if layers not in ("attention", "attention+conv"):
        raise ValueError(f"layers must be 'attention' or 'attention+conv', not {layers!r}")
    targets = ATTENTION if layers == "attention" else ATTENTION + CONVOLUTIONS
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for part, names in ((prior.unet, targets), (prior.text_encoder, TEXT_ATTENTION)):
            part.add_adapter(LoraConfig(r=rank, lora_alpha=alpha, lora_dropout=dropout, target_modules=list(names)))
    set_dropout(prior, False)
    return {"unet": _lora_parameters(prior.unet), "text": _lora_parameters(prior.text_encoder)}


def _lora_parameters(part: nn.Module) -> list[nn.Parameter]:
    found = []
    for name, parameter in part.named_parameters():
        if "lora_" in name:
            parameter.data = parameter.data.float()
            parameter.requires_grad_(True)
            found.append(parameter)
    return found


def lora_state(prior: Prior) -> dict[str, Tensor]:
    """The LoRA weights by name, for checkpoints."""
    return {
        f"{label}.{name}": parameter.detach().cpu().clone()
        for label, part in (("unet", prior.unet), ("text", prior.text_encoder))
        for name, parameter in part.named_parameters()
        if "lora_" in name
    }


def load_lora_state(prior: Prior, state: dict[str, Tensor]) -> None:
    """Put back what `lora_state` gave, into layers that `add_lora` attached."""
    for label, part in (("unet", prior.unet), ("text", prior.text_encoder)):
        for name, parameter in part.named_parameters():
            if "lora_" in name:
                parameter.data.copy_(state[f"{label}.{name}"])


def set_dropout(prior: Prior, active: bool) -> None:
    """Training mode (LoRA dropout on) or evaluation mode."""
    for part in (prior.unet, prior.text_encoder):
        part.train(active)


def save_lora(prior: Prior, folder: Path) -> None:
    """Write `pytorch_lora_weights.safetensors` as diffusers' `load_lora_weights` reads it, rank and alpha included."""
    from peft import get_peft_model_state_dict

    _pipeline_class().save_lora_weights(
        folder,
        unet_lora_layers=get_peft_model_state_dict(prior.unet, save_embedding_layers=False),
        text_encoder_lora_layers=get_peft_model_state_dict(prior.text_encoder, save_embedding_layers=False),
        weight_name=LORA_FILE,
        unet_lora_adapter_metadata=_adapter_facts(prior.unet),
        text_encoder_lora_adapter_metadata=_adapter_facts(prior.text_encoder),
    )


def _adapter_facts(part: nn.Module) -> dict[str, Any]:
    """The adapter's configuration (rank, alpha, layers) in an order of its own, without this machine's paths."""
    facts = next(iter(part.peft_config.values())).to_dict()
    plain = {key: sorted(value) if isinstance(value, set) else value for key, value in sorted(facts.items())}
    return plain | {"base_model_name_or_path": None}


def load_lora(prior: Prior, folder: Path) -> Prior:
    """The prior adapted by the LoRA in `folder`, merged into the UNet's weights (the text encoder keeps its layers)."""
    if not (folder / LORA_FILE).exists():
        raise ValueError(f"{folder / LORA_FILE} does not exist; run the personalize stage first")
    pipe = pipeline(prior)
    pipe.load_lora_weights(folder, weight_name=LORA_FILE)
    prior.unet.fuse_lora()
    prior.unet.unload_lora()
    for part in (prior.unet, prior.text_encoder):
        part.requires_grad_(False).eval()
    return replace(prior)


def pipeline(prior: Prior) -> Any:
    """diffusers' own inpainting pipeline over the same parts."""
    return _pipeline_class()(
        vae=prior.vae,
        text_encoder=prior.text_encoder,
        tokenizer=prior.tokenizer,
        unet=prior.unet,
        scheduler=prior.scheduler,
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )


def _pipeline_class() -> Any:
    """StableDiffusionInpaintPipeline, imported without the advice to install torchvision, which nothing here needs."""
    from transformers.utils import logging as transformers_logging

    level = transformers_logging.get_verbosity()
    transformers_logging.set_verbosity_error()
    from diffusers import StableDiffusionInpaintPipeline

    transformers_logging.set_verbosity(level)
    return StableDiffusionInpaintPipeline

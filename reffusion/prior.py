"""The inpainting latent diffusion model: load, encode, decode, predict, sample.

The only importer of diffusers. Works with any Stable-Diffusion-type inpainting folder
(latents C | mask 1 | masked latents C); sizes, factor and prediction type are read from its configuration, so the
embedded prior and SD2-inpainting take the same path. In masks 1 = repaint.
"""

from __future__ import annotations

import itertools
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate


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
        return self.alphas_cumprod.device  # a model's own answer searches all of its modules: 9 ms

    @property
    def dtype(self) -> torch.dtype:
        return next(self.vae.parameters()).dtype

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


def pipeline(prior: Prior) -> Any:
    """diffusers' own inpainting pipeline over the same parts."""
    return pipeline_class()(
        vae=prior.vae,
        text_encoder=prior.text_encoder,
        tokenizer=prior.tokenizer,
        unet=prior.unet,
        scheduler=prior.scheduler,
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )


def pipeline_class() -> Any:
    """StableDiffusionInpaintPipeline, imported without the advice to install torchvision, which nothing here needs."""
    from transformers.utils import logging as transformers_logging

    level = transformers_logging.get_verbosity()
    transformers_logging.set_verbosity_error()
    from diffusers import StableDiffusionInpaintPipeline

    transformers_logging.set_verbosity(level)
    return StableDiffusionInpaintPipeline

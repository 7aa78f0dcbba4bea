"""The inpainting latent diffusion model: load, encode, decode, predict, sample.

The only importer of diffusers. Works with any Stable-Diffusion-type inpainting folder, SDXL's too
(latents C | mask 1 | masked latents C); sizes, factor and prediction type are read from its configuration, so the
embedded prior and SD2-inpainting take the same path. In masks 1 = repaint.

Half precision is for UNet and text encoders. Float32 in any case:
- the VAE: SDXL's overflows in float16, a gradient through the encoder underflows in it, and the 8 bits of bfloat16
  show as bands in a decoded picture;
- schedule, noise and x0 = (z_t - s eps) / a: at the last timestep 1 / a is 15, and a rounding is multiplied by it;
- LoRA and its optimiser (reffusion.lora); the sums of a softmax, within PyTorch's attention kernels.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.functional import interpolate
from torch.utils.checkpoint import checkpoint

from reffusion import weights


@dataclass(frozen=True)
class Prior:
    """An inpainting diffusion model on one device.

    Attributes:
        unet, vae, text_encoder, tokenizer: diffusers and transformers objects, frozen, in evaluation mode;
            text_encoder is None once `without_text` has dropped it.
        alphas_cumprod: [T] float32, abar_t of the noise schedule.
        prediction_type: "epsilon" or "v_prediction".
        scheduler: the folder's scheduler object; only handed on when a pipeline is built.
        text_encoder_2, tokenizer_2: SDXL's second ones, else None.
        zero_empty: the empty prompt is embedded as zeros (SDXL says so of itself).
        rows, rows_graded: samples that UNet and VAE take in one pass, without and with a gradient; 0: all. A gradient
            through more is computed part by part, each part's activations once more on the way back.
    """

    unet: nn.Module
    vae: nn.Module
    text_encoder: nn.Module | None
    tokenizer: Any
    alphas_cumprod: Tensor
    prediction_type: str
    scheduler: Any
    text_encoder_2: nn.Module | None = None
    tokenizer_2: Any = None
    zero_empty: bool = False
    rows: int = 0
    rows_graded: int = 0

    @property
    def device(self) -> torch.device:
        return self.alphas_cumprod.device  # a model's own answer searches all of its modules: 9 ms

    @property
    def dtype(self) -> torch.dtype:
        """Of the UNet and the text encoders; the module's text says what is float32 beside them."""
        return next(self.unet.parameters()).dtype

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

    @property
    def bytes(self) -> int:
        """What its weights take in memory."""
        parts = [p for p in (self.unet, self.vae, self.text_encoder, self.text_encoder_2) if p is not None]
        return sum(p.numel() * p.element_size() for part in parts for p in part.parameters())


def load_prior(source: str | Path, device: str = "cpu", dtype: torch.dtype = torch.float32) -> Prior:
    """The model in a local diffusers folder, or of a hub id whose weights are on this machine (`weights.locate`).

    Nothing is downloaded. `dtype` is that of UNet and text encoders.

    Raises:
        ValueError: no such weights here, a damaged file, parts or shapes that do not fit, no inpainting model, or one
            that predicts neither epsilon nor v. What names, headers and configurations tell is told at once.
    """
    from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
    from transformers import CLIPTextModel, CLIPTextModelWithProjection, CLIPTokenizer

    try:
        folder = weights.locate(source)
        if folder is None:
            raise ValueError(weights.absent(source))
        weights.check(folder)
    except ValueError as error:
        raise ValueError(f"prior {error}") from None
    second = (folder / "text_encoder_2").is_dir()
    unet = _part(UNet2DConditionModel, folder, "unet", torch_dtype=dtype)
    vae = _part(AutoencoderKL, folder, "vae", torch_dtype=torch.float32)
    text = _part(CLIPTextModel, folder, "text_encoder", dtype=dtype)
    text_2 = _part(CLIPTextModelWithProjection, folder, "text_encoder_2", dtype=dtype) if second else None
    try:
        tokenizers = [CLIPTokenizer.from_pretrained(folder / n) for n in ("tokenizer", "tokenizer_2")[: 1 + second]]
        scheduler = DDIMScheduler.from_pretrained(folder / "scheduler")
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"prior {folder}: tokenizer or scheduler cannot be read: {_line(error)}") from error
    tokenizer_2 = tokenizers[1] if second else None
    prior = make_prior(unet, vae, text, tokenizers[0], scheduler, device, str(source), text_2, tokenizer_2)
    index = folder / "model_index.json"
    return replace(prior, zero_empty=second and '"force_zeros_for_empty_prompt": true' in index.read_text())


def _part(kind: Any, folder: Path, part: str, **dtype: torch.dtype) -> nn.Module:
    """One network of the folder, every weight of it read. Raises ValueError naming what does not fit."""
    from transformers.utils import logging as transformers_logging

    transformers_logging.disable_progress_bar()
    level = transformers_logging.get_verbosity()
    transformers_logging.set_verbosity_error()  # what it would say of shapes and missing weights is raised here
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            network, found = kind.from_pretrained(
                folder / part,
                variant=weights.variant(folder / part),
                use_safetensors=True,
                local_files_only=True,
                output_loading_info=True,
                **dtype,
            )
    except Exception as error:  # the libraries raise what they like for a shape that does not fit
        raise ValueError(f"prior {folder / part}: the weights do not fit config.json: {_line(error)}") from error
    finally:
        transformers_logging.set_verbosity(level)
    if lost := sorted(found["missing_keys"]):
        raise ValueError(f"prior {folder / part}: {len(lost)} weights are missing, {lost[0]} first: take a whole copy")
    return network


def _line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 300 else text[:297] + "..."


def make_prior(
    unet: nn.Module,
    vae: nn.Module,
    text: nn.Module,
    tokenizer: Any,
    scheduler: Any,
    device: str = "cpu",
    name: str = "",
    text_2: nn.Module | None = None,
    tokenizer_2: Any = None,
) -> Prior:
    """A Prior from parts already in memory, checked to fit together; the last two are SDXL's.

    Raises ValueError as `load_prior` does.
    """
    configs = {"unet": dict(unet.config), "vae": dict(vae.config), "scheduler": dict(scheduler.config)}
    configs["text_encoder"] = text.config.to_dict()
    if text_2 is not None:
        configs["text_encoder_2"] = text_2.config.to_dict()
    if problem := weights.misfit(configs):
        raise ValueError(f"prior {name}: {problem}")
    kind, alphas = scheduler.config.prediction_type, scheduler.alphas_cumprod.float()
    if kind == "epsilon" and float(alphas.min()) <= 0:
        raise ValueError(f"prior {name}: it predicts epsilon where its schedule leaves no signal; take another model")
    for part in (unet, vae, text, text_2):
        if part is not None:
            part.requires_grad_(False).eval().to(device)
    return Prior(unet, vae, text, tokenizer, alphas.to(device), kind, scheduler, text_2, tokenizer_2)


def without_text(prior: Prior) -> Prior:
    """The prior less its text encoders, once every prompt is embedded: their memory is free for other things."""
    return replace(prior, text_encoder=None, text_encoder_2=None)


def recomputing(prior: Prior) -> Prior:
    """The prior with UNet and VAE keeping a block's input only, and computing the block again in the backward pass."""
    prior.unet.enable_gradient_checkpointing()
    prior.vae.enable_gradient_checkpointing()
    return prior


# ---------------------------------------------------------------------------------------------- the model's maps


def embed_text(prior: Prior, prompts: list[str]) -> Tensor:
    """[B, L, D] hidden states of the prompts; differentiable in the text encoder's LoRA.

    Of SDXL: the last hidden layer but one of both encoders side by side, and as one row more, filled up with zeros,
    the pooled embedding that its UNet takes besides. So a prompt is one tensor for either kind.
    """
    if prior.text_encoder is None:
        raise ValueError("this prior's text encoder was dropped; embed every prompt before `without_text`")
    if prior.text_encoder_2 is None:
        return prior.text_encoder(_ids(prior.tokenizer, prior.text_encoder, prompts, prior.device)).last_hidden_state
    pairs = ((prior.tokenizer, prior.text_encoder), (prior.tokenizer_2, prior.text_encoder_2))
    outputs = [net(_ids(tokens, net, prompts, prior.device), output_hidden_states=True) for tokens, net in pairs]
    states = torch.cat([output.hidden_states[-2] for output in outputs], -1)
    pooled = outputs[1].text_embeds
    packed = torch.cat([states, F.pad(pooled, (0, states.shape[-1] - pooled.shape[-1]))[:, None]], 1)
    said = torch.tensor([prompt != "" or not prior.zero_empty for prompt in prompts], device=prior.device)
    return packed * said[:, None, None]


def _ids(tokenizer: Any, encoder: nn.Module, prompts: list[str], device: torch.device) -> Tensor:
    length = min(tokenizer.model_max_length, encoder.config.max_position_embeddings)
    tokens = tokenizer(prompts, padding="max_length", max_length=length, truncation=True, return_tensors="pt")
    return tokens.input_ids.to(device)


def _in_parts(prior: Prior, function: Callable[..., Tensor], *rows: Tensor) -> Tensor:
    """`function` of the rows, at most as many of them in one pass as the prior says."""
    most = (prior.rows_graded if torch.is_grad_enabled() else prior.rows) or len(rows[0])
    if len(rows[0]) <= most:
        return function(*rows)
    parts = zip(*(tensor.split(most) for tensor in rows), strict=True)
    if not torch.is_grad_enabled():
        return torch.cat([function(*part) for part in parts])
    return torch.cat([checkpoint(function, *part, use_reentrant=False) for part in parts])


def encode(prior: Prior, images: Tensor) -> Tensor:
    """Images [B, 3, H, W] in [-1, 1] -> latents [B, C, H/f, W/f], the posterior's mean, scaled; differentiable."""
    dtype = next(prior.vae.parameters()).dtype
    mean = _in_parts(prior, lambda part: prior.vae.encode(part.to(dtype)).latent_dist.mean, images)
    return (mean * prior.vae.config.scaling_factor).float()


def decode(prior: Prior, latents: Tensor) -> Tensor:
    """Latents [B, C, h, w] -> images [B, 3, H, W], about [-1, 1]; differentiable."""
    dtype = next(prior.vae.parameters()).dtype
    scaled = latents / prior.vae.config.scaling_factor
    return _in_parts(prior, lambda part: prior.vae.decode(part.to(dtype)).sample, scaled).float()


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
    return _in_parts(prior, lambda *rows: _unet(prior, *rows), inputs, t, text.to(prior.dtype)).float()


def _unet(prior: Prior, inputs: Tensor, t: Tensor, text: Tensor) -> Tensor:
    if prior.unet.config.addition_embed_type is None:
        return prior.unet(inputs, t, encoder_hidden_states=text).sample
    # SDXL: size of the original, top left corner of the crop, size asked for; a window is a picture of its own here.
    height, width = (extent * prior.factor for extent in inputs.shape[-2:])
    sizes = inputs.new_tensor([height, width, 0, 0, height, width]).expand(len(inputs), -1)
    pooled = prior.unet.config.projection_class_embeddings_input_dim - 6 * prior.unet.config.addition_time_embed_dim
    added = {"text_embeds": text[:, -1, :pooled], "time_ids": sizes}
    return prior.unet(inputs, t, encoder_hidden_states=text[:, :-1], added_cond_kwargs=added).sample


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
    if prior.text_encoder_2 is not None:
        return pipeline_class("StableDiffusionXLInpaintPipeline")(
            vae=prior.vae,
            text_encoder=prior.text_encoder,
            text_encoder_2=prior.text_encoder_2,
            tokenizer=prior.tokenizer,
            tokenizer_2=prior.tokenizer_2,
            unet=prior.unet,
            scheduler=prior.scheduler,
            force_zeros_for_empty_prompt=prior.zero_empty,
        )
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


def pipeline_class(name: str = "StableDiffusionInpaintPipeline") -> Any:
    """A pipeline of diffusers, imported without the advice to install torchvision, which nothing here needs."""
    from transformers.utils import logging as transformers_logging

    level = transformers_logging.get_verbosity()
    transformers_logging.set_verbosity_error()
    import diffusers

    found = getattr(diffusers, name)
    transformers_logging.set_verbosity(level)
    return found

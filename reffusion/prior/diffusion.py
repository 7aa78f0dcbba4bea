"""Operations of the inpainting diffusion model: embed, encode, decode, add noise, predict, sample. Masks: 1 = repaint.

Schedule, noise and x0 = (z_t - s eps) / a are float32 whatever the precision of the UNet. At the last timestep 1 / a is
15, and rounding errors are multiplied by this factor.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.functional import interpolate
from torch.utils.checkpoint import checkpoint

from reffusion.prior import harmonic_fill, levels
from reffusion.prior.model import Prior


def embed_text(prior: Prior, prompts: list[str]) -> Tensor:
    """Return the hidden states of prompts, [B, L, D], differentiable in the LoRA of the text encoder.

    For SDXL these are the penultimate hidden layers of both text encoders, concatenated. One more row, padded with
    zeros, contains the pooled embedding that its UNet also takes. So a prompt is one tensor for both kinds of model.

    Raises:
        ValueError: The text encoder was dropped (`model.drop_text_encoders`).
    """
    if prior.text_encoder is None:
        raise ValueError("this prior's text encoder was dropped; embed every prompt before `drop_text_encoders`")
    if prior.text_encoder_2 is None:
        return prior.text_encoder(
            _token_ids(prior.tokenizer, prior.text_encoder, prompts, prior.device)
        ).last_hidden_state
    pairs = ((prior.tokenizer, prior.text_encoder), (prior.tokenizer_2, prior.text_encoder_2))
    outputs = [net(_token_ids(tokens, net, prompts, prior.device), output_hidden_states=True) for tokens, net in pairs]
    states = torch.cat([output.hidden_states[-2] for output in outputs], -1)
    pooled = outputs[1].text_embeds
    packed = torch.cat([states, F.pad(pooled, (0, states.shape[-1] - pooled.shape[-1]))[:, None]], 1)
    is_kept = torch.tensor([prompt != "" or not prior.zero_empty for prompt in prompts], device=prior.device)
    return packed * is_kept[:, None, None]


def _token_ids(tokenizer: Any, encoder: nn.Module, prompts: list[str], device: torch.device) -> Tensor:
    length = min(tokenizer.model_max_length, encoder.config.max_position_embeddings)
    tokens = tokenizer(prompts, padding="max_length", max_length=length, truncation=True, return_tensors="pt")
    return tokens.input_ids.to(device)


def _in_batches(prior: Prior, function: Callable[..., Tensor], *rows: Tensor) -> Tensor:
    """Return `function` of rows [B, ...], computed in passes of at most the number of rows that the prior sets."""
    max_rows = (prior.rows_with_grad if torch.is_grad_enabled() else prior.rows) or len(rows[0])
    if len(rows[0]) <= max_rows:
        return function(*rows)
    parts = zip(*(tensor.split(max_rows) for tensor in rows), strict=True)
    if not torch.is_grad_enabled():
        return torch.cat([function(*part) for part in parts])
    # With a gradient, the passes are recomputed in the backward pass.
    return torch.cat([checkpoint(function, *part, use_reentrant=False) for part in parts])


def encode(prior: Prior, images: Tensor) -> Tensor:
    """Encode images [B, 3, H, W] in [-1, 1] as latents [B, C, H/f, W/f]; differentiable.

    The latents are the mean of the VAE's posterior times its scaling factor. f is `prior.factor`.
    """
    dtype = next(prior.vae.parameters()).dtype
    mean = _in_batches(prior, lambda part: prior.vae.encode(part.to(dtype)).latent_dist.mean, images)
    return (mean * prior.vae.config.scaling_factor).float()


def decode(prior: Prior, latents: Tensor) -> Tensor:
    """Decode latents [B, C, h, w] to images [B, 3, H, W], roughly in [-1, 1]; differentiable."""
    dtype = next(prior.vae.parameters()).dtype
    scaled = latents / prior.vae.config.scaling_factor
    return _in_batches(prior, lambda part: prior.vae.decode(part.to(dtype)).sample, scaled).float()


def measure_levels(prior: Prior, images: Tensor, masks: Tensor) -> levels.Levels:
    """Measure the levels by which pictures are normalized before `encode` and `conditioning`.

    Args:
        prior: The diffusion prior. Without `contrast` normalization changes nothing.
        images: [B, 3, H, W] in [-1, 1].
        masks: [B, 1, H, W], 1 = repaint.
    """
    return levels.measure_levels(images, (masks > 0.5).to(images.dtype), prior.contrast)


@torch.no_grad()
def conditioning(prior: Prior, images: Tensor, masks: Tensor) -> Tensor:
    """Return the conditioning of the UNet, [mask | latents of the masked image], [B, 1 + C, h, w], without gradient.

    The hole in the masked image is gray, or filled from its surroundings if `prior.fills`.

    Args:
        prior: The diffusion prior.
        images: [B, 3, H, W] in [-1, 1].
        masks: [B, 1, H, W], 1 = repaint.
    """
    hidden = (masks > 0.5).to(images.dtype)
    latents = encode(prior, harmonic_fill.harmonic_extension(images, hidden) if prior.fills else images * (1 - hidden))
    small_mask = interpolate(hidden, size=latents.shape[-2:], mode="nearest") if prior.factor > 1 else hidden
    return torch.cat([small_mask.float(), latents], 1)


def alpha_bar(prior: Prior, t: Tensor) -> Tensor:
    """Return alpha_bar at timesteps `t` [B], in the shape [B, 1, 1, 1]."""
    return prior.alphas_cumprod[t].view(-1, 1, 1, 1)


def add_noise(prior: Prior, latents: Tensor, noise: Tensor, t: Tensor) -> Tensor:
    """Return the noisy latents z_t = sqrt(abar_t) z_0 + sqrt(1 - abar_t) eps.

    Args:
        prior: The diffusion prior.
        latents: [B, C, h, w], the clean latents z_0.
        noise: [B, C, h, w], the noise eps.
        t: [B] timesteps.
    """
    a = alpha_bar(prior, t)
    return a.sqrt() * latents + (1 - a).sqrt() * noise


def raw_prediction(prior: Prior, noisy: Tensor, t: Tensor, condition: Tensor, text: Tensor) -> Tensor:
    """Return the output of the UNet, which is a prediction of eps or of v, float32 [B, C, h, w]. For training.

    Args:
        prior: The diffusion prior.
        noisy: [B, C, h, w], the noisy latents z_t.
        t: [B] timesteps.
        condition: [B, 1 + C, h, w], see `conditioning`.
        text: [B, L, D], the hidden states of the prompts.
    """
    inputs = torch.cat([noisy, condition], 1).to(prior.dtype)
    return _in_batches(prior, lambda *rows: _unet(prior, *rows), inputs, t, text.to(prior.dtype)).float()


def _unet(prior: Prior, inputs: Tensor, t: Tensor, text: Tensor) -> Tensor:
    if prior.unet.config.addition_embed_type is None:
        return prior.unet(inputs, t, encoder_hidden_states=text).sample
    # SDXL: original size, top left corner of the crop, target size; here a window is a picture of its own.
    height, width = (extent * prior.factor for extent in inputs.shape[-2:])
    sizes = inputs.new_tensor([height, width, 0, 0, height, width]).expand(len(inputs), -1)
    pooled = prior.unet.config.projection_class_embeddings_input_dim - 6 * prior.unet.config.addition_time_embed_dim
    added = {"text_embeds": text[:, -1, :pooled], "time_ids": sizes}
    return prior.unet(inputs, t, encoder_hidden_states=text[:, :-1], added_cond_kwargs=added).sample


def training_target(prior: Prior, latents: Tensor, noise: Tensor, t: Tensor) -> Tensor:
    """Return the target of `raw_prediction`: eps, or v = sqrt(abar) eps - sqrt(1 - abar) z_0."""
    if prior.prediction_type == "epsilon":
        return noise
    a = alpha_bar(prior, t)
    return a.sqrt() * noise - (1 - a).sqrt() * latents


def predict(prior: Prior, noisy: Tensor, t: Tensor, condition: Tensor, text: Tensor) -> tuple[Tensor, Tensor]:
    """Return eps and z_0 as predicted from the noisy latents z_t, float32 [B, C, h, w] each, without guidance.

    The arguments are those of `raw_prediction`.
    """
    output, a = raw_prediction(prior, noisy, t, condition, text), alpha_bar(prior, t)
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
    """Inpaint pictures by deterministic DDIM.

    Args:
        prior: The diffusion prior.
        images: [B, 3, H, W] in [-1, 1]. Pixels under the mask matter only if `start` < 1.
        masks: [B, 1, H, W], 1 = repaint.
        text: [B, L, D], the hidden states of the prompts.
        steps: Number of denoising steps, at least 1.
        random: Draws the noise, on the CPU.
        guidance: γ in (1 + γ) ε(cond) - γ ε(empty). The guidance scale of libraries is 1 + γ.
        empty: [B, L, D], the hidden states of the empty prompt; needed if `guidance` > 0.
        start: Initial noise level in (0, 1], as a fraction of the schedule. 1 starts from pure noise.

    Returns:
        [B, 3, H, W] in [-1, 1], the whole pictures of the model. The caller restores known pixels.

    Raises:
        ValueError: `start` is out of range, or `empty` is missing.
    """
    if not 0 < start <= 1:
        raise ValueError(f"start must lie in (0, 1], not {start}")
    shown = measure_levels(prior, images, masks)
    images = shown.normalize(images)
    condition = conditioning(prior, images, masks)
    shape = (len(images), condition.shape[1] - 1, *condition.shape[-2:])
    noise = torch.randn(shape, generator=random).to(images.device)
    start_t = start * prior.timesteps - 1
    times = torch.linspace(start_t, 0, steps + 1).round().long().clamp(min=0).tolist()
    batch = torch.full((len(images),), times[0], device=images.device)
    noisy = noise if start == 1 else add_noise(prior, encode(prior, images), noise, batch)
    for t, next_t in itertools.pairwise(times):
        eps, clean = predict_with_guidance(prior, noisy, torch.full_like(batch, t), condition, text, empty, guidance)
        noisy = clean if next_t == times[-1] else add_noise(prior, clean, eps, torch.full_like(batch, next_t))
    return shown.restore(decode(prior, noisy)).clamp(-1, 1)


def predict_with_guidance(
    prior: Prior, noisy: Tensor, t: Tensor, condition: Tensor, text: Tensor, empty: Tensor | None, guidance: float
) -> tuple[Tensor, Tensor]:
    """Return eps and z_0 with classifier-free guidance, (1 + γ) ε(cond) - γ ε(empty), in one batch of the UNet.

    If the prompt itself is empty, the result is eps(empty) for every γ, and the UNet runs for this prompt only.

    Args:
        prior: The diffusion prior.
        noisy: [B, C, h, w], the noisy latents z_t.
        t: [B] timesteps.
        condition: [B, 1 + C, h, w], see `conditioning`.
        text: [B, L, D], the hidden states of the prompts.
        empty: [B, L, D], the hidden states of the empty prompt. None is allowed without guidance.
        guidance: γ; 0 means no guidance.

    Raises:
        ValueError: `guidance` is not 0 and `empty` is None.
    """
    if guidance and empty is None:
        raise ValueError("guidance needs the empty prompt's embedding")
    if guidance == 0 or empty is None or torch.equal(text, empty):
        return predict(prior, noisy, t, condition, text)
    both = [torch.cat([x, x]) for x in (noisy, t, condition)]
    eps, clean = predict(prior, *both, torch.cat([text, empty]))
    (eps, eps_empty), (clean, clean_empty) = eps.chunk(2), clean.chunk(2)
    return (1 + guidance) * eps - guidance * eps_empty, (1 + guidance) * clean - guidance * clean_empty

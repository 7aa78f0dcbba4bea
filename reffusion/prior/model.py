"""The inpainting latent diffusion model: loaded, put together from parts, handed on as a pipeline of diffusers.

The only importer of diffusers. Works with any Stable-Diffusion-type inpainting folder, SDXL's too
(latents C | mask 1 | masked latents C); sizes, factor and prediction type are read from its configuration, so the
embedded prior and SD2-inpainting take the same path. What it computes: reffusion.prior.diffusion.

Half precision is for UNet and text encoders. Float32 in any case:
- the VAE: SDXL's overflows in float16, a gradient through the encoder underflows in it, and the 8 bits of bfloat16
  show as bands in a decoded picture;
- schedule, noise and x0 (reffusion.prior.diffusion); LoRA and its optimiser (reffusion.prior.lora); the sums of a
  softmax, within PyTorch's attention kernels.
"""

from __future__ import annotations

import json
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from reffusion.weights import local

CONDITIONING = "conditioning.json"  # of a folder, {"hole": one of HOLES}: what the masked image shows in its hole
HOLES = ("grey", "harmonic")


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
        fills: beside the noisy latents the model is shown the picture with the hole filled from its surroundings
            (`fill.extended`), as the folder's conditioning.json says; else with a grey hole, as libraries do.
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
    fills: bool = False

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
        folder = local.locate(source)
        if folder is None:
            raise ValueError(local.absent(source))
        local.check(folder)
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
    zero_empty = second and '"force_zeros_for_empty_prompt": true' in index.read_text()
    return replace(prior, zero_empty=zero_empty, fills=_fills(folder))


def _fills(folder: Path) -> bool:
    """What the folder's conditioning.json says of holes; without that file they are grey."""
    path = folder / CONDITIONING
    if not path.exists():
        return False
    try:
        hole = json.loads(path.read_text())["hole"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"prior {path}: cannot be read: {_line(error)}") from error
    if hole not in HOLES:
        raise ValueError(f"prior {path}: hole is {hole!r}, not one of {', '.join(HOLES)}")
    return hole == "harmonic"


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
                variant=local.variant(folder / part),
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
    if problem := local.misfit(configs):
        raise ValueError(f"prior {name}: {problem}")
    kind, alphas = scheduler.config.prediction_type, scheduler.alphas_cumprod.float()
    if kind == "epsilon" and float(alphas.min()) <= 0:
        raise ValueError(f"prior {name}: it predicts epsilon where its schedule leaves no signal; take another model")
    for part in (unet, vae, text, text_2):
        if part is not None:
            part.requires_grad_(False).eval().to(device)
    if torch.device(device).type == "cuda":  # the order in which half-precision convolutions read there: no transposing
        unet.to(memory_format=torch.channels_last)
    return Prior(unet, vae, text, tokenizer, alphas.to(device), kind, scheduler, text_2, tokenizer_2)


def without_text(prior: Prior) -> Prior:
    """The prior less its text encoders, once every prompt is embedded: their memory is free for other things."""
    return replace(prior, text_encoder=None, text_encoder_2=None)


def recomputing(prior: Prior) -> Prior:
    """The prior with UNet and VAE keeping a block's input only, and computing the block again in the backward pass."""
    prior.unet.enable_gradient_checkpointing()
    prior.vae.enable_gradient_checkpointing()
    return prior


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

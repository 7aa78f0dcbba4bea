"""The inpainting latent diffusion model: loading, assembly from parts, and conversion to a diffusers pipeline.

This is the only module that imports diffusers. It works with any inpainting folder of the Stable Diffusion type, SDXL
included (channels of the UNet's input: latents C | mask 1 | masked latents C). Sizes, factor and prediction type are
read from the configuration, so that the embedded prior and SD2-inpainting take the same path.
`reffusion.prior.diffusion` contains the operations.

Half precision applies to UNet and text encoders. Always float32 are:
- the VAE: SDXL's overflows in float16, a gradient through the encoder underflows in float16, and the 8 bits of bfloat16
show as bands in a decoded picture;
- schedule, noise and x0 (reffusion.prior.diffusion); LoRA and its optimizer (reffusion.prior.lora); the sums of a
softmax, within PyTorch's attention kernels.
"""

from __future__ import annotations

import importlib
import json
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from reffusion.weights import local

# File in a model folder, {"hole": one of HOLES, "contrast": number}: content of the hole in the masked image, and the
# contrast to which pictures are normalized (`Prior.contrast`).
CONDITIONING = "conditioning.json"
HOLES = ("grey", "harmonic")


@dataclass(frozen=True)
class Prior:
    """An inpainting diffusion model on one device.

    Attributes:
        unet, vae, text_encoder, tokenizer: Objects of diffusers and transformers, frozen and in evaluation mode. The
            text encoder is None after `drop_text_encoders`.
        alphas_cumprod: [T] float32, abar_t of the noise schedule.
        prediction_type: "epsilon" or "v_prediction".
        scheduler: The scheduler of the folder, which is used only to build a pipeline.
        text_encoder_2, tokenizer_2: The second text encoder and tokenizer of SDXL; None for other models.
        zero_empty: Whether the empty prompt is embedded as zeros (set in the configuration of SDXL).
        rows: Number of samples in one pass of UNet and VAE without a gradient; 0 means all. More samples are processed
            in parts.
        rows_with_grad: The same for passes with a gradient. Activations of the parts are recomputed in the backward
            pass.
        fills: Whether the hole in the conditioning picture is filled from its surroundings
            (`harmonic_fill.harmonic_extension`), as conditioning.json may ask. Else the hole is gray, as usual.
        contrast: Standard deviation of the known pixels of a picture as the model sees it (`levels`), which
            conditioning.json may set. 0, as usual: the model sees the picture as it is.
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
    rows_with_grad: int = 0
    fills: bool = False
    contrast: float = 0.0

    @property
    def device(self) -> torch.device:
        """Return the device of the networks."""
        return self.alphas_cumprod.device  # a network's own `device` searches all modules: 9 ms

    @property
    def dtype(self) -> torch.dtype:
        """Return the type of UNet and text encoders. The module docstring lists what is always float32."""
        return next(self.unet.parameters()).dtype

    @property
    def factor(self) -> int:
        """Return the number of pixels per latent along a side."""
        config: Any = self.vae.config
        return 2 ** (len(config.block_out_channels) - 1)

    @property
    def native_size(self) -> int:
        """Return the side in pixels of the square images on which the model was trained."""
        config: Any = self.unet.config
        size = config.sample_size
        return self.factor * (size if isinstance(size, int) else min(size))

    @property
    def timesteps(self) -> int:
        """Return the number of timesteps of the noise schedule."""
        return len(self.alphas_cumprod)

    @property
    def bytes(self) -> int:
        """Return the memory of the weights in bytes."""
        parts = [p for p in (self.unet, self.vae, self.text_encoder, self.text_encoder_2) if p is not None]
        return sum(p.numel() * p.element_size() for part in parts for p in part.parameters())


def load_prior(source: str | Path, device: str = "cpu", dtype: torch.dtype | str = torch.float32) -> Prior:
    """Load the model from a diffusers folder, or by a hub id whose weights are on this machine. Nothing is downloaded.

    Names, headers and configurations are checked before weights are read.

    Args:
        source: The folder or the hub id (see `local.locate`).
        device: The device of the model.
        dtype: Type of UNet and text encoders, or its name in torch, such as "float16".

    Raises:
        ValueError: Weights are missing or damaged, parts or shapes do not fit, the model is no inpainting model, or it
            predicts neither epsilon nor v.
    """
    from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
    from transformers import CLIPTextModel, CLIPTextModelWithProjection, CLIPTokenizer

    dtype = getattr(torch, dtype) if isinstance(dtype, str) else dtype
    try:
        folder = find_folder(source)
        local.check(folder)
        has_second = (folder / "text_encoder_2").is_dir()
        unet = load_network(UNet2DConditionModel, folder, "unet", torch_dtype=dtype)
        vae = load_network(AutoencoderKL, folder, "vae", torch_dtype=torch.float32)
        text = load_network(CLIPTextModel, folder, "text_encoder", dtype=dtype)
        second = CLIPTextModelWithProjection
        text_2 = load_network(second, folder, "text_encoder_2", dtype=dtype) if has_second else None
    except ValueError as error:
        raise ValueError(f"prior {error}") from error.__cause__
    try:
        tokenizers = [CLIPTokenizer.from_pretrained(folder / n) for n in ("tokenizer", "tokenizer_2")[: 1 + has_second]]
        scheduler = DDIMScheduler.from_pretrained(folder / "scheduler")
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"prior {folder}: tokenizer or scheduler cannot be read: {one_line(error)}") from error
    tokenizer_2 = tokenizers[1] if has_second else None
    prior = make_prior(unet, vae, text, tokenizers[0], scheduler, device, str(source), text_2, tokenizer_2)
    index = folder / "model_index.json"
    zero_empty = has_second and '"force_zeros_for_empty_prompt": true' in index.read_text()
    fills, contrast = _load_conditioning(folder)
    return replace(prior, zero_empty=zero_empty, fills=fills, contrast=contrast)


def _load_conditioning(folder: Path) -> tuple[bool, float]:
    """Return `Prior.fills` and `Prior.contrast` as conditioning.json has them; raises ValueError if it is invalid."""
    path = folder / CONDITIONING
    if not path.exists():
        return False, 0.0
    try:
        content = json.loads(path.read_text())
        hole, contrast = content["hole"], float(content.get("contrast", 0))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"prior {path}: cannot be read: {one_line(error)}") from error
    if hole not in HOLES:
        raise ValueError(f"prior {path}: hole is {hole!r}, not one of {', '.join(HOLES)}")
    if not 0 <= contrast < float("inf"):
        raise ValueError(f"prior {path}: contrast is {contrast}, not a number of at least 0")
    return hole == "harmonic", contrast


def find_folder(source: str | Path) -> Path:
    """Return the folder of a model, see `local.locate`; raises ValueError if it is not on this machine."""
    folder = local.locate(source)
    if folder is None:
        raise ValueError(local.explain_missing(source))
    return folder


def load_network(kind: Any, folder: Path, part: str, **dtype: torch.dtype) -> nn.Module:
    """Load a network with all of its weights, and print no messages of its library.

    Args:
        kind: the class of the network, of diffusers or transformers.
        folder: the folder of the model.
        part: the network's folder in it, such as "unet".
        dtype: type of the weights, as the keyword argument that `kind` takes: `torch_dtype` or `dtype`.

    Raises:
        ValueError: weights are missing or do not fit config.json.
    """
    from transformers.utils import logging as transformers_logging

    transformers_logging.disable_progress_bar()
    level = transformers_logging.get_verbosity()
    transformers_logging.set_verbosity_error()  # shapes and missing weights raise errors here instead
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # `kind` is a class of diffusers or transformers, and `dtype` its keyword argument for the type of the
            # weights.
            network, info = kind.from_pretrained(
                folder / part,
                variant=local.variant(folder / part),
                use_safetensors=True,
                local_files_only=True,
                output_loading_info=True,
                **dtype,
            )
    except Exception as error:  # the libraries raise various types for shapes that do not fit
        raise ValueError(f"{folder / part}: the weights do not fit config.json: {one_line(error)}") from error
    finally:
        transformers_logging.set_verbosity(level)
    if missing := sorted(info["missing_keys"]):
        raise ValueError(f"{folder / part}: {len(missing)} weights are missing, {missing[0]} first: take a whole copy")
    return network


def one_line(error: BaseException) -> str:
    """Return the text of an error on one line of at most 300 characters."""
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
    """Build a Prior from networks in memory, freeze them, and check that they fit together.

    Args:
        unet, vae, text, tokenizer, scheduler: The parts of the model; `text` is the text encoder.
        device: The device to which the networks are moved.
        name: The name of the model in error messages.
        text_2, tokenizer_2: The second text encoder and tokenizer of SDXL; None for other models.

    Raises:
        ValueError: The parts do not fit together, or the model predicts epsilon although its noise schedule ends
            without any signal.
    """
    of_part: dict[str, Any] = {"unet": unet.config, "vae": vae.config, "scheduler": scheduler.config}
    configs = {name: dict(config) for name, config in of_part.items()}
    configs["text_encoder"] = text.config.to_dict()
    if text_2 is not None:
        configs["text_encoder_2"] = text_2.config.to_dict()
    if problem := local.find_mismatch(configs):
        raise ValueError(f"prior {name}: {problem}")
    kind, alphas = scheduler.config.prediction_type, scheduler.alphas_cumprod.float()
    if kind == "epsilon" and float(alphas.min()) <= 0:
        raise ValueError(f"prior {name}: it predicts epsilon where its schedule leaves no signal; take another model")
    for part in (unet, vae, text, text_2):
        if part is not None:
            part.requires_grad_(False).eval().to(device)
    if torch.device(device).type == "cuda":  # the layout of half-precision convolutions: avoids transposing
        unet.to(memory_format=torch.channels_last)
    return Prior(unet, vae, text, tokenizer, alphas.to(device), kind, scheduler, text_2, tokenizer_2)


def drop_text_encoders(prior: Prior) -> Prior:
    """Return a new Prior without text encoders, for use once all prompts are embedded.

    The given prior keeps its text encoders; their memory is freed when nothing refers to them any more.
    """
    return replace(prior, text_encoder=None, text_encoder_2=None)


def enable_checkpointing(prior: Prior) -> Prior:
    """Enable gradient checkpointing in UNet and VAE, in place, and return the same prior.

    With checkpointing the activations of each block are recomputed in the backward pass.
    """
    prior.unet.enable_gradient_checkpointing()
    prior.vae.enable_gradient_checkpointing()
    return prior


def pipeline(prior: Prior) -> Any:
    """Return the inpainting pipeline of diffusers with the networks of the prior."""
    parts = {name: getattr(prior, name) for name in ("vae", "text_encoder", "tokenizer", "unet", "scheduler")}
    if prior.text_encoder_2 is None:
        unused = {"safety_checker": None, "feature_extractor": None, "requires_safety_checker": False}
        return library_class("StableDiffusionInpaintPipeline")(**parts, **unused)
    parts |= {"text_encoder_2": prior.text_encoder_2, "tokenizer_2": prior.tokenizer_2}
    kind = library_class("StableDiffusionXLInpaintPipeline")
    return kind(**parts, force_zeros_for_empty_prompt=prior.zero_empty)


def library_class(name: str, library: str = "diffusers") -> Any:
    """Import and return a class of diffusers or transformers; raises AttributeError if the library has none so called.

    The import is silenced, because transformers advises to install torchvision, which is not needed.
    """
    from transformers.utils import logging as transformers_logging

    level = transformers_logging.get_verbosity()
    transformers_logging.set_verbosity_error()
    try:
        return getattr(importlib.import_module(library), name)
    finally:
        transformers_logging.set_verbosity(level)

"""Diffusion priors of the published configurations with random weights, full-size or shrunken."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from reffusion.prior.model import Prior, make_prior

TINY = Path(__file__).resolve().parents[2] / "priors" / "tiny"


@dataclass(frozen=True)
class Shape:
    """Configuration of a diffusion prior, as arguments of the classes of diffusers and transformers.

    Attributes:
        unet: configuration of the UNet.
        vae: configuration of the VAE.
        texts: configurations of the text encoders: one, or two for SDXL.
    """

    unet: dict[str, Any]
    vae: dict[str, Any]
    texts: tuple[dict[str, Any], ...]


_VAE = {
    "block_out_channels": (128, 256, 512, 512),
    "down_block_types": ("DownEncoderBlock2D",) * 4,
    "up_block_types": ("UpDecoderBlock2D",) * 4,
    "layers_per_block": 2,
    "latent_channels": 4,
    "norm_num_groups": 32,
}
_CLIP = {"vocab_size": 49408, "max_position_embeddings": 77}

SD2 = Shape(
    unet={
        "sample_size": 64,
        "in_channels": 9,
        "out_channels": 4,
        "block_out_channels": (320, 640, 1280, 1280),
        "down_block_types": ("CrossAttnDownBlock2D",) * 3 + ("DownBlock2D",),
        "up_block_types": ("UpBlock2D",) + ("CrossAttnUpBlock2D",) * 3,
        "layers_per_block": 2,
        "cross_attention_dim": 1024,
        "attention_head_dim": (5, 10, 20, 20),
        "use_linear_projection": True,
    },
    vae=_VAE | {"sample_size": 512, "scaling_factor": 0.18215},
    texts=(
        _CLIP
        | {"hidden_size": 1024, "intermediate_size": 4096, "num_hidden_layers": 23, "num_attention_heads": 16}
        | {"hidden_act": "gelu", "projection_dim": 512},
    ),
)
SDXL = Shape(
    unet={
        "sample_size": 128,
        "in_channels": 9,
        "out_channels": 4,
        "block_out_channels": (320, 640, 1280),
        "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D"),
        "up_block_types": ("CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D"),
        "layers_per_block": 2,
        "transformer_layers_per_block": (1, 2, 10),
        "cross_attention_dim": 2048,
        "attention_head_dim": (5, 10, 20),
        "use_linear_projection": True,
        "addition_embed_type": "text_time",
        "addition_time_embed_dim": 256,
        "projection_class_embeddings_input_dim": 2816,
    },
    vae=_VAE | {"sample_size": 1024, "scaling_factor": 0.13025},
    texts=(
        _CLIP
        | {"hidden_size": 768, "intermediate_size": 3072, "num_hidden_layers": 12, "num_attention_heads": 12}
        | {"hidden_act": "quick_gelu", "projection_dim": 768},
        _CLIP
        | {"hidden_size": 1280, "intermediate_size": 5120, "num_hidden_layers": 32, "num_attention_heads": 20}
        | {"hidden_act": "gelu", "projection_dim": 1280},
    ),
)


def shrink(shape: Shape) -> Shape:
    """Return a configuration with the same kinds of layers but few channels, at 32 px, which runs in milliseconds."""
    second = len(shape.texts) == 2
    depth = len(shape.unet["block_out_channels"])
    unet = shape.unet | {"sample_size": 16, "block_out_channels": (32, 64, 64, 64)[:depth], "cross_attention_dim": 64}
    unet |= {"attention_head_dim": (2, 4, 4, 4)[:depth], "layers_per_block": 1, "norm_num_groups": 8}
    if second:
        unet |= {"cross_attention_dim": 96, "transformer_layers_per_block": (1, 1, 2), "addition_time_embed_dim": 8}
        unet |= {"projection_class_embeddings_input_dim": 32 + 6 * 8}
    vae = {"block_out_channels": (16, 16), "layers_per_block": 1, "norm_num_groups": 8, "sample_size": 32}
    vae |= {"down_block_types": ("DownEncoderBlock2D",) * 2, "up_block_types": ("UpDecoderBlock2D",) * 2}
    small = {"intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}
    tiny = json.loads((TINY / "text_encoder/config.json").read_text())  # whose tokenizer the small models share
    small |= {key: tiny[key] for key in ("vocab_size", "max_position_embeddings", "bos_token_id", "eos_token_id")}
    widths = (64, 32) if second else (64,)
    texts = tuple(t | small | {"hidden_size": w, "projection_dim": w} for t, w in zip(shape.texts, widths, strict=True))
    return Shape(unet, shape.vae | vae, texts)


def networks(shape: Shape, dtype: torch.dtype) -> dict[str, torch.nn.Module]:
    """Create the networks of a prior on torch's default device: UNet and text encoders in `dtype`, the VAE in float32.

    On the device `meta` nothing is allocated or computed, only counted.
    """
    from diffusers import AutoencoderKL, UNet2DConditionModel
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTextModelWithProjection

    kinds = (CLIPTextModel, CLIPTextModelWithProjection)
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        models = {"unet": UNet2DConditionModel(**shape.unet)}
        for name, kind, text in zip(("text_encoder", "text_encoder_2"), kinds, shape.texts, strict=False):
            models[name] = kind(CLIPTextConfig(**text))
    finally:
        torch.set_default_dtype(before)
    return models | {"vae": AutoencoderKL(**shape.vae)}


def count_parameters(shape: Shape) -> int:
    """Return the number of parameters of all networks, without allocating them."""
    with torch.device("meta"):
        return sum(p.numel() for part in networks(shape, torch.float32).values() for p in part.parameters())


def build_prior(shape: Shape, dtype: torch.dtype, device: str = "cpu", seed: int = 0) -> Prior:
    """Make a prior with random weights on a device; equal seeds give equal weights on the same device."""
    with torch.random.fork_rng(), torch.device(device):
        torch.manual_seed(seed)
        models = networks(shape, dtype)
    return assemble_prior(shape, models, device)


def assemble_prior(shape: Shape, models: dict[str, torch.nn.Module], device: str) -> Prior:
    """Make a prior from networks, with the embedded prior's tokenizer and SD2's noise schedule.

    The tokenizer does not matter here, because the weights are random.
    """
    from diffusers import DDIMScheduler
    from transformers import CLIPTokenizer

    length = shape.texts[0]["max_position_embeddings"]
    tokens = CLIPTokenizer.from_pretrained(TINY / "tokenizer", model_max_length=length)
    schedule = DDIMScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", clip_sample=False, steps_offset=1
    )
    second = models.get("text_encoder_2")
    return make_prior(
        models["unet"],
        models["vae"],
        models["text_encoder"],
        tokens,
        schedule,
        device,
        "random weights",
        second,
        tokens,
    )

"""The parts of the embedded prior before training: ordinary diffusers and transformers objects.

The VAE works at full resolution (factor 1) and is exact by construction, not trained: see `linear_vae`.
"""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
from torch import Tensor
from torch.nn.functional import conv2d
from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

NATIVE = 64  # px
# The words of the prompts and of the training captions, each of which is one token.
WORDS = (
    *("a", "photo", "of", "sks", "cropped", ",", "scene", "and"),
    *("brick", "planks", "plaster", "tiles", "stripes", "fabric", "dots"),
    *("room", "corner", "table", "bedroom", "garden"),
    *("flowers", "leaves", "grass", "water", "sky", "wood", "hills", "forest", "things", "person", "stone"),
    *("dark", "bright", "gray", "red", "orange", "yellow", "green", "blue", "purple"),
)
TEXT_LENGTH = 24
# Opponent colors of (r, g, b) in [-1, 1]. Their rows in `analysis` are orthogonal and of equal length, so that an
# error of the latents weighs the same in every direction of color. Diffusers' inpainting pipeline wants four latents;
# the fourth is empty.
LIGHT = 1.9
WARM, GREEN = LIGHT * (2 / 3) ** 0.5, LIGHT * (8 / 9) ** 0.5
# At full resolution the content of a hole is decided at strong noise, since neighbors average weak noise away. So the
# schedule spends most timesteps between a log signal-to-noise ratio of 0 and -7, and ends where even a hole's mean
# color is hidden (with SD's schedule, which ends at -5.4, 1.1 dB of a hole's PSNR came from what showed through).
TIMESTEPS, SHIFT, LOWEST = 1000, -2.2, -12.0


def analysis() -> Tensor:
    """[4, 3, 3, 3], the convolution that equals the VAE's encoder: pixels in [-1, 1] to latents."""
    light = torch.tensor([1, 1, 1]) / 3
    kernel = torch.zeros(4, 3, 3, 3)
    kernel[0, :, 1, 1] = LIGHT * light
    kernel[1, :, 1, 1] = WARM * torch.tensor([0.5, 0, -0.5])
    kernel[2, :, 1, 1] = GREEN * torch.tensor([-0.25, 0.5, -0.25])
    return kernel


def latents(pixels: Tensor) -> Tensor:
    """[B, 3, H, W] in [-1, 1] -> [B, 4, H, W]: the output of the VAE's encoder up to 1e-3, at a tenth of the cost."""
    return conv2d(pixels, analysis(), padding=1)


def linear_vae() -> AutoencoderKL:
    """Build an AutoencoderKL of factor 1 and four latent channels that is a linear map up to 1e-4 of the picture.

    Group norm and SiLU stand between the first and the last convolution; both are made harmless: every signal x
    travels as the pair (x, -x), since silu(x) - silu(-x) = x exactly, and one pair of large constants (c, -c) fixes
    the group's mean at 0 and its deviation at c (2 / channels)^(1/2). Residual branches end in zeros.
    """
    constant, channels = 400.0, 10
    vae = AutoencoderKL(
        down_block_types=("DownEncoderBlock2D",),
        up_block_types=("UpDecoderBlock2D",),
        block_out_channels=(channels,),
        layers_per_block=1,
        latent_channels=4,
        norm_num_groups=1,
        sample_size=NATIVE,
        scaling_factor=1.0,
        force_upcast=False,
        use_quant_conv=False,
        use_post_quant_conv=False,
        mid_block_add_attention=False,
    )
    kernel = analysis()
    back = torch.zeros(3, 4, 3, 3)
    back[:, :3, 1, 1] = torch.linalg.inv(kernel[:3, :, 1, 1])
    gain = constant * (2 / channels) ** 0.5  # divisor of the group norm
    with torch.no_grad():
        for module in vae.modules():
            if type(module).__name__ == "ResnetBlock2D":
                module.conv2.weight.zero_()
                module.conv2.bias.zero_()
        _carry(vae.encoder.conv_in, kernel, constant)
        _gather(vae.encoder.conv_out, gain)
        vae.encoder.conv_out.bias[4:] = -30.0  # log variance of the posterior: none
        identity = torch.zeros(4, 4, 3, 3)
        identity[:, :, 1, 1] = torch.eye(4)
        _carry(vae.decoder.conv_in, identity, constant)
        _gather(vae.decoder.conv_out, gain, back)
    return vae.requires_grad_(False)


def _carry(conv: torch.nn.Conv2d, kernel: torch.Tensor, constant: float) -> None:
    """Write x = kernel * input as (x, -x) into channels 0-7 and (c, -c) into 8-9."""
    conv.weight.zero_()
    conv.bias.zero_()
    conv.weight[0:4], conv.weight[4:8] = kernel, -kernel
    conv.bias[8], conv.bias[9] = constant, -constant


def _gather(conv: torch.nn.Conv2d, gain: float, kernel: torch.Tensor | None = None) -> None:
    """Read the pairs back: kernel * (silu(x / gain) - silu(-x / gain)) * gain."""
    conv.weight.zero_()
    conv.bias.zero_()
    if kernel is None:
        kernel = torch.zeros(4, 4, 3, 3)
        kernel[:, :, 1, 1] = torch.eye(4)
    conv.weight[: kernel.shape[0], 0:4], conv.weight[: kernel.shape[0], 4:8] = kernel * gain, -kernel * gain


def tokenizer() -> CLIPTokenizer:
    """Build a CLIP tokenizer for bytes and the words of the prompts."""
    letters = _byte_letters()
    vocabulary, merges = [*letters, *(c + "</w>" for c in letters)], []
    for word in WORDS:
        parts = [*word[:-1], word[-1] + "</w>"]
        while len(parts) > 1:
            joined = parts[0] + parts[1]
            if f"{parts[0]} {parts[1]}" not in merges:
                merges.append(f"{parts[0]} {parts[1]}")
            if joined not in vocabulary:
                vocabulary.append(joined)
            parts = [joined, *parts[2:]]
    vocabulary += ["<|startoftext|>", "<|endoftext|>"]
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "vocab.json").write_text(json.dumps({token: i for i, token in enumerate(vocabulary)}))
        (folder / "merges.txt").write_text("#version: 0.2\n" + "\n".join(merges) + "\n")
        return CLIPTokenizer.from_pretrained(folder, model_max_length=TEXT_LENGTH)


def _byte_letters() -> list[str]:
    """Return the printable letter that byte-level BPE writes for each byte."""
    printable = [*range(ord("!"), ord("~") + 1), *range(0xA1, 0xAD), *range(0xAE, 0x100)]
    others = [b for b in range(256) if b not in printable]
    letters = {b: chr(b) for b in printable} | {b: chr(256 + i) for i, b in enumerate(others)}
    return [letters[b] for b in range(256)]


def text_encoder(tokens: CLIPTokenizer) -> CLIPTextModel:
    return CLIPTextModel(
        CLIPTextConfig(
            vocab_size=len(tokens),
            hidden_size=64,
            intermediate_size=128,
            projection_dim=64,
            num_hidden_layers=2,
            num_attention_heads=2,
            max_position_embeddings=TEXT_LENGTH,
            bos_token_id=tokens.bos_token_id,
            eos_token_id=tokens.eos_token_id,
            pad_token_id=tokens.pad_token_id,
        )
    )


def unet(channels: tuple[int, ...] = (32, 64, 96), layers: int = 1) -> UNet2DConditionModel:
    """Build a mostly convolutional UNet; attention (to the text and within the view) only at the coarsest level."""
    levels = len(channels)
    return UNet2DConditionModel(
        sample_size=NATIVE,
        in_channels=9,
        out_channels=4,
        down_block_types=("DownBlock2D",) * (levels - 1) + ("CrossAttnDownBlock2D",),
        up_block_types=("CrossAttnUpBlock2D",) + ("UpBlock2D",) * (levels - 1),
        block_out_channels=channels,
        layers_per_block=layers,
        cross_attention_dim=64,
        attention_head_dim=4,
        norm_num_groups=8,
        use_linear_projection=True,
    )


def scheduler() -> DDIMScheduler:
    return DDIMScheduler(
        trained_betas=betas(),
        prediction_type="v_prediction",
        clip_sample=False,
        set_alpha_to_one=True,
        steps_offset=1,
        timestep_spacing="trailing",
    )


def betas() -> list[float]:
    """Build the cosine schedule, log signal-to-noise ratio moved by SHIFT (Hoogeboom et al. 2023) and over LOWEST."""
    t = (torch.arange(TIMESTEPS, dtype=torch.float64) + 1) / (TIMESTEPS + 1)
    ratio = (SHIFT - 2 * torch.log(torch.tan(torch.pi / 2 * t))).clamp_min(LOWEST)
    kept = torch.cat([torch.ones(1, dtype=torch.float64), torch.sigmoid(ratio)])
    return (1 - kept[1:] / kept[:-1]).clamp(1e-7, 0.999).tolist()

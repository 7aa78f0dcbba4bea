"""A random inpainting prior of 16 px, for tests that need how a prior behaves, not what it knows."""

from pathlib import Path

import torch
from diffusers import UNet2DConditionModel

from reffusion.prior.model import Prior, make_prior, pipeline

TINY = Path(__file__).resolve().parent.parent / "priors" / "tiny"


def small_prior(seed: int = 0) -> Prior:
    """The embedded prior's VAE, text encoder and schedule around a UNet of 16 and 16 channels, seeded."""
    from diffusers import AutoencoderKL, DDIMScheduler
    from transformers import CLIPTextModel, CLIPTokenizer

    torch.manual_seed(seed)
    unet = UNet2DConditionModel(
        sample_size=16,
        in_channels=9,
        out_channels=4,
        block_out_channels=(16, 16),
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
        up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        layers_per_block=1,
        cross_attention_dim=CLIPTextModel.from_pretrained(TINY / "text_encoder").config.hidden_size,
        attention_head_dim=8,
        norm_num_groups=4,
        use_linear_projection=True,
    )
    return make_prior(
        unet,
        AutoencoderKL.from_pretrained(TINY / "vae"),
        CLIPTextModel.from_pretrained(TINY / "text_encoder"),
        CLIPTokenizer.from_pretrained(TINY / "tokenizer"),
        DDIMScheduler.from_pretrained(TINY / "scheduler"),
    )


def save_small_prior(folder: Path, seed: int = 0) -> None:
    """The same as a diffusers folder."""
    pipeline(small_prior(seed)).save_pretrained(folder)

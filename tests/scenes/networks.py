"""Small networks of real architectures with random weights, and a stand-in for an inpainting network."""

from pathlib import Path

import torch

from reffusion.prior.model import Prior, make_prior, pipeline

TINY = Path(__file__).resolve().parents[2] / "priors" / "tiny"


def small_prior(seed: int = 0) -> Prior:
    """Return a diffusion prior with a small random UNet (two levels of 16 channels).

    The VAE, the text encoder and the noise schedule are those of the prior that the package embeds.
    """
    from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
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
    """Write `small_prior(seed)` in the folder layout of diffusers."""
    pipeline(small_prior(seed)).save_pretrained(folder)


def small_depth_model(kind="relative", seed=0):
    """Return a network of Depth Anything's architecture: random weights, 4 layers of 16 channels, pictures of 56 px."""
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config

    backbone = Dinov2Config(
        hidden_size=16, num_hidden_layers=4, num_attention_heads=2, image_size=56, patch_size=14,
        out_features=["stage1", "stage2", "stage3", "stage4"], reshape_hidden_states=False,
    )  # fmt: skip
    torch.manual_seed(seed)
    config = DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=16, neck_hidden_sizes=[8, 8, 16, 16], fusion_hidden_size=8,
        head_hidden_size=8, depth_estimation_type=kind, initializer_range=0.2,
    )  # fmt: skip
    return DepthAnythingForDepthEstimation(config)


class MeanInpainter(torch.nn.Module):
    """A stand-in for LaMa that fills the mask with the mean of the other pixels."""

    def forward(self, image: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        assert image.size(2) % 8 == 0 and image.size(3) % 8 == 0
        assert mask.size(1) == 1 and image.size(2) == mask.size(2)
        mean = (image * (1 - mask)).sum([2, 3], keepdim=True) / (1 - mask).sum()
        return image * (1 - mask) + mean * mask

"""Weights that can be fetched: where they are published, how large they are, what does the same work."""

from __future__ import annotations

from dataclasses import dataclass

NETWORKS = ("unet", "vae", "text_encoder", "text_encoder_2")


@dataclass(frozen=True)
class Published:
    """A model of the hub.

    Attributes:
        parameters: how many numbers it has in all: counted on its configuration (benchmarks/gpu/full_size.py).
        instead: other models that do the same work.
    """

    parameters: int
    instead: str


SD2 = "sd2-community/stable-diffusion-2-inpainting"


SDXL = "diffusers/stable-diffusion-xl-1.0-inpainting-0.1"


DEPTH_ANYTHING = "depth-anything/Depth-Anything-V2-Small-hf"


PUBLISHED = {
    SD2: Published(1_289_966_827, "stable-diffusion-v1-5/stable-diffusion-inpainting, or the embedded priors/tiny"),
    SDXL: Published(3_468_852_267, f"{SD2}, or a reference painted elsewhere (`reference` in scene.yaml)"),
    DEPTH_ANYTHING: Published(24_785_089, "depth-anything/Depth-Anything-V2-Base-hf"),
}


# LPIPS: torchvision's backbones, their sha256 in their names, and the linear weights of version 0.1 by its authors:
# file -> (address, bytes, sha256 or how it begins).
_TORCHVISION = "https://download.pytorch.org/models/"


_LINEAR = "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/"


LPIPS_FILES = {
    "alexnet-owt-7be5be79.pth": (_TORCHVISION, 244_408_911, "7be5be79"),
    "vgg16-397923af.pth": (_TORCHVISION, 553_433_881, "397923af"),
    "alex.pth": (_LINEAR, 6_009, "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0"),
    "vgg.pth": (_LINEAR, 7_289, "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868"),
}


# Packages that bring the linear weights of version 0.1 along, under the same names, and the folder inside them.
LPIPS_PACKAGES = {"lpips": "weights/v0.1", "torchmetrics": "functional/image/lpips_models"}


@dataclass(frozen=True)
class PublishedPainter:
    """A feed-forward inpainter, one file.

    Attributes:
        name: for tables and messages.
        endings: of the files that are read.
        where: which file, its size and licence, and who publishes it. Taken from public sources, not tried.
    """

    name: str
    endings: tuple[str, ...]
    where: str


PAINTERS = {
    "lama": PublishedPainter(
        "LaMa",
        (".pt", ".onnx"),
        "lama_fp32.onnx (208 MB, Apache-2.0) from https://huggingface.co/Carve/LaMa-ONNX or big-lama.pt (206 MB) from "
        "https://github.com/enesmsahin/simple-lama-inpainting/releases",
    ),
    "migan": PublishedPainter(
        "MI-GAN",
        (".onnx",),
        "migan_pipeline_v2.onnx (28 MB, MIT) from https://huggingface.co/andraniksargsyan/migan",
    ),
}

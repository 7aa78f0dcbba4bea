"""View names, and which picture another program means by a name or a path.

Programs write the same picture as `A.jpg`, `images/A.jpg`, `day0\\A.jpg` or `A.jpg.png` (COLMAP's masks), and macOS
decomposes accents. Names are compared in Unicode's NFC form with forward slashes.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import TypeVar

from reffusion.io.files import BadInput
from reffusion.io.images import ENDINGS

MASK_FOLDERS = ("label", "test_label", "masks", "mask")  # folders of these names inside a folder of pictures hold none
MASK_SUFFIXES = ("_mask", ".mask", "-mask")  # `A_mask.png` beside `A.png` is its mask

K = TypeVar("K")
V = TypeVar("V")


def normalize_path(path: str) -> str:
    """The path in NFC, with forward slashes, without `./`, and without the drive or root of an absolute path."""
    parts = unicodedata.normalize("NFC", path).replace("\\", "/").split("/")
    return "/".join(part for part in parts if part not in ("", ".") and not part.endswith(":"))


def strip_ending(path: str) -> str:
    """The path without its ending, if that is one of pictures; any other ending is part of the name."""
    stem, dot, ending = path.rpartition(".")
    return stem if dot and PurePosixPath(stem).name and f".{ending}".lower() in ENDINGS else path


def list_pictures(folder: Path, nested: bool = False) -> list[str]:
    """Paths of the pictures in a folder, relative to it, sorted; without masks beside their pictures (`MASK_SUFFIXES`).

    Args:
        nested: also those in sub-folders other than `MASK_FOLDERS`.
    """
    found = [path.relative_to(folder).as_posix() for path in _walk(folder, nested)]
    stems = {strip_ending(path) for path in found}
    return sorted(path for path in found if not is_mask_of_another(strip_ending(path), stems))


def _walk(folder: Path, nested: bool) -> Iterable[Path]:
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.name.startswith("."):
            continue
        if path.suffix.lower() in ENDINGS:
            yield path
        elif nested and path.is_dir() and path.name not in MASK_FOLDERS:
            yield from _walk(path, nested)


def is_mask_of_another(stem: str, stems: Collection[str]) -> bool:
    """Is a picture of this path, without its ending, the mask of one of `stems`?"""
    return any(stem.endswith(suffix) and stem.removesuffix(suffix) in stems for suffix in MASK_SUFFIXES)


def name_views(paths: Collection[str]) -> dict[str, str]:
    """View name -> path, in the order of the paths.

    A view has the file name of its picture without the ending. Where two of these are equal, all views have the path as
    name, with `-` for `/`: `cam0/0001.png` is the view `cam0-0001`.

    Raises:
        BadInput: two paths give the same name even so.
    """
    plain = {path: strip_ending(normalize_path(path)) for path in paths}
    flat = {path: PurePosixPath(name).name for path, name in plain.items()}
    if len(set(flat.values())) < len(flat):
        flat = {path: flatten(name) for path, name in plain.items()}
    named: dict[str, str] = {}
    for path in sorted(flat):
        if flat[path] in named:
            raise BadInput(
                f"{path}: the view name '{flat[path]}' is also that of {named[flat[path]]}; rename one of them"
            )
        named[flat[path]] = path
    return named


def flatten(path: str) -> str:
    """The path as a single name, with `-` for `/`."""
    return path.replace("/", "-")


def pair_names(wanted: Mapping[K, Iterable[str]], known: Mapping[V, Iterable[str]]) -> dict[K, V]:
    """Pair each of `wanted` with the one of `known` that it means; ambiguous and unknown ones are left out.

    Whole paths are compared first, then paths without their first folder, and so on down to file names; then all of
    that without regard to case. A pair needs a key that no other entry on either side has.

    Args:
        wanted, known: identity -> the paths by which it may be called.
    """
    pairs: dict[K, V] = {}
    used: set[V] = set()
    for fold in (str, str.casefold):
        mine, theirs = _split(wanted, fold), _split(known, fold)
        deepest = max((len(parts) for side in (mine, theirs) for paths in side.values() for parts in paths), default=0)
        for depth in range(deepest, 0, -1):
            owners = _index(theirs, depth)
            for key, identities in _index(mine, depth).items():
                candidates = owners.get(key, set())
                if len(identities) == len(candidates) == 1:
                    (identity,), (candidate,) = identities, candidates
                    if identity not in pairs and candidate not in used:
                        pairs[identity] = candidate
                        used.add(candidate)
    return pairs


def _split(paths: Mapping[K, Iterable[str]], fold: Callable[[str], str]) -> dict[K, list[list[str]]]:
    """The parts of each path, as `fold` writes them."""
    return {identity: [fold(normalize_path(p)).split("/") for p in spellings] for identity, spellings in paths.items()}


def _index(paths: Mapping[K, Iterable[list[str]]], depth: int) -> dict[tuple[str, ...], set[K]]:
    """The last `depth` parts of each path -> the identities that have them."""
    found: dict[tuple[str, ...], set[K]] = {}
    for identity, spellings in paths.items():
        for parts in spellings:
            found.setdefault(tuple(parts[-depth:]), set()).add(identity)
    return found


def pair_pictures(wanted: Mapping[K, str], files: Collection[str]) -> dict[K, str]:
    """Key -> the file that another program's path means: by its name with ending, else without."""
    pairs = pair_names({key: [path] for key, path in wanted.items()}, {file: [file] for file in files})
    rest = {key: [strip_ending(normalize_path(path))] for key, path in wanted.items()}
    by_stem = pair_names(rest, {file: [strip_ending(file)] for file in files})
    used = set(pairs.values())
    return pairs | {key: file for key, file in by_stem.items() if key not in pairs and file not in used}


def pair_masks(masks: Collection[str], views: Mapping[V, Iterable[str]]) -> dict[str, V]:
    """Mask file -> the view it belongs to, for masks that belong to one.

    A mask is called like its picture (`A.png`), like its picture with the ending (COLMAP: `A.jpg.png`), or with one of
    `MASK_SUFFIXES`.

    Args:
        views: identity -> the paths by which its picture may be called, with their endings.
    """
    stems = {mask: strip_ending(normalize_path(mask)) for mask in masks}
    bare = {view: [strip_ending(normalize_path(path)) for path in paths] for view, paths in views.items()}
    whole = {view: list(paths) for view, paths in views.items()}
    trimmed = {mask: _strip_mask_suffix(stem) for mask, stem in stems.items()}
    pairs: dict[str, V] = {}
    for spelling, known in ((stems, bare), (stems, whole), (trimmed, bare)):
        for mask, view in pair_names({m: [s] for m, s in spelling.items()}, known).items():
            pairs.setdefault(mask, view)
    return pairs


def _strip_mask_suffix(stem: str) -> str:
    """The stem without the ending of COLMAP's masks and without a suffix for masks."""
    stem = strip_ending(stem)
    return next((stem.removesuffix(suffix) for suffix in MASK_SUFFIXES if stem.endswith(suffix)), stem)

r"""View names, and the search for the picture that another program means by a name or a path.

Programs write the same picture as `A.jpg`, `images/A.jpg`, `day0\\A.jpg` or `A.jpg.png` (COLMAP's masks), and macOS
decomposes accents. So names are compared in Unicode's NFC form with forward slashes. An *ending* is a file name's
suffix, such as `.jpg`.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import TypeVar

from reffusion.io.files import BadInput
from reffusion.io.images import ENDINGS

MASK_FOLDERS = ("label", "test_label", "masks", "mask", "ignore")  # sub-folders of a folder of pictures that hold masks
MASK_WORDS = ("mask", "msk", "seg", "segmentation", "matte", "alpha", "silhouette", "label")
MASK_SUFFIXES = tuple(mark + word for mark in "_-." for word in MASK_WORDS)  # `A_mask.png` beside `A.png` is its mask
MASK_PREFIXES = ("dynamic_mask_", "mask_")  # so is `mask_A.png`
MASK_ENDINGS = (".json", ".npy")  # endings of masks that are no pictures, in lower case

K = TypeVar("K")
V = TypeVar("V")


def normalize_path(path: str) -> str:
    """Return the path in NFC, with forward slashes, without `./`, and without the drive or root of an absolute path."""
    parts = unicodedata.normalize("NFC", path).replace("\\", "/").split("/")
    return "/".join(part for part in parts if part not in ("", ".") and not part.endswith(":"))


def shorten_path(path: Path, folder: Path) -> str:
    """Return the path relative to a folder, for messages; the whole path if it lies elsewhere."""
    return path.relative_to(folder).as_posix() if folder in path.parents else str(path)


def strip_ending(path: str) -> str:
    """Return the path without the ending of a picture format (`ENDINGS`). Other endings count as part of the name."""
    stem, dot, ending = path.rpartition(".")
    return stem if dot and PurePosixPath(stem).name and f".{ending}".lower() in ENDINGS else path


def list_pictures(folder: Path, nested: bool = False) -> list[str]:
    """Return the paths of the pictures in a folder, sorted, relative to the folder.

    Hidden files are left out, and masks that lie beside their pictures (`is_mask_of_another`).
    A folder that does not exist gives an empty list.

    Args:
        nested: True to include pictures in sub-folders, except in folders of masks (`MASK_FOLDERS`).
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
    """Return whether the path `stem`, without ending, is a mask (`A_mask`, `mask_A`) of a picture in `stems` (`A`)."""
    return any(each in stems for each in _picture_stems(stem))


def _picture_stems(stem: str) -> list[str]:
    """Return the paths of the pictures whose mask the path `stem` may name, all without endings."""
    folder, slash, name = stem.rpartition("/")
    found = [name.removesuffix(each) for each in MASK_SUFFIXES if name.endswith(each)]
    found += [name.removeprefix(each) for each in MASK_PREFIXES if name.startswith(each)]
    return [f"{folder}{slash}{strip_ending(each)}" for each in found if each]


def name_views(paths: Collection[str]) -> dict[str, str]:
    """Return view name -> path of its picture, sorted by path.

    A view is named by the file name of its picture without the ending. If two of these names are equal, all views are
    named by their paths instead, with `-` for `/`: `cam0/0001.png` is the view `cam0-0001`.

    Raises:
        BadInput: two views have the same name even then.
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
    """Return the path as a single name, with `-` for `/`."""
    return path.replace("/", "-")


def pair_names(wanted: Mapping[K, Iterable[str]], known: Mapping[V, Iterable[str]]) -> dict[K, V]:
    """Pair each entry of `wanted` with the entry of `known` that has the same path, or the same end of a path.

    Whole paths are compared first, then paths without their first folder, and so on down to file names. Then all
    comparisons are repeated without regard to case. Two entries are paired if they agree in a path (or end of a path)
    that no other entry of `wanted` or of `known` has. An entry is part of at most one pair.

    Args:
        wanted, known: key of an entry -> the paths by which the entry may be called.

    Returns:
        Key in `wanted` -> key in `known`. Entries without a partner, or with several possible partners, are left out.
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
    """Return for each entry its paths, split at `/`, after `fold` was applied to them."""
    return {identity: [fold(normalize_path(p)).split("/") for p in spellings] for identity, spellings in paths.items()}


def _index(paths: Mapping[K, Iterable[list[str]]], depth: int) -> dict[tuple[str, ...], set[K]]:
    """Return the last `depth` parts of a path -> keys of the entries with such a path."""
    found: dict[tuple[str, ...], set[K]] = {}
    for identity, spellings in paths.items():
        for parts in spellings:
            found.setdefault(tuple(parts[-depth:]), set()).add(identity)
    return found


def pair_pictures(wanted: Mapping[K, str], files: Collection[str]) -> dict[K, str]:
    """Return key -> the file that a path written by another program means.

    Paths are compared with their endings first, then without. Keys for which no single file fits are left out.

    Args:
        wanted: key -> the path that the other program wrote.
        files: paths of the files that exist.
    """
    pairs = pair_names({key: [path] for key, path in wanted.items()}, {file: [file] for file in files})
    rest = {key: [strip_ending(normalize_path(path))] for key, path in wanted.items()}
    by_stem = pair_names(rest, {file: [strip_ending(file)] for file in files})
    used = set(pairs.values())
    return pairs | {key: file for key, file in by_stem.items() if key not in pairs and file not in used}


def pair_masks(masks: Collection[str], views: Mapping[V, Iterable[str]]) -> dict[str, V]:
    """Return mask file -> key of the view to which the mask belongs. Masks that fit no single view are left out.

    Several masks may get the same view, if they are called differently. The mask of the picture `A.jpg` may be
    called `A.png`, `A.jpg.png` (as COLMAP does), or `A` with one of `MASK_SUFFIXES` or `MASK_PREFIXES`, such as
    `A_mask.png`, and may end in one of `MASK_ENDINGS`.

    Args:
        masks: paths of mask files.
        views: key of a view -> the paths by which its picture may be called, with their endings.
    """
    spelled = {mask: mask_stems(mask) for mask in masks}
    stems, trimmed = ({mask: each[k] for mask, each in spelled.items()} for k in (0, -1))
    bare = {view: [strip_ending(normalize_path(path)) for path in paths] for view, paths in views.items()}
    whole = {view: list(paths) for view, paths in views.items()}
    pairs: dict[str, V] = {}
    for spelling, known in ((stems, bare), (stems, whole), (trimmed, bare)):
        for mask, view in pair_names({m: [s] for m, s in spelling.items()}, known).items():
            pairs.setdefault(mask, view)
    return pairs


def mask_stems(mask: str) -> list[str]:
    """Return two or three paths, without ending, that the picture of a mask may have; the likeliest comes last.

    The first is the path `mask` without its ending. The second lacks a second ending, too (`A.jpg` -> `A`). The third,
    if the name has a suffix or prefix of masks, lacks this as well (`A_mask` -> `A`).
    """
    path = normalize_path(mask)
    stem, _, ending = path.rpartition(".")
    first = stem if f".{ending}".lower() in MASK_ENDINGS else strip_ending(path)
    second = strip_ending(first)
    return [first, second, *_picture_stems(second)[:1]]

"""Finds the masks in a scene folder: their files, the view of each mask, and the object that it marks.

Masks may distinguish between several objects: each object then has a folder of masks, which is named like the object.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from reffusion.capture.layouts.capture import Capture
from reffusion.capture.names import (
    MASK_ENDINGS,
    is_mask_of_another,
    list_pictures,
    pair_masks,
    shorten_path,
    strip_ending,
)
from reffusion.io.annotations import annotated_pictures, is_labelme, original_names
from reffusion.io.files import VIDEOS, BadInput
from reffusion.io.given_masks import WHITE, MaskValues
from reffusion.io.images import ENDINGS
from reffusion.params.capture import MaskSpec

NONE = "none"
IGNORE, ALL_VIEWS = "ignore", "all"  # usual folder of masks of what is ignored, and the name of a mask for every view
CVAT = "annotations.xml"  # CVAT's own file, which is not read
USUAL = (
    "masks",
    "mask",
    "label",
    "labels",
    "annotations",
)  # usual folders, searched after `label` in the folder of pictures


@dataclass(frozen=True)
class FoundMasks:
    """The masks of a scene.

    Attributes:
        files: object -> view -> mask file (for a mask in a COCO file, see `reffusion.io.annotations`). The object is ""
            if the masks do not distinguish between objects. Empty if the scene has no masks.
        values: the pixel values that mark the object.
        warning: a sentence for the user, or None.
    """

    files: dict[str, dict[str, Path]]
    values: MaskValues = WHITE
    warning: str | None = None


def find_masks(folder: Path, capture: Capture, spec: str | MaskSpec | None, optional: bool) -> FoundMasks:
    """Find the mask files of a scene, and check by their names that each belongs to a picture.

    If no folder is named, masks are taken from the first of these places that has some: `label` in the folder of
    pictures, the usual folders, masks beside their pictures (`A_mask.png` or `A.json` beside `A.png`), the files that
    the layout names (`Capture.ignore_masks`). Black pixels of the latter mark the object. Masks of left-out pictures
    are dropped.

    Args:
        spec: the key `masks` of scene.yaml (`reffusion.params.capture`): a folder or a COCO file, optionally with the
            numbers that mark the object; "none" for no masks; None to search.
        optional: True to return no masks if the search finds none, False to raise BadInput. A folder that `spec` names
            must hold masks in any case.

    Raises:
        BadInput: there are no masks, or as for `group_by_object`; the message names the file or folder and the remedy.
    """
    named = spec if isinstance(spec, MaskSpec) else MaskSpec(folder=spec)
    if named.folder is not None and named.folder.lower() == NONE:
        return FoundMasks({})
    values = MaskValues(named.numbers)
    if named.folder is not None:
        place, files = _mask_paths(folder / named.folder, capture)
        if not files:
            _refuse_cvat([place])
            inside = any(place in path.parents for path in capture.pictures.values())
            why = (
                "it holds photographs, and no mask beside one (A_mask.png beside A.png)"
                if inside
                else f"no masks there{_unread(place)}"
            )
            raise BadInput(f"{place}: {why}; correct `masks` in scene.yaml")
        return FoundMasks(group_by_object(place, files, capture), values)
    places = [capture.label_folder / "label", *(folder / name for name in USUAL)]
    beside = _pictures_folder(capture)
    ignored = set(capture.ignore_masks.values())
    for place in (*(p for p in places if p != capture.label_folder), *([beside] if beside else [])):
        place, files = _mask_paths(place, capture)
        if files and not {place / path for path in files} <= ignored:
            return FoundMasks(group_by_object(place, files, capture), values)
    if ignored:
        warning = f"mask_path of {capture.pose_source.name}: black, which training ignores, is taken for the object"
        return FoundMasks({"": capture.ignore_masks}, MaskValues(named.numbers, inverted=True), warning)
    if optional:
        return FoundMasks({})
    _refuse_cvat([folder, *places])
    raise BadInput(
        f"{folder}: no mask at all (looked for {', '.join(shorten_path(p, folder) for p in places)}"
        f"{''.join(map(_unread, places))}){_guess_masks(folder, capture)}; click on "
        f"the object (`make scene={folder} mask`, or `clicks` in scene.yaml), add a mask for each picture, name "
        "their folder as `masks` or a box as `region` in scene.yaml, or say `masks: none` to fit and render only"
    )


def _refuse_cvat(places: Iterable[Path]) -> None:
    """Raise BadInput if one of these places is, or holds, CVAT's own file."""
    for path in (each for place in places for each in (place, place / CVAT)):
        if path.name == CVAT and path.is_file():
            raise BadInput(
                f'{path}: CVAT\'s {CVAT} is not read; export "Segmentation mask 1.1" and copy SegmentationClass/*.png '
                "to masks, or export COCO"
            )


def _guess_masks(folder: Path, capture: Capture) -> str:
    """Return a hint, for a message, at what may be masks under another name in the scene's folder; perhaps empty."""
    paths = {name: (name, *paths) for name, paths in capture.paths.items()}
    ours = {parent for path in capture.pictures.values() for parent in path.parents}
    for place in sorted(folder.iterdir()):
        if place.name.startswith(".") or place in ours:
            continue
        if place.is_dir() and not place.name.startswith("images"):
            count = len(pair_masks(list_pictures(place), paths))
            if count > len(paths) / 2:
                why = f"{place.name} holds {count} pictures named like the photographs"
                return f"; {why}: if they are masks, say `masks: {place.name}`"
        elif "mask" in place.name.lower() and place.suffix.lower() in (".npy", ".npz", *VIDEOS):
            return f"; {place.name} is not read: save a mask for each picture in masks/, named like it"
    return ""


def find_ignore_masks(folder: Path, capture: Capture, name: str | None) -> dict[str, tuple[Path, ...]]:
    """Return view -> files of its ignore masks: those for all views (`ALL_VIEWS`), then one named like its picture.

    Views without a mask have no entry.

    Args:
        folder: the scene's folder.
        name: the key `ignore` of scene.yaml: the folder of the masks; "none" for none; None for the usual folder.

    Raises:
        BadInput: the folder is named, or holds files, but no masks; a mask belongs to no picture; or two masks belong
            to one picture.
    """
    if name is not None and name.lower() == NONE:
        return {}
    place, files = _mask_paths(folder / (name or IGNORE), capture)
    if not files and (name is not None or _unread(place)):
        raise BadInput(
            f"{place}: no masks there{_unread(place)}; correct `ignore` in scene.yaml, or say `ignore: none`"
        )
    shared = [path for path in files if strip_ending(path) == ALL_VIEWS]
    named = match_masks(place, [path for path in files if path not in shared], capture)
    own = _assign_masks(place, named, capture)
    found = {
        view: (*(place / path for path in shared), *([own[view]] if view in own else [])) for view in capture.pictures
    }
    return {view: paths for view, paths in found.items() if paths}


def _pictures_folder(capture: Capture) -> Path | None:
    """Return the folder that holds all pictures of a capture; None if they lie in several folders."""
    parents = {path.parent for path in capture.pictures.values()}
    return parents.pop() if len(parents) == 1 else None


def _mask_paths(place: Path, capture: Capture) -> tuple[Path, list[str]]:
    """Return the folder or COCO file of the masks, and their paths in it, perhaps none; BadInput for two COCO files."""
    if place.suffix.lower() == ".json" and place.is_file():
        return place, annotated_pictures(place)
    found = _visible_files(place, (*ENDINGS, *MASK_ENDINGS))
    pictures = [path for path in found if Path(path).suffix.lower() in ENDINGS]
    stems = {strip_ending(path) for path in pictures}
    # All pictures are masks, but among photographs only A_mask.png, or A.json, beside A.png.
    if among_photographs := not {place / path for path in pictures}.isdisjoint(capture.pictures.values()):
        pictures = [path for path in pictures if is_mask_of_another(strip_ending(path), stems)]
        found = [path for path in found if path.lower().endswith(".json") and path[: -len(".json")] in stems]
    if pictures:
        return place, pictures
    # files of labelme and arrays; raises BadInput if a .json is unreadable
    others = [path for path in found if path.lower().endswith(".npy") or is_labelme(place / path)]
    if others or among_photographs:
        return place, others
    files = [path for path in found if annotated_pictures(place / path)]
    if len(files) > 1:
        raise BadInput(f"{place}: {len(files)} COCO files ({', '.join(files)}); name one as `masks` in scene.yaml")
    return (place / files[0], annotated_pictures(place / files[0])) if files else (place, [])


def _visible_files(place: Path, endings: Collection[str] = ()) -> list[str]:
    """Return the sorted relative paths of the visible files in a folder and its sub-folders, of `endings` if any."""
    # With endings, folders and broken links are included, which readers refuse.
    paths = [path for path in place.rglob("*") if (path.suffix.lower() in endings if endings else path.is_file())]
    relative = [path.relative_to(place) for path in paths]
    return sorted(each.as_posix() for each in relative if not any(part.startswith(".") for part in each.parts))


def _unread(place: Path) -> str:
    """Return what a folder without masks holds instead, as the end of a sentence; "" if it holds nothing."""
    counts = Counter(Path(path).suffix or "without ending" for path in _visible_files(place))
    found = ", ".join(f"{count} {ending}" for ending, count in sorted(counts.items()))
    return f"; {place.name} holds {found}, not read as masks" if found else ""


def group_by_object(place: Path, files: Collection[str], capture: Capture) -> dict[str, dict[str, Path]]:
    """Return object -> view -> mask file, for the masks in a folder. Masks of left-out pictures are dropped.

    Sub-folders are objects if a view has masks in several of them, or if there is only one sub-folder. All masks are of
    one object, called "", if there are no sub-folders; if each view has a mask in only one of several sub-folders; or
    if the pictures lie in sub-folders of the same names.

    Args:
        place: the folder.
        files: paths of the masks, relative to the folder.

    Raises:
        BadInput: a mask belongs to no picture; two masks of one object belong to one picture; or masks lie beside
            folders of masks.
    """
    folders = {PurePosixPath(path).parts[0] for path in files if "/" in path}
    if not folders or _are_picture_folders(folders, capture):
        return {"": _assign_masks(place, match_masks(place, files, capture), capture)}
    if any("/" not in path for path in files):
        raise BadInput(
            f"{place}: holds masks and folders of masks ({', '.join(sorted(folders))}); put them into one folder for "
            "each object, or all into one"
        )
    whole = match_masks(place, files, capture, strict=False)
    if len(folders) > 1 and len(set(whole.values())) == len(files):
        return {"": _assign_masks(place, whole, capture)}
    found = {}
    for name in sorted(folders):
        mine = [path.removeprefix(f"{name}/") for path in files if path.startswith(f"{name}/")]
        found[name] = _assign_masks(place / name, match_masks(place / name, mine, capture), capture)
    return found


def _are_picture_folders(folders: Collection[str], capture: Capture) -> bool:
    """Return whether all these folder names also occur in the paths of the capture's pictures."""
    ours = {part for paths in capture.paths.values() for path in paths for part in PurePosixPath(path).parent.parts}
    return set(folders) <= ours


def match_masks(place: Path, files: Collection[str], capture: Capture, strict: bool = True) -> dict[str, str]:
    """Return mask -> the view, or the path of the left-out picture, to which the mask belongs.

    Several masks may belong to one view.

    Args:
        place: the folder of the masks.
        files: paths of the masks, relative to the folder.
        strict: True to refuse masks that belong to no picture; False to leave them out of the result.

    Raises:
        BadInput: `strict`, and a mask belongs to no picture, or not to a single one.
    """
    everything = {name: (name, *paths) for name, paths in capture.paths.items()}
    found = pair_masks(files, everything)
    views = {name: paths for name, paths in everything.items() if name in capture.pictures}
    found |= pair_masks([path for path in files if path not in found], views)
    originals = original_names(place, [path for path in files if path not in found])
    pairs = pair_masks(originals.values(), everything)
    found |= {path: pairs[name] for path, name in originals.items() if name in pairs}
    if strict and (lone := sorted(set(files) - found.keys())):
        if view := pair_masks(lone[:1], everything).get(lone[0]):
            twin = next(path for path in files if path != lone[0] and pair_masks([path], everything).get(path) == view)
            raise BadInput(f"{place / lone[0]}: the view '{view}' has another mask, {place / twin}; remove one")
        name = PurePosixPath(strip_ending(lone[0])).name
        if several := sorted(v for v in views if name in {PurePosixPath(strip_ending(p)).name for p in views[v]}):
            raise BadInput(
                f"{place / lone[0]}: {' and '.join(several)} are called so; put masks into folders as pictures are"
            )
        holder = (place / lone[0]).parent
        if pair_masks([f"{holder.name}.png"], everything):
            raise BadInput(
                f"{holder}: a folder of several masks for one picture; copy the object's to {holder}.png, and move the "
                "folder elsewhere"
            )
        hint = "; name it like its picture, or remove it"
        if (shift := _numbering_shift(files, views)) is not None:
            hint = (
                f": masks are numbered from {shift[0]}, pictures from {shift[1]}; renumber all masks, and remove none"
            )
        raise BadInput(f"{place / lone[0]}: a mask for no picture{hint}")
    return found


def _numbering_shift(masks: Collection[str], views: Collection[str]) -> tuple[int, int] | None:
    """Return the first number of masks and of views if both are numbered alike, from different numbers; else None."""
    numbers = [
        sorted(int(found[0]) for name in names if (found := re.findall(r"\d+$", strip_ending(name))))
        for names in (masks, views)
    ]
    steps = {view - mask for mask, view in zip(*numbers, strict=False)}
    is_shifted = len(steps) == 1 and steps != {0} and len(masks) == len(views) == len(numbers[0]) == len(numbers[1])
    return (numbers[0][0], numbers[1][0]) if is_shifted else None


def _assign_masks(place: Path, views: Mapping[str, str], capture: Capture) -> dict[str, Path]:
    """Return view -> mask file, sorted, without left-out pictures; raises BadInput if a view has two masks."""
    result: dict[str, Path] = {}
    for path, view in sorted(views.items()):
        if view in result:
            raise BadInput(f"{place / path}: '{view}' has another mask, {result[view]}; remove one")
        result[view] = place / path
    return {view: result[view] for view in sorted(result) if view in capture.pictures}

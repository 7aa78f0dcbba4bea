"""Assigns roles to the views of a capture, and masks to views.

A training view supervises the fit. A test view is held out, for scores. A clean view is a training view in which the
object is absent. A camera-only view (`cameras_only` in scene.yaml) is a camera whose pixels are not used.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from reffusion.capture.layouts.capture import Capture
from reffusion.capture.mask_files import NONE, find_ignore_masks, find_masks, match_masks
from reffusion.capture.names import list_pictures
from reffusion.capture.views import ViewTable, check_proportions, resolve_view
from reffusion.io.files import BadInput
from reffusion.io.given_masks import WHITE, MaskValues, mask_file_size
from reffusion.io.images import image_size
from reffusion.params.capture import MaskSpec

LEAST_TRAINING_VIEWS = 3  # for a scene without camera-only views; with such views, one is enough
OTHERS = "others"
Files = TypeVar("Files", Path, tuple[Path, ...])  # one file of a view, or several


@dataclass(frozen=True)
class Roles:
    """The views of each role, and the files of their masks. A view without a role is left out of the scene.

    Attributes:
        train, test: names of the training views and of the test views.
        clean: names of the training views in which the object is absent.
        masks: object -> view -> file of the mask of this object. Views are training views, and test views whose
            photographs show the object. The object is "" if the masks do not distinguish between objects.
        test_masks: test view -> file of a mask of where the view shows the object, or would show it. Scores are
            computed in the bounding box of this mask.
        warnings: sentences for the user.
        camera_only: names of the camera-only views, which are neither training nor test views.
        values: the pixel values in `masks` that mark the object.
        fill: training view -> file of a mask of the pixels to fill, whatever the photograph shows there.
        ignore: view -> files of masks of pixels that neither train nor are filled, such as those of a passer-by.
        keep: names of views that stay in the scene even if their photographs contradict their poses.
    """

    train: tuple[str, ...]
    test: tuple[str, ...]
    clean: frozenset[str]
    masks: dict[str, dict[str, Path]]
    test_masks: dict[str, Path]
    warnings: tuple[str, ...]
    camera_only: tuple[str, ...] = ()
    values: MaskValues = WHITE
    fill: dict[str, Path] = field(default_factory=dict)
    ignore: dict[str, tuple[Path, ...]] = field(default_factory=dict)
    keep: frozenset[str] = frozenset()

    @property
    def mask_files(self) -> dict[str, dict[str, Path]]:
        """All mask files, by the folder into which the stage `raw_masks` writes them: folder -> view -> file.

        Folders are "masks/" or "masks/<object>", "test_masks", and "fill".
        """
        masks = {f"masks/{thing}": files for thing, files in self.masks.items()}
        return {**masks, "test_masks": self.test_masks, "fill": self.fill}

    def restrict(self, names: set[str]) -> Roles:
        """Return the roles of the views in `names` only, for example of the views that structure from motion placed.

        Raises:
            BadInput: fewer than 3 training views are left (with camera-only views: none is left).
        """
        kept = lambda values: {name: value for name, value in values.items() if name in names}
        roles = replace(
            self,
            train=tuple(n for n in self.train if n in names),
            test=tuple(n for n in self.test if n in names),
            clean=self.clean & names,
            camera_only=tuple(n for n in self.camera_only if n in names),
            masks={thing: kept(files) for thing, files in self.masks.items()},
            test_masks=kept(self.test_masks),
            fill=kept(self.fill),
            ignore=kept(self.ignore),
        )
        _check_enough(roles.train, bool(roles.camera_only))
        return roles


def assign_roles(
    folder: Path,
    capture: Capture,
    *,
    masks: str | MaskSpec | None = None,
    test_masks: str | None = None,
    ignore: str | None = None,
    train: Sequence[str] | str | None = None,
    test: Sequence[str] | str | None = None,
    clean: Sequence[str] = (),
    region: bool = False,
    cameras_only: Sequence[str] | str | None = None,
    remove: Sequence[str] | None = None,
) -> Roles:
    """Assign a role to each view, from the keys of scene.yaml and the masks in the folder.

    Test views are the first of these that exist:
    - the views that `test` names;
    - the views of the test masks (usually in `<pictures>/test_label`), except those that `train` names. If the test
      masks are named like views, their names decide. Otherwise they belong, in order, to the views without a training
      mask; or, if some training masks are missing too, to the first views of the capture;
    - the views that the layout itself holds out (`Capture.test`), except those that `train` names;
    - the views whose pictures are called test_*, if most are not, except those that `train` names.

    Training views are the views that `train` names, else all views that are neither test nor camera-only views, except
    those that the layout's own lists leave out (`Capture.unused`). All other views are left out of the scene, unless
    they are camera-only views.

    Args:
        folder: the scene's folder.
        masks: folder of masks, and optionally the numbers in them that mark the object. "none" if the scene has no
            masks. None searches <pictures>/label, masks, mask, label, then `A_mask.png` beside `A.png`, then the masks
            that the layout names.
        test_masks: folder of the masks of test views, named like the views or sorted like them. "none" if there are
            none; None searches `<pictures>/test_label`.
        ignore: folder of the masks of what neither trains nor is filled, see `find_ignore_masks`.
        train, test: names of views, or "every 8" for the first of each eight in the order of `Capture.pictures`; None
            if not given.
        clean: names of training views in which the object is absent.
        region: True if scene.yaml tells in another way what to change (a region, masks to fill, clicks, cleaned
            Gaussians). Masks are then optional.
        cameras_only: the camera-only views: names, "every 8", or "others" for all that are neither in train nor in
            test. Masks are then optional too.
        remove: names of the objects to remove. Each must be a folder of masks; they are only checked here.

    Raises:
        BadInput: a mask belongs to no picture, or its aspect ratio differs from that of its view by more than 10%;
            there is no mask at all, and masks are not optional; a view is unknown, or is named as both a training and a
            test view; there are fewer than 3 training views (with `cameras_only`: none). The message names the file and
            the remedy.
    """
    folder = Path(folder)
    found = find_masks(folder, capture, masks, optional=region or cameras_only is not None)
    of_objects = found.files
    _check_objects(remove, of_objects)
    mask_files = {name: path for files in of_objects.values() for name, path in files.items()}
    label_folder = capture.label_folder / "test_label" if test_masks is None else folder / test_masks
    label_files = _test_mask_files(label_folder, test_masks)
    train_named, test_named = (_select_views(value, capture, key) for key, value in (("train", train), ("test", test)))
    labelled = (
        None if label_files is None else _test_mask_views(capture, mask_files, label_folder, label_files, test_named)
    )
    named = None if cameras_only in (None, OTHERS) else _select_views(cameras_only, capture, "cameras_only")
    train_named, test_views = _split_views(train_named, test_named, labelled, named or [], capture)
    _check_enough(train_named, cameras_only is not None)
    camera_only = _camera_only_views(cameras_only, named, {*train_named, *test_views}, capture)
    clean_views = _clean_views(clean, train_named, capture)
    labels = None if labelled is None else dict(zip(labelled, label_files or (), strict=True))
    held_out, test_files = _split_masks(test_views, mask_files, labels or {})
    kept = {name: path for name, path in mask_files.items() if name in set(train_named)}
    training_masks = {thing: _restrict_files(files, {*kept, *held_out}) for thing, files in of_objects.items()}
    ignored = _restrict_files(find_ignore_masks(folder, capture, ignore), {*train_named, *test_views})
    of_views = [item for files in (*training_masks.values(), test_files) for item in files.items()]
    for name, path in (*of_views, *((name, path) for name, paths in ignored.items() for path in paths)):
        check_proportions(path, mask_file_size(path), name, _size_of(name, capture), 0.10, "mask")
    messages = [found.warning] if found.warning else []
    messages += _warn_missing(train_named, kept, clean_views, of_objects)
    if scored := [name for name in test_views if name in ignored]:
        messages.append(f"{len(scored)} test views have ignored pixels, which their scores count: {', '.join(scored)}")
    return Roles(
        train=tuple(train_named),
        test=tuple(test_views),
        clean=clean_views,
        masks=training_masks,
        test_masks=test_files,
        warnings=tuple(messages),
        camera_only=camera_only,
        values=found.values,
        ignore=ignored,
    )


def _warn_missing(
    train: Sequence[str],
    masked: Collection[str],
    clean: Collection[str],
    of_objects: Mapping[str, Mapping[str, Path]],
) -> list[str]:
    """Return warnings about training views without masks, and about those with masks of only some objects."""
    messages = []
    unmasked = [name for name in train if name not in masked and name not in clean]
    if masked and unmasked:
        is_end = len(unmasked) == 1 and unmasked[0] in (min(train), max(train)) and unmasked[0][-1:].isdigit()
        hint = "; if masks are numbered from another number than pictures, all lie one picture off" if is_end else ""
        messages.append(f"{len(unmasked)} training views have no mask: {', '.join(unmasked)}{hint}")
    partial = [name for name in masked if not all(name in files for files in of_objects.values())]
    if len(of_objects) > 1 and partial:
        messages.append(
            f"{len(partial)} training views have masks of only some objects, which do not count: {', '.join(partial)}; "
            "add empty masks where an object is out of sight"
        )
    return messages


def describe_split(train: int, test: int) -> str:
    """Return in words what photographs are for, e.g. "20 photographs build the scene; 3 are kept to test it".

    Args:
        train, test: numbers of training views and of test views.
    """
    words = f"{train} photograph{' builds' if train == 1 else 's build'} the scene"
    return words + (f"; {test} {'is' if test == 1 else 'are'} kept to test it" if test else "")


def _clean_views(clean: Sequence[str], train: list[str], capture: Capture) -> frozenset[str]:
    """Return the clean views (training views without the object). Raises BadInput if one is not in `train`."""
    views = frozenset(resolve_view(name, capture.pictures, "clean") for name in clean)
    if views - set(train):
        raise BadInput(f"scene.yaml: clean: {', '.join(sorted(views - set(train)))} is no training view")
    return views


def _split_masks(
    test: list[str], masks: dict[str, Path], labels: dict[str, Path]
) -> tuple[dict[str, Path], dict[str, Path]]:
    """Return two mappings of test view -> file: masks of the object in the photograph, and `Roles.test_masks`."""
    # A test view with a mask, and no test mask, shows the object. Its photograph is no ground truth inside the mask,
    # which is then also its test mask.
    held_out = {name: path for name, path in masks.items() if name in set(test)}
    own = {name: path for name, path in labels.items() if name in set(test)}
    return {name: path for name, path in held_out.items() if name not in own}, held_out | own


def _restrict_files(files: dict[str, Files], names: set[str]) -> dict[str, Files]:
    return {name: path for name, path in files.items() if name in names}


def _check_objects(remove: Sequence[str] | None, found: dict[str, dict[str, Path]]) -> None:
    """Raise BadInput if an object in `remove` has no masks in `found` (object -> view -> file)."""
    if remove is None:
        return
    if "" in found or not found:
        raise BadInput("scene.yaml: remove: the masks tell no objects apart; give each a folder, masks/<object>/")
    if unknown := [name for name in remove if name not in found]:
        raise BadInput(f"scene.yaml: remove: there is no object '{unknown[0]}'; masks tell apart {', '.join(found)}")


def capture_views(capture: Capture, roles: Roles) -> ViewTable:
    """Return the table of all views of a capture, to check files that the user made for one of them."""
    return ViewTable(capture.pictures, roles.train, roles.test, lambda name: _size_of(name, capture))


def _size_of(name: str, capture: Capture) -> tuple[int, int]:
    return image_size(capture.pictures[name], upright=capture.upright)


def _split_views(
    train: list[str] | None,
    test: list[str] | None,
    labelled: list[str] | None,
    camera_only: list[str],
    capture: Capture,
) -> tuple[list[str], list[str]]:
    """Return the training and test views; `labelled`: views of the test masks. Raises BadInput for a view in both."""
    test_views = test if test is not None else (labelled or [*capture.test] or _views_named_test(capture))
    if train is None:
        train = [name for name in capture.pictures if name not in {*test_views, *camera_only, *capture.unused}]
    elif test is None:
        test_views = [name for name in test_views if name not in set(train)]
    both = sorted(set(train) & set(test_views))
    if both:
        raise BadInput(f"scene.yaml: {', '.join(both)} in both train and test; a view is for one of them")
    return train, test_views


def _views_named_test(capture: Capture) -> list[str]:
    """Return the views whose pictures are called test_*, if most are not (in Inpaint360GS these lack the object)."""
    found = [name for name, path in capture.pictures.items() if path.name.startswith("test_")]
    return found if 2 * len(found) < len(capture.pictures) else []


def _camera_only_views(
    cameras_only: Sequence[str] | str | None, named: Sequence[str] | None, used: set[str], capture: Capture
) -> tuple[str, ...]:
    """Return the camera-only views: `named`, or all not `used` for None; BadInput if a list names a used view."""
    if cameras_only is None:
        return ()
    if named is None:
        return tuple(name for name in capture.pictures if name not in used)
    if both := sorted(set(named) & used):
        if not isinstance(cameras_only, str):
            raise BadInput(f"scene.yaml: cameras_only: {', '.join(both)} is a training or test view too")
    return tuple(name for name in named if name not in used)


def _check_enough(train: Sequence[str], sparse: bool = False) -> None:
    """Raise BadInput for fewer than 3 training views, or fewer than 1 if `sparse` (there are camera-only views)."""
    if len(train) < (1 if sparse else LEAST_TRAINING_VIEWS):
        raise BadInput(
            f"{len(train)} training view{'' if len(train) == 1 else 's'} ({', '.join(train) or 'none'}): "
            f"at least {LEAST_TRAINING_VIEWS} are needed; add pictures, or correct train and test in scene.yaml"
        )


def _select_views(value: Sequence[str] | str | None, capture: Capture, key: str) -> list[str] | None:
    """Return the views that a list of names (sorted) or "every N" in scene.yaml's `key` selects; None for None."""
    if value is None:
        return None
    if isinstance(value, str):
        match = re.fullmatch(r"every ([1-9][0-9]*)", value.strip())
        if match is None:
            raise BadInput(f"scene.yaml: {key}: '{value}' is neither a list of views nor like 'every 8'")
        return list(capture.pictures)[:: int(match[1])]
    names = sorted(resolve_view(name, capture.pictures, key) for name in value)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise BadInput(f"scene.yaml: {key}: {', '.join(twice)} named twice")
    return names


def _test_mask_files(found: Path, test_masks: str | None) -> list[Path] | None:
    """Return the sorted test masks in a folder; if empty, None, or raise BadInput if scene.yaml names it."""
    if test_masks is not None and test_masks.lower() == NONE:
        return None
    files = [found / path for path in list_pictures(found, nested=True)]
    if not files and test_masks is not None:
        raise BadInput(f"{found}: no masks there; correct `test_masks` in scene.yaml")
    return files or None


def _test_mask_views(
    capture: Capture, masks: dict[str, Path], place: Path, labels: list[Path], test_named: list[str] | None
) -> list[str]:
    """Return the view of each test mask in `labels`; raises BadInput if neither their names nor their number fit."""
    files = [path.relative_to(place).as_posix() for path in labels]
    named = match_masks(place, files, capture, strict=False)
    if all(view in capture.pictures for view in named.values()) and len(named) == len(labels):
        return [named[file] for file in files]
    # Else the masks are of all views without a training mask, in order, or of the first views of the capture, if none
    # of them has a training mask.
    without = [name for name in capture.pictures if name not in masks]
    first = list(capture.pictures)[: len(labels)]
    for candidate in (without, first):
        if len(candidate) == len(labels) and not set(candidate) & masks.keys():
            return candidate
    if test_named is not None and len(test_named) == len(labels):
        return test_named
    raise BadInput(
        f"{place}: {len(labels)} test masks, but {len(without)} views have no training mask and the first "
        f"{len(labels)} in order of names are not all among them; name the test views as `test` in scene.yaml, or the "
        "masks like their views"
    )

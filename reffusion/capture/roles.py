"""Assigns roles to the views of a capture (training, test, clean, cameras only), and masks to views."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from reffusion.capture.layouts.capture import Capture
from reffusion.capture.layouts.mask_files import NONE, find_masks, match_masks
from reffusion.capture.names import list_pictures
from reffusion.capture.views import ViewTable, check_proportions, resolve_view
from reffusion.io.files import BadInput
from reffusion.io.images import WHITE, MaskValues, image_size
from reffusion.params.capture import MaskSpec

LEAST_TRAINING_VIEWS = 3  # for a scene without views that are cameras only
OTHERS = "others"


@dataclass(frozen=True)
class Roles:
    """The role of each view. Names are sorted.

    Attributes:
        train, test, clean: names of views.
        masks: object -> view -> file of the mask, for training views, and test views that show the object too. "" is
            the object of masks that tell no objects apart.
        test_masks: test view -> file of a mask of where it shows the object, or would show it; the test box comes from
            it.
        warnings: sentences for the user.
        blank: names of views whose pixels are not used, beside training and test views.
        values: the pixel values of `masks` that are the object.
        fill: training view -> file of a mask of what is to be filled, whatever its photograph shows there.
        keep: names of views that stay, even where their photographs contradict their poses.
    """

    train: tuple[str, ...]
    test: tuple[str, ...]
    clean: frozenset[str]
    masks: dict[str, dict[str, Path]]
    test_masks: dict[str, Path]
    warnings: tuple[str, ...]
    blank: tuple[str, ...] = ()
    values: MaskValues = WHITE
    fill: dict[str, Path] = field(default_factory=dict)
    keep: frozenset[str] = frozenset()

    @property
    def mask_files(self) -> dict[str, dict[str, Path]]:
        """Folder of the stage `raw_masks` -> view -> file; folders are "masks/" or "masks/<object>", "test_masks",
        "fill"."""
        masks = {f"masks/{thing}": files for thing, files in self.masks.items()}
        return {**masks, "test_masks": self.test_masks, "fill": self.fill}

    def restrict(self, names: set[str]) -> Roles:
        """The roles of the views in `names`, such as those that structure from motion placed.

        Raises:
            BadInput: fewer than 3 training views are left.
        """
        kept = lambda values: {name: value for name, value in values.items() if name in names}
        roles = replace(
            self,
            train=tuple(n for n in self.train if n in names),
            test=tuple(n for n in self.test if n in names),
            clean=self.clean & names,
            blank=tuple(n for n in self.blank if n in names),
            masks={thing: kept(files) for thing, files in self.masks.items()},
            test_masks=kept(self.test_masks),
            fill=kept(self.fill),
        )
        _check_enough(roles.train, bool(roles.blank))
        return roles


def load_roles(
    folder: Path,
    capture: Capture,
    *,
    masks: str | MaskSpec | None = None,
    test_masks: str | None = None,
    train: Sequence[str] | str | None = None,
    test: Sequence[str] | str | None = None,
    clean: Sequence[str] = (),
    region: bool = False,
    cameras_only: Sequence[str] | str | None = None,
    remove: Sequence[str] | None = None,
) -> Roles:
    """Assign roles from scene.yaml's keys and the folder's usual places.

    Test views are those named; else, where the folder has test masks (`<pictures>/test_label`), the views without a
    mask, or where some training masks are missing the first views in order of names; else those that the layout holds
    out. Training views are those named, else all others. A view that is neither is left out of the scene.

    Args:
        masks: folder of masks, and the numbers in them that are the object; "none" for a scene without. None looks into
            <pictures>/label, masks, mask, label, for `A_mask.png` beside `A.png`, and for masks that the layout names.
        test_masks: folder of the test views' masks, named like the views or in their order; "none"; None looks.
        train, test: names, or "every 8" (the first of each eight in order of names), or None.
        region: the scene names a 3D region, so it may lack masks.
        cameras_only: views whose pixels are not used: names, "every 8", or "others": all not in train or test.
        remove: objects, each a folder of masks; only checked here.

    Raises:
        BadInput: naming the file and the remedy: a mask for no picture, of other proportions (over 10%), no mask at
            all, an unknown view, a view for both training and test, fewer than 3 training views.
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
    blank_named = None if cameras_only in (None, OTHERS) else _select_views(cameras_only, capture, "cameras_only")
    train_named, test_views = _split_views(train_named, test_named, labelled, blank_named or [], capture)
    _check_enough(train_named, cameras_only is not None)
    blank = _camera_only_views(cameras_only, blank_named, {*train_named, *test_views}, capture)
    clean_views = _clean_views(clean, train_named, capture)
    labels = None if labelled is None else dict(zip(labelled, label_files or (), strict=True))
    held_out, test_files = _split_masks(test_views, mask_files, labels or {})
    kept = {name: path for name, path in mask_files.items() if name in set(train_named)}
    training_masks = {thing: _restrict_files(files, {*kept, *held_out}) for thing, files in of_objects.items()}
    for name, path in (*(item for files in training_masks.values() for item in files.items()), *test_files.items()):
        check_proportions(path, name, _size_of(name, capture), 0.10, "mask")
    unmasked = [name for name in train_named if name not in kept and name not in clean_views]
    warning = f"{len(unmasked)} training views have no mask: {', '.join(unmasked)}" if kept and unmasked else None
    messages = tuple(filter(None, (found.warning, warning)))
    return Roles(
        tuple(train_named), tuple(test_views), clean_views, training_masks, test_files, messages, blank, found.values
    )


def _clean_views(clean: Sequence[str], train: list[str], capture: Capture) -> frozenset[str]:
    """The views that the scene names as clean, without the object."""
    views = frozenset(resolve_view(name, capture.pictures, "clean") for name in clean)
    if views - set(train):
        raise BadInput(f"scene.yaml: clean: {', '.join(sorted(views - set(train)))} is no training view")
    return views


def _split_masks(
    test: list[str], masks: dict[str, Path], labels: dict[str, Path]
) -> tuple[dict[str, Path], dict[str, Path]]:
    """The masks of test views that show the object (view -> file), and `Roles.test_masks`.

    Test views with a mask among the training masks are held out, but their photographs are no ground truth inside it.
    """
    held_out = {name: path for name, path in masks.items() if name in set(test)}
    own = {name: path for name, path in labels.items() if name in set(test)}
    return {name: path for name, path in held_out.items() if name not in own}, held_out | own


def _restrict_files(files: dict[str, Path], names: set[str]) -> dict[str, Path]:
    return {name: path for name, path in files.items() if name in names}


def _check_objects(remove: Sequence[str] | None, found: dict[str, dict[str, Path]]) -> None:
    if remove is None:
        return
    if "" in found or not found:
        raise BadInput("scene.yaml: remove: the masks tell no objects apart; give each a folder, masks/<object>/")
    if unknown := [name for name in remove if name not in found]:
        raise BadInput(f"scene.yaml: remove: there is no object '{unknown[0]}'; masks tell apart {', '.join(found)}")


def capture_views(capture: Capture, roles: Roles) -> ViewTable:
    """The views of a capture, for checking what people bring for them."""
    return ViewTable(capture.pictures, roles.train, roles.test, lambda name: _size_of(name, capture), capture.upright)


def _size_of(name: str, capture: Capture) -> tuple[int, int]:
    return image_size(capture.pictures[name], upright=capture.upright)


def _split_views(
    train: list[str] | None, test: list[str] | None, labelled: list[str] | None, blank: list[str], capture: Capture
) -> tuple[list[str], list[str]]:
    """Training and test views, from the named ones (None where none are named), the test masks', and the layout's test
    views."""
    test_views = test if test is not None else (labelled or [*capture.test])
    if train is None:
        train = [name for name in capture.pictures if name not in {*test_views, *blank}]
    elif test is None:
        test_views = [name for name in test_views if name not in set(train)]
    both = sorted(set(train) & set(test_views))
    if both:
        raise BadInput(f"scene.yaml: {', '.join(both)} in both train and test; a view is for one of them")
    return train, test_views


def _camera_only_views(
    cameras_only: Sequence[str] | str | None, named: Sequence[str] | None, used: set[str], capture: Capture
) -> tuple[str, ...]:
    """The views whose pixels are not used."""
    if cameras_only is None:
        return ()
    if named is None:
        return tuple(name for name in capture.pictures if name not in used)
    if both := sorted(set(named) & used):
        if not isinstance(cameras_only, str):
            raise BadInput(f"scene.yaml: cameras_only: {', '.join(both)} is a training or test view too")
    return tuple(name for name in named if name not in used)


def _check_enough(train: Sequence[str], sparse: bool = False) -> None:
    if len(train) < (1 if sparse else LEAST_TRAINING_VIEWS):
        raise BadInput(
            f"{len(train)} training view{'' if len(train) == 1 else 's'} ({', '.join(train) or 'none'}): "
            f"at least {LEAST_TRAINING_VIEWS} are needed; add pictures, or correct train and test in scene.yaml"
        )


def _select_views(value: Sequence[str] | str | None, capture: Capture, key: str) -> list[str] | None:
    """View names, sorted, from a list of names or from "every N"."""
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
    """The test views' masks in a folder, in order of their paths; None where the scene has none."""
    if test_masks is not None and test_masks.lower() == NONE:
        return None
    files = [found / path for path in list_pictures(found, nested=True)]
    if not files and test_masks is not None:
        raise BadInput(f"{found}: no masks there; correct `test_masks` in scene.yaml")
    return files or None


def _test_mask_views(
    capture: Capture, masks: dict[str, Path], place: Path, labels: list[Path], test_named: list[str] | None
) -> list[str]:
    """The view of each test mask in a folder, in the order of the masks."""
    files = [path.relative_to(place).as_posix() for path in labels]
    named = match_masks(place, files, capture, strict=False)
    if all(view in capture.pictures for view in named.values()) and len(named) == len(labels):
        return [named[file] for file in files]
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

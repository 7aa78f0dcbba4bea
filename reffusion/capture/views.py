"""Looks up the views of a scene by the names that people write: in scene.yaml, for references, clicks and regions."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

from reffusion.capture.lenses import load_lenses
from reffusion.capture.names import flatten, normalize_path, strip_ending
from reffusion.io.arrays import load_json
from reffusion.io.files import BadInput
from reffusion.io.images import image_size


@dataclass(frozen=True)
class ViewTable:
    """The views of a capture (`reffusion.capture.roles.capture_views`), or those that `poses` placed.

    Attributes:
        names: all views.
        train, test: training and test views.
        size_of: name -> (width, height) of its picture.
        upright: the orientation tag of pictures is obeyed.
        placed: the views are those that `poses` wrote (`load_placed_views`), so the capture may have others.
        outliers: views that `poses` left out because their photographs contradict their poses.
    """

    names: Collection[str]
    train: Collection[str]
    test: Collection[str]
    size_of: Callable[[str], tuple[int, int]]
    upright: bool
    placed: bool = False
    outliers: Collection[str] = ()


def load_placed_views(poses_dir: Path) -> ViewTable:
    """The views of a finished `poses` folder, at the sizes of its undistorted pictures."""
    lenses, upright = load_lenses(poses_dir)
    roles = load_json(Path(poses_dir) / "views.json")
    size_of = lambda name: (lenses[name].width, lenses[name].height)
    return ViewTable(lenses, roles["train"], roles["test"], size_of, upright, True, roles.get("outliers", ()))


def resolve_view(name: str, names: Collection[str], key: str) -> str:
    """The view of that name, or of the picture of that path; BadInput with the most similar names for none."""
    if found := find_view(name, names):
        return found
    raise BadInput(f"scene.yaml: {key}: there is no view '{name}'; views are named like {_similar_names(name, names)}")


def resolve_file_view(path: Path, name: str, views: ViewTable, key: str) -> str:
    """`resolve_view`, for the view that the file at `path` is made for."""
    if not views.placed:
        return resolve_view(name, views.names, key)
    if found := find_view(name, views.names):
        return found
    raise not_placed_error(path, name, views)


def not_placed_error(path: Path, name: str, views: ViewTable) -> BadInput:
    """The error for a file whose view is not among those that `poses` placed."""
    if outlier := find_view(name, views.outliers):
        return outlier_error(str(path), outlier)
    return BadInput(
        f"{path}: its view '{name}' could not be placed, or is neither a training nor a test view; "
        f"make it for another view: they are named like {_similar_names(name, views.names)}"
    )


def check_outliers(key: str, names: Iterable[str], outliers: Collection[str]) -> None:
    """BadInput where a key of scene.yaml names a view that is left out because its photograph contradicts its pose."""
    for name in names:
        if outlier := find_view(name, outliers):
            raise outlier_error(f"scene.yaml: {key}", outlier)


def outlier_error(where: str, name: str) -> BadInput:
    """The error for a file or key (`where`) that stands for a view which is left out."""
    return BadInput(
        f"{where}: it is for the view '{name}', which is left out: its photograph contradicts its pose; choose another "
        f'view, or add `keep: ["{name}"]` to scene.yaml'
    )


def find_view(name: str, names: Collection[str]) -> str | None:
    """The view that a name, a file name or a path means: `cam0/0001.png` is `cam0-0001`; None where there is none."""
    path = strip_ending(normalize_path(name))
    spellings = (name, path, flatten(path), path.rpartition("/")[2], Path(name).stem)
    return next((candidate for candidate in spellings if candidate in names), None)


def _similar_names(name: str, names: Collection[str]) -> str:
    return ", ".join(get_close_matches(name, names, 3, 0.0))


def check_proportions(
    path: Path, name: str, of_size: tuple[int, int], tolerance: float, what: str, upright: bool = False
) -> None:
    """Checks that a picture has the aspect ratio of its view.

    Args:
        name: of the view. of_size: (width, height) of the view.
        tolerance: largest relative difference of the aspect ratios.
        what: the kind of picture, for the message. upright: whether the picture's EXIF orientation is applied.

    Raises:
        BadInput: the ratios differ by more than `tolerance`.
    """
    (width, height), (of_width, of_height) = image_size(path, upright), of_size
    if abs(width * of_height - height * of_width) > tolerance * width * of_height:
        raise BadInput(
            f"{path}: {width}x{height} px, but its view '{name}' has {of_width}x{of_height}; "
            f"make the {what} over the whole picture, in its proportions"
        )

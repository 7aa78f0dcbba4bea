"""Looks up views by the names that users write in scene.yaml, for references, clicks and regions.

A *placed* view is one for which the stage `poses` has a camera. `poses` leaves out views that structure from motion
could not place, views that have no role, and *outliers*: views whose photographs contradict their poses.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

from reffusion.capture.lenses import load_lenses
from reffusion.capture.names import flatten, normalize_path, strip_ending
from reffusion.io.arrays import load_json
from reffusion.io.files import BadInput


@dataclass(frozen=True)
class ViewTable:
    """The names and picture sizes of a scene's views.

    The views are either all views of a capture (`reffusion.capture.roles.capture_views`), or only the placed views.

    Attributes:
        names: names of all these views.
        train, test: names of the training views and of the test views.
        size_of: function from a view's name to the (width, height) of its picture.
        placed: True if the table holds only the placed views (`load_placed_views`), so that the capture may have more.
        outliers: names of the views that `poses` left out because their photographs contradict their poses.
    """

    names: Collection[str]
    train: Collection[str]
    test: Collection[str]
    size_of: Callable[[str], tuple[int, int]]
    placed: bool = False
    outliers: Collection[str] = ()


def load_placed_views(poses_dir: Path) -> ViewTable:
    """Return the views of the folder that the stage `poses` wrote, with the sizes of its undistorted pictures."""
    lenses = load_lenses(poses_dir)[0]
    roles = load_json(Path(poses_dir) / "views.json")
    size_of = lambda name: (lenses[name].width, lenses[name].height)
    return ViewTable(lenses, roles["train"], roles["test"], size_of, True, roles.get("outliers", ()))


def resolve_view(name: str, names: Collection[str], key: str) -> str:
    """Return the name of the view that the user means by `name`, by the rules of `find_view`.

    Args:
        name: a view's name, or the name or path of its picture.
        names: names of the views that exist.
        key: the key of scene.yaml in which `name` is written, for the message.

    Raises:
        BadInput: there is no such view; the message shows the most similar names.
    """
    if found := find_view(name, names):
        return found
    raise BadInput(f"scene.yaml: {key}: there is no view '{name}'; views are named like {_similar_names(name, names)}")


def resolve_file_view(path: Path, name: str, views: ViewTable, key: str) -> str:
    """Return the name of the view for which the file at `path` was made.

    Args:
        name: the view's name, or the name or path of its picture.
        key: the key of scene.yaml in which `name` is written, for the message.

    Raises:
        BadInput: there is no such view, or it is not placed.
    """
    if not views.placed:
        return resolve_view(name, views.names, key)
    if found := find_view(name, views.names):
        return found
    raise not_placed_error(path, name, views)


def not_placed_error(path: Path, name: str, views: ViewTable) -> BadInput:
    """Return the error for the file at `path`, which was made for a view `name` that is not placed."""
    if outlier := find_view(name, views.outliers):
        return outlier_error(str(path), outlier)
    return BadInput(
        f"{path}: its view '{name}' could not be placed, or is neither a training nor a test view; "
        f"make it for another view: they are named like {_similar_names(name, views.names)}"
    )


def check_outliers(key: str, names: Iterable[str], outliers: Collection[str]) -> None:
    """Check that a key of scene.yaml names no outlier (a view left out because its photograph contradicts its pose).

    Args:
        key: the key of scene.yaml, for the message.
        names: the names of views that stand under this key.
        outliers: names of the outliers.

    Raises:
        BadInput: one of `names` is an outlier.
    """
    for name in names:
        if outlier := find_view(name, outliers):
            raise outlier_error(f"scene.yaml: {key}", outlier)


def outlier_error(where: str, name: str) -> BadInput:
    """Return the error for `where`, a file or a key of scene.yaml that refers to the outlier `name`."""
    return BadInput(
        f"{where}: it is for the view '{name}', which is left out: its photograph contradicts its pose; choose another "
        f'view, or add `keep: ["{name}"]` to scene.yaml'
    )


def find_view(name: str, names: Collection[str]) -> str | None:
    """Return the view in `names` that a user means by a view name, a file name or a path; None if there is none.

    A path means the view that is named by the path, else the view that is named by the file: `cam0/0001.png` is the
    view `cam0-0001`, else `0001`.
    """
    path = strip_ending(normalize_path(name))
    spellings = (name, path, flatten(path), path.rpartition("/")[2], Path(name).stem)
    return next((candidate for candidate in spellings if candidate in names), None)


def _similar_names(name: str, names: Collection[str]) -> str:
    """Return up to three of `names` that are most similar to `name`, joined by commas."""
    return ", ".join(get_close_matches(name, names, 3, 0.0))


def is_in_proportion(size: tuple[int, int], of_size: tuple[int, int], tolerance: float) -> bool:
    """Return whether the aspect ratios of two sizes (width, height) differ by at most the share `tolerance`."""
    return abs(size[0] * of_size[1] - size[1] * of_size[0]) <= tolerance * size[0] * of_size[1]


def check_proportions(
    path: Path, size: tuple[int, int], name: str, of_size: tuple[int, int], tolerance: float, what: str
) -> None:
    """Check that a picture has the aspect ratio of its view.

    Args:
        path: file of the picture, for the message.
        size: (width, height) of the picture.
        name: name of the view.
        of_size: (width, height) of the view.
        tolerance: largest allowed difference of the aspect ratios, relative to that of the picture.
        what: the kind of picture, such as "mask", for the message.

    Raises:
        BadInput: the ratios differ by more than `tolerance`.
    """
    (width, height), (of_width, of_height) = size, of_size
    if not is_in_proportion(size, of_size, tolerance):
        turned = is_in_proportion((height, width), of_size, tolerance)
        raise BadInput(
            f"{path}: {width}x{height} px, but its view '{name}' has {of_width}x{of_height}; "
            + (
                f"turn the {what} by 90 degrees: photographs count as stored, without EXIF orientation"
                if turned
                else f"make the {what} over the whole picture, in its proportions"
            )
        )

"""The views of a scene, as far as what people bring for them is checked: their names, roles and sizes."""

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
class Views:
    """Those of a capture (`reffusion.capture.roles.views_of`), or those that `poses` placed (`placed_views`).

    Attributes:
        names: all of them.
        train, test: those that are for either.
        size_of: name -> (width, height) of its picture.
        upright: the camera's orientation tag is obeyed.
        placed: they are what `poses` wrote, so a view that is not among them may be the capture's all the same.
        outliers: views that `poses` left out because their photographs contradict their poses.
    """

    names: Collection[str]
    train: Collection[str]
    test: Collection[str]
    size_of: Callable[[str], tuple[int, int]]
    upright: bool
    placed: bool = False
    outliers: Collection[str] = ()


def placed_views(poses_dir: Path) -> Views:
    """The views of a finished `poses` folder, at the sizes of its undistorted pictures."""
    lenses, upright = load_lenses(poses_dir)
    roles = load_json(Path(poses_dir) / "views.json")
    size_of = lambda name: (lenses[name].width, lenses[name].height)
    return Views(lenses, roles["train"], roles["test"], size_of, upright, True, roles.get("outliers", ()))


def known(name: str, names: Collection[str], key: str) -> str:
    """The view of that name, or of the picture of that path; BadInput with the nearest names where there is none."""
    if found := find_view(name, names):
        return found
    raise BadInput(f"scene.yaml: {key}: there is no view '{name}'; views are named like {_near(name, names)}")


def known_for(path: Path, name: str, views: Views, key: str) -> str:
    """`known`, of the view that the file at `path` is made for."""
    if not views.placed:
        return known(name, views.names, key)
    if found := find_view(name, views.names):
        return found
    raise not_placed(path, name, views)


def not_placed(path: Path, name: str, views: Views) -> BadInput:
    if outlier := find_view(name, views.outliers):
        return outlier_named(str(path), outlier)
    return BadInput(
        f"{path}: its view '{name}' could not be placed, or is neither a training nor a test view; "
        f"make it for another view: they are named like {_near(name, views.names)}"
    )


def check_outliers(key: str, names: Iterable[str], outliers: Collection[str]) -> None:
    """BadInput where a key of scene.yaml names a view that is left out because its photograph contradicts its pose."""
    for name in names:
        if outlier := find_view(name, outliers):
            raise outlier_named(f"scene.yaml: {key}", outlier)


def outlier_named(where: str, name: str) -> BadInput:
    """What is said of a file or key that stands for a view which is left out."""
    return BadInput(
        f"{where}: it is for the view '{name}', which is left out: its photograph contradicts its pose; choose another "
        f'view, or add `keep: ["{name}"]` to scene.yaml'
    )


def find_view(name: str, names: Collection[str]) -> str | None:
    """The view that a name, a file name or a path means: `cam0/0001.png` is `cam0-0001`; None where there is none."""
    path = strip_ending(normalize_path(name))
    spellings = (name, path, flatten(path), path.rpartition("/")[2], Path(name).stem)
    return next((candidate for candidate in spellings if candidate in names), None)


def _near(name: str, names: Collection[str]) -> str:
    return ", ".join(get_close_matches(name, names, 3, 0.0))


def check_proportions(
    path: Path, name: str, of_size: tuple[int, int], tolerance: float, what: str, upright: bool = False
) -> None:
    """BadInput where a picture's sides are not in the proportion of its view's, by more than `tolerance`."""
    (width, height), (of_width, of_height) = image_size(path, upright), of_size
    if abs(width * of_height - height * of_width) > tolerance * width * of_height:
        raise BadInput(
            f"{path}: {width}x{height} px, but its view '{name}' has {of_width}x{of_height}; "
            f"make the {what} over the whole picture, in its proportions"
        )

"""The files of the references that come with a scene: named in its scene.yaml, or saved in its folder `painted`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from reffusion.capture.views import (
    ViewTable,
    check_proportions,
    is_in_proportion,
    not_placed_error,
    resolve_file_view,
)
from reffusion.io.files import BadInput
from reffusion.io.images import ENDINGS, image_size
from reffusion.params.reference import ReferenceSpec, reference_list

PAINTED = "painted"  # folder of the scene with <view>.png and <view>_depth.*
DEPTH_ENDINGS = (".npy", ".exr", ".png", ".tif", ".tiff")
PROPORTION_TOLERANCE = 0.1  # relative difference of aspect ratio from the view's that is allowed, because people crop


@dataclass(frozen=True)
class ReferenceFile:
    """The files of a completed view that comes with the scene.

    Attributes:
        view: name of the view.
        path: file of the picture. Its size may differ from the photograph's, and its proportions slightly; both are
            corrected later.
        depth: file of a depth or disparity map of the whole picture; None if there is none.
        painted: True if the picture lies in the folder `painted`. It was then painted over an image that the stage
            `reference` wrote for this purpose, undistorted and in the common exposure of the scene, or over the
            photograph.
        trust: True to use the picture even if it does not seem to show its view.
    """

    view: str
    path: Path
    depth: Path | None = None
    painted: bool = False
    trust: bool = False

    @property
    def trust_hint(self) -> str:
        """A sentence that tells users how to make scene.yaml accept the reference despite a failed check."""
        if not self.painted:
            return "write `trust: true` beside it in scene.yaml"
        line = f"{{view: {self.view}, image: {PAINTED}/{self.path.name}, trust: true}}"
        return f"write `reference: {line}` in scene.yaml"


def list_paintings(folder: Path) -> list[Path]:
    """Return all files in the scene's folder `painted` (pictures, depth maps, masks), sorted, but no hidden files."""
    return sorted(path for path in (Path(folder) / PAINTED).glob("[!.]*") if path.is_file())


def obeys_orientation(path: Path, of_size: tuple[int, int]) -> bool:
    """Return whether the EXIF orientation tag of a reference is obeyed.

    The tag is ignored only if the picture has the proportions of its view without the tag, but not with it: an editor
    may keep the tag of a photograph whose tag is ignored because its pose refers to the stored pixels.

    Args:
        path: file of the picture.
        of_size: (width, height) of its view.
    """
    turned, stored = (is_in_proportion(image_size(path, each), of_size, PROPORTION_TOLERANCE) for each in (True, False))
    return turned or not stored


def list_teaching_files(folder: Path, names: Sequence[str]) -> list[Path]:
    """Return the files of the pictures that only personalize the prior, which scene.yaml names by the key `teach`.

    Raises:
        BadInput: a file is missing, or two have the same stem.
    """
    paths = [Path(folder) / name for name in names]
    for path in paths:
        if not path.is_file():
            raise BadInput(f"{path}: no such file; correct `teach` in scene.yaml")
        if sum(path.stem == other.stem for other in paths) > 1:
            raise BadInput(f"{path}: another picture in `teach` has the same name; rename one")
    return paths


def load_reference_files(
    folder: Path, views: ViewTable, specs: ReferenceSpec | Sequence[ReferenceSpec] | None
) -> list[ReferenceFile]:
    """Find the references that scene.yaml names and those in the folder `painted`, and check their files.

    A painting is called <view>.png, its depth map <view>_depth.*. A painting replaces a reference that scene.yaml names
    for the same view.

    Args:
        folder: the scene's folder.
        views: the views of the scene.
        specs: value of the key `reference` of scene.yaml.

    Returns:
        The references, sorted by view name.

    Raises:
        BadInput: a view is unknown, or is no training view; scene.yaml names two references for a view, or `painted`
            holds two paintings or two depth maps of a view; a file is missing; a depth map in `painted` has no
            painting; a picture has other proportions than its view; or a depth map is of an unknown kind. The message
            names the file and the remedy.
    """
    folder = Path(folder)
    found: dict[str, ReferenceFile] = {}
    for each in reference_list(specs):
        path = folder / each.image
        name = resolve_file_view(path, each.view, views, "reference")
        if name in found:
            raise BadInput(f"scene.yaml: reference: two for the view '{name}'; keep one")
        depth = None if each.depth is None else folder / each.depth
        found[name] = ReferenceFile(name, path, depth, trust=each.trust)
    for file in _paintings(list_paintings(folder), views):
        named = found.get(file.view)
        found[file.view] = replace(file, trust=named is not None and named.trust and named.path == file.path)
    for file in found.values():
        _check(file, views)
    return sorted(found.values(), key=lambda file: file.view)


def describe_references(given: Sequence[ReferenceFile]) -> str:
    """Return the names of the references' views as text for people, with "(painted)" after those of paintings."""
    return ", ".join(each.view + (" (painted)" if each.painted else "") for each in given)


def _paintings(files: Sequence[Path], views: ViewTable) -> list[ReferenceFile]:
    """Return the paintings among `files` with their depth maps; raises BadInput for other or duplicate files."""
    pictures, depths = {}, {}
    for path in files:
        of = {end: path.stem.removesuffix(end) for end in ("_depth", "_mask") if path.stem.endswith(end)}
        if path.stem not in views.names and of.get("_depth") in views.names:
            kind, name = depths, of["_depth"]
        elif path.stem not in views.names and (of.get("_mask") in views.names or (views.placed and "_mask" in of)):
            # Copies of the views' mask files are ignored.
            continue
        elif path.suffix.lower() in ENDINGS:
            kind, name = pictures, path.stem
        else:
            raise BadInput(f"{path}: no picture; a painting is called <view>.png, its depth <view>_depth.png or .exr")
        if name not in views.names and views.placed:
            raise not_placed_error(path, name, views)
        if name not in views.names:
            raise BadInput(f"{path}: no view is called '{name}'; call the painting like its view, or remove it")
        if name in kind:
            raise BadInput(f"{path}: there is {kind[name].name} too; keep one for the view '{name}'")
        kind[name] = path
    for name in depths.keys() - pictures.keys():
        raise BadInput(f"{depths[name]}: a depth map without a painting; add {name}.png, or remove it")
    return [ReferenceFile(name, path, depths.get(name), True, True) for name, path in pictures.items()]


def _check(file: ReferenceFile, views: ViewTable) -> None:
    """Raise BadInput if the files of a reference cannot be used; see `load_reference_files`."""
    where = "" if file.painted else "; correct `reference` in scene.yaml"
    for path in (file.path, file.depth):
        if path is not None and not path.is_file():
            raise BadInput(f"{path}: no such file{where}")
    if file.view in views.test:
        raise BadInput(
            f"{file.path}: '{file.view}' is a test view, and scored: a reference would train it; "
            "make it for a training view, or take the view out of `test` in scene.yaml"
        )
    if file.view not in views.train:
        raise BadInput(
            f"{file.path}: '{file.view}' is neither a training nor a test view; "
            "name it in `train` in scene.yaml, or make the reference for another view"
        )
    of_size = views.size_of(file.view)
    size = image_size(file.path, obeys_orientation(file.path, of_size))
    check_proportions(file.path, size, file.view, of_size, PROPORTION_TOLERANCE, "reference")
    if file.depth is not None:
        if file.depth.suffix.lower() not in DEPTH_ENDINGS:
            raise BadInput(f"{file.depth}: a depth map is a 16-bit .png, a .npy or an .exr; convert it")
        if file.depth.suffix.lower() not in (".npy", ".exr"):
            image_size(file.depth)

"""Completed views that a scene brings: named in its scene.yaml, or painted into its folder `painted`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from reffusion.capture.views import Views, check_proportions, known_for, not_placed
from reffusion.io.files import BadInput
from reffusion.io.images import ENDINGS, image_size
from reffusion.params.reference import Given, reference_list

PAINTED = "painted"  # folder of the scene: <view>.png and <view>_depth.*
DEPTHS = (".npy", ".exr", ".png", ".tif", ".tiff")
PROPORTIONS = 0.1  # how far a reference's may be from its view's: people crop


@dataclass(frozen=True)
class GivenReference:
    """A completed view that the scene brings.

    Attributes:
        view: its name.
        path: the picture; another size than the photograph's, and slightly other proportions, are made up for.
        depth: its depth or disparity, over the picture; or None.
        undistorted: the picture was painted over an undistorted image, not over the photograph.
        painted: it lies in `painted`, over what `reference` wrote to be painted: the view's exposure is taken out.
        trust: it is taken even where it does not seem to show its view.
    """

    view: str
    path: Path
    depth: Path | None = None
    undistorted: bool = False
    painted: bool = False
    trust: bool = False

    @property
    def way_to_trust(self) -> str:
        """What to write in scene.yaml to have it taken whatever is measured, in words."""
        if not self.painted:
            return "write `trust: true` beside it in scene.yaml"
        line = f"{{view: {self.view}, image: {PAINTED}/{self.path.name}, trust: true}}"
        return f"write `reference: {line}` in scene.yaml"


def paintings_in(folder: Path) -> list[Path]:
    """The files of the scene's folder `painted`."""
    return sorted(path for path in (Path(folder) / PAINTED).glob("[!.]*") if path.is_file())


def load_given(folder: Path, views: Views, asked: Given | Sequence[Given] | None) -> list[GivenReference]:
    """The references that scene.yaml names (`asked`) and those in `painted`, <view>.png, with <view>_depth.* where
    there is one; sorted by view. A painting stands for one that scene.yaml names for the same view.

    Raises:
        BadInput: naming the file and the remedy: an unknown view, a test view, a view that is for neither, two for a
            view, a missing file, other proportions than the view's, a depth map of another kind.
    """
    folder = Path(folder)
    found: dict[str, GivenReference] = {}
    for each in reference_list(asked):
        path = folder / each.image
        name = known_for(path, each.view, views, "reference")
        if name in found:
            raise BadInput(f"scene.yaml: reference: two for the view '{name}'; keep one")
        depth = None if each.depth is None else folder / each.depth
        found[name] = GivenReference(name, path, depth, each.undistorted, trust=each.trust)
    for given in _paintings(paintings_in(folder), views):
        named = found.get(given.view)
        found[given.view] = replace(given, trust=named is not None and named.trust and named.path == given.path)
    for given in found.values():
        _check(given, views)
    return sorted(found.values(), key=lambda given: given.view)


def words(given: Sequence[GivenReference]) -> str:
    """Their views for people."""
    return ", ".join(each.view + (" (painted)" if each.painted else "") for each in given)


def _paintings(files: Sequence[Path], views: Views) -> list[GivenReference]:
    """The paintings with their depth maps; masks that were copied along are passed over."""
    pictures, depths = {}, {}
    for path in files:
        of = {end: path.stem.removesuffix(end) for end in ("_depth", "_mask") if path.stem.endswith(end)}
        if path.stem not in views.names and of.get("_depth") in views.names:
            kind, name = depths, of["_depth"]
        elif path.stem not in views.names and (of.get("_mask") in views.names or (views.placed and "_mask" in of)):
            continue
        elif path.suffix.lower() in ENDINGS:
            kind, name = pictures, path.stem
        else:
            raise BadInput(f"{path}: no picture; a painting is called <view>.png, its depth <view>_depth.png or .exr")
        if name not in views.names and views.placed:
            raise not_placed(path, name, views)
        if name not in views.names:
            raise BadInput(f"{path}: no view is called '{name}'; call the painting like its view, or remove it")
        if name in kind:
            raise BadInput(f"{path}: there is {kind[name].name} too; keep one for the view '{name}'")
        kind[name] = path
    for name in depths.keys() - pictures.keys():
        raise BadInput(f"{depths[name]}: a depth map without a painting; add {name}.png, or remove it")
    return [GivenReference(name, path, depths.get(name), True, True) for name, path in pictures.items()]


def _check(given: GivenReference, views: Views) -> None:
    where = "" if given.painted else "; correct `reference` in scene.yaml"
    for path in (given.path, given.depth):
        if path is not None and not path.is_file():
            raise BadInput(f"{path}: no such file{where}")
    if given.view in views.test:
        raise BadInput(
            f"{given.path}: '{given.view}' is a test view, and scored: a reference would train it; "
            "make it for a training view, or take the view out of `test` in scene.yaml"
        )
    if given.view not in views.train:
        raise BadInput(
            f"{given.path}: '{given.view}' is neither a training nor a test view; "
            "name it in `train` in scene.yaml, or make the reference for another view"
        )
    check_proportions(given.path, given.view, views.size_of(given.view), PROPORTIONS, "reference", views.upright)
    if given.depth is not None:
        if given.depth.suffix.lower() not in DEPTHS:
            raise BadInput(f"{given.depth}: a depth map is a 16-bit .png, a .npy or an .exr; convert it")
        if given.depth.suffix.lower() not in (".npy", ".exr"):
            image_size(given.depth)

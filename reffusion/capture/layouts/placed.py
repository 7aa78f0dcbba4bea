"""Makes a capture of pictures that another program placed, from the cameras in that program's own file."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from reffusion.capture.checks.sparse_points import keep_points_in_frame
from reffusion.capture.layouts.capture import (
    NO_POINTS,
    Capture,
    Correction,
    PointCloud,
    Poses,
    count_message,
    nearest_rigid,
    relative_paths,
    resize_lens,
)
from reffusion.capture.lens import Lens
from reffusion.capture.names import list_pictures, name_views, pair_pictures, shorten_path
from reffusion.io.files import BadInput
from reffusion.io.images import image_size

USUAL = ("images", "images_2", "images_4", "images_8", "photos", "input", "rgb", ".")  # usual folders of pictures


@dataclass(frozen=True)
class PictureCamera:
    """The camera of a picture in another program's file.

    Attributes:
        world_to_camera: [4, 4], axes as in `Poses`.
        lens: the lens for the size (width, height) of the picture file. Programs that store a size of their own give
            the lens at that size.
    """

    world_to_camera: np.ndarray
    lens: Callable[[tuple[int, int]], Lens]


def read_placed(
    folder: Path,
    images: str | None,
    layout: str,
    source: Path,
    placed: Mapping[str, PictureCamera],
    correction: Correction,
    points: PointCloud = NO_POINTS,
    usual: Sequence[str] = USUAL,
) -> Capture:
    """Return the capture of the pictures that a program placed.

    Pictures are found by their names (`pair_pictures`). Names without a picture and pictures without a name are left
    out, and points that are not in the frame of the cameras; `Capture.warnings` tells all of this.

    Args:
        folder: the scene's folder.
        images: folder of pictures, relative to the scene; None for the first of `usual` that holds a named picture.
        layout: see `Capture`.
        source: the program's file, for messages.
        placed: name or path of a picture, as the program writes it -> its camera.
        correction: what is changed in the poses.
        points: sparse points in the frame of the cameras.

    Raises:
        BadInput: no picture is named in the file, two have the same view name, a pose is no rotation, or a lens is
            wrong or has other proportions than its picture.
    """
    places = [folder / name for name in ([images] if images is not None else usual)]
    listed = {place: list_pictures(place, nested=not place.samefile(folder)) for place in places if place.is_dir()}
    pairs = {place: pair_pictures({name: name for name in placed}, files) for place, files in listed.items()}
    place = next((place for place, found in pairs.items() if found), None)
    if place is None:
        raise BadInput(
            f"{source}: none of its {len(placed)} pictures ({', '.join(list(placed)[:3])}, ...) is in "
            f"{', '.join(shorten_path(path, folder) for path in places)}; name their folder as `images` in "
            "scene.yaml"
        )
    file_of = pairs[place]
    name_of = {file: name for name, file in file_of.items()}
    views = name_views(name_of)
    pictures = {view: place / file for view, file in views.items()}
    cameras = {view: placed[name_of[file]] for view, file in views.items()}
    lenses = {view: resize_lens(_check_lens(cameras[view], pictures[view], source), pictures[view]) for view in views}
    poses = {view: nearest_rigid(each.world_to_camera, view, source) for view, each in cameras.items()}
    found = correction.apply(Poses(lenses, poses, *NO_POINTS, {}))
    points, point_warning = keep_points_in_frame(source, points, found, pictures)
    lost, rest = sorted(placed.keys() - file_of.keys()), sorted(set(listed[place]) - name_of.keys())
    warnings = (
        count_message(f"of the {len(placed)} pictures in {source.name} are missing", lost),
        count_message(f"pictures are not in {source.name} and are left out", rest),
        point_warning,
    )
    paths = relative_paths(place, pictures)
    return Capture(
        layout,
        pictures,
        {view: (*paths[view], name_of[file]) for view, file in views.items()} | {path: (path,) for path in lost + rest},
        replace(found, points=points[0], colors=points[1]),
        source,
        _common_folder(pictures),
        tuple(filter(None, warnings)),
    )


def _check_lens(placed: PictureCamera, picture: Path, source: Path) -> Lens:
    """Return the lens of a picture. Raises BadInput if a size or focal length is not positive, or a number infinite."""
    lens = placed.lens(image_size(picture))
    numbers = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.radial, *lens.tangential)
    if not np.isfinite(numbers).all() or min(lens.fx, lens.fy, lens.width, lens.height) <= 0:
        raise BadInput(
            f"{source}: the camera of '{picture.name}' is {lens.width}x{lens.height} px with a focal length of "
            f"{lens.fx:g} px; sizes and focal lengths must be positive, and all numbers finite"
        )
    return lens


def _common_folder(pictures: Mapping[str, Path]) -> Path:
    """Return the folder that holds all pictures, some of them perhaps in its sub-folders."""
    return Path(os.path.commonpath([path.parent for path in pictures.values()]))

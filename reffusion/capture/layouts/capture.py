"""The data types into which every layout of a scene folder is read, and functions that its readers share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from reffusion.capture.layouts.unread import refuse_without_pictures
from reffusion.capture.lens import Lens, from_colmap
from reffusion.capture.names import list_pictures, name_views, normalize_path
from reffusion.io.colmap import ModelCamera
from reffusion.io.files import BadInput
from reffusion.io.images import image_size

PointCloud = tuple[np.ndarray, np.ndarray]  # positions [P, 3] float64 and colors [P, 3] uint8
NO_POINTS: PointCloud = (np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


@dataclass(frozen=True)
class Poses:
    """Cameras and sparse points in the scene's own frame.

    Attributes:
        lenses: view name -> lens, at the size of the view's picture file (from structure from motion: of the reduced
            picture).
        world_to_camera: view name -> [4, 4] float64, rigid; the camera looks along +z, x right, y down.
        points, colors: [P, 3] float64 positions and [P, 3] uint8 colors of sparse points; P may be 0.
        bounds: view name -> (near, far) depth; empty if the layout has none.
    """

    lenses: dict[str, Lens]
    world_to_camera: dict[str, np.ndarray]
    points: np.ndarray
    colors: np.ndarray
    bounds: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class Capture:
    """The contents of a scene folder.

    Attributes:
        layout: one of `load.LAYOUTS`.
        pictures: view name -> picture file, sorted by path. Either all of them have poses, or none.
        paths: name of a view, or path of a picture that is left out -> the paths by which its mask file may be named.
            Pictures that are left out are listed so that their masks are not refused.
        poses: cameras and sparse points; None if structure from motion has to find them.
        pose_source: the file from which the poses were read, for messages; None without poses.
        label_folder: the folder whose sub-folders `label` and `test_label` are searched for masks and test masks. It is
            the folder of the pictures, or of the same pictures at another size.
        warnings: sentences for the user.
        test: names of the views that the layout itself holds out (Blender's transforms_test.json, or `test_filenames`).
        unused: names of the views that are in neither of the layout's own lists of training and test views.
        ignore_masks: view name -> the mask file that the layout names for the view. Such a mask is black where training
            should ignore the picture.
        depth_maps: files of depth maps from which points may be made.
        upright: True if EXIF orientation tags are obeyed: for photographs without poses, and where the poses are those
            of the turned pictures. Other poses refer to the stored pixels.
    """

    layout: str
    pictures: dict[str, Path]
    paths: dict[str, tuple[str, ...]]
    poses: Poses | None
    pose_source: Path | None
    label_folder: Path
    warnings: tuple[str, ...]
    test: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()
    ignore_masks: dict[str, Path] = field(default_factory=dict)
    depth_maps: tuple[Path, ...] = ()
    upright: bool = False


@dataclass(frozen=True)
class Correction:
    """A mistake in the poses of a capture, and how to undo it (`reffusion.capture.checks.agreement`).

    Attributes:
        cause: the mistake, as a part of a sentence.
        poses: function from the given world-to-camera poses to the right ones, view name -> [4, 4]. Views whose pose is
            lost are missing from the result.
        upright: True if the poses are those of photographs turned by their EXIF orientation.
    """

    cause: str = "none"
    poses: Callable[[Mapping[str, np.ndarray]], dict[str, np.ndarray]] = dict
    upright: bool = False

    def apply(self, given: Poses) -> Poses:
        """Return the cameras with corrected poses, without the views whose pose is lost."""
        poses = self.poses(given.world_to_camera)
        lenses = {name: given.lenses[name] for name in poses}
        bounds = {name: given.bounds[name] for name in poses if name in given.bounds}
        return replace(given, world_to_camera=poses, lenses=lenses, bounds=bounds)


AS_GIVEN = Correction()


def find_pictures(folder: Path, nested: bool = False) -> dict[str, Path]:
    """Return view name -> picture file in a folder, sorted by path (`list_pictures`); empty if there is no such folder.

    Args:
        nested: True to include pictures in sub-folders.

    Raises:
        BadInput: two pictures have the same view name.
    """
    return {name: folder / path for name, path in name_views(list_pictures(folder, nested)).items()}


def has_pictures(folder: Path, nested: bool = False) -> bool:
    """Return whether a folder holds pictures. `nested`: sub-folders count too, see `list_pictures`."""
    return bool(list_pictures(folder, nested))


def relative_paths(folder: Path, pictures: dict[str, Path]) -> dict[str, tuple[str, ...]]:
    """Return the `Capture.paths` of pictures in a folder.

    For each view these are the picture's path relative to `folder`, and the view's name with the picture's ending.

    Args:
        pictures: view name -> picture file.
    """
    below = {name: normalize_path(path.relative_to(folder).as_posix()) for name, path in pictures.items()}
    return {name: (path, name + Path(path).suffix) for name, path in below.items()}


def find_image_folder(folder: Path, images: str | None, usual: tuple[str, ...]) -> Path:
    """Return the folder of a scene's pictures.

    Without `images`, this is the first usual folder that holds pictures and has a sub-folder `label` (masks), else the
    first one that holds pictures. Pictures in sub-folders count, except in sub-folders of the scene's own folder ("."),
    which hold masks and other files.

    Args:
        folder: the scene's folder.
        images: folder of pictures that scene.yaml names, relative to the scene; it is returned unchecked. None if not
            named.
        usual: the layout's usual folders, in order of preference.

    Raises:
        BadInput: no usual folder holds pictures.
    """
    if images is not None:
        return folder / images
    folders = [folder / name for name in usual if has_pictures(folder / name, nested=name != ".")]
    if not folders:
        raise refuse_without_pictures(folder, usual)
    return next((path for path in folders if (path / "label").is_dir()), folders[0])


def lens_from_model(camera: ModelCamera, source: Path) -> Lens:
    """Convert a camera of a COLMAP model to a lens.

    Args:
        source: the file from which the camera was read, for messages.

    Raises:
        BadInput: the camera's model (its kind of lens) is not supported.
    """
    try:
        return from_colmap(camera.model, camera.width, camera.height, camera.params)
    except BadInput as error:
        raise BadInput(f"{source}: {error}") from None


def resize_lens(lens: Lens, picture: Path) -> Lens:
    """Return the lens, resized to a picture file, or to the picture turned by its EXIF orientation if only that fits.

    Raises:
        BadInput: the aspect ratios differ by more than 2%, whether the picture is turned or not.
    """
    sizes = [image_size(picture), image_size(picture, upright=True)]
    for width, height in sizes:
        if abs(width * lens.height - height * lens.width) <= 0.02 * width * lens.height:
            return lens.resized(width, height)
    width, height = sizes[0]
    raise BadInput(
        f"{picture}: {width}x{height} px, but its camera is for {lens.width}x{lens.height}; "
        "other proportions: the picture was cropped or turned after its pose was found"
    )


def nearest_rigid(matrix: np.ndarray, name: str, source: Path) -> np.ndarray:
    """Return a pose [4, 4] with its rotation part replaced by the nearest rotation; the translation stays.

    Args:
        matrix: [4, 4], a pose with rounding errors, or with a uniform scale of its rotation part, which is dropped.
        name, source: the view and the file of the pose, for messages.

    Raises:
        BadInput: the matrix is not finite, mirrors, stretches some axis by over 2% more than another (shears count
            too), or scales to zero.
    """
    if not np.isfinite(matrix).all():
        raise BadInput(f"{source}: the pose of '{name}' is not finite; remove the view or solve its pose again")
    u, stretch, v = np.linalg.svd(matrix[:3, :3])
    if np.linalg.det(u @ v) < 0 or stretch[0] > 1.02 * stretch[2] or stretch[2] < 1e-6:
        raise BadInput(f"{source}: the pose of '{name}' is no rotation; solve its pose again")
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = u @ v, matrix[:3, 3]
    return result


def invert_pose(pose: np.ndarray) -> np.ndarray:
    """Return the inverse of a rigid pose [4, 4]."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
    return result


def count_message(what: str, names: list[str]) -> str | None:
    """Return a message such as `2 pictures are left out: a, b`, with `what` after the number; None for no names."""
    return f"{len(names)} {what}: {', '.join(names)}" if names else None

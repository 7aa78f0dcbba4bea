"""What every layout is read into, and what the readers share."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from reffusion.capture.lens import Lens, from_colmap
from reffusion.capture.names import list_pictures, name_views, normalize_path
from reffusion.io.colmap import ModelCamera
from reffusion.io.files import BadInput
from reffusion.io.images import image_size

PointCloud = tuple[np.ndarray, np.ndarray]  # positions [P, 3] float64 and colours [P, 3] uint8
NO_POINTS: PointCloud = (np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


@dataclass(frozen=True)
class Poses:
    """Cameras in the scene's own frame.

    Attributes:
        lenses: view name -> lens at the size of the view's picture file.
        world_to_camera: view name -> [4, 4] float64, rigid; the camera looks along +z, x right, y down.
        points, colors: [P, 3] float64 and uint8; P may be 0.
        bounds: view name -> (near, far) depths; empty where the layout has none.
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
        layout: llff, colmap, transforms or photos.
        pictures: view name -> picture file, in the order of the files' paths; all of them have poses, if any has.
        paths: name of a view, or of one that is left out -> the paths by which its mask may call it.
        poses: None where structure from motion has to find them.
        pose_source: the file the poses come from, for messages; None without poses.
        label_folder: where masks (`label`) and test masks (`test_label`) are looked for: the pictures' folder, or that
            of the same pictures at another size.
        warnings: sentences for the user.
        test: names of the views that the layout itself holds out (Blender's transforms_test.json).
        depth_maps: files that points may be made from.
        ignore_masks: view name -> the mask that the layout names for it, black where training ignores the picture.
    """

    layout: str
    pictures: dict[str, Path]
    paths: dict[str, tuple[str, ...]]
    poses: Poses | None
    pose_source: Path | None
    label_folder: Path
    warnings: tuple[str, ...]
    test: tuple[str, ...] = ()
    ignore_masks: dict[str, Path] = field(default_factory=dict)
    depth_maps: tuple[Path, ...] = ()

    @property
    def upright(self) -> bool:
        """Are orientation tags obeyed? Poses that come along refer to the stored pixels instead."""
        return self.layout == "photos"


def find_pictures(folder: Path, nested: bool = False) -> dict[str, Path]:
    """View name -> picture, in the order of their paths (`list_pictures`); empty where the folder does not exist.

    Raises:
        BadInput: two pictures have the same view name.
    """
    return {name: folder / path for name, path in name_views(list_pictures(folder, nested)).items()}


def has_pictures(folder: Path, nested: bool = False) -> bool:
    return bool(list_pictures(folder, nested))


def relative_paths(folder: Path, pictures: dict[str, Path]) -> dict[str, tuple[str, ...]]:
    """`Capture.paths` of pictures in a folder: their relative paths, and their views' names with the endings."""
    below = {name: normalize_path(path.relative_to(folder).as_posix()) for name, path in pictures.items()}
    return {name: (path, name + Path(path).suffix) for name, path in below.items()}


def find_image_folder(folder: Path, images: str | None, usual: tuple[str, ...]) -> Path:
    """The named folder; else the first usual one that holds pictures, preferring one with a `label` folder inside.

    Pictures may lie in sub-folders, except in those of the scene's own folder, which holds masks and more.
    """
    if images is not None:
        return folder / images
    folders = [folder / name for name in usual if has_pictures(folder / name, nested=name != ".")]
    if not folders:
        raise BadInput(f"{folder}: no pictures in {', '.join(usual)}; name their folder as `images` in scene.yaml")
    return next((path for path in folders if (path / "label").is_dir()), folders[0])


def lens_from_model(camera: ModelCamera, source: Path) -> Lens:
    """`from_colmap`, for a camera in the file `source`."""
    try:
        return from_colmap(camera.model, camera.width, camera.height, camera.params)
    except BadInput as error:
        raise BadInput(f"{source}: {error}") from None


def resize_lens(lens: Lens, picture: Path) -> Lens:
    """The lens at the size of the picture file; BadInput where the two have different proportions."""
    width, height = image_size(picture)
    if abs(width * lens.height - height * lens.width) > 0.02 * width * lens.height:
        raise BadInput(
            f"{picture}: {width}x{height} px, but its camera is for {lens.width}x{lens.height}; "
            "other proportions: the picture was cropped or turned after its pose was found"
        )
    return lens.resized(width, height)


def nearest_rigid(matrix: np.ndarray, name: str, source: Path) -> np.ndarray:
    """[4, 4] with the nearest rotation; BadInput where the matrix is not finite, or mirrors, shears or scales."""
    if not np.isfinite(matrix).all():
        raise BadInput(f"{source}: the pose of '{name}' is not finite; remove the view or solve its pose again")
    u, stretch, v = np.linalg.svd(matrix[:3, :3])
    if np.linalg.det(u @ v) < 0 or stretch[0] > 1.02 * stretch[2] or stretch[2] < 1e-6:
        raise BadInput(f"{source}: the pose of '{name}' is no rotation; solve its pose again")
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = u @ v, matrix[:3, 3]
    return result


def invert_pose(pose: np.ndarray) -> np.ndarray:
    """Inverse of a rigid pose [4, 4]."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
    return result


def count_message(what: str, names: list[str]) -> str | None:
    """`17 of the ... : a, b, c`, or None for no names."""
    return f"{len(names)} {what}: {', '.join(names)}" if names else None

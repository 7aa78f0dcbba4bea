"""Reading and writing of the files that stages hand on: scenes, views, masks and references.

The stage `poses` writes images/<view>.png, ignored/<view>.png, sparse/0/*.bin, transform.json, views.json and
lenses.json. The stage `raw_masks` writes masks/<view>.png (or masks/<object>/<view>.png if the scene has masks of
several objects), test_masks/<view>.png and fill/<view>.png. Terms of masks are explained in `reffusion.types.MaskSet`.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reffusion.io.arrays import load_json, load_labels, save_json
from reffusion.io.colmap import ModelCamera, ModelImage, load_cameras, load_images, load_model_points, save_model
from reffusion.io.images import load_exr, load_image, load_mask, save_exr, save_image, save_mask

if TYPE_CHECKING:
    from torch import Tensor

    from reffusion.types import MaskSet, Reference, Scene

WARNINGS = "warnings.json"  # in the folder of a stage: sentences about what looks wrong in its input
IGNORED = "ignored"  # in the folder of `poses`: masks of the pixels of a photograph that neither train nor are filled
PIXEL_CLASSES = ("raw", "consistent", "unobserved", "invent")


def save_scene(poses_dir: Path, scene: Scene) -> None:
    """Write a scene as sparse/0/*.bin, transform.json and views.json; pictures are not written.

    The cameras in sparse/0/ are of COLMAP's model PINHOLE, in the normalized frame. transform.json holds the
    similarity. views.json holds the names of training, test and clean views (clean: without the object), and of
    camera-only views, suspects and outliers if there are any (`reffusion.types.Scene`).
    """
    poses_dir = Path(poses_dir)
    cameras, images = {}, {}
    for identity, camera in enumerate(scene.cameras.values(), start=1):
        params = (camera.fx, camera.fy, camera.cx, camera.cy)
        cameras[identity] = ModelCamera("PINHOLE", camera.width, camera.height, params)
        images[identity] = ModelImage(f"{camera.name}.png", identity, camera.world_to_camera)
    save_model(poses_dir / "sparse" / "0", cameras, images, scene.points, scene.point_colors)
    similarity = {"scale": float(scene.similarity.scale), "offset": [float(v) for v in scene.similarity.offset]}
    save_json(poses_dir / "transform.json", similarity)
    views = {"train": list(scene.train), "test": list(scene.test), "clean": sorted(scene.clean)}
    more = {"cameras_only": scene.camera_only, "suspects": scene.suspects, "outliers": scene.outliers}
    views |= {key: list(names) for key, names in more.items() if names}
    save_json(poses_dir / "views.json", views)


def load_scene(poses_dir: Path) -> Scene:
    """Read the scene that the stage `poses` wrote, in the normalized frame.

    Raises:
        ValueError: a file is missing or wrong; the message names it.
    """
    from reffusion.types import Camera, Scene, Similarity

    poses_dir = Path(poses_dir)
    model = poses_dir / "sparse" / "0"
    for path in (model / f"{stem}.bin" for stem in ("cameras", "images", "points3D")):
        if not path.is_file():
            raise ValueError(f"{path}: missing; {poses_dir} is no finished `poses` folder")
    intrinsics, cameras = load_cameras(model / "cameras.bin"), {}
    for image in load_images(model / "images.bin").values():
        name, shared = image.name.rsplit(".", 1)[0], intrinsics[image.camera_id]
        if shared.model != "PINHOLE":
            raise ValueError(f"{model / 'cameras.bin'}: {shared.model}; `poses` writes PINHOLE cameras only")
        fx, fy, cx, cy = shared.params
        cameras[name] = Camera(name, shared.width, shared.height, fx, fy, cx, cy, image.world_to_camera)
    points = load_model_points(model / "points3D.bin")
    views, similarity = load_json(poses_dir / "views.json"), load_json(poses_dir / "transform.json")
    return Scene(
        cameras={name: cameras[name] for name in sorted(cameras)},
        train=tuple(views["train"]),
        test=tuple(views["test"]),
        clean=frozenset(views["clean"]),
        points=points.positions,
        point_colors=points.colors,
        similarity=Similarity(similarity["scale"], np.array(similarity["offset"], np.float64)),
        camera_only=tuple(views.get("cameras_only", ())),
        suspects=tuple(views.get("suspects", ())),
        outliers=tuple(views.get("outliers", ())),
    )


def load_views(poses_dir: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Read the undistorted pictures of views as a dict name -> uint8 [H, W, 3]; raises BadInput if one is missing."""
    return {name: load_image(Path(poses_dir) / "images" / f"{name}.png") for name in names}


def load_ignored(poses_dir: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Read which pixels of the named views are ignored, as a dict view name -> bool [H, W].

    Ignored pixels show what passes by or moves with the camera. They neither train nor are filled. A view that ignores
    nothing has no entry.
    """
    files = {name: Path(poses_dir) / IGNORED / f"{name}.png" for name in names}
    return {name: load_mask(file) for name, file in files.items() if file.is_file()}


def has_photograph(poses_dir: Path, name: str) -> bool:
    """Return whether the stage `poses` wrote a picture of the view; camera-only views have none.

    In a scene without photographs no view has one, and later stages use renders of its Gaussians instead.
    """
    return (Path(poses_dir) / "images" / f"{name}.png").exists()


def save_warnings(folder: Path, messages: Sequence[str]) -> None:
    """Print the warnings of a stage, and write them to warnings.json in its folder if there are any."""
    for line in messages:
        warnings.warn(line, stacklevel=1)
    # `make check` reads this file. A run in which the stage is cached prints its warnings again.
    if messages:
        save_json(Path(folder) / WARNINGS, list(messages))


def load_warnings(folder: Path) -> list[str]:
    """Read the warnings that a stage left in its folder, a sentence each; empty if there are none."""
    path = Path(folder) / WARNINGS
    return load_json(path) if path.is_file() else []


def list_objects(raw_masks_dir: Path) -> list[str]:
    """Return the sorted names of the objects that have masks of their own, masks/<object>/.

    The list is empty if the masks do not distinguish between objects.
    """
    return sorted(path.name for path in (Path(raw_masks_dir) / "masks").glob("[!.]*") if path.is_dir())


def raw_mask_files(raw_masks_dir: Path, name: str, objects: Sequence[str] | None = None) -> list[Path]:
    """Return the paths of a view's raw masks that exist.

    Args:
        raw_masks_dir: folder of the stage `raw_masks`.
        name: the view.
        objects: names of the objects whose masks are returned, if objects have masks of their own; None: all objects.

    Returns:
        One file for each of these objects that has a mask in the view, or masks/<view>.png if objects have no masks of
        their own; empty if the view has no mask.
    """
    folder = Path(raw_masks_dir) / "masks"
    found_objects = list_objects(raw_masks_dir) if objects is None else objects
    return [path for path in (folder / thing / f"{name}.png" for thing in found_objects or [""]) if path.is_file()]


def load_raw_masks(
    raw_masks_dir: Path, names: Iterable[str], objects: Sequence[str] | None = None
) -> dict[str, np.ndarray]:
    """Read the raw masks of views as a dict view name -> bool [H, W], True = the object.

    If objects have masks of their own, a view's mask is the union of those of `objects`.

    Args:
        raw_masks_dir: folder of the stage `raw_masks`.
        names: the views.
        objects: names of the objects; None: all.

    Returns:
        Only views that have a mask are keys; if objects have masks of their own, only views that have a mask of each
        of `objects`.
    """
    objects = list_objects(raw_masks_dir) if objects is None else objects
    files = {name: raw_mask_files(raw_masks_dir, name, objects) for name in names}
    found = {name: paths for name, paths in files.items() if len(paths) == max(len(objects), 1)}
    return {name: np.logical_or.reduce([load_mask(path) for path in paths]) for name, paths in found.items()}


def load_fill_masks(raw_masks_dir: Path) -> dict[str, np.ndarray]:
    """Read the fill masks: the pixels that the scene asks to fill, whatever the photographs show there.

    Returns:
        Training view name -> bool [H, W], True = to be filled; empty if the scene has no such masks.
    """
    return {path.stem: load_mask(path) for path in sorted((Path(raw_masks_dir) / "fill").glob("*.png"))}


def save_mask_sets(masks_dir: Path, sets: Mapping[str, MaskSet]) -> None:
    """Write the pixel classes of each view as raw/, consistent/, unobserved/ and invent/<view>.png."""
    for name, mask_set in sets.items():
        for kind in PIXEL_CLASSES:
            save_mask(Path(masks_dir) / kind / f"{name}.png", getattr(mask_set, kind))


def load_mask_sets(masks_dir: Path, names: Iterable[str]) -> dict[str, MaskSet]:
    """Read the pixel classes that the stage `masks` wrote for the named views, as a dict view name -> MaskSet."""
    from reffusion.types import MaskSet

    load = lambda kind, name: load_mask(Path(masks_dir) / kind / f"{name}.png")
    return {name: MaskSet(*(load(kind, name) for kind in PIXEL_CLASSES)) for name in names}


def has_object_mask(raw_masks_dir: Path, masks_dir: Path | None, name: str) -> bool:
    """Return whether the view has a raw mask that the user gave, empty or not, or a non-empty one made from clicks.

    Args:
        raw_masks_dir: folder of the stage `raw_masks`, which holds the given masks.
        masks_dir: folder of the stage `masks`, which makes masks from clicks; None if the stage was skipped.
        name: the view.
    """
    if raw_mask_files(raw_masks_dir, name) or masks_dir is None:
        return bool(raw_mask_files(raw_masks_dir, name))
    made = Path(masks_dir) / "raw" / f"{name}.png"
    return made.is_file() and bool(load_mask(made).any())


def load_object_labels(masks_dir: Path) -> Tensor:
    """Read which Gaussians are the object, as bool [N] on the CPU.

    The stage `masks` also labels debris for removal: Gaussians that the object had hidden and that the photographs
    contradict. Debris is False here.
    """
    labels, debris = load_labels(masks_dir / "labels.npy"), masks_dir / "debris.npy"
    return labels & ~load_labels(debris) if debris.exists() else labels


def save_references(reference_dir: Path, references: Sequence[Reference]) -> None:
    """Write references as references/<view>.png and masks/<view>.png, and depth/<view>.exr if a reference has depth."""
    for reference in references:
        name = f"{reference.camera.name}.png"
        save_image(Path(reference_dir) / "references" / name, reference.image)
        save_mask(Path(reference_dir) / "masks" / name, reference.mask)
        if reference.depth is not None:
            save_exr(_depth_file(reference_dir, reference.camera.name), reference.depth)


def save_teaching(reference_dir: Path, pictures: Mapping[str, np.ndarray]) -> None:
    """Write pictures that only personalize the prior, uint8 [H, W, 3] each, as teaching/<name>.png."""
    for name, picture in pictures.items():
        save_image(Path(reference_dir) / "teaching" / f"{name}.png", picture)


def load_teaching(reference_dir: Path) -> list[np.ndarray]:
    """Read the pictures that `save_teaching` wrote, uint8 [H, W, 3] each, sorted by name; empty if there are none."""
    return [load_image(path) for path in sorted((Path(reference_dir) / "teaching").glob("*.png"))]


def _depth_file(reference_dir: Path, view: str) -> Path:
    return Path(reference_dir) / "depth" / f"{view}.exr"


def load_references(reference_dir: Path, scene: Scene) -> list[Reference]:
    """Read the references that `save_references` wrote, sorted by view name; empty if there are none.

    Raises:
        ValueError: a reference belongs to no view of the scene or has no mask, or its picture, mask or depth is not of
            the view's size. The message names the picture's file.
    """
    from reffusion.types import Reference

    found = []
    for path in sorted((Path(reference_dir) / "references").glob("*.png")):
        camera = scene.cameras.get(path.stem)
        if camera is None:
            raise ValueError(f"{path}: the scene has no view '{path.stem}'")
        image, mask = load_image(path), load_mask(Path(reference_dir) / "masks" / path.name)
        depth_file = _depth_file(reference_dir, path.stem)
        depth = load_exr(depth_file) if depth_file.is_file() else None
        shapes = {image.shape[:2], mask.shape, mask.shape if depth is None else depth.shape}
        if shapes != {(camera.height, camera.width)}:
            raise ValueError(
                f"{path}: it, its mask and its depth must have their view's size {camera.width}x{camera.height}"
            )
        found.append(Reference(camera, image, mask, depth))
    return found

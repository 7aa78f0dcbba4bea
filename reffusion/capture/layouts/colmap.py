"""A COLMAP model beside its pictures."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from reffusion.capture.layouts.capture import (
    NO_POINTS,
    Capture,
    Poses,
    counted,
    fitted,
    image_folder_of,
    lens_of,
    pictures_in,
)
from reffusion.io.colmap import is_model, load_cameras, load_images, load_model_points, model_file
from reffusion.io.files import BadInput

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap", ".")


def model_folder(folder: Path) -> Path | None:
    return next((folder / name for name in MODEL_FOLDERS if is_model(folder / name)), None)


def read(folder: Path, images: str | None) -> Capture:
    """See `load_capture`."""
    model = model_folder(folder)
    if model is None:
        raise BadInput(f"{folder}: no COLMAP model (cameras and images, .bin or .txt) in {', '.join(MODEL_FOLDERS)}")
    image_folder = image_folder_of(folder, images, ("images", "images_2", "images_4", "."))
    return from_model(folder, model, image_folder, "colmap", image_folder)


def from_model(folder: Path, model: Path, image_folder: Path, layout: str, label_folder: Path) -> Capture:
    """Pictures matched to the model's images by name without ending; failing that, by order where the counts agree."""
    source = model_file(model, "images")
    registered = sorted(load_images(source).values(), key=lambda image: image.name)
    stems = Counter(Path(image.name).stem for image in registered)
    if twice := [stem for stem, count in stems.items() if count > 1]:
        raise BadInput(f"{source}: two images are called '{twice[0]}', but for their endings or folders; rename one")
    by_name = {Path(image.name).stem: Path(image.name) for image in registered}
    images = {Path(image.name).stem: image for image in registered}
    found = _pictures_of_model(image_folder, by_name)
    if not found.keys() & images.keys() and len(found) == len(images):
        # LLFF's downscaled copies are renamed image000.png, image001.png, ...: the order is all that is left.
        images = dict(zip(found, (images[name] for name in sorted(images)), strict=True))
    pictures = {name: path for name, path in found.items() if name in images}
    if not pictures:
        raise BadInput(f"{source}: none of its images is in {image_folder}; name their folder as `images`")
    camera_file = model_file(model, "cameras")
    cameras = load_cameras(camera_file)
    lenses, poses = {}, {}
    for name, path in pictures.items():
        camera = cameras.get(images[name].camera_id)
        if camera is None:
            raise BadInput(f"{source}: the camera {images[name].camera_id} of '{name}' is missing in the model")
        lenses[name] = fitted(lens_of(camera, camera_file), path)
        poses[name] = images[name].world_to_camera
    file = model_file(model, "points3D")
    points = load_model_points(file) if file else None
    brought = (points.positions, points.colors) if points else NO_POINTS
    warnings = (
        counted("images of the model have no picture", sorted(images.keys() - found.keys())),
        counted("pictures are not in the model and are left out", sorted(found.keys() - images.keys())),
    )
    return Capture(
        layout,
        pictures,
        Poses(lenses, poses, *brought, {}),
        source,
        label_folder,
        frozenset(images.keys() ^ found.keys()),
        tuple(filter(None, warnings)),
    )


def read_cameras(model: Path) -> Poses:
    """The lenses and poses alone, of a model whose pictures are not there."""
    source, camera_file = model_file(model, "images"), model_file(model, "cameras")
    images = {Path(image.name).stem: image for image in load_images(source).values()}
    cameras = load_cameras(camera_file)
    if lost := [name for name, image in images.items() if image.camera_id not in cameras]:
        raise BadInput(f"{source}: the camera of '{lost[0]}' is missing in the model")
    names = sorted(images)
    lenses = {name: lens_of(cameras[images[name].camera_id], camera_file) for name in names}
    return Poses(lenses, {name: images[name].world_to_camera for name in names}, *NO_POINTS, {})


def _pictures_of_model(image_folder: Path, by_name: dict[str, Path]) -> dict[str, Path]:
    """Pictures of the folder; those that the model names in sub-folders are found there."""
    if all(len(path.parts) == 1 for path in by_name.values()):
        return pictures_in(image_folder)
    return {name: image_folder / path for name, path in by_name.items() if (image_folder / path).is_file()}

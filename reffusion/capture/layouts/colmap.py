"""Reads a capture in the layout "colmap": a COLMAP model (cameras, images, points3D) and its pictures."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from reffusion.capture.checks.sparse_points import are_tracks_inside, keep_points_in_frame
from reffusion.capture.layouts.capture import (
    AS_GIVEN,
    NO_POINTS,
    Capture,
    Correction,
    PointCloud,
    Poses,
    count_message,
    find_image_folder,
    has_pictures,
    lens_from_model,
    relative_paths,
    resize_lens,
)
from reffusion.capture.names import list_pictures, name_views, normalize_path, pair_pictures, shorten_path
from reffusion.io.colmap import ModelImage, is_model, load_cameras, load_images, load_model_points, model_file
from reffusion.io.files import BadInput, is_file, reading

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap", ".")
# Lists of the test pictures, beside the model or in the scene's folder: of 3DGS, of its forks, and of ScanNet++
TEST_LISTS = ("test.txt", "test_list.txt", "train_test_lists.json")
USUAL = ("images", "images_2", "images_4", ".")  # usual folders of pictures
RENAMED = re.compile(r"image\d+")  # names of LLFF's reduced copies, numbered in the order of the originals' names


def find_model(folder: Path) -> Path | None:
    """Return the folder of the scene's COLMAP model with the most images, the first of equals; None without a model."""
    return max(found, key=found.__getitem__) if (found := _count_images(folder)) else None


def find_workspace(folder: Path) -> Path | None:
    """Return the folder in which COLMAP put undistorted pictures with their model; None without one.

    The folder has sub-folders `images` and `sparse`, as dense/0 of an automatic reconstruction. The result is also None
    if the scene has another model and pictures in a usual folder. Of several folders the one with most pictures counts.
    """
    found = [
        path for path in (folder / "dense", *sorted((folder / "dense").glob("[0-9]*"))) if is_model(path / "sparse")
    ]
    sizes = {path: len(list_pictures(path / "images", nested=True)) for path in found}
    if not any(sizes.values()):
        return None
    if find_model(folder) is not None and any(has_pictures(folder / name) for name in USUAL):
        return None
    return max(sizes, key=sizes.__getitem__)


def other_models(folder: Path, model: Path) -> str | None:
    """Return a message to the user about the COLMAP models that are not used; None if `model` is the only one."""
    found = _count_images(folder)
    others = [f"{shorten_path(path, folder)} ({count})" for path, count in found.items() if path != model]
    if not others or model not in found:
        return None
    return f"{shorten_path(model, folder)} is taken, which has most images ({found[model]}); not {', '.join(others)}"


def _count_images(folder: Path) -> dict[Path, int]:
    """Return model folder -> number of images for all COLMAP models of a scene; 0, not counted, for a single model."""
    numbered = sorted(path for place in ("sparse", "colmap/sparse") for path in (folder / place).glob("[0-9]*"))
    places = dict.fromkeys([*(folder / name for name in MODEL_FOLDERS), *numbered])
    models = [place for place in places if is_model(place)]
    if len(models) < 2:
        return dict.fromkeys(models, 0)
    return {model: len(load_images(_files(model)[0])) for model in models}


def _files(model: Path) -> tuple[Path, Path]:
    """Return the files of images and of cameras of a model; both exist in a model (`is_model`)."""
    images, cameras = model_file(model, "images"), model_file(model, "cameras")
    assert images is not None and cameras is not None
    return images, cameras


def read(folder: Path, images: str | None, correction: Correction = AS_GIVEN) -> Capture:
    """Read a scene folder with a COLMAP model.

    Args:
        images: folder of pictures, relative to the scene; None for the usual folders.
        correction: what is changed in the poses.

    Raises:
        BadInput: there is no model; the usual folders hold no pictures; or as for `capture_from_model`.
    """
    model, workspace = find_model(folder), find_workspace(folder)
    if workspace is not None and images is None:
        pictures = workspace / "images"
        return capture_from_model(folder, workspace / "sparse", pictures, "colmap", pictures, correction)
    if model is None:
        raise BadInput(f"{folder}: no COLMAP model (cameras and images, .bin or .txt) in {', '.join(MODEL_FOLDERS)}")
    image_folder = find_image_folder(folder, images, USUAL)
    return capture_from_model(folder, model, image_folder, "colmap", image_folder, correction)


def capture_from_model(
    folder: Path, model: Path, image_folder: Path, layout: str, label_folder: Path, correction: Correction = AS_GIVEN
) -> Capture:
    """Return the capture of a COLMAP model whose images are paired with picture files.

    Pairs are found by paths (`pair_pictures`). LLFF's renamed copies (`image000.png` and so on) are paired by order if
    there are as many as images in the model and none has an image's name. Images without a picture and pictures without
    an image are left out, and so are the model's points if they are not in the frame of its cameras. `Capture.warnings`
    tells all of this.

    Args:
        folder: the scene's folder.
        model: the model's folder.
        image_folder: the folder of the pictures.
        layout, label_folder: see `Capture`.
        correction: what is changed in the poses.

    Raises:
        BadInput: no image has a picture; a camera is missing, its model is not supported, or it has another aspect
            ratio than the picture; or two images have the same name.
    """
    source, camera_file = _files(model)
    images, identities = _images_by_name(source)
    files = _pictures_of_model(folder, image_folder, list(images))
    pairs, warnings = pair_pictures({name: name for name in images}, files), [other_models(folder, model)]
    if not pairs and len(files) == len(images) and all(RENAMED.match(Path(f).name) for f in files):
        pairs = dict(zip(sorted(images), files, strict=True))
        warnings.append(f"{image_folder}: renamed pictures, paired with the images of {source.name} in order of names")
    if not pairs:
        raise BadInput(f"{source}: {_pairing_error(image_folder, list(images), files)}")
    views = name_views(pairs.values())
    of_file = {file: images[name] for name, file in pairs.items()}
    pictures = {view: image_folder / file for view, file in views.items()}
    cameras, lenses, poses = load_cameras(camera_file), {}, {}
    for view, file in views.items():
        camera = cameras.get(of_file[file].camera_id)
        if camera is None:
            raise BadInput(f"{source}: the camera {of_file[file].camera_id} of '{view}' is missing in the model")
        lenses[view] = resize_lens(lens_from_model(camera, camera_file), pictures[view])
        poses[view] = of_file[file].world_to_camera
    found = correction.apply(Poses(lenses, poses, *NO_POINTS, {}))
    points, point_warning = _points(
        model, found, pictures, {v: identities[of_file[views[v]].name] for v in found.lenses}
    )
    unplaced, lost = sorted(set(files) - set(pairs.values())), sorted(images.keys() - pairs.keys())
    warnings += [
        count_message("images of the model have no picture", [_stem(name) for name in lost]),
        count_message("pictures are not in the model and are left out", [_stem(file) for file in unplaced]),
        point_warning,
    ]
    paths = relative_paths(image_folder, pictures)
    paths = {view: (*paths[view], of_file[file].name) for view, file in views.items()}
    rest = {path: (path,) for path in (*lost, *unplaced)}
    test = _list_test_pictures((model, folder), list(views.values()))
    return Capture(
        layout,
        pictures,
        paths | rest,
        replace(found, points=points[0], colors=points[1]),
        source,
        label_folder,
        tuple(filter(None, warnings)),
        test=tuple(view for view, file in views.items() if file in test),
    )


def _list_test_pictures(folders: Iterable[Path], files: list[str]) -> set[str]:
    """Return the pictures among `files` that the first list of test pictures in `folders` names; empty without one."""
    places = [folder / name for folder in folders for name in TEST_LISTS]
    if (source := next((path for path in places if is_file(path)), None)) is None:
        return set()
    with reading(source, "a list of test pictures"):
        text = source.read_text(encoding="utf-8-sig")
        # a .json is ScanNet++'s list of the key "test"
        names = json.loads(text)["test"] if source.suffix == ".json" else text.splitlines()
        listed = {name.strip(): name.strip() for name in names if name.strip()}
    return set(pair_pictures(listed, files).values())


def _images_by_name(source: Path) -> tuple[dict[str, ModelImage], dict[str, int]]:
    """Read name -> image, and name -> image id; raises BadInput if two images have the same name."""
    images: dict[str, ModelImage] = {}
    identities: dict[str, int] = {}
    for identity, image in load_images(source).items():
        if image.name in images:
            raise BadInput(f"{source}: two images are called '{image.name}'; rename one")
        images[image.name], identities[image.name] = image, identity
    return images, identities


def _stem(path: str) -> str:
    return Path(normalize_path(path)).stem


def _pairing_error(image_folder: Path, images: list[str], files: list[str]) -> str:
    """Return the part of a message that says why no image of a model has a picture, and what would help."""
    if not files:
        return f"none of its images is in {image_folder}; name their folder as `images` in scene.yaml"
    ours, theirs = (", ".join(sorted(names)[:3]) for names in (files, images))
    return (
        f"none of its {len(images)} images ({theirs}, ...) is called like a picture in {image_folder} ({ours}, ...); "
        "name the right folder as `images` in scene.yaml, or give the pictures the names that the model has"
    )


def _points(
    model: Path, poses: Poses, pictures: dict[str, Path], identities: dict[str, int]
) -> tuple[PointCloud, str | None]:
    """Return a model's points, or no points and a message if they are not in the frame of its cameras."""
    file = model_file(model, "points3D")
    if file is None:
        return NO_POINTS, None
    found = load_model_points(file)
    by_id = {identity: (poses.lenses[v], poses.world_to_camera[v]) for v, identity in identities.items()}
    if not are_tracks_inside(found, by_id):
        return NO_POINTS, f"{file}: its points are not in the frame of the cameras and are not used"
    return keep_points_in_frame(file, (found.positions, found.colors), poses, pictures)


def read_cameras(model: Path) -> Poses:
    """Read the lenses and poses of a model without its pictures. The result has no points.

    Raises:
        BadInput: a file cannot be read; an image's camera is missing, or its camera model is not supported; or two
            images have the same name.
    """
    source, camera_file = _files(model)
    images, _ = _images_by_name(source)
    cameras = load_cameras(camera_file)
    if lost := [name for name, image in images.items() if image.camera_id not in cameras]:
        raise BadInput(f"{source}: the camera of '{lost[0]}' is missing in the model")
    views = {view: images[name] for view, name in name_views(list(images)).items()}
    lenses = {view: lens_from_model(cameras[image.camera_id], camera_file) for view, image in views.items()}
    return Poses(lenses, {view: image.world_to_camera for view, image in views.items()}, *NO_POINTS, {})


def _pictures_of_model(folder: Path, image_folder: Path, names: list[str]) -> list[str]:
    """Return the paths, relative to `image_folder`, of the pictures that the names of a model's images may mean."""
    loose = list_pictures(image_folder)
    in_folders = any("/" in normalize_path(name) for name in names)
    if image_folder.samefile(folder):
        # in the scene's own folder, of the pictures in sub-folders only those that the model names exactly
        named = [path for path in map(normalize_path, names) if "/" in path and (image_folder / path).is_file()]
        return sorted({*loose, *named})
    return list_pictures(image_folder, nested=True) if in_folders or not loose else loose

"""Reads a capture in the layout "llff": LLFF's poses_bounds.npy, as in SPIn-NeRF's scenes.

If the folder has a COLMAP model with images, poses are read from the model instead. A *partial model* without images
still gives the lens and the points. The folder holds the same pictures in several sizes, and the masks beside one of
these sizes (in SPIn-NeRF's scenes beside the quarter size).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from reffusion.capture.layouts.capture import (
    AS_GIVEN,
    NO_POINTS,
    Capture,
    Correction,
    PointCloud,
    Poses,
    find_image_folder,
    find_pictures,
    invert_pose,
    lens_from_model,
    nearest_rigid,
    relative_paths,
    resize_lens,
)
from reffusion.capture.layouts.colmap import capture_from_model, find_model
from reffusion.capture.lens import Lens
from reffusion.capture.normalized_frame import depths_in_view
from reffusion.io.arrays import load_array
from reffusion.io.colmap import load_cameras, load_model_points, model_file
from reffusion.io.files import BadInput, is_file
from reffusion.io.images import image_size

USUAL = ("images_4", "images_2", "images_8", "images")


def read(
    folder: Path,
    images: str | None,
    longest: int,
    references: frozenset[Path] = frozenset(),
    correction: Correction = AS_GIVEN,
) -> Capture:
    """Read a scene folder in this layout.

    Args:
        images: folder of pictures, relative to the scene; None to choose a size of the usual folders.
        longest: requested longer side of the pictures in pixels. The smallest size with at least as many is chosen,
            else the largest size.
        references: files of references (inpainted views), which are not views. References among the pictures are
            left out if the numbers of pictures and of rows in poses_bounds.npy differ.
        correction: what is changed in the poses.

    Raises:
        BadInput: there is neither poses_bounds.npy nor a COLMAP model; the numbers of poses and pictures differ; a pose
            is wrong; or, with a COLMAP model, as for `capture_from_model`.
    """
    source = folder / "poses_bounds.npy"
    label_folder = _label_folder(folder, images)
    image_folder, warnings = (folder / images, []) if images else _choose_image_folder(folder, label_folder, longest)
    model = find_model(folder)
    if model is not None:  # with its exact poses, distortion and points
        found = capture_from_model(folder, model, image_folder, "llff", label_folder, correction)
        return replace(found, warnings=(*warnings, *found.warnings))
    if not is_file(source):
        raise BadInput(f"{source}: missing, and there is no complete COLMAP model in {folder / 'sparse/0'}")
    pictures, rows = find_pictures(image_folder), _load_poses_bounds(source)
    if len(rows) != len(pictures):
        pictures = {name: path for name, path in pictures.items() if path not in references}
    if len(rows) != len(pictures):
        raise BadInput(
            f"{source}: {len(rows)} poses, but {image_folder} holds {len(pictures)} pictures; "
            "one pose a picture is needed, in the order of the file names"
        )
    lenses, poses, bounds = {}, {}, {}
    for row, (name, path) in zip(rows, pictures.items(), strict=True):
        columns, (height, width, focal) = row[:15].reshape(3, 5), row[[4, 9, 14]]
        lens = Lens(
            round(width), round(height), float(focal), float(focal), width / 2, height / 2, model="SIMPLE_PINHOLE"
        )
        lenses[name] = resize_lens(lens, path)
        camera_to_world = np.eye(4)
        # LLFF's columns are down, right, backwards.
        camera_to_world[:3] = np.stack([columns[:, 1], columns[:, 0], -columns[:, 2], columns[:, 3]], axis=1)
        poses[name] = invert_pose(nearest_rigid(camera_to_world, name, source))
        bounds[name] = float(row[15]), float(row[16])
    partial = folder / "sparse" / "0"
    lenses = _lens_of_partial_model(partial, lenses, pictures, warnings)
    right = correction.apply(Poses(lenses, poses, *NO_POINTS, bounds))
    points = _points_of_partial_model(partial, right.lenses, right.world_to_camera, right.bounds, warnings)
    right = replace(right, points=points[0], colors=points[1])
    paths = relative_paths(image_folder, pictures)
    return Capture("llff", pictures, paths, right, source, label_folder, tuple(warnings))


def _label_folder(folder: Path, images: str | None) -> Path:
    """Return the folder of pictures with masks in `label`: `images`, else a usual one, else as `find_image_folder`."""
    if images and (folder / images / "label").is_dir():
        return folder / images
    labelled = [folder / name for name in USUAL if (folder / name / "label").is_dir()]
    return labelled[0] if labelled else find_image_folder(folder, images, USUAL)


def _choose_image_folder(folder: Path, label_folder: Path, longest: int) -> tuple[Path, list[str]]:
    """Return the folder of the smallest pictures of at least `longest` px, else of the largest, and warnings."""
    # A folder counts only if it holds all pictures of `label_folder`, which has masks, under the same names.
    names, sizes, other = find_pictures(label_folder).keys(), {}, []
    for place in dict.fromkeys([label_folder, *(folder / name for name in USUAL)]):
        pictures = find_pictures(place) if place.is_dir() else {}
        if pictures and names <= pictures.keys():
            sizes[place] = max(image_size(next(iter(pictures.values()))))
        elif pictures:
            other.append(place)
    enough = {place: size for place, size in sizes.items() if size >= longest}
    chosen = min(enough, key=enough.__getitem__) if enough else max(sizes, key=sizes.__getitem__)
    if enough or not other:
        return chosen, []
    named = ", ".join(place.name for place in other)
    return chosen, [f"{named}: not the pictures of {label_folder.name} under the same names, so not used"]


def _load_poses_bounds(source: Path) -> np.ndarray:
    """Read poses_bounds.npy as [V, 17] float64; raises BadInput if its shape or its values are wrong."""
    # a row: 3x5 matrix (camera-to-world pose, column of height, width, focal length), near and far depth
    rows = load_array(source)
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise BadInput(f"{source}: {list(rows.shape)}, expected [views, 17] as LLFF writes it")
    if rows.dtype.kind not in "fiu":
        raise BadInput(f"{source}: {rows.dtype}, expected numbers as LLFF writes them")
    rows = rows.astype(np.float64)
    if not np.isfinite(rows).all():
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        raise BadInput(f"{source}: rows {bad.tolist()} are not finite; solve these poses again")
    if (rows[:, [4, 9, 14, 15]] <= 0).any() or (rows[:, 16] <= rows[:, 15]).any():
        raise BadInput(f"{source}: sizes, focal lengths and bounds must be positive, and far greater than near")
    return rows


def _lens_of_partial_model(
    model: Path, lenses: dict[str, Lens], pictures: dict[str, Path], warnings: list[str]
) -> dict[str, Lens]:
    """Return a partial model's lenses, else `lenses`; add to `warnings` if the focal lengths disagree."""
    file = model_file(model, "cameras") if model.is_dir() else None
    cameras = list(load_cameras(file).values()) if file else []
    if file is None or len(cameras) != 1:
        return lenses
    model_lens = lens_from_model(cameras[0], file)
    replaced = {name: resize_lens(model_lens, path) for name, path in pictures.items()}
    ratio = np.median([replaced[name].fx / lens.fx for name, lens in lenses.items()])
    if abs(ratio - 1) > 0.02:
        warnings.append(f"{file}: its focal length is {ratio:.3f} times that of poses_bounds.npy and is not used")
        return lenses
    return replaced


def _points_of_partial_model(
    model: Path,
    lenses: dict[str, Lens],
    poses: dict[str, np.ndarray],
    bounds: dict[str, tuple[float, float]],
    warnings: list[str],
) -> PointCloud:
    """Return a partial model's points, else none; add to `warnings` if points are not in the frame of the poses."""
    file = model_file(model, "points3D") if model.is_dir() else None
    if file is None:
        return NO_POINTS
    found = load_model_points(file)
    identities = np.unique(found.track_images)
    shares, needed = [], 0.2
    if len(identities) == len(poses):
        # Image ids in ascending order stand for the views in order of their names. 95% of the observed points must lie
        # inside the picture of the median view.
        needed = 0.95
        for identity, name in zip(identities, sorted(poses), strict=True):
            seen = found.positions[found.track_points[found.track_images == identity]]
            shares.append(len(depths_in_view(seen, poses[name], lenses[name])) / len(seen))
    else:
        # A fifth of all points must lie inside the picture of the median view. A view counts only if half of its points
        # lie about between its near and far depth.
        for name, (near, far) in bounds.items():
            z = depths_in_view(found.positions, poses[name], lenses[name])
            inside = ((z > 0.8 * near) & (z < 1.25 * far)).sum()
            shares.append(len(z) / max(len(found.positions), 1) if 2 * inside >= max(len(z), 1) else 0.0)
    if np.median(shares) < needed:
        warnings.append(f"{file}: its points are not in the frame of poses_bounds.npy and are not used")
        return NO_POINTS
    return found.positions, found.colors

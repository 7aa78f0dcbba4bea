"""Reads a scene folder in any of the layouts of `layouts/`, from SPIn-NeRF's to photographs only.

Every layout is read into a `Capture`: pictures by view name and, if the folder holds poses, lenses and poses in the
scene's own frame. Of pictures only headers are read, except for a few, whose colors are compared with the colors of
the sparse points, and pictures twice as wide as high.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from reffusion.capture.layouts import (
    bundler,
    colmap,
    llff,
    opensfm,
    photos,
    polycam,
    realitycapture,
    splat_cameras,
    transforms,
    unread,
)
from reffusion.capture.layouts.capture import AS_GIVEN, Capture, Correction
from reffusion.capture.layouts.intrinsics import check_intrinsics
from reffusion.capture.lens import Lens
from reffusion.io.files import BadInput, as_bad_input, is_file
from reffusion.io.images import image_size

# layouts of other programs -> (finds the file with the poses in a scene folder, reads the scene)
PROGRAMS = {
    "polycam": (polycam.find, polycam.read),
    "realitycapture": (realitycapture.find, realitycapture.read),
    "opensfm": (opensfm.find, opensfm.read),
    "bundler": (bundler.find, bundler.read),
    "3dgs": (splat_cameras.find, splat_cameras.read),
}
LAYOUTS = ("llff", "colmap", "transforms", *PROGRAMS, "photos")
FAR = 50  # times the median distance of cameras from their middle: a camera that is farther away has another unit
LONGEST = 1600  # px, longer side of the pictures in the paper


def load_capture(
    folder: Path,
    layout: str | None = None,
    images: str | None = None,
    longest: int = LONGEST,
    references: frozenset[Path] = frozenset(),
    correction: Correction = AS_GIVEN,
) -> Capture:
    """Read a scene folder: its pictures and, if it holds poses, its cameras and sparse points.

    Args:
        layout: one of LAYOUTS; None to detect the layout.
        images: folder of pictures, relative to the scene; None for the layout's usual folders.
        longest: requested longer side of the pictures in pixels. The layout "llff" may hold the same pictures in
            several sizes; the smallest size that is large enough is taken, else the largest size.
        references: files of references (inpainted views). They may lie among the photographs, but are not views.
        correction: what is changed in the poses. Views whose pose is lost are left out.

    Raises:
        BadInput: the folder is no capture, two pictures share a view name, a picture is unreadable, a pose is not
            finite or not a rotation, a lens is impossible (`check_intrinsics`), or the files contradict each other. The
            message names the file and the remedy.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise BadInput(f"{folder}: no such folder")
    layout = layout or detect_layout(folder)
    if layout not in LAYOUTS:
        raise BadInput(f"{folder}: unknown layout '{layout}'; one of {', '.join(LAYOUTS)}")
    if images is not None and not (folder / images).is_dir():
        raise BadInput(f"{folder / images}: no such folder; correct `images` in scene.yaml")
    with as_bad_input(_source(folder, layout), "a capture that can be read"):
        capture = _read(folder, layout, images, longest, references, correction)
        if capture.poses is not None and capture.pose_source is not None:
            check_intrinsics(capture.poses.lenses, capture.pose_source)
        return unread.add_warnings(folder, _warn_of_far_cameras(_restrict_to_poses(capture, correction)))


def _read(
    folder: Path,
    layout: str,
    images: str | None,
    longest: int,
    references: frozenset[Path],
    correction: Correction,
) -> Capture:
    if layout == "llff":
        return llff.read(folder, images, longest, references, correction)
    if layout == "photos":
        return photos.read(folder, images, references)
    if layout not in PROGRAMS:
        return (colmap if layout == "colmap" else transforms).read(folder, images, correction)
    find, read = PROGRAMS[layout]
    source = find(folder)
    if source is None:
        raise BadInput(f"{folder}: no file with poses of the layout {layout}; correct `layout` in scene.yaml")
    return read(folder, source, images, correction)


def _restrict_to_poses(capture: Capture, correction: Correction) -> Capture:
    """Return the capture without the views that lack a pose, and with `upright` set as the poses or correction need."""
    if capture.poses is None:
        return capture
    lenses = capture.poses.lenses
    pictures = {name: path for name, path in capture.pictures.items() if name in lenses}
    turned = any(_fits_turned_only(path, lenses[name]) for name, path in pictures.items())
    return replace(capture, pictures=pictures, upright=turned or correction.upright)


def _warn_of_far_cameras(capture: Capture) -> Capture:
    """Return the capture with a warning if a few cameras are much farther from the cameras' middle than the others."""
    if capture.poses is None or not capture.poses.world_to_camera:
        return capture
    poses = capture.poses.world_to_camera
    centers = np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses.values()])
    distances = np.linalg.norm(centers - np.median(centers, 0), axis=1)
    ratios = distances / max(np.median(distances), 1e-12)
    far = [name for name, ratio in zip(poses, ratios, strict=True) if ratio > FAR]
    if not far:
        return capture
    line = f"{len(far)} of {len(poses)} cameras are {ratios.max():.0f} times as far away as usual, such as {far[0]}"
    return replace(capture, warnings=(*capture.warnings, f"{line}: are their positions in another unit?"))


def _fits_turned_only(picture: Path, lens: Lens) -> bool:
    """Return whether a lens has the size of the picture turned by its EXIF orientation, and not of the stored one."""
    size = lens.width, lens.height
    return image_size(picture) != size and image_size(picture, upright=True) == size


def _source(folder: Path, layout: str) -> Path:
    """Return the file or folder from which a layout's poses are read, for messages."""
    known = {"llff": "poses_bounds.npy", "transforms": "transforms.json"}
    return folder / known[layout] if layout in known else folder


def detect_layout(folder: Path) -> str:
    """Return the layout of a folder, one of LAYOUTS, from the files it holds.

    The first match decides: "llff" for poses_bounds.npy, or for a COLMAP model with masks in images_4/label (a scene of
    SPIn-NeRF without its poses_bounds.npy); "transforms" for transforms.json or Blender's transforms_train.json;
    "colmap" for a COLMAP model; a layout of another program (`PROGRAMS`) for its file; else "photos".
    """
    if is_file(folder / "poses_bounds.npy"):
        return "llff"
    if (folder / "images_4" / "label").is_dir() and colmap.find_model(folder) is not None:
        return "llff"
    if transforms.split_files(folder):
        return "transforms"
    if colmap.find_model(folder) or colmap.find_workspace(folder):
        return "colmap"
    return next((layout for layout, (find, _) in PROGRAMS.items() if find(folder) is not None), "photos")

"""Photographs only: structure from motion finds their poses."""

from __future__ import annotations

from pathlib import Path

from reffusion.capture.layouts.capture import Capture, has_pictures, image_folder_of, paths_below, pictures_in
from reffusion.io.files import BadInput
from reffusion.io.images import image_size


def read(folder: Path, images: str | None, references: frozenset[Path] = frozenset()) -> Capture:
    """See `load_capture`. References that lie among the photographs are none."""
    image_folder = image_folder_of(folder, images, ("images", "photos", "input", "."))
    found = pictures_in(image_folder, nested=not has_pictures(image_folder))
    pictures = {name: path for name, path in found.items() if path not in references}
    sizes: dict[tuple[int, int], list[str]] = {}
    for name, path in pictures.items():
        sizes.setdefault(image_size(path, upright=True), []).append(name)
    if len(sizes) > 1:
        shown = "; ".join(f"{w}x{h}: {', '.join(names[:3])}" for (w, h), names in sizes.items())
        raise BadInput(
            f"{image_folder}: pictures of {len(sizes)} sizes and no intrinsics ({shown}); "
            "bring poses and intrinsics (COLMAP or transforms.json), or photos of one size"
        )
    paths = paths_below(image_folder, pictures)
    return Capture("photos", pictures, paths, None, None, image_folder, frozenset(), ())

"""Photographs only: structure from motion finds their poses."""

from __future__ import annotations

from pathlib import Path

from reffusion.capture.layouts.capture import Capture, has_pictures, image_folder_of, paths_below, pictures_in
from reffusion.io.images import image_size


def read(folder: Path, images: str | None, references: frozenset[Path] = frozenset()) -> Capture:
    """See `load_capture`. Sizes may differ, so a phone may be held both ways. References among the photographs are no
    views."""
    image_folder = image_folder_of(folder, images, ("images", "photos", "input", "."))
    found = pictures_in(image_folder, nested=not has_pictures(image_folder))
    pictures = {name: path for name, path in found.items() if path not in references}
    for path in pictures.values():
        image_size(path)  # an unreadable one is refused here, before any work
    paths = paths_below(image_folder, pictures)
    return Capture("photos", pictures, paths, None, None, image_folder, ())

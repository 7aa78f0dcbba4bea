"""Photographs only: structure from motion finds their poses."""

from __future__ import annotations

from pathlib import Path

from reffusion.capture.layouts.capture import Capture, image_folder_of, pictures_in
from reffusion.io.images import image_size


def read(folder: Path, images: str | None) -> Capture:
    """See `load_capture`. Sizes may differ, so a phone may be held both ways."""
    image_folder = image_folder_of(folder, images, ("images", "photos", "input", "."))
    pictures = pictures_in(image_folder)
    for path in pictures.values():
        image_size(path)  # an unreadable one is refused here, before any work
    return Capture("photos", pictures, None, None, image_folder, frozenset(), ())

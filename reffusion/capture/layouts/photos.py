"""Reads photographs without poses, for structure from motion."""

from __future__ import annotations

from pathlib import Path

from reffusion.capture.layouts.capture import Capture, find_image_folder, find_pictures, has_pictures, relative_paths
from reffusion.io.images import image_size


def read(folder: Path, images: str | None, references: frozenset[Path] = frozenset()) -> Capture:
    """Read a scene in this layout, see `load_capture`. Sizes may differ, so a phone may be held both ways. References
    among the photographs are no views."""
    image_folder = find_image_folder(folder, images, ("images", "photos", "input", "."))
    found = find_pictures(image_folder, nested=not has_pictures(image_folder))
    pictures = {name: path for name, path in found.items() if path not in references}
    for path in pictures.values():
        image_size(path)  # an unreadable one is refused here, before any work
    paths = relative_paths(image_folder, pictures)
    return Capture("photos", pictures, paths, None, None, image_folder, ())

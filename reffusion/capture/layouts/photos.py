"""Reads a capture in the layout "photos": photographs without poses, for structure from motion."""

from __future__ import annotations

import filecmp
from pathlib import Path

from reffusion.capture.layouts.capture import Capture, find_image_folder, find_pictures, has_pictures, relative_paths
from reffusion.capture.layouts.panoramas import IMAGE_FOLDERS, refuse_panoramas
from reffusion.io.files import BadInput
from reffusion.io.images import image_size


def read(folder: Path, images: str | None, references: frozenset[Path] = frozenset()) -> Capture:
    """Read a scene folder that holds photographs only. Their sizes may differ, as in portrait and landscape.

    Photographs in sub-folders are read only if the folder of pictures itself holds none.

    Args:
        images: folder of pictures, relative to the scene; None for the usual folders.
        references: files of references (inpainted views). They may lie among the photographs, but are not views.

    Raises:
        BadInput: there are no pictures, two share a view name, one is unreadable or a panorama, or the folder holds
            placeholders of iCloud.
    """
    image_folder = find_image_folder(folder, images, IMAGE_FOLDERS)
    if waiting := sorted(path.name for path in image_folder.glob(".*.icloud")):
        raise BadInput(
            f"{image_folder}: placeholders of iCloud in place of photographs ({len(waiting)}, such as {waiting[0]}); "
            "download the photographs first, or remove the placeholders"
        )
    found = find_pictures(image_folder, nested=not has_pictures(image_folder))
    pictures = {name: path for name, path in found.items() if path not in references}
    for path in pictures.values():
        image_size(path)  # raises BadInput for an unreadable picture now, before long computations
    refuse_panoramas(folder, pictures)
    paths = relative_paths(image_folder, pictures)
    return Capture("photos", pictures, paths, None, None, image_folder, _warn_of_copies(pictures), upright=True)


def _warn_of_copies(pictures: dict[str, Path]) -> tuple[str, ...]:
    """Return at most one warning: pictures, view name -> file, are copies of others, byte for byte."""
    by_size: dict[int, list[Path]] = {}
    copies = []
    for path in pictures.values():
        others = by_size.setdefault(path.stat().st_size, [])
        copies += [f"{path.name} of {other.name}" for other in others if filecmp.cmp(path, other, shallow=False)][:1]
        others.append(path)
    return (f"copies among the photographs ({len(copies)}, such as {copies[0]}); remove them",) if copies else ()

"""References: the views worth painting, and pictures that the user completed."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image, ImageOps

from reffusion.io.files import BadInput, check_pixels
from reffusion.io.images import image_size, replace_image
from reffusion.references.files import PAINTED, PROPORTION_TOLERANCE
from report.app.scenes import OpenScene
from report.job_data import JobFiles
from report.verdict import TO_PAINT, rank_views

PICTURE_BYTES = 60_000_000
FORMATS = ("PNG", "JPEG", "WEBP")


def list_views(scene: OpenScene, job: JobFiles) -> list[dict[str, Any]]:
    """Return the views worth painting for which there is a template, in the order of `verdict.rank_views`.

    Returns:
        For each view "view", its name; "share", the share of the hole in [0, 1] that it adds to the views before it;
        and "painted", the time of change of its painting in seconds, or None without one.
    """
    folder = scene.home / TO_PAINT
    return [
        {"view": name, "share": share, "painted": path.stat().st_mtime if path.is_file() else None}
        for name, share, _ in rank_views(job)
        if (folder / f"{name}.png").is_file() and (path := painting_path(scene, name))
    ]


def painting_path(scene: OpenScene, view: str) -> Path:
    """Return the file of a view's painting, which may not exist."""
    return scene.folder / PAINTED / f"{view}.png"


def save_painting(scene: OpenScene, view: str, content: bytes, replace: bool) -> None:
    """Save a completed picture of a view as painted/<view>.png in the scene's folder.

    Args:
        view: name of a view of `list_views`.
        content: bytes of a PNG, JPEG or WebP picture of the view's proportions.
        replace: True overwrites an earlier painting of this view.

    Raises:
        FileExistsError: there is a painting of this view, and `replace` is False.
        ValueError: the content is no such picture.
    """
    path = painting_path(scene, view)
    picture = decode_picture(content)
    width, height = image_size(scene.home / TO_PAINT / f"{view}.png")
    ratio = picture.shape[1] / picture.shape[0] / (width / height)
    if max(ratio, 1 / ratio) > 1 + PROPORTION_TOLERANCE:
        raise ValueError(
            f"the picture has {picture.shape[1]}x{picture.shape[0]} px, and the view {width}x{height}: keep the framing"
        )
    if path.exists() and not replace:
        raise FileExistsError(f"{path} is there already")
    path.parent.mkdir(exist_ok=True)
    replace_image(path, picture)


def decode_picture(content: bytes, mode: Literal["RGB", "RGBA"] = "RGB") -> np.ndarray:
    """Return the picture in the bytes of a PNG, JPEG or WebP file, uint8 [H, W, 3], or [H, W, 4] with alpha.

    The orientation tag, with which phones save pictures, is applied.

    Raises:
        ValueError: the bytes are no such picture, or it has too many pixels.
    """
    try:
        with Image.open(BytesIO(content), formats=FORMATS) as image:
            check_pixels("the picture", *image.size)  # type: ignore[arg-type]
            return np.array(ImageOps.exif_transpose(image).convert(mode))
    except BadInput:
        raise
    except Exception:
        raise ValueError(f"this is no picture; {', '.join(FORMATS)} are accepted") from None

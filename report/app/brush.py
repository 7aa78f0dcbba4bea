"""The brush of the step Paint: the picture that a user paints on, and patches of photographs for its marked part."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from reffusion.inpaint import exemplar
from reffusion.io.images import load_image, load_mask
from reffusion.workspace import Workspace
from report.app import pictures
from report.app.mask_step import to_png
from report.app.painting import decode_picture
from report.app.scenes import OpenScene
from report.sheet import stage_folder
from report.verdict import TO_PAINT

MAX_SHARE = 0.5  # largest share of the picture that is filled at once
OPAQUE = 128  # alpha from which a pixel is kept


def draw_canvas(scene: OpenScene, view: str) -> bytes:
    """Return the picture that the user paints on as a PNG: the view without the object, filled as by the job.

    The filling is that of the view's reference, or else the finished scene from this view.

    Args:
        view: name of a view in the folder `verdict.TO_PAINT`.
    """
    folder = scene.home / TO_PAINT
    canvas, hole = load_image(folder / f"{view}.png"), load_mask(folder / f"{view}_mask.png")
    reference = stage_folder(scene.home, "reference") / "references" / f"{view}.png"
    filled = load_image(reference) if reference.is_file() else pictures.load_result(scene, view)
    return to_png(np.where(hole[..., None], filled, canvas))


def fill(scene: OpenScene, view: str, content: bytes, seed: int) -> bytes:
    """Fill the transparent part of a picture with patches of the photographs, and return the picture as a PNG.

    Args:
        view: name of a training view.
        content: bytes of a PNG of the view's size. Pixels with an alpha below `OPAQUE` are filled, and their colors
            are not read.
        seed: seed of the search for patches; another seed gives another filling.

    Raises:
        ValueError: the content is no such picture, nothing is transparent, or more than `MAX_SHARE` of it is.
    """
    picture = decode_picture(content, "RGBA")
    image, hole = np.ascontiguousarray(picture[..., :3]), picture[..., 3] < OPAQUE
    masks = stage_folder(scene.home, "masks")
    space = _load_workspace(scene.home, masks, (masks / "receipt.json").stat().st_mtime_ns)
    consistent, camera = space.mask_sets[view].consistent, space.scene.cameras[view]
    if hole.shape != consistent.shape:
        raise ValueError(f"the picture has {hole.shape[1]}x{hole.shape[0]} px, not {camera.width}x{camera.height}")
    if not 0 < hole.mean() <= MAX_SHARE:
        raise ValueError("mark a part of the picture, at most half of it")
    with pictures.RENDERING:
        filled = next(exemplar.complete_view(image, hole, camera, consistent | hole, space.background, [seed])).image
    return to_png(np.where(hole[..., None], filled, image))


@lru_cache(1)
def _load_workspace(home: Path, masks: Path, changed: int) -> Workspace:
    """Return the results of the first stages; `changed` is the time at which the stage `masks` was done."""
    return Workspace(stage_folder(home, "poses"), stage_folder(home, "fit"), masks)

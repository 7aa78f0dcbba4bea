"""A note in a picture: here it shows what no photograph saw."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from reffusion.background import training_coverage
from reffusion.io.images import load_mask, resize_nearest
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_raw_masks
from reffusion.types import Camera, Gaussians, Scene
from report.sheet import stage_folder

MIN_SHARE = 0.003  # of a picture, under which nothing is said
LINE_PERIOD, LINE_WIDTH = 14, 2  # px between the lines of the hatching, and their width
WORDS = "hatched: no photograph shows it"


def load_seen_views(home: Path, scene: Scene) -> list[training_coverage.SeenView]:
    """What the training views saw, by the fit of them; empty where there is none."""
    fit = stage_folder(home, "fit") / "gaussians.ply"
    if not fit.exists():
        return []
    consistent = stage_folder(home, "masks") / "consistent"
    train = [name for name in scene.train if name not in scene.clean]
    masks = load_raw_masks(stage_folder(home, "raw_masks"), train)
    masks |= {name: load_mask(path) for name in train if (path := consistent / f"{name}.png").exists()}
    return training_coverage.seen_views(load_ply(fit), [scene.cameras[name] for name in scene.train], masks)


def hatch_unseen(
    picture: np.ndarray, gaussians: Gaussians, camera: Camera, seen_by: list[training_coverage.SeenView]
) -> np.ndarray:
    """uint8 [H, W, 3] with what none of the training views saw hatched, and words for it; as it is where that is next
    to nothing.

    Args:
        camera: of any size; a small one answers sooner.
    """
    found = resize_nearest(training_coverage.unseen(gaussians, camera, seen_by), picture.shape[:2])
    if found.mean() < MIN_SHARE:
        return picture
    rows, columns = np.indices(found.shape)
    place = (rows + columns) % LINE_PERIOD
    marked = picture.copy()
    for offset, level in ((0, 255), (LINE_WIDTH, 0)):  # a bright line beside a dark one: one of them shows anywhere
        line = found & (place >= offset) & (place < offset + LINE_WIDTH)
        marked[line] = (0.45 * marked[line] + 0.55 * level).astype(np.uint8)
    canvas = Image.fromarray(marked)
    size = min(picture.shape[0] // 32, picture.shape[1] // 20)  # a phone held upright is narrow
    draw, font, at = ImageDraw.Draw(canvas), ImageFont.load_default(max(11, size)), (8, 8)  # axes stand below
    left, top, right, bottom = draw.textbbox(at, WORDS, font, anchor="la")
    draw.rectangle((left - 4, top - 4, right + 4, bottom + 4), "#222")
    draw.text(at, WORDS, "white", font, anchor="la")
    return np.asarray(canvas)

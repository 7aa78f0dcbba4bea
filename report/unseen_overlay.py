"""Hatching over the parts of a rendered picture that show surfaces which no training photograph shows."""

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

MIN_SHARE = 0.003  # of a picture; smaller unseen parts are not marked
LINE_PERIOD, LINE_WIDTH = 14, 2  # distance between the lines of the hatching, and their width, px
WORDS = "hatched: no photograph shows it"


def load_seen_views(home: Path, scene: Scene) -> list[training_coverage.CoverageView]:
    """Render from the fit what each training view saw: its depth, and the pixels that show the object.

    Args:
        home: runs/<scene> or runs/<scene>@<variant>.
        scene: the scene of the stage `poses`.

    Returns:
        One entry per training view; empty if the scene has no fit.
    """
    fit = stage_folder(home, "fit") / "gaussians.ply"
    if not fit.exists():
        return []
    consistent = stage_folder(home, "masks") / "consistent"
    train = [name for name in scene.train if name not in scene.clean]
    masks = load_raw_masks(stage_folder(home, "raw_masks"), train)
    masks |= {name: load_mask(path) for name in train if (path := consistent / f"{name}.png").exists()}
    return training_coverage.render_coverage_views(load_ply(fit), [scene.cameras[name] for name in scene.train], masks)


def hatch_unseen(
    picture: np.ndarray, gaussians: Gaussians, camera: Camera, seen_by: list[training_coverage.CoverageView]
) -> np.ndarray:
    """Return a picture with hatching over all pixels that no training view saw, and a label.

    The picture is returned unchanged if less than `MIN_SHARE` of it is unseen.

    Args:
        picture: uint8 [H, W, 3], a render of `gaussians`.
        camera: camera of the picture; its size may differ from the picture's, and a small one is faster.
        seen_by: result of `load_seen_views`.

    Returns:
        uint8 [H, W, 3].
    """
    unseen = resize_nearest(training_coverage.unseen_pixels(gaussians, camera, seen_by), picture.shape[:2])
    if unseen.mean() < MIN_SHARE:
        return picture
    rows, columns = np.indices(unseen.shape)
    place = (rows + columns) % LINE_PERIOD
    marked = picture.copy()
    for offset, level in ((0, 255), (LINE_WIDTH, 0)):  # a bright line beside a dark one, visible on any background
        line = unseen & (place >= offset) & (place < offset + LINE_WIDTH)
        marked[line] = (0.45 * marked[line] + 0.55 * level).astype(np.uint8)
    canvas = Image.fromarray(marked)
    size = min(picture.shape[0] // 32, picture.shape[1] // 20)  # narrow on a phone held upright
    draw, font, at = (
        ImageDraw.Draw(canvas),
        ImageFont.load_default(max(11, size)),
        (8, 8),
    )  # at the top: the viewer draws its axes at the bottom
    left, top, right, bottom = draw.textbbox(at, WORDS, font, anchor="la")
    draw.rectangle((left - 4, top - 4, right + 4, bottom + 4), "#222")
    draw.text(at, WORDS, "white", font, anchor="la")
    return np.asarray(canvas)

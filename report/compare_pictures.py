"""Pictures of the same test views by every method, side by side, cropped to the box (the bounding box of the mask)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reffusion.io.images import load_image, save_image
from report.results import FULL, Comparison, Run, shows_object
from report.sheet import arrange, enlarge, pick_evenly

WIDTH = 1920  # approximate width of a sheet, px
CONTEXT = 0.15  # margin of the crop on each side, as a share of the box's width or height
BOX = ("left", "top", "right", "bottom")  # columns of per_view.csv


def save_sheets(comparison: Comparison, out: Path, count: int = 3) -> dict[str, Path]:
    """Write a sheet for a few views: the photograph and every method's render, cropped to the box; return {view: PNG}.

    Methods that are not finished, and duplicates of earlier methods, are left out. One scene gets sheets of `count`
    evenly spread views. Of several scenes, `count` evenly spread ones get a sheet of one view each, whose key begins
    with the scene's name. Views without a box are used only if no view has one.

    Args:
        out: existing folder for the sheets.
        count: largest number of sheets.
    """
    if len(comparison.scenes) == 1:
        return _sheets_of(comparison, comparison.scenes[0], out, "", count)
    paths: dict[str, Path] = {}
    for scene in pick_evenly(list(comparison.scenes), count):
        paths |= _sheets_of(comparison, scene, out, f"{scene}-", 1)
    return paths


def _sheets_of(comparison: Comparison, scene: str, out: Path, prefix: str, count: int) -> dict[str, Path]:
    """Write sheets of at most `count` views of a scene, <prefix><view>.png; return {prefix + view: path}."""
    runs = [
        run for m in comparison.distinct_methods if (run := comparison.runs[m, scene]).state == "done" and run.views
    ]
    if not runs:
        return {}
    first = next((run for run in runs if run.method == FULL), runs[0])
    boxed = [view for view, row in first.views.items() if all(side in row for side in BOX)]
    paths = {}
    for view in pick_evenly(boxed or list(first.views), count):
        cells = _cells(runs, first, view)
        if cells:
            path = paths[f"{prefix}{view}"] = out / f"{prefix}{view}.png"
            save_image(path, arrange_crops([picture for _, picture in cells], [title for title, _ in cells]))
    return paths


def _cells(runs: list[Run], first: Run, view: str) -> list[tuple[str, np.ndarray]]:
    """Return (title, picture cropped to the box) of the photograph and of each run, as far as they exist."""
    poses = first.folders.get("poses", Path())
    photo, cells = poses / "images" / f"{view}.png", []
    if photo.exists() and (poses / "views.json").exists():
        title = "photograph, with the object" if shows_object(first.folders, view) else "ground truth"
        cells.append((title, load_image(photo)))
    for run in runs:
        path = run.folders["evaluate"] / "renders" / f"{view}.png"
        if path.exists():
            cells.append((_title(run, view), load_image(path)))
    return [(title, crop_to_box(picture, first.views[view])) for title, picture in cells]


def _title(run: Run, view: str) -> str:
    """Return the name of the method and, in a second line, its scores in the view, if known."""
    row = run.views.get(view, {})
    scores = [f"{row['psnr_box']:.1f} dB"] if "psnr_box" in row else []
    perceptual = {"LPIPS": row.get("lpips_vgg_box"), "FLIP": row.get("flip_box")}
    scores += [f"{name} {value:.3f}" for name, value in perceptual.items() if value is not None][:1]
    return "\n".join([run.method, *([", ".join(scores)] if scores else [])])


def crop_to_box(picture: np.ndarray, row: dict[str, float]) -> np.ndarray:
    """Return a picture, [H, W, 3], cropped to a view's box with a margin on each side.

    The margin is `CONTEXT` times the box's width or height. The crop ends at the picture's border.

    Args:
        row: the view's row of per_view.csv. The picture stays whole if the row has no box.
    """
    if not all(side in row for side in BOX):
        return picture
    left, top, right, bottom = (int(row[side]) for side in BOX)
    wide, high = round(CONTEXT * (right - left)), round(CONTEXT * (bottom - top))
    return picture[max(0, top - high) : bottom + high, max(0, left - wide) : right + wide]


def arrange_crops(cells: list[np.ndarray], titles: list[str]) -> np.ndarray:
    """Return one image, uint8 [H, W, 3], with pictures in rows of at most four, each below its title.

    Args:
        cells: pictures of about one size, uint8 [h, w, 3], which are enlarged by a whole factor.
        titles: one per picture, of one line or of two lines separated by a newline.
    """
    width, columns = max(cell.shape[1] for cell in cells), min(len(cells), 4)
    scale = max(1, round(WIDTH / columns / width))
    size = max(13, min(26, width * scale // 14))
    return arrange([enlarge(cell, scale) for cell in cells], titles, columns, size)

"""Contact sheet of a finished scene, a row per view: with the object, ground truth, initialization, result.

This module also has helpers for other sheets of pictures.

python -m report.sheet runs/demo --views 3 --out docs/images/demo.png
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from reffusion.io.arrays import load_json
from reffusion.io.images import load_image, save_image
from report import cli

Item = TypeVar("Item")

GAP = 6  # space between pictures, px
TITLES = {
    "renders_fit": "with the object",
    "truth": "ground truth",
    "renders_initialize": "initialization",
    "renders": "ours",
}


def make(scene_dir: Path, out: Path, *, views: list[str] | int = 3, scale: int | None = None) -> Path:
    """Write the contact sheet of a scene as a PNG and return its path.

    Args:
        scene_dir: runs/<scene> or runs/<scene>@<variant>.
        out: the PNG to write.
        views: names of views, or a number of views to choose evenly.
        scale: whole factor by which pixels are repeated; None enlarges to a width of about 480 px.

    Raises:
        ValueError: the scene is not evaluated yet, or a named view has not been rendered.
    """
    evaluate, poses = (stage_folder(scene_dir, stage) for stage in ("evaluate", "poses"))
    rendered = sorted(path.stem for path in (evaluate / "renders").glob("*.png"))
    if not rendered:
        raise ValueError(f"{evaluate / 'renders'}: no pictures; run `make scene={scene_dir.name} evaluate` first")
    names = pick_evenly(rendered, views) if isinstance(views, int) else views
    if unknown := [name for name in names if name not in rendered]:
        raise ValueError(f"{evaluate / 'renders'} has no {', '.join(unknown)}; it has {rendered[0]} ... {rendered[-1]}")
    test = load_json(poses / "views.json")["test"]
    rows = [load_view_pictures(evaluate, poses if name in test else None, name) for name in names]
    columns = [key for key in TITLES if any(key in row for row in rows)]
    width = max(picture.shape[1] for row in rows for picture in row.values())
    scale = scale or max(1, round(480 / width))
    cells = [[enlarge(row[key], scale) if key in row else None for key in columns] for row in rows]
    save_image(out, compose_sheet(cells, [TITLES[key] for key in columns], names))
    return out


def pick_evenly(items: list[Item], count: int) -> list[Item]:
    """Return `count` items evenly spread over a list, or all items if there are fewer.

    Each item is from the middle of one of `count` equal parts of the list, so the first and the last item of a long
    list are not chosen.
    """
    places = (np.arange(min(count, len(items))) + 0.5) * len(items) / max(min(count, len(items)), 1)
    return [items[int(place)] for place in places]


def scene_home(home: Path) -> Path:
    """Return the folder of the scene's own run, runs/<scene>, also for that of a variant, runs/<scene>@<variant>."""
    return home.with_name(home.name.split("@")[0])


def stage_folder(scene_dir: Path, stage: str) -> Path:
    """Return the folder of a stage; for a variant that has no such folder, the folder of the scene's own run.

    A variant shares the stages in which it does not differ from the scene's own run.

    Args:
        scene_dir: runs/<scene> or runs/<scene>@<variant>.
    """
    own = scene_dir / stage
    return own if own.exists() else scene_home(scene_dir) / stage


def load_view_pictures(evaluate: Path, poses: Path | None, name: str) -> dict[str, np.ndarray]:
    """Load the existing pictures of a view as {column, a key of `TITLES`: uint8 [H, W, 3]}.

    Args:
        evaluate: folder of the stage `evaluate`.
        poses: folder of the stage `poses`, whose photograph of a test view is ground truth; None for a training view,
            whose photograph shows the object.
        name: name of the view.
    """
    paths = {key: evaluate / key / f"{name}.png" for key in TITLES}
    if poses:
        paths["truth"] = poses / "images" / f"{name}.png"
    return {key: load_image(path) for key, path in paths.items() if path.exists()}


def enlarge(picture: np.ndarray, scale: int) -> np.ndarray:
    """Return a picture enlarged without blur: each pixel is repeated `scale` times in both directions."""
    return picture.repeat(scale, 0).repeat(scale, 1)


def compose_sheet(cells: Sequence[Sequence[np.ndarray | None]], titles: list[str], names: list[str]) -> np.ndarray:
    """Return one image, uint8 [H, W, 3], of a table of pictures on white.

    Args:
        cells: [rows][columns] of pictures uint8 [h, w, 3]; None leaves a cell empty.
        titles: titles of the columns, written above them.
        names: names of the rows, written on the first column.
    """
    heights = [max(cell.shape[0] for cell in row if cell is not None) for row in cells]
    width = max(cell.shape[1] for row in cells for cell in row if cell is not None)
    size = max(12, width // 20)
    font, small = ImageFont.load_default(size), ImageFont.load_default(max(10, size * 2 // 3))
    head = 2 * size
    canvas = Image.new("RGB", (len(titles) * (width + GAP) + GAP, head + sum(heights) + GAP * len(heights)), "white")
    draw = ImageDraw.Draw(canvas)
    for column, title in enumerate(titles):
        draw.text((GAP + column * (width + GAP) + width // 2, head // 2), title, "black", font, anchor="mm")
    top = head
    for row, height, name in zip(cells, heights, names, strict=True):
        for column, cell in enumerate(row):
            if cell is not None:
                canvas.paste(Image.fromarray(cell), (GAP + column * (width + GAP), top))
        place = (GAP + 4, top + height - 4)
        draw.rectangle(draw.textbbox(place, name, small, anchor="ls"), "black")
        draw.text(place, name, "white", small, anchor="ls")
        top += height + GAP
    return np.asarray(canvas)


def arrange(pictures: Sequence[np.ndarray], titles: Sequence[str], columns: int, size: int = 13) -> np.ndarray:
    """Return one image, uint8 [H, W, 3], with pictures in rows on white, each below its title.

    Args:
        pictures: uint8 [h, w, 3], of about one size.
        titles: one per picture, of one line or of two lines separated by a newline; the second line is gray.
        columns: largest number of pictures in a row.
        size: size of the font, px.
    """
    height, width = (max(picture.shape[axis] for picture in pictures) for axis in (0, 1))
    columns = min(len(pictures), columns)
    below = round(1.2 * size) if any("\n" in title for title in titles) else 0  # room for a second line
    font, head = ImageFont.load_default(size), round(1.8 * size) + below
    step = width + 2 * GAP, height + head + GAP
    rows = -(-len(pictures) // columns)
    canvas = Image.new("RGB", (columns * step[0] - 2 * GAP, rows * step[1] - GAP), "white")
    draw = ImageDraw.Draw(canvas)
    for index, (picture, title) in enumerate(zip(pictures, titles, strict=True)):
        left, top = index % columns * step[0], index // columns * step[1]
        first, _, second = title.partition("\n")
        draw.text((left, top + head - size // 3), second, "#666", font, anchor="ls")
        draw.text((left, top + head - size // 3 - below), first, "black", font, anchor="ls")
        canvas.paste(Image.fromarray(picture), (left, top + head))
    return np.asarray(canvas)


@cli.command
def main() -> None:
    """Run `reffusion sheet`: write the contact sheet of a finished scene, and print its path."""
    parser = argparse.ArgumentParser(prog="reffusion sheet", description=__doc__.split("\n")[0])
    parser.add_argument("scene", type=Path, help="runs/<scene>")
    parser.add_argument("--views", nargs="+", default=["3"], help="number of views, or their names")
    parser.add_argument("--scale", type=int, help="whole factor of enlargement (default: to about 480 px)")
    parser.add_argument("--out", type=Path, help="default: runs/<scene>/sheet.png")
    arguments = parser.parse_args()
    views = arguments.views if len(arguments.views) > 1 or not arguments.views[0].isdigit() else int(arguments.views[0])
    print(make(arguments.scene, arguments.out or arguments.scene / "sheet.png", views=views, scale=arguments.scale))


if __name__ == "__main__":
    main()

"""A look at what a scene brings: `python -m report.check --scene demo` (`make scene=X check`), after its stage
`raw_masks`.

Writes runs/<scene>/check.png, every mask over its photograph, and prints what is odd.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from reffusion.io.arrays import load_json
from reffusion.io.images import load_image, load_mask, resize_nearest, resized, save_image
from reffusion.io.scene import has_photograph, load_warnings
from report import cli, sheet

WIDTH, HEIGHT, GAP = 240, 180, 4  # px of the room for a picture, and between them
COLUMNS = 6
TINT = (255, 0, 160)  # of masks; test masks in the complement


def make(home: Path) -> tuple[Path, list[str]]:
    """Write check.png of runs/<scene>; its path, and what is odd, a sentence each.

    Raises:
        ValueError: the stage `raw_masks` has not run.
    """
    poses, raw_masks = (sheet.stage_folder(home, stage) for stage in ("poses", "raw_masks"))
    if not (poses / "views.json").is_file() or not raw_masks.is_dir():
        raise ValueError(f"{raw_masks}: not there; run `make scene={home.name.split('@')[0]} raw_masks` first")
    views = load_json(poses / "views.json")
    there = {*views["train"], *views["test"], *views.get("outliers", ())}
    named = [name for name in sorted(there) if has_photograph(poses, name)]
    if not named:
        raise ValueError(f"{poses}: the scene has no photographs to look at")
    cells = [(name, overlay_masks(poses, raw_masks, name), view_role(name, views)) for name in named]
    save_image(home / "check.png", contact_sheet(cells))
    return home / "check.png", [*load_warnings(poses), *load_warnings(raw_masks)]


def view_role(name: str, views: dict[str, list[str]]) -> str:
    if name in views.get("outliers", ()):
        return "left out"
    return "clean" if name in views["clean"] else "test" if name in views["test"] else "training"


def overlay_masks(poses: Path, raw_masks: Path, name: str) -> np.ndarray:
    """uint8 [h, w, 3], at most `WIDTH` x `HEIGHT`: the photograph, its mask over it."""
    image = load_image(poses / "images" / f"{name}.png")
    factor = min(WIDTH / image.shape[1], HEIGHT / image.shape[0])
    size = max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor))
    small = resized(image, size)
    for folder, tint in (("test_masks", [255 - level for level in TINT]), ("masks", TINT)):
        if (path := raw_masks / folder / f"{name}.png").is_file():
            mask = resize_nearest(load_mask(path), size[::-1])
            small[mask] = (small[mask] // 2 + np.array(tint, np.uint8) // 2).astype(np.uint8)
    return small


def contact_sheet(cells: list[tuple[str, np.ndarray, str]]) -> np.ndarray:
    """uint8 [H, W, 3]: the pictures in rows on white, under each its view's name and what it is for."""
    font, line = ImageFont.load_default(13), 20
    columns = min(COLUMNS, len(cells))
    rows = -(-len(cells) // columns)
    canvas = Image.new("RGB", (columns * (WIDTH + GAP) + GAP, rows * (HEIGHT + GAP + line) + GAP), "white")
    draw = ImageDraw.Draw(canvas)
    for index, (name, picture, kind) in enumerate(cells):
        left, top = GAP + index % columns * (WIDTH + GAP), GAP + index // columns * (HEIGHT + GAP + line)
        canvas.paste(Image.fromarray(picture), (left, top))
        draw.text((left, top + HEIGHT + 2), f"{name[:28]}  {kind}", "black", font)
    return np.asarray(canvas)


def main() -> None:
    home = cli.run_folder(cli.scene_parser("check", __doc__).parse_args())
    try:
        path, said = make(home)
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None
    if (solved := sheet.stage_folder(home, "poses") / "sfm.json").is_file():
        print(load_json(solved)["summary"])
    for line in said:
        print(f"odd: {line}")
    print(f"{len(said) or 'nothing'} odd; every mask over its photograph: {path}")


if __name__ == "__main__":
    main()

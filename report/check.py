"""Overview of a scene's input, after its stage `raw_masks`: `python -m report.check --scene X` (`make scene=X check`).

The command writes runs/<scene>/check.png, which shows each mask over its photograph. It also prints the warnings that
the stages `poses`, `raw_masks` and `masks` recorded about photographs, masks and poses.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reffusion.io.arrays import load_json
from reffusion.io.images import load_image, load_mask, resize_image, resize_nearest, save_image
from reffusion.io.scene import has_photograph, load_warnings, raw_mask_files
from report import cli, sheet

WIDTH, HEIGHT = 240, 180  # largest width and height of a picture, px
COLUMNS = 6
TINT = (255, 0, 160)  # color of the training views' masks; masks for scoring test views get the complementary color


def make(home: Path) -> tuple[Path, list[str]]:
    """Write check.png, the photographs with their masks, into a scene's run folder; return path and warnings.

    Args:
        home: runs/<scene> or runs/<scene>@<variant>.

    Returns:
        The path of check.png, and the warnings of the stages `poses`, `raw_masks` and `masks`, one sentence each.

    Raises:
        ValueError: the stage `raw_masks` has not run, or the scene has no photographs.
    """
    poses, raw_masks = (sheet.stage_folder(home, stage) for stage in ("poses", "raw_masks"))
    if not (poses / "views.json").is_file() or not raw_masks.is_dir():
        raise ValueError(f"{raw_masks} is missing; run `make scene={sheet.scene_home(home).name} raw_masks` first")
    views = load_json(poses / "views.json")
    known = {*views["train"], *views["test"], *views.get("outliers", ())}
    names = [name for name in sorted(known) if has_photograph(poses, name)]
    if not names:
        raise ValueError(f"{poses}: the scene has no photographs to look at")
    pictures = [overlay_masks(poses, raw_masks, name) for name in names]
    titles = [f"{name[:28]}  {view_role(name, views)}" for name in names]
    save_image(home / "check.png", sheet.arrange(pictures, titles, COLUMNS))
    folders = (poses, raw_masks, sheet.stage_folder(home, "masks"))
    return home / "check.png", [line for folder in folders for line in load_warnings(folder)]


def view_role(name: str, views: dict[str, list[str]]) -> str:
    """Return the role of a view: "left out", "clean", "test" or "training".

    A view is "left out" if its photograph contradicts its pose, and "clean" if it is a training view without the
    object.

    Args:
        views: content of views.json of the stage `poses`: list of view names for each role.
    """
    if name in views.get("outliers", ()):
        return "left out"
    return "clean" if name in views["clean"] else "test" if name in views["test"] else "training"


def overlay_masks(poses: Path, raw_masks: Path, name: str) -> np.ndarray:
    """Return a photograph with its masks tinted, uint8 [h, w, 3], resized to fit into `WIDTH` x `HEIGHT`.

    A small photograph is enlarged. The tint of a test mask is the complement of `TINT`. If several objects have masks
    of their own (masks/<object>/), all are drawn in the same tint.

    Args:
        poses: folder of the stage `poses`, which has the photographs.
        raw_masks: folder of the stage `raw_masks`, which has the masks and test masks.
        name: name of the view.
    """
    image = load_image(poses / "images" / f"{name}.png")
    factor = min(WIDTH / image.shape[1], HEIGHT / image.shape[0])
    size = max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor))
    small = resize_image(image, size)
    test_mask, complement = raw_masks / "test_masks" / f"{name}.png", [255 - level for level in TINT]
    for files, tint in (([test_mask], complement), (raw_mask_files(raw_masks, name), TINT)):
        for path in (path for path in files if path.is_file()):
            mask = resize_nearest(load_mask(path), size[::-1])
            small[mask] = (small[mask] // 2 + np.array(tint, np.uint8) // 2).astype(np.uint8)
    return small


@cli.command
def main() -> None:
    """Run `reffusion check`: write check.png, and print the recorded warnings and the path."""
    home = cli.run_folder(cli.scene_parser("check", __doc__).parse_args())
    path, warnings = make(home)
    if (sfm := sheet.stage_folder(home, "poses") / "sfm.json").is_file():
        print(load_json(sfm)["summary"])
    for line in warnings:
        print(f"warning: {line}")
    count = f"{len(warnings) or 'no'} warning{'' if len(warnings) == 1 else 's'}"
    print(f"{count}; masks drawn over the photographs: {path}")


if __name__ == "__main__":
    main()

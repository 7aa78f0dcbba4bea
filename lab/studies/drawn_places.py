"""Places that a seeded generator draws, so that nobody chose them: `python -m lab.studies.drawn_places`.

Captures without points (`fox`, `church`) are first converted from the stage `poses` with --convert.

View, pixel, size, shape and arc are random. A place is rejected only because the object would hang in the air, or would
have to be hidden by something that stands before it; somebody decides this by looking at the sheets that this program
writes, on which each place shows the view in which it is placed and the two outermost views. `drawn_places.json` lists
all places that were drawn, with the use of each: twelve judge the parts of the method ("judge"), six show what is to be
mended ("mend"), six stay sealed until the end ("sealed"), "spare" ones judge the parts that twelve places leave
undecided, and the others are "rejected".
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np

from lab.studies import compositing, placement
from lab.studies.placement import Place
from reffusion.io.arrays import load_json, save_json
from reffusion.io.images import save_image
from report.sheet import compose_sheet

LIST = Path(__file__).with_name("drawn_places.json")
# seed -> captures in the order in which they are drawn, number of places of each, and number of the first place
DRAWS = {
    20261129: (("garden", "bear", "dinosaur"), 16, 0),
    20261130: (("garden", "bear"), 20, 16),
    20261201: (("fox", "church"), 16, 0),
}
COLUMNS, ROWS = (0.12, 0.88), (0.25, 0.9)  # range of the pixel, relative to the photograph's size
SIZES, ARCS = (0.07, 0.2), (30, 60, 90, 180)  # range of `Place.size`, and values of `Place.arc`
TRAIN, TEST, NEAR = 34, 6, 30  # `Place.train`, `Place.test`, `Place.near`
MIN_VIEWS = 14  # photographs that must show the object
MAX_TRIES = 400
TINTS = np.array([[0.7, 0.21, 0.21], [0.21, 0.7, 0.21], [0.28, 0.28, 0.7]])  # colors of the object on the sheets
SHEET_WIDTH = 240  # px, of one view on a sheet


def load_drawn_places(use: str | None = None) -> tuple[Place, ...]:
    """Return the drawn places of one use ("judge", "mend", "sealed", "spare", "rejected"); None for all."""
    rows = [row | {"pixel": tuple(row["pixel"])} for row in load_json(LIST)]
    return tuple(Place(**row) for row in rows if row.pop("use") == use or use is None)


def draw_places(captures: Sequence[placement.Photographs], seed: int, count: int, first: int = 0) -> list[list[Place]]:
    """Draw `count` places in each capture, where at least `MIN_VIEWS` photographs show the whole object.

    They are called <capture>-<number>, from `first` on.
    """
    random = np.random.default_rng(seed)
    found = []
    for capture in captures:
        places: list[Place] = []
        for _ in range(MAX_TRIES):
            if len(places) == count:
                break
            place = _draw_place(random, capture, f"{capture.folder.name}-{first + len(places)}")
            try:
                thing = placement.place_object(capture, place)
                views = placement.select_views(capture, place, thing)
            except ValueError:  # no surface there, or too few photographs
                continue
            if len(views.all) >= MIN_VIEWS and np.isfinite(thing.height):
                places.append(place)
        found.append(places)
    return found


def _draw_place(random: np.random.Generator, capture: placement.Photographs, name: str) -> Place:
    """Draw one place, wherever it may lie."""
    between = lambda low, high, size: int(random.integers(low * size, high * size))
    pixel = (between(*COLUMNS, capture.width), between(*ROWS, capture.height))
    view = sorted(capture.frames)[random.integers(len(capture.frames))]
    size, arc = float(np.exp(random.uniform(*np.log(SIZES)))), float(random.choice(ARCS))
    shape = str(random.choice(["box", "ellipsoid"]))
    return Place(name, capture.folder.name, view, pixel, size, arc, TRAIN, TEST, NEAR, shape)


def draw_sheet(capture: placement.Photographs, places: Sequence[Place]) -> np.ndarray:
    """Return a picture, uint8 [H, W, 3], with a row for each place."""
    rays, height = compositing.PixelRays(capture), round(SHEET_WIDTH * capture.height / capture.width)
    rows = []
    for place in places:
        thing = placement.place_object(capture, place)
        views = placement.select_views(capture, place, thing).all
        pictures = []
        for name in (place.view, views[0], views[-1]):
            photo = compositing.load_photograph(capture, name) / 255
            picture, _ = compositing.composite_object(photo, rays, capture.cameras[name], thing, TINTS)
            pictures.append(cv2.resize(picture, (SHEET_WIDTH, height), interpolation=cv2.INTER_AREA))
        rows.append(pictures)
    return compose_sheet(rows, ["its view", "first view", "last view"], [place.name for place in places])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=Path, default=Path("../shared/data"), help="folder of nerfstudio captures")
    parser.add_argument("--convert", type=Path, help="only write a capture to --out from a folder of the stage poses")
    parser.add_argument("--seeds", type=int, nargs="*", help="only these draws")
    parser.add_argument("--out", type=Path, default=Path("runs/places"))
    arguments = parser.parse_args()
    if arguments.convert:
        placement.convert_poses(arguments.convert, arguments.out)
        return
    draws = {seed: DRAWS[seed] for seed in arguments.seeds or DRAWS}
    for seed, (names, count, first) in draws.items():
        captures = [placement.load_photographs(arguments.captures / name) for name in names]
        for capture, places in zip(captures, draw_places(captures, seed, count, first), strict=True):
            name = f"{capture.folder.name}-{seed}"
            save_image(arguments.out / f"{name}.png", draw_sheet(capture, places))
            save_json(arguments.out / f"{name}.json", [asdict(place) for place in places])


if __name__ == "__main__":
    main()

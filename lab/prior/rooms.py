"""Pictures of made rooms for the training of the embedded prior: `python -m lab.prior.rooms OUT`.

The scene generator `lab/scenes/` furnishes and lights the rooms; here they are drawn without their object. Seeds
start at `FIRST_SEED`, far from those of the scenes on which the method is evaluated.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from lab.scenes import photographs
from lab.scenes.kinds import KINDS
from lab.scenes.room import furnish
from lab.scenes.world import bake

FIRST_SEED = 100
HELD_OUT_EVERY = 5  # every fifth room is held out
VIEWS = 12  # pictures of a room
PLACES = {  # kind of scene -> kind of place that captions name
    "demo": "a room",
    "corner": "a corner",
    "table": "a table",
    "360": "a bedroom",
    "grass": "a garden",
}
WIDTH, HEIGHT = 384, 288  # px
DETAIL = {"samples": 2, "texture": 512, "node": 0.15}  # less than in scenes: see `kinds.Kind`


def list_rooms(count: int) -> list[tuple[int, str]]:
    """Return the seeds and kinds of `count` rooms; every second one is of the kind `demo`, the others in turn."""
    others = [kind for kind in PLACES if kind != "demo"]
    return [(FIRST_SEED + k, others[k // 2 % len(others)] if k % 2 else "demo") for k in range(count)]


def draw_room(seed: int, kind_name: str, folder: Path) -> None:
    """Write `VIEWS` pictures of one room, named <kind>-<seed>-<view>.png. Those that exist are kept."""
    if (folder / f"{kind_name}-{seed}-{VIEWS - 1}.png").exists():
        return
    kind = replace(KINDS[kind_name], width=WIDTH, height=HEIGHT, **DETAIL)
    furniture, target = furnish(seed, kind)
    world = bake(furniture, seed, kind)
    cameras = photographs.path(seed, kind, target, VIEWS, "train")
    world = photographs.set_exposure(world, cameras[VIEWS // 2], kind)
    for view, camera in enumerate(cameras):
        picture, _ = photographs.shoot(world, camera, kind, with_object=False)
        cv2.imwrite(str(folder / f"{kind_name}-{seed}-{view}.png"), picture[..., ::-1])


def load_rooms(folder: Path, held_out: bool) -> list[tuple[str, np.ndarray]]:
    """Load the pictures of rooms.

    Args:
        folder: the output of this module.
        held_out: load the rooms that training never sees, instead of those that it sees.

    Returns:
        The places as captions name them, and the pictures as uint8 [HEIGHT, WIDTH, 3]; sorted by file.

    Raises:
        ValueError: the folder has no such picture.
    """
    found = []
    for path in sorted(folder.glob("*-*-*.png")):
        kind, seed, _ = path.stem.split("-")
        if (int(seed) % HELD_OUT_EVERY == 0) == held_out:
            found.append((PLACES[kind], cv2.imread(str(path), cv2.IMREAD_COLOR)[..., ::-1].copy()))
    if not found:
        raise ValueError(f"{folder}: no picture of a room; run python -m lab.prior.rooms {folder}")
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder for the pictures")
    parser.add_argument("--count", type=int, default=12, help="number of rooms")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for each_seed, each_kind in list_rooms(options.count):
        draw_room(each_seed, each_kind, options.out)
        print(f"room {each_seed} ({each_kind})", flush=True)

"""The kinds of synthetic scenes, and the source of their randomness."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

FULL = 4  # full resolution over that of images_4


@dataclass(frozen=True)
class Kind:
    """The parameters of a kind of scene.

    Attributes:
        width, height: pixels of the written images; samples: rays along a side of a pixel.
        train, test: numbers of views; photos: write photographs and masks only.
        spread: degrees that the cameras reach to either side of the object; from 180 on they circle it.
        texture: pixels along a side of the largest textures; node: metres between nodes of the light map.
        bend: largest k1 of SIMPLE_RADIAL; points: number of sparse points.
        hangs: the object hangs in mid-air, so that other views show all that it hides.
        place: where the object is: "room", "behind" (an object that stays is in front), "table" (on its edge), "corner"
            (in front of the corner of a wall), "grass", "floor" or "pair" (two objects side by side).
        task: what the scene asks for: "remove" the object; "insert" it: it is only in the test views and the
            references; "outpaint" what lies beyond a sphere, nothing else is changed; "sparse": nothing is changed, but
            few views have pixels.
        references: number of completed views that the scene brings; for outpainting, as many as show everything.
        shown: number of training views with pixels, the others are cameras only; 0: all have pixels.
        least: smallest share of the masks that no training view shows.
        low: metres above the floor of the lowest cameras; None: all are at eye level.
    """

    width: int = 320
    height: int = 240
    samples: int = 3
    train: int = 60
    test: int = 40
    photos: bool = False
    spread: float = 22.0
    texture: int = 1024
    node: float = 0.03
    bend: float = 0.045
    points: int = 3000
    hangs: bool = False
    place: str = "room"
    task: str = "remove"
    least: float = 0.4
    low: float | None = None
    references: int = 1
    shown: int = 0

    @property
    def is_circle(self) -> bool:
        """Do the cameras circle the object?"""
        return self.spread >= 180


KINDS = {
    "demo": Kind(),
    "mini": Kind(width=64, height=48, train=8, test=3, texture=256, node=0.1, points=400),
    "wide": Kind(spread=50.0),
    "360": Kind(spread=180.0),
    "seen": Kind(spread=34.0, hangs=True),
    "behind": Kind(spread=50.0, place="behind"),
    "table": Kind(spread=34.0, place="table", least=0.05, low=0.45),
    "corner": Kind(spread=30.0, place="corner", least=0.25),
    "grass": Kind(samples=2, spread=30.0, node=0.08, place="grass"),
    "insert": Kind(place="floor", task="insert", least=0, references=4),
    "outpaint": Kind(spread=16.0, task="outpaint", least=0),
    "pair": Kind(spread=30.0, place="pair", least=0.2, references=2),
    "sparse": Kind(spread=30.0, task="sparse", least=0, shown=4),
    "photos": Kind(width=480, height=360, train=26, test=0, photos=True, texture=2048, node=0.025),
}


def randomness(seed: int, label: str) -> np.random.Generator:
    """A generator for each part, so that changing one part leaves the others as they were."""
    return np.random.default_rng([seed, zlib.crc32(label.encode())])

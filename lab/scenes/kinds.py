"""The kinds of synthetic scenes, and the random generators that all scenes draw from."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

FULL = 4  # ratio of the full resolution to that of the written images in images_4


@dataclass(frozen=True)
class Kind:
    """Parameters of a kind of scene.

    Attributes:
        width: width of the written images, px.
        height: height of the written images, px.
        samples: rays along a side of a pixel, i.e. samples² rays per pixel.
        train: number of training views.
        test: number of test views.
        photos: True writes photographs, masks and the truth only, without poses, e.g. for structure from motion.
        spread: degrees that the cameras reach to either side of the object; from 180 on the cameras circle the object.
        texture: pixels along a side of the largest textures.
        node: distance between nodes of the light map, metres.
        bend: largest distortion coefficient k1 of COLMAP's SIMPLE_RADIAL.
        points: largest number of sparse points.
        hangs: True if the object hangs in mid-air, so that other views show everything that it hides.
        place: where the object is: "room" (against a wall), "behind" (another object, which stays, is in front),
            "table" (on the edge of a table), "corner" (in front of the corner of a wall), "grass" (on a lawn), "floor",
            "beside" (on the floor, close to four things that stay), "around" (the same, with things in random places
            that may touch the object) or "pair" (two objects side by side).
        task: what the scene asks for. "remove": remove the object. "insert": insert the object, which only the test
            views and the references show. "outpaint": continue the scene beyond a sphere. "sparse": no object is
            removed or inserted, but few views have pixels.
        references: number of references in the scene's folder for the tasks "remove" (none if the object hangs) and
            "insert". For "outpaint" there are as many as are needed to show everything, for "sparse" there are `shown`.
        past: share of the picture's width by which test views are turned away, in random directions, so that they look
            past what training views show.
        shown: for the task "sparse" the number of training views with pixels; the other training views are cameras
            only. 0 for all other tasks, in which all training views have pixels.
        least: smallest allowed mean share of the masks whose background no training view shows, in [0, 1]. It is
            checked for the task "remove" only, unless the object hangs.
        low: height of the lowest cameras above the floor, metres; None for cameras at eye level.
        depth_error: for the task "remove", largest relative error of the disparity in the depth maps of the references,
            which then are as a monocular network gives them. 0: the references have no depth maps.
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
    past: float = 0.0
    depth_error: float = 0.0

    @property
    def is_circle(self) -> bool:
        """True if the cameras circle the object."""
        return self.spread >= 180


KINDS = {
    "demo": Kind(),
    "mini": Kind(width=64, height=48, train=8, test=3, texture=256, node=0.1, points=400),
    "wide": Kind(spread=50.0),
    "360": Kind(spread=180.0),
    "beside": Kind(spread=180.0, place="beside", least=0.1),
    "around": Kind(spread=180.0, place="around", least=0.05),
    "seen": Kind(spread=34.0, hangs=True),
    "behind": Kind(spread=50.0, place="behind"),
    "mono": Kind(width=144, height=108, train=40, test=20, spread=50.0, bend=0.0, depth_error=0.25),
    "table": Kind(spread=34.0, place="table", least=0.05, low=0.45),
    "past": Kind(past=0.15),
    "corner": Kind(spread=30.0, place="corner", least=0.25),
    "grass": Kind(samples=2, spread=30.0, node=0.08, place="grass"),
    "insert": Kind(place="floor", task="insert", least=0, references=4),
    "outpaint": Kind(spread=16.0, task="outpaint", least=0),
    "pair": Kind(spread=30.0, place="pair", least=0.2, references=2),
    "sparse": Kind(spread=30.0, task="sparse", least=0, shown=4),
    "photos": Kind(width=480, height=360, train=26, test=0, photos=True, texture=2048, node=0.025),
}


def randomness(seed: int, label: str) -> np.random.Generator:
    """Return the random generator of one part of a scene.

    Each part has a generator of its own, so that a change to one part does not change the other parts.

    Args:
        seed: seed of the scene.
        label: name of the part.
    """
    return np.random.default_rng([seed, zlib.crc32(label.encode())])

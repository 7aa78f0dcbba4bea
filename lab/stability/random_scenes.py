"""Random small scenes, ordinary and extreme, on which the compiled rasterizer must agree with the oracle.

A seeded generator makes the same scenes for every version of the code. It often draws the ends of a range. Each scene
has up to eight Gaussians and up to 12 x 10 pixels, because the oracle evaluates all pairs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from lab.stability import oracle
from lab.stability.cases import Case
from reffusion.types import Camera, Gaussians

ORDINARY, EXTREME = 2e-5, 1e-3  # bounds of the relative error
MAX_GAUSSIANS = 8
END_SHARE = 0.2  # share of drawn numbers that are at an end of their range


class Worst(NamedTuple):
    """Largest error over random scenes.

    Attributes:
        error: the error.
        where: image or gradient that has this error.
        scene: number of the scene, from 0.
        scenes: number of scenes.
    """

    error: float
    where: str
    scene: int
    scenes: int


def _between(random: np.random.Generator, low: float, high: float) -> float:
    """Draw a number from a range; with probability `END_SHARE` it is one of the ends."""
    return float(random.choice((low, high))) if random.random() < END_SHARE else random.uniform(low, high)


def _integer(random: np.random.Generator, low: int, high: int) -> int:
    """Draw an integer from `low` to `high`, inclusive."""
    return round(_between(random, low - 0.49, high + 0.49))


def ordinary(random: np.random.Generator) -> tuple[Gaussians, Camera]:
    """Draw an ordinary scene: Gaussians of about a tenth of the extent, at most 30 times longer than thick.

    The camera is 1 to 2 extents away from the origin.
    """
    count, degree = _integer(random, 1, MAX_GAUSSIANS), _integer(random, 0, 3)
    view = _camera(random, _between(random, 1.0, 2.0), _between(random, 0.5, 3.0))
    scales = math.log(0.1) + np.clip(0.7 * random.normal(size=(count, 3)), -1.7, 1.7)
    arrays = (
        0.4 * random.normal(size=(count, 3)),
        random.normal(size=(count, 4)),
        scales,
        2 * random.normal(size=count),
        0.5 * random.normal(size=(count, (degree + 1) ** 2, 3)),
    )
    return _gaussians(arrays, random.random() < 0.5), view


def extreme(random: np.random.Generator) -> tuple[Gaussians, Camera]:
    """Draw an extreme scene.

    Standard deviations are 1e-7 to 1e4 extents, anisotropies up to 1e6, opacity logits up to 30 in size. Quaternions
    have any length, also 0. Gaussians may be near the near plane, behind the camera, or at its center.
    """
    count, degree = _integer(random, 1, MAX_GAUSSIANS), _integer(random, 0, 3)
    view = _camera(random, _between(random, 0.125, 4.0), _between(random, 0.25, 10.0))
    means, quaternions, scales, logits = [], [], [], []
    for _ in range(count):
        means.append(_place(random, view))
        length = 10.0 ** _between(random, -12, 12) if random.random() < 0.9 else 0.0
        quaternions.append(length * random.normal(size=4))
        thin = np.array([0.0, _between(random, 0, 6), _between(random, 0, 6)])
        scales.append(math.log(10) * np.maximum(_between(random, -7, 4) - random.permutation(thin), -7))
        logits.append(random.choice((_between(random, -5, 5), _between(random, -30, 30), 30.0)))
    sh = 10 ** _between(random, -2, 1) * random.normal(size=(count, (degree + 1) ** 2, 3))
    return _gaussians((means, quaternions, scales, logits, sh), random.random() < 0.5), view


def _place(random: np.random.Generator, view: Camera) -> np.ndarray:
    """Draw a mean [3] in the scene, near the near plane, behind the camera, at the camera's center, or far away."""
    kind = random.choice(("scene", "scene", "near plane", "behind", "centre", "far"))
    if kind == "scene":
        return 0.4 * random.normal(size=3)
    if kind == "far":
        return 10.0 ** _between(random, 0, 4) * random.normal(size=3)
    depth = {"near plane": 0.01 * _between(random, 0.5, 2.0), "behind": -_between(random, 0.0, 10.0), "centre": 0.0}[
        kind
    ]
    at = np.array([*(0.5 * depth * random.normal(size=2)), depth])
    pose = view.world_to_camera
    return pose[:3, :3].T @ (at - pose[:3, 3])


def _camera(random: np.random.Generator, distance: float, focal: float) -> Camera:
    """Draw a camera of up to 12 x 10 pixels that looks at the origin; `focal` is relative to the image width."""
    width, height = _integer(random, 1, 12), _integer(random, 1, 10)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=int(random.integers(2**31))).as_matrix()
    pose[:3, 3] = [*(0.05 * random.normal(size=2)), distance]
    middle = width / 2 + 0.3 * random.normal(), height / 2 + 0.3 * random.normal()
    return Camera("random", width, height, focal * width, 1.1 * focal * width, *middle, pose)


def _gaussians(arrays, antialiased: bool) -> Gaussians:
    """Return Gaussians from arrays of all parameters."""
    tensors = (torch.tensor(np.array(array), dtype=torch.float32) for array in arrays)
    return Gaussians(*tensors, antialiased=antialiased)


def find_worst(scenes: Callable, relative: float, count: int) -> Worst:
    """Draw scenes, the same ones in each call, compare the rasterizer with the oracle, and return the largest error.

    An error that is NaN counts as infinite.

    Args:
        scenes: `ordinary` or `extreme`.
        relative: bound of the relative error, see `oracle.errors`.
        count: number of scenes.
    """
    results = []
    for number in range(count):
        errors = oracle.errors(*scenes(np.random.default_rng((0, number))), relative, seed=number)
        where = max(errors, key=lambda name: errors[name] if errors[name] == errors[name] else math.inf)
        results.append((errors[where] if errors[where] == errors[where] else math.inf, where))
    at = max(range(len(results)), key=lambda k: results[k][0])
    return Worst(*results[at], at, len(results))


def _measured(scenes: Callable, relative: float, count: int) -> float:
    """Return the largest error over random scenes, and print where it occurs."""
    worst = find_worst(scenes, relative, count)
    print(f"  worst of {worst.scenes} {scenes.__name__} scenes: {worst.where}, scene {worst.scene}", flush=True)
    return worst.error


QUANTITY = "worst relative L2 error of a value or gradient block against float64"
CASES = (
    Case("1,000 random ordinary scenes", QUANTITY, ORDINARY, partial(_measured, ordinary, ORDINARY, 1000)),
    Case("1,000 random extreme scenes", QUANTITY, EXTREME, partial(_measured, extreme, EXTREME, 1000)),
)

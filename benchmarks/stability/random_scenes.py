"""Random small scenes, ordinary and extreme, on which the compiled rasterizer must agree with the oracle.

Hypothesis draws what is extreme (and so tries the ends of each range); a seeded generator draws what need only be
generic. Each scene has up to eight Gaussians and 12 x 10 pixels, for the oracle looks at every pair.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchmarks.stability import oracle
from benchmarks.stability.cases import Case
from reffusion.types import Camera, Gaussians

ORDINARY, EXTREME = 2e-5, 1e-3
MOST = 8
_between = partial(st.floats, width=32)
_seeds = st.integers(0, 2**32 - 1)


class Worst(NamedTuple):
    """The largest error over random scenes, where it is, and in which scene (counted from 0)."""

    error: float
    where: str
    scene: int
    scenes: int


@st.composite
def ordinary(draw) -> tuple[Gaussians, Camera]:
    """Gaussians a tenth of the scene large, at most 30 times longer than thick, seen from about one extent away."""
    random, count, degree = np.random.default_rng(draw(_seeds)), draw(st.integers(1, MOST)), draw(st.integers(0, 3))
    view = _camera(draw, random, draw(_between(1.0, 2.0)), draw(_between(0.5, 3.0)))
    scales = math.log(0.1) + np.clip(0.7 * random.normal(size=(count, 3)), -1.7, 1.7)
    arrays = (
        0.4 * random.normal(size=(count, 3)),
        random.normal(size=(count, 4)),
        scales,
        2 * random.normal(size=count),
        0.5 * random.normal(size=(count, (degree + 1) ** 2, 3)),
    )
    return _gaussians(arrays, draw(st.booleans())), view


@st.composite
def extreme(draw) -> tuple[Gaussians, Camera]:
    """Scales of 1e-7 to 1e4 extents, anisotropy to 1e6, logits to 30, any quaternion; at, behind and in the camera."""
    random, count, degree = np.random.default_rng(draw(_seeds)), draw(st.integers(1, MOST)), draw(st.integers(0, 3))
    view = _camera(draw, random, draw(_between(0.125, 4.0)), draw(_between(0.25, 10.0)))
    means, quaternions, scales, logits = [], [], [], []
    for _ in range(count):
        means.append(_place(draw, random, view))
        length = 10.0 ** draw(_between(-12, 12)) if draw(st.integers(0, 9)) else 0.0
        quaternions.append(length * random.normal(size=4))
        thin = np.array([0.0, draw(_between(0, 6)), draw(_between(0, 6))])
        scales.append(math.log(10) * np.maximum(draw(_between(-7, 4)) - random.permutation(thin), -7))
        logits.append(draw(st.one_of(_between(-5, 5), _between(-30, 30), st.just(30.0))))
    sh = 10 ** draw(_between(-2, 1)) * random.normal(size=(count, (degree + 1) ** 2, 3))
    return _gaussians((means, quaternions, scales, logits, sh), draw(st.booleans())), view


def _place(draw, random: np.random.Generator, view: Camera) -> np.ndarray:
    """A mean [3] in the scene, about the near plane, behind the camera, in its centre, or far away."""
    kind = draw(st.sampled_from(("scene", "scene", "near plane", "behind", "centre", "far")))
    if kind == "scene":
        return 0.4 * random.normal(size=3)
    if kind == "far":
        return 10.0 ** draw(_between(0, 4)) * random.normal(size=3)
    depth = {"near plane": 0.01 * draw(_between(0.5, 2.0)), "behind": -draw(_between(0.0, 10.0)), "centre": 0.0}[kind]
    at = np.array([*(0.5 * depth * random.normal(size=2)), depth])
    pose = view.world_to_camera
    return pose[:3, :3].T @ (at - pose[:3, 3])


def _camera(draw, random: np.random.Generator, distance: float, focal: float) -> Camera:
    """A view of the origin, up to 12 x 10 pixels; `focal`: over the image's width."""
    width, height = draw(st.integers(1, 12)), draw(st.integers(1, 10))
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=int(random.integers(2**31))).as_matrix()
    pose[:3, 3] = [*(0.05 * random.normal(size=2)), distance]
    middle = width / 2 + 0.3 * random.normal(), height / 2 + 0.3 * random.normal()
    return Camera("random", width, height, focal * width, 1.1 * focal * width, *middle, pose)


def _gaussians(arrays, antialiased: bool) -> Gaussians:
    tensors = (torch.tensor(np.array(array), dtype=torch.float32) for array in arrays)
    return Gaussians(*tensors, antialiased=antialiased)


def worst_of(scenes: Callable, relative: float, count: int) -> Worst:
    """Draw `count` scenes, the same ones each time, and compare each with the oracle."""
    found = []

    @seed(0)
    @settings(max_examples=count, database=None, deadline=None, phases=[Phase.generate],
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(scenes())
    def compare(scene):
        errors = oracle.errors(*scene, relative, seed=len(found))
        where = max(errors, key=lambda name: errors[name] if errors[name] == errors[name] else math.inf)
        found.append((errors[where] if errors[where] == errors[where] else math.inf, where))

    compare()
    at = max(range(len(found)), key=lambda k: found[k][0])
    return Worst(*found[at], at, len(found))


def _measured(scenes: Callable, relative: float, count: int) -> float:
    worst = worst_of(scenes, relative, count)
    print(f"  the worst of {worst.scenes} {scenes.__name__} scenes: {worst.where}, scene {worst.scene}", flush=True)
    return worst.error


QUANTITY = "worst relative L2 error of a value or gradient block against float64"
CASES = (
    Case("1,000 random ordinary scenes", QUANTITY, ORDINARY, partial(_measured, ordinary, ORDINARY, 1000)),
    Case("1,000 random extreme scenes", QUANTITY, EXTREME, partial(_measured, extreme, EXTREME, 1000)),
)

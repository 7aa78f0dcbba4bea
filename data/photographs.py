"""Photographs a made scene: a walk with a camera, exposure, and the masked pixels whose background no photograph
shows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import raycast
from kinds import Kind, randomness
from world import World

SPREAD = 8  # views of `Session.spread`


@dataclass(frozen=True)
class Session:
    """V photographs; those of test views come first, without the object (`shows_object`).

    Attributes:
        names: of the views; cameras: [V, 16]; test: number of test views.
        photos: [V, H, W, 3] uint8; masks: bool [V, H, W], pixels that the object touches or would touch.
        hidden: bool [V, H, W], masked pixels whose background no training view shows.
        middle: the view from the middle of the training views' walk.
        completions: view -> uint8 [H, W, 3], the desired picture, of the middle view and those farthest from it.
        spread: training views, each the one farthest from those before it, the middle one first.
        object_masks: object -> bool [V, H, W], its mask, for objects with masks of their own.
    """

    names: list[str]
    cameras: np.ndarray
    test: int
    photos: np.ndarray
    masks: np.ndarray
    hidden: np.ndarray
    middle: int
    completions: dict[int, np.ndarray]
    spread: list[int]
    object_masks: dict[str, np.ndarray]


def take_photographs(seed: int, kind: Kind, world: World, target: np.ndarray) -> Session:
    """All photographs of a scene, at one exposure."""
    train, test = (path(seed, kind, target, n, label) for n, label in ((kind.train, "train"), (kind.test, "test")))
    cameras = np.concatenate([test, train])
    names = [f"IMG_{k + 2000:04d}" for k in range(len(cameras))]
    middle = kind.test + _middle(train, kind)
    world = set_exposure(world, cameras[middle], kind)
    shots = [shoot(world, camera, kind, shows_object(kind, k)) for k, camera in enumerate(cameras)]
    photos, masks = (np.stack(pictures) for pictures in zip(*shots, strict=True))
    in_training = train, masks[kind.test :]
    hidden = [never_seen(world, camera, mask, *in_training) for camera, mask in zip(cameras, masks, strict=True)]
    spread = [kind.test + k for k in _spread(train, middle - kind.test, min(SPREAD, kind.train))]
    whole = {k: shoot(world, cameras[k], kind, kind.task != "remove")[0] for k in spread[: kind.references]}
    object_masks = {
        name: np.stack([_object_mask(world, c, kind, own) for c in cameras]) for name, own in world.objects.items()
    }
    return Session(names, cameras, kind.test, photos, masks, np.stack(hidden), middle, whole, spread, object_masks)


def _spread(cameras: np.ndarray, first: int, count: int) -> list[int]:
    """`count` cameras, each the one farthest from those before it."""
    chosen, distance = [first], np.full(len(cameras), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.linalg.norm(cameras[:, 13:] - cameras[chosen[-1], 13:], axis=1))
        chosen.append(int(np.argmax(distance)))
    return chosen


def _object_mask(world: World, camera: np.ndarray, kind: Kind, own: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels whose ray hits this object, bool [n] of the solids, first."""
    alone = replace(world, solids=world.solids._replace(removable=own))
    return _radiance(alone, camera, kind, True, kind.samples)[1]


def shows_object(kind: Kind, k: int) -> bool:
    """Does the photograph of view k show the object?"""
    return (k >= kind.test) != (kind.task == "insert") or kind.task == "outpaint"


def path(seed: int, kind: Kind, target: np.ndarray, count: int, label: str) -> np.ndarray:
    """Cameras [count, 16] along an unsteady walk around the target; `label` names the walk."""
    draw = randomness(seed, f"path {label}")
    azimuth, height, radius = _walk(kind, count, 1.0 if label == "train" else 0.88, draw)
    angle = np.radians(azimuth + draw.normal(0, 0.6, count))
    center = target + np.stack([radius * np.sin(angle), height - target[1], radius * np.cos(angle)], 1)
    center += draw.normal(0, 0.015, (count, 3))
    aim = target + draw.normal(0, 0.04, (count, 3))
    roll = np.radians(draw.normal(0, 1.2, count))
    focal = kind.width * (0.82 if kind.is_circle else 0.85)
    bend = kind.bend * randomness(seed, "lens").uniform(0.7, 1.0)
    cameras = np.empty((count, 16))
    for k in range(count):
        turn = _look_at(aim[k] - center[k], roll[k])
        cameras[k] = focal, kind.width / 2, kind.height / 2, bend, *turn.ravel(), *center[k]
    return cameras


def _middle(cameras: np.ndarray, kind: Kind) -> int:
    """The camera nearest to the mean of all; if some are low, to the mean at the height of the highest."""
    mean_position = cameras[:, 13:].mean(0)
    if kind.low is not None:
        mean_position[1] = cameras[:, 14].max()
    return int(np.argmin(np.linalg.norm(cameras[:, 13:] - mean_position, axis=1)))


def _walk(kind: Kind, count: int, reach: float, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Azimuth [count] in degrees, height and horizontal distance from the target in metres."""
    s = (np.arange(count) + 0.5) / max(count, 1)
    phase = draw.random(4) * 6.28
    if kind.is_circle:
        azimuth = 360 * (2 * s + draw.random())
        height = 1.15 + 0.12 * np.sin(6.28 * 3 * s + phase[1]) + np.where(s < 0.5, 0.2, -0.1)
        return azimuth, height, 2.25 + 0.1 * np.sin(6.28 * 5 * s + phase[2])
    # Few views walk one arc and back; many go to and fro, so that heights and sides mix.
    azimuth = reach * kind.spread * np.sin(6.28 * 2.5 * s + phase[0])
    swing = np.sin(6.28 * 1.5 * s + phase[1])
    # With a low end, most views still come from above.
    height = 1.22 + 0.2 * swing if kind.low is None else 1.42 - (1.42 - kind.low) * (0.5 - 0.5 * swing) ** 2
    return azimuth, height, 2.45 + 0.08 * np.sin(6.28 * 4 * s + phase[2])


def _look_at(along: np.ndarray, roll: float) -> np.ndarray:
    """[3, 3] camera-to-room rotation that looks along a direction, rolled by `roll` radians."""
    forward = along / np.linalg.norm(along)
    right = np.cross(forward, (0, 1, 0))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    return np.stack([c * right + s * down, c * down - s * right, forward], 1)


def develop(color: np.ndarray, exposure: float) -> np.ndarray:
    """Linear radiance -> sRGB bytes, with a shoulder instead of clipped highlights."""
    tone = 1 - np.exp(-exposure * color)
    return np.round(255 * tone ** (1 / 2.2)).astype(np.uint8)


def shoot(world: World, camera: np.ndarray, kind: Kind, with_object: bool) -> tuple[np.ndarray, np.ndarray]:
    """(photograph uint8 [H, W, 3], bool [H, W]: pixels that the object touches, or would touch)."""
    color, mask = _radiance(world, camera, kind, with_object, kind.samples)
    return develop(color, world.exposure), mask


def _radiance(world: World, camera, kind: Kind, with_object: bool, samples: int) -> tuple[np.ndarray, np.ndarray]:
    return raycast.render(
        world.solids, world.faces, world.textures, world.light, camera, kind.width, kind.height, with_object, samples
    )


def set_exposure(world: World, camera: np.ndarray, kind: Kind) -> World:
    """The world with the exposure that makes the mean of this view, without the object, a medium grey."""
    color, _ = _radiance(world, camera, kind, False, 1)
    low, high = 0.01, 1000.0
    for _ in range(40):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if develop(color, middle).mean() < 128 else (low, middle)
    return replace(world, exposure=float(middle))


def pixel_centers(mask: np.ndarray) -> np.ndarray:
    """[P, 2] image points of a mask's pixels."""
    return np.argwhere(mask)[:, ::-1] + 0.5


def never_seen(world: World, camera, mask, train_cameras, train_masks) -> np.ndarray:
    """Bool [H, W]: pixels of the mask whose background no training view shows outside its own mask."""
    points, _ = raycast.surface_points(world.solids, camera, pixel_centers(mask), False)
    result = np.zeros(mask.shape, bool)
    result[mask] = raycast.never_seen(world.solids, train_cameras, train_masks, points)
    return result


def corner_shift(camera: np.ndarray) -> float:
    """Pixels by which the lens moves the image's corners."""
    radius = np.hypot(camera[1], camera[2]) / camera[0]
    undone = radius
    for _ in range(8):
        undone -= (undone + camera[3] * undone**3 - radius) / (1 + 3 * camera[3] * undone**2)
    return camera[0] * (radius - undone)

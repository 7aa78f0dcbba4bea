"""Photographs of a made scene: camera positions along a walk, exposure, masks, and never-seen background.

A camera is one row [16] of the ray caster, see `raycast`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lab.scenes import raycast
from lab.scenes.kinds import Kind, randomness
from lab.scenes.world import World

SPREAD = 8  # largest number of views in `Session.spread`


@dataclass(frozen=True)
class Session:
    """V photographs of a scene. Test views come first; `shows_object` says which views show the object.

    Attributes:
        names: names of the V views.
        cameras: [V, 16].
        test: number of test views.
        photos: uint8 [V, H, W, 3].
        masks: bool [V, H, W], True for pixels that the object touches, or would touch in a view without the object.
        hidden: bool [V, H, W], True for masked pixels whose background no training view shows.
        middle: index, among all V views, of the training view nearest to the mean position of the training cameras (if
            the kind has low cameras: to the mean position at the height of the highest camera).
        completions: view index -> uint8 [H, W, 3], the picture that the task asks for (without the object where it is
            to be removed). The first `Kind.references` views of `spread` have one.
        spread: indices, among all V views, of at most `SPREAD` training views that are far apart: the middle view, then
            each time the view whose distance to the nearest view chosen before is largest.
        object_masks: name of an object -> bool [V, H, W], the object's mask; only objects with masks of their own.
        seed: seed of the scene.
        backgrounds: uint8 [N, H, W, 3], the training views without the object; N = 0 unless the kind has a
            `depth_error`.
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
    seed: int
    backgrounds: np.ndarray


def take_photographs(seed: int, kind: Kind, world: World, target: np.ndarray) -> Session:
    """Take all photographs of a scene at one exposure, with their masks.

    Args:
        seed: seed of the scene.
        kind: kind of the scene.
        world: the furnished room with materials and light.
        target: [3], the point that the cameras look at, metres.
    """
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
    backgrounds = [shoot(world, camera, kind, with_object=False)[0] for camera in train] if kind.depth_error else []
    return Session(
        names,
        cameras,
        kind.test,
        photos,
        masks,
        np.stack(hidden),
        middle,
        whole,
        spread,
        object_masks,
        seed=seed,
        backgrounds=np.array(backgrounds),
    )


def _spread(cameras: np.ndarray, first: int, count: int) -> list[int]:
    """Return the indices of `count` cameras: `first`, then each time the one farthest from its nearest chosen one."""
    chosen, distance = [first], np.full(len(cameras), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.linalg.norm(cameras[:, 13:] - cameras[chosen[-1], 13:], axis=1))
        chosen.append(int(np.argmax(distance)))
    return chosen


def _object_mask(world: World, camera: np.ndarray, kind: Kind, own: np.ndarray) -> np.ndarray:
    """Return bool [H, W], pixels where at least one ray meets the object first; `own` [n] marks the object's solids."""
    alone = replace(world, solids=world.solids._replace(removable=own))
    return _radiance(alone, camera, kind, True, kind.samples)[1]


def shows_object(kind: Kind, k: int) -> bool:
    """Return True if the photograph of view k shows the object.

    For removal these are the training views, for insertion the test views, for outpainting all views.
    """
    return (k >= kind.test) != (kind.task == "insert") or kind.task == "outpaint"


def path(seed: int, kind: Kind, target: np.ndarray, count: int, label: str) -> np.ndarray:
    """Return cameras [count, 16] along an unsteady walk around the target.

    Args:
        seed: seed of the scene.
        kind: kind of the scene.
        target: [3], the point at which the cameras look approximately, metres.
        count: number of cameras.
        label: "train" or "test"; each has a walk of its own, and the test cameras reach less far to the sides.
    """
    draw = randomness(seed, f"path {label}")
    azimuth, height, radius = _walk(kind, count, 1.0 if label == "train" else 0.88, draw)
    angle = np.radians(azimuth + draw.normal(0, 0.6, count))
    center = target + np.stack([radius * np.sin(angle), height - target[1], radius * np.cos(angle)], 1)
    center += draw.normal(0, 0.015, (count, 3))
    aim = target + draw.normal(0, 0.04, (count, 3))
    roll = np.radians(draw.normal(0, 1.2, count))
    focal = kind.width * (0.82 if kind.is_circle else 0.85)
    bend = kind.bend * randomness(seed, "lens").uniform(0.7, 1.0)
    if kind.past and label == "test":
        aim = _turn_away(center, aim, kind.past * kind.width / focal, randomness(seed, "past"))
    cameras = np.empty((count, 16))
    for k in range(count):
        turn = _look_at(aim[k] - center[k], roll[k])
        cameras[k] = focal, kind.width / 2, kind.height / 2, bend, *turn.ravel(), *center[k]
    return cameras


def _turn_away(center: np.ndarray, aim: np.ndarray, slope: float, draw: np.random.Generator) -> np.ndarray:
    """Return new aims [V, 3], which turn each camera in a random direction by an angle whose tangent is `slope`."""
    ahead = aim - center
    right = np.cross(ahead, [0.0, 1.0, 0.0])
    right *= np.linalg.norm(ahead, axis=1, keepdims=True) / np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(right, ahead) / np.linalg.norm(ahead, axis=1, keepdims=True)
    angle = draw.uniform(0, 2 * np.pi, (len(aim), 1))
    return aim + slope * (np.cos(angle) * right + np.sin(angle) * up)


def _middle(cameras: np.ndarray, kind: Kind) -> int:
    """Return the index of the camera nearest to the mean position, at the height of the highest if some are low."""
    mean_position = cameras[:, 13:].mean(0)
    if kind.low is not None:
        mean_position[1] = cameras[:, 14].max()
    return int(np.argmin(np.linalg.norm(cameras[:, 13:] - mean_position, axis=1)))


def _walk(kind: Kind, count: int, reach: float, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return azimuth in degrees, height above the floor and horizontal distance to the target in m, [count] each."""
    s = (np.arange(count) + 0.5) / max(count, 1)
    phase = draw.random(4) * 6.28
    if kind.is_circle:
        azimuth = 360 * (2 * s + draw.random())
        height = 1.15 + 0.12 * np.sin(6.28 * 3 * s + phase[1]) + np.where(s < 0.5, 0.2, -0.1)
        return azimuth, height, 2.25 + 0.1 * np.sin(6.28 * 5 * s + phase[2])
    # The azimuth swings 2.5 times, the height 1.5 times, so that different heights occur on both sides.
    # `reach` is a factor on the azimuth to either side.
    azimuth = reach * kind.spread * np.sin(6.28 * 2.5 * s + phase[0])
    swing = np.sin(6.28 * 1.5 * s + phase[1])
    # The square keeps most views high even if the lowest cameras are near the floor.
    height = 1.22 + 0.2 * swing if kind.low is None else 1.42 - (1.42 - kind.low) * (0.5 - 0.5 * swing) ** 2
    return azimuth, height, 2.45 + 0.08 * np.sin(6.28 * 4 * s + phase[2])


def _look_at(along: np.ndarray, roll: float) -> np.ndarray:
    """Return the camera-to-room rotation [3, 3] of a camera that looks along a direction, rolled by `roll` radians."""
    forward = along / np.linalg.norm(along)
    right = np.cross(forward, (0, 1, 0))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    return np.stack([c * right + s * down, c * down - s * right, forward], 1)


def develop(color: np.ndarray, exposure: float) -> np.ndarray:
    """Convert linear radiance times `exposure` to sRGB bytes by a curve that compresses highlights without clipping."""
    tone = 1 - np.exp(-exposure * color)
    return np.round(255 * tone ** (1 / 2.2)).astype(np.uint8)


def shoot(world: World, camera: np.ndarray, kind: Kind, with_object: bool) -> tuple[np.ndarray, np.ndarray]:
    """Take a photograph with or without the object.

    Returns:
        The photograph, uint8 [H, W, 3], and the mask, bool [H, W], True for pixels that the object touches, or would
        touch if it were there.
    """
    color, mask = _radiance(world, camera, kind, with_object, kind.samples)
    return develop(color, world.exposure), mask


def _radiance(world: World, camera, kind: Kind, with_object: bool, samples: int) -> tuple[np.ndarray, np.ndarray]:
    return raycast.render(
        world.solids, world.faces, world.textures, world.light, camera, kind.width, kind.height, with_object, samples
    )


def set_exposure(world: World, camera: np.ndarray, kind: Kind) -> World:
    """Return the world with the exposure at which the mean byte of a view without the object is 128.

    Args:
        camera: [16], camera of the view.
    """
    color, _ = _radiance(world, camera, kind, False, 1)
    low, high = 0.01, 1000.0
    for _ in range(40):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if develop(color, middle).mean() < 128 else (low, middle)
    return replace(world, exposure=float(middle))


def pixel_centers(mask: np.ndarray) -> np.ndarray:
    """Return the image points (x, y) of the centers of a mask's P True pixels, [P, 2]."""
    return np.ascontiguousarray(np.argwhere(mask)[:, ::-1] + 0.5)


def never_seen(world: World, camera, mask, train_cameras, train_masks) -> np.ndarray:
    """Return bool [H, W], the pixels of a view's mask whose background no training view shows.

    A training view shows a background point only outside the view's own mask.

    Args:
        camera: [16], camera of the view.
        mask: bool [H, W], mask of the view.
        train_cameras: [V, 16].
        train_masks: bool [V, H, W].
    """
    points, _ = raycast.surface_points(world.solids, camera, pixel_centers(mask), False)
    result = np.zeros(mask.shape, bool)
    result[mask] = raycast.never_seen(world.solids, train_cameras, train_masks, points)
    return result


def corner_shift(camera: np.ndarray) -> float:
    """Return the distance in px by which the lens distortion moves the corners of the image."""
    radius = np.hypot(camera[1], camera[2]) / camera[0]
    undone = radius
    for _ in range(8):
        undone -= (undone + camera[3] * undone**3 - radius) / (1 + 3 * camera[3] * undone**2)
    return camera[0] * (radius - undone)

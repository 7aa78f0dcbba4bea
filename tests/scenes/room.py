"""Photographs of a room's corner, whose textures are rich in features, by a camera that walks past it."""

import numpy as np

from scenes.cameras import rotation_along


def speckle_texture(generator: np.random.Generator, size: int = 256) -> np.ndarray:
    """Return a texture [size, size, 3] of speckle at several scales, in [0, 255]."""
    total = np.zeros((size, size, 3))
    for cell in (2, 4, 8, 16, 32):
        coarse = generator.random((size // cell, size // cell, 3))
        total += np.kron(coarse, np.ones((cell, cell, 1))) * cell**0.5
    return 255 * (total - total.min()) / np.ptp(total)


def room_textures(generator: np.random.Generator) -> np.ndarray:
    """Return textures [3, 256, 256, 3] of speckle, one for each plane of the corner."""
    return np.stack([speckle_texture(generator) for _ in range(3)])


def render_room_corner(pose: np.ndarray, textures: np.ndarray, size=(200, 150), focal=170.0) -> np.ndarray:
    """Render the corner of a room with the planes x = 2, y = 1.5 and z = 3; return uint8 [H, W, 3].

    Args:
        pose: [4, 4], from world to camera.
        textures: [3, S, S, 3], the textures of these planes in [0, 255].
        size: width and height in px.
        focal: focal length in px.
    """
    columns, rows = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    rays = np.stack([(columns - size[0] / 2) / focal, (rows - size[1] / 2) / focal, np.ones_like(rows)], -1)
    rays, center = rays @ pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3]
    with np.errstate(divide="ignore"):
        times = (np.array([2.0, 1.5, 3.0]) - center) / rays
    times = np.where(times > 0, times, np.inf)
    plane = times.argmin(-1)
    hit = center + rays * times.min(-1)[..., None]
    flat = np.stack([hit[..., 1], hit[..., 0], hit[..., 0]], -1), np.stack([hit[..., 2], hit[..., 2], hit[..., 1]], -1)
    u, v = (np.take_along_axis(axis, plane[..., None], -1)[..., 0] * 40 for axis in flat)
    texels = textures.shape[1]
    return textures[plane, v.astype(int) % texels, u.astype(int) % texels].astype(np.uint8)


def room_walk(count: int) -> dict[str, np.ndarray]:
    """Return view name -> pose [4, 4] from world to camera, of `count` views that face the corner.

    The camera centers alternate in height, because a similarity cannot be estimated from centers on one line.
    """
    result = {}
    for k in range(count):
        t = k / (count - 1) - 0.5
        center, forward = np.array([1.6 * t, 0.3 * (-1) ** k, -1.0 + 0.8 * t * t]), np.array([0.35 - 0.4 * t, 0.2, 1.0])
        pose = np.eye(4)
        pose[:3, :3] = rotation_along(forward, (0.0, -1.0, 0.0))
        pose[:3, 3] = -pose[:3, :3] @ center
        result[f"p{k}"] = pose
    return result

"""Rendering of a synthetic object into photographs, for the scenes of `lab/studies/composites.py`.

The object is drawn over everything else, so a place is valid only if nothing there should occlude the object.
Photographs without the object stay as they are, so the truth behind the object is exact. Cameras are camera-to-world
matrices, as in `placement.py`.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from scipy.interpolate import LinearNDInterpolator

from lab.studies import placement
from reffusion.io.images import load_image, save_image

SAMPLES = 3  # rays per side of a pixel
DARKEST, SQUARES = 0.45, 3  # ambient light; squares of the checkerboard along half an edge of the object
LIGHT = (0.9, -0.2, 1.0)  # direction to the light, along the object's axes
CELL = 12  # side of image cells, px; in each cell only the nearest sparse points are used
# Center and reach of the shadow on the surface along the object's first two axes, relative to its height.
SHADOW_AT, SHADOW_REACH = (
    (-0.8, 0.15),
    (0.95, 0.8),
)


@dataclass(frozen=True)
class Options:
    """Options of a scene beside its place.

    Attributes:
        reference: True if the scene's reference is the untouched photograph of the middle training view; False if the
            scene has no reference.
        shadow: strength of the object's soft shadow on the surface, 0 to 1. Masks do not contain the shadow.
        rough: largest perturbation of training masks, px: each is dilated or eroded, and shifted, at random.
        seed: seed of the object's colors and of the masks' perturbations.
    """

    reference: bool = True
    shadow: float = 0.0
    rough: int = 0
    seed: int = 0

    @property
    def suffix(self) -> str:
        """Suffix of the scene's name, which encodes the options."""
        parts = [f"-shadow{self.shadow:g}" if self.shadow else "", f"-rough{self.rough}" if self.rough else ""]
        return "".join(parts) + ("" if self.reference else "-alone") + (f"-{self.seed}" if self.seed else "")


@dataclass(frozen=True)
class PixelRays:
    """Rays through the pixels of a capture, with lens distortion removed. They are the same in every view."""

    capture: placement.Photographs

    def rays(self, samples: int) -> np.ndarray:
        """Return rays with z = 1 in the camera's axes, [H samples W samples, 3], row by row.

        Args:
            samples: rays per side of a pixel.
        """
        k = self.capture
        u, v = np.meshgrid(*((np.arange(side * samples) + 0.5) / samples for side in (k.width, k.height)))
        distorted = np.stack([u, v], -1).reshape(-1, 1, 2)
        straight = cv2.undistortPoints(distorted, k.intrinsics, k.distortion).reshape(-1, 2)
        return np.concatenate([straight, np.ones((len(straight), 1))], 1)

    @cached_property
    def fine(self) -> np.ndarray:
        """Rays with `SAMPLES` per side of a pixel."""
        return self.rays(SAMPLES)

    @cached_property
    def coarse(self) -> np.ndarray:
        """Rays through the pixel centers."""
        return self.rays(1)

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Average values [N, ...] of the fine rays over each pixel; return [H, W, ...]."""
        k = self.capture
        return values.reshape(k.height, SAMPLES, k.width, SAMPLES, *values.shape[1:]).mean((1, 3))


def render_object(
    view: PixelRays, camera: np.ndarray, thing: placement.PlacedObject, tints: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Render the object alone.

    Args:
        view: rays of the capture.
        camera: camera-to-world matrix [4, 4].
        thing: the object.
        tints: [3, 3], RGB colors in [0, 1] of the faces of each axis; an ellipsoid has the first one only.

    Returns:
        RGB [H, W, 3] multiplied by the coverage, and the coverage [H, W], all in [0, 1].
    """
    # In the object's axes and divided by its half extents, the object is a cube, or a ball of radius 1.
    ways = view.fine @ camera[:3, :3].T @ thing.axes.T / thing.half
    start = (camera[:3, 3] - thing.middle) @ thing.axes.T / thing.half
    far, hit, normal, face = (_cube if thing.shape == "box" else _ball)(ways, start, thing.half)
    at = start + np.where(hit, far, 0)[:, None] * ways
    # A face of the cube is at the border of two layers of the checkerboard. Without the offset, rounding would decide
    # which layer a point belongs to.
    pattern = np.floor(at * SQUARES + 1e-6).sum(1).astype(int) % 2 * 0.5 + 0.5
    light = np.array(LIGHT) / np.linalg.norm(LIGHT)
    lit = DARKEST + (1 - DARKEST) * np.clip(normal @ light, 0, 1)
    color = tints[face] * (pattern * lit * hit)[:, None]
    return view.mean(color), view.mean(hit.astype(float))


def composite_object(
    photo: np.ndarray, view: PixelRays, camera: np.ndarray, thing: placement.PlacedObject, tints: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the object into a photograph.

    Args:
        photo: [H, W, 3] in [0, 1]; it is not changed.
        view, camera, thing, tints: as for `render_object`.

    Returns:
        Photograph with the object, uint8 [H, W, 3], and the object's mask, uint8 [H, W] in {0, 255}: 255 where the
        object covers a part of the pixel.
    """
    color, cover = render_object(view, camera, thing, tints)
    both = photo * (1 - cover[..., None]) + color
    return (both * 255 + 0.5).clip(0, 255).astype(np.uint8), (cover > 0).astype(np.uint8) * 255


def composite_depth(view: PixelRays, camera: np.ndarray, thing: placement.PlacedObject) -> np.ndarray:
    """Return a depth map [H, W] of camera z with the object.

    Outside the object, depth is interpolated between sparse points; it is NaN outside the convex hull of these points.
    """
    ways, shape = view.coarse @ camera[:3, :3].T, (view.capture.height, view.capture.width)
    start = (camera[:3, 3] - thing.middle) @ thing.axes.T / thing.half
    far, hit, _, _ = (_cube if thing.shape == "box" else _ball)(ways @ thing.axes.T / thing.half, start, thing.half)
    return np.where(hit, far, interpolate_points(view, camera).ravel()).reshape(shape)


def interpolate_points(view: PixelRays, camera: np.ndarray) -> np.ndarray:
    """Return a depth map [H, W] of camera z, interpolated linearly between sparse points.

    In each cell of the image only points of the front surface are used. Depth is NaN outside their convex hull.
    """
    image, z = view.capture.project(camera, view.capture.points)
    size = np.array([view.capture.width, view.capture.height])
    image, z = (each[(z > 0) & ((image >= 0) & (image < size)).all(1)] for each in (image, z))
    _, cell = np.unique(image // CELL, axis=0, return_inverse=True)
    nearest = np.full(cell.max() + 1, np.inf)
    np.minimum.at(nearest, cell, z)
    front = z < placement.FRONT_TOLERANCE * nearest[cell]
    columns, rows = np.meshgrid(*(np.arange(side) + 0.5 for side in size))
    return LinearNDInterpolator(image[front], z[front])(columns, rows)


def _cube(ways: np.ndarray, start: np.ndarray, half: np.ndarray):
    """Intersect rays [N, 3] from `start` with the cube [-1, 1]^3; return ray parameter, hit, normal and face axis."""
    # In the object's axes, divided by its half extents; `half` is used for the ball only.
    with np.errstate(divide="ignore"):
        walls = np.stack([(-1 - start) / ways, (1 - start) / ways])
    enter, leave = walls.min(0), walls.max(0)
    far, face, row = enter.max(1), enter.argmax(1), np.arange(len(ways))
    normal = np.zeros_like(ways)
    normal[row, face] = -np.sign(ways[row, face])
    return far, (far < leave.min(1)) & (far > 0), normal, face


def _ball(ways: np.ndarray, start: np.ndarray, half: np.ndarray):
    """Intersect N rays with the ball of radius 1, as `_cube` does for the cube. The ball has one face, 0."""
    a, b, c = (ways * ways).sum(1), (ways * start).sum(1), (start * start).sum() - 1
    root = b * b - a * c
    far = (-b - np.sqrt(np.maximum(root, 0))) / a
    normal = (start + far[:, None] * ways) / half
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
    return far, (root > 0) & (far > 0), normal, np.zeros(len(ways), int)


def shadow_factor(view: PixelRays, camera: np.ndarray, thing: placement.PlacedObject, strength: float) -> np.ndarray:
    """Return the factor [H, W] by which the object's soft shadow multiplies the light on the surface.

    The factor is in [1 - strength, 1], and 1 outside the shadow.
    """
    ways = view.coarse @ camera[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        far = ((thing.foot - camera[:3, 3]) @ thing.normal) / (ways @ thing.normal)
    ahead = np.isfinite(far) & (far > 0)
    at = (camera[:3, 3] + np.where(ahead, far, 0)[:, None] * ways - thing.foot) @ thing.axes[:2].T / thing.height
    squared_distance = (((at - SHADOW_AT) / SHADOW_REACH) ** 2).sum(1)
    light = np.where(ahead, 1 - strength * np.exp(-(squared_distance**2)), 1.0)
    return light.reshape(view.capture.height, view.capture.width)


def perturb_mask(mask: np.ndarray, most: int, random: np.random.Generator) -> np.ndarray:
    """Return a mask, uint8 [H, W], dilated or eroded by 1 to `most` px, then shifted by up to `most` px per axis."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * random.integers(1, most + 1) + 1,) * 2)
    mask = cv2.dilate(mask, disc) if random.random() < 0.5 else cv2.erode(mask, disc)
    down, right = (int(step) for step in random.integers(-most, most + 1, 2))
    return cv2.warpAffine(mask, np.float32([[1, 0, right], [0, 1, down]]), mask.shape[::-1], flags=cv2.INTER_NEAREST)


def write_scene(place: placement.Place, capture: placement.Photographs, options: Options, out: Path) -> None:
    """Write the scene of a place: images, masks, test_masks, truth, transforms.json, points and scene.yaml.

    The object is in the images of the training views only; the images of the test views are the untouched photographs.

    Args:
        place: the place.
        capture: the capture.
        options: options of the scene.
        out: folder to write to; emptied first.

    Raises:
        ValueError: the object cannot be placed, too few photographs show it, or a photograph has another size than
            transforms.json says.
    """
    thing = placement.place_object(capture, place)
    views = placement.select_views(capture, place, thing)
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    random, view = np.random.default_rng(options.seed), PixelRays(capture)
    tints = random.uniform(0.35, 0.9, (3, 3))
    for name in views.all:
        camera, photo = capture.cameras[name], load_photograph(capture, name)
        light = shadow_factor(view, camera, thing, options.shadow)[..., None] if options.shadow else 1.0
        both, mask = composite_object(photo / 255.0 * light, view, camera, thing, tints)
        save_image(out / f"truth/{name}.png", photo)
        if name in views.test:
            save_image(out / f"images/{name}.png", photo)
            save_image(out / f"test_masks/{name}.png", mask)
            continue
        save_image(out / f"images/{name}.png", both)
        raw_mask = perturb_mask(mask, options.rough, random) if options.rough else mask
        save_image(out / f"masks/{name}.png", raw_mask)
    write_cameras(capture, views, out)
    lines = ["masks: masks", "test_masks: test_masks", f"test: {yaml_list(views.test)}"]
    if options.reference:
        middle = views.train[len(views.train) // 2]
        lines += ["reference:", f'  view: "{middle}"', f"  image: truth/{middle}.png"]
    (out / "scene.yaml").write_text("\n".join(lines) + "\n")


def write_untouched(place: placement.Place, capture: placement.Photographs, scene: Path, out: Path) -> None:
    """Write the scene of a place without the object and with nothing to remove; a fit to it is the ceiling.

    Args:
        place: the place.
        capture: the capture.
        scene: folder of the scene with the object, from `write_scene`.
        out: folder to write to; emptied first.
    """
    views = placement.select_views(capture, place, placement.place_object(capture, place))
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(scene / "truth", out / "images")
    shutil.copytree(scene / "test_masks", out / "test_masks")
    write_cameras(capture, views, out)
    (out / "scene.yaml").write_text(f"masks: none\ntest_masks: test_masks\ntest: {yaml_list(views.test)}\n")


def write_cameras(capture: placement.Photographs, views: placement.Views, out: Path) -> None:
    """Write transforms.json for the selected views and copy the file of the capture's points."""
    placement.save_transforms(capture, views.all, out / "transforms.json")
    (out / capture.cloud).parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(capture.folder / capture.cloud, out / capture.cloud)


def load_photograph(capture: placement.Photographs, name: str) -> np.ndarray:
    """Load a photograph of a capture, uint8 [H, W, 3].

    Raises:
        ValueError: its size differs from the size in transforms.json.
    """
    path = capture.folder / capture.frames[name]["file_path"]
    photo = load_image(path)
    if photo.shape[:2] != (capture.height, capture.width):
        raise ValueError(f"{path} is {photo.shape[1]}x{photo.shape[0]} px, transforms.json says "
                         f"{capture.width}x{capture.height}")  # fmt: skip
    return photo


def yaml_list(names: list[str]) -> str:
    """Return a YAML list of quoted names."""
    return "[" + ", ".join(f'"{name}"' for name in names) + "]"

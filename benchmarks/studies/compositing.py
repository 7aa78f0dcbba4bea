"""Rendering of a synthetic object into photographs: the scenes of `benchmarks/studies/composites.py`.

The object is drawn over everything, so a place is valid only where nothing should occlude it. Photographs without the
object stay as they are, so the truth behind it is exact.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from scipy.interpolate import LinearNDInterpolator

from benchmarks.studies import placement
from reffusion.io.images import load_image, save_image

SAMPLES = 3  # rays per side of a pixel
DARKEST, SQUARES = 0.45, 3  # ambient light; squares of the pattern along half an edge
LIGHT = (0.9, -0.2, 1.0)  # direction along the object's axes
CELL = 12  # side of the cells in px in which only the nearest sparse points count
SHADOW_AT, SHADOW_REACH = (
    (-0.8, 0.15),
    (0.95, 0.8),
)  # centre and reach, in heights of the object


@dataclass(frozen=True)
class Options:
    """Options of a scene beside the object.

    Attributes:
        reference: whether the untouched photograph of the middle training view is handed over.
        shadow: strength, 0 to 1, of a soft shadow on the surface that no mask contains.
        rough: training masks are dilated or eroded, and shifted, each at random by up to this many px.
        seed: of the object's colours and of these faults.
    """

    reference: bool = True
    shadow: float = 0.0
    rough: int = 0
    seed: int = 0

    @property
    def suffix(self) -> str:
        """Suffix of the scene's name that encodes the options."""
        parts = [f"-shadow{self.shadow:g}" if self.shadow else "", f"-rough{self.rough}" if self.rough else ""]
        return "".join(parts) + ("" if self.reference else "-alone") + (f"-{self.seed}" if self.seed else "")


@dataclass(frozen=True)
class PixelRays:
    """A capture with the undistorted rays of its pixels, which are the same in every view."""

    capture: placement.Photographs

    def rays(self, samples: int) -> np.ndarray:
        """[H samples W samples, 3]: rays with z = 1, row by row, in the camera's axes."""
        k = self.capture
        u, v = np.meshgrid(*((np.arange(side * samples) + 0.5) / samples for side in (k.width, k.height)))
        distorted = np.stack([u, v], -1).reshape(-1, 1, 2)
        straight = cv2.undistortPoints(distorted, k.intrinsics, k.distortion).reshape(-1, 2)
        return np.concatenate([straight, np.ones((len(straight), 1))], 1)

    @cached_property
    def fine(self) -> np.ndarray:
        return self.rays(SAMPLES)

    @cached_property
    def coarse(self) -> np.ndarray:
        return self.rays(1)

    def mean(self, values: np.ndarray) -> np.ndarray:
        """[H, W, ...]: values [N, ...] of the fine rays averaged per pixel."""
        k = self.capture
        return values.reshape(k.height, SAMPLES, k.width, SAMPLES, *values.shape[1:]).mean((1, 3))


def render_object(
    view: PixelRays, camera: np.ndarray, thing: placement.PlacedObject, tints: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(RGB [H, W, 3] times coverage, coverage [H, W]) of the object, in [0, 1]; `tints` [3, 3] colours its faces."""
    # In the object's own axes, divided by its half extents: a cube, or a ball of radius 1.
    ways = view.fine @ camera[:3, :3].T @ thing.axes.T / thing.half
    start = (camera[:3, 3] - thing.middle) @ thing.axes.T / thing.half
    far, hit, normal, face = (_cube if thing.shape == "box" else _ball)(ways, start, thing.half)
    at = start + np.where(hit, far, 0)[:, None] * ways
    # A face of the cube lies on the border of two layers of squares: the offset decides, not rounding.
    pattern = np.floor(at * SQUARES + 1e-6).sum(1).astype(int) % 2 * 0.5 + 0.5
    light = np.array(LIGHT) / np.linalg.norm(LIGHT)
    lit = DARKEST + (1 - DARKEST) * np.clip(normal @ light, 0, 1)
    color = tints[face] * (pattern * lit * hit)[:, None]
    return view.mean(color), view.mean(hit.astype(float))


def composite_object(
    photo: np.ndarray, view: PixelRays, camera: np.ndarray, thing: placement.PlacedObject, tints: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(photograph with the object, mask [H, W] in {0, 255}), uint8; `photo` is [H, W, 3] in [0, 1]."""
    color, cover = render_object(view, camera, thing, tints)
    both = photo * (1 - cover[..., None]) + color
    return (both * 255 + 0.5).clip(0, 255).astype(np.uint8), (cover > 0).astype(np.uint8) * 255


def composite_depth(view: PixelRays, camera: np.ndarray, thing: placement.PlacedObject) -> np.ndarray:
    """[H, W]: camera z of the object, elsewhere interpolated between sparse points; NaN outside their hull."""
    ways, shape = view.coarse @ camera[:3, :3].T, (view.capture.height, view.capture.width)
    start = (camera[:3, 3] - thing.middle) @ thing.axes.T / thing.half
    far, hit, _, _ = (_cube if thing.shape == "box" else _ball)(ways @ thing.axes.T / thing.half, start, thing.half)
    return np.where(hit, far, interpolate_points(view, camera).ravel()).reshape(shape)


def interpolate_points(view: PixelRays, camera: np.ndarray) -> np.ndarray:
    """[H, W]: camera z, linear between the sparse points of the front surface per cell; NaN outside their hull."""
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
    """(distance [N], hit [N], normal [N, 3] in the object's axes, face [N], i.e. its axis) of rays to the unit cube."""
    with np.errstate(divide="ignore"):
        walls = np.stack([(-1 - start) / ways, (1 - start) / ways])
    enter, leave = walls.min(0), walls.max(0)
    far, face, row = enter.max(1), enter.argmax(1), np.arange(len(ways))
    normal = np.zeros_like(ways)
    normal[row, face] = -np.sign(ways[row, face])
    return far, (far < leave.min(1)) & (far > 0), normal, face


def _ball(ways: np.ndarray, start: np.ndarray, half: np.ndarray):
    """Like `_cube`, for the unit ball, which has one face."""
    a, b, c = (ways * ways).sum(1), (ways * start).sum(1), (start * start).sum() - 1
    root = b * b - a * c
    far = (-b - np.sqrt(np.maximum(root, 0))) / a
    normal = (start + far[:, None] * ways) / half
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
    return far, (root > 0) & (far > 0), normal, np.zeros(len(ways), int)


def shadow_factor(view: PixelRays, camera: np.ndarray, thing: placement.PlacedObject, strength: float) -> np.ndarray:
    """[H, W]: light that the object's soft shadow leaves on the surface; 1 outside the shadow."""
    ways = view.coarse @ camera[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        far = ((thing.foot - camera[:3, 3]) @ thing.normal) / (ways @ thing.normal)
    ahead = np.isfinite(far) & (far > 0)
    at = (camera[:3, 3] + np.where(ahead, far, 0)[:, None] * ways - thing.foot) @ thing.axes[:2].T / thing.height
    squared_distance = (((at - SHADOW_AT) / SHADOW_REACH) ** 2).sum(1)
    light = np.where(ahead, 1 - strength * np.exp(-(squared_distance**2)), 1.0)
    return light.reshape(view.capture.height, view.capture.width)


def perturb_mask(mask: np.ndarray, most: int, random: np.random.Generator) -> np.ndarray:
    """A uint8 mask [H, W] dilated or eroded by up to `most` px, then shifted by up to `most` px along each axis."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * random.integers(1, most + 1) + 1,) * 2)
    mask = cv2.dilate(mask, disc) if random.random() < 0.5 else cv2.erode(mask, disc)
    down, right = (int(step) for step in random.integers(-most, most + 1, 2))
    return cv2.warpAffine(mask, np.float32([[1, 0, right], [0, 1, down]]), mask.shape[::-1], flags=cv2.INTER_NEAREST)


def write_scene(place: placement.Place, capture: placement.Photographs, options: Options, out: Path) -> None:
    """Write the scene of a place to a new folder `out`: images, masks, test_masks, truth, transforms.json, scene.yaml.

    Raises:
        ValueError: the object cannot be placed, too few photographs show it, or one has another size.
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
    """Write the same views without the object and with nothing to remove; a fit to them is the ceiling.

    `scene` is the place's folder as `write_scene` made it.
    """
    views = placement.select_views(capture, place, placement.place_object(capture, place))
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(scene / "truth", out / "images")
    shutil.copytree(scene / "test_masks", out / "test_masks")
    write_cameras(capture, views, out)
    (out / "scene.yaml").write_text(f"masks: none\ntest_masks: test_masks\ntest: {yaml_list(views.test)}\n")


def write_cameras(capture: placement.Photographs, views: placement.Views, out: Path) -> None:
    """Write transforms.json and the points of the capture."""
    placement.save_transforms(capture, views.all, out / "transforms.json")
    (out / capture.cloud).parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(capture.folder / capture.cloud, out / capture.cloud)


def load_photograph(capture: placement.Photographs, name: str) -> np.ndarray:
    """uint8 [H, W, 3]. ValueError if its size differs from that in transforms.json."""
    path = capture.folder / capture.frames[name]["file_path"]
    photo = load_image(path)
    if photo.shape[:2] != (capture.height, capture.width):
        raise ValueError(f"{path} is {photo.shape[1]}x{photo.shape[0]} px, transforms.json says "
                         f"{capture.width}x{capture.height}")  # fmt: skip
    return photo


def yaml_list(names: list[str]) -> str:
    """A YAML list of quoted names."""
    return "[" + ", ".join(f'"{name}"' for name in names) + "]"

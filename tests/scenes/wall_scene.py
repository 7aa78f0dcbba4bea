"""A wall of Gaussians with a square of Gaussians (the object) before it, cameras side by side, and the true masks.

The cameras look along z. The wall is at depth `WALL`; `square_at` is the z of the square.
"""

from pathlib import Path

import numpy as np
import torch

from reffusion import geometry
from reffusion.background.model import surfaces_to_arrays
from reffusion.capture.lens import Lens
from reffusion.capture.lenses import save_lenses
from reffusion.gaussians.surfels import surface_gaussians
from reffusion.io.arrays import save_arrays
from reffusion.io.images import load_image, save_image, save_mask
from reffusion.io.ply import save_ply
from reffusion.io.scene import save_scene
from reffusion.types import Camera
from reffusion.workspace import SURFACES, Workspace
from scenes.cameras import make_camera, make_scene
from scenes.gaussians import join_gaussians

WALL, HALF, RIM = 2.0, 0.17, 0.015  # depth of the wall; half the side of the square, and its soft rim; scene units
WIDTH, HEIGHT, FOCAL = 96, 72, 90.0


def front_camera(name: str, x: float, y: float = 0.0, z: float = 0.0) -> Camera:
    """Return a camera at (x, y, z) that looks along z, perpendicular to the wall."""
    return make_camera(name, (WIDTH, HEIGHT), FOCAL, (x, y, z))


CAMERAS = {c.name: c for c in [*(front_camera(f"a{k}", x) for k, x in enumerate((-0.3, -0.15, 0.0, 0.15, 0.3))),
                               front_camera("t0", 0.07), front_camera("t1", -0.2, 0.05)]}  # fmt: skip
TRAIN, TEST = ("a0", "a1", "a2", "a3", "a4"), ("t0", "t1")


def wall_color(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the color [..., 3] in [0, 1] of the wall at (x, y)."""
    return np.stack([0.5 + 0.3 * np.sin(9 * x), 0.5 + 0.3 * np.cos(8 * y), 0.5 + 0.2 * np.sin(6 * (x + y))], -1)


def rectangle_gaussians(depth: float, half_x: float, half_y: float, color):
    """Return the Gaussians of a rectangle perpendicular to z, one for each pixel of a camera whose picture it fills.

    Args:
        depth: z of the rectangle.
        half_x, half_y: half its width and height.
        color: function (x, y) -> colors [..., 3] in [0, 1].
    """
    wide, high = (max(2, round(2 * half * FOCAL / depth * 1.3)) for half in (half_x, half_y))
    fx, fy = wide * depth / 2 / half_x, high * depth / 2 / half_y
    view = Camera("sheet", wide, high, fx, fy, wide / 2, high / 2, np.eye(4))
    points = geometry.unproject(np.full((high, wide), depth), view)
    picture = color(points[..., 0], points[..., 1])
    return surface_gaussians(
        picture, np.full((high, wide), depth), np.ones((high, wide), bool), view, sh_count=1, spread=0.6, opacity=0.98
    )


def wall_and_square(square_at: float):
    """Return the Gaussians of the wall and of the square, and labels, bool [N], True for those of the square.

    The part of the wall that the square hides from all training views has no Gaussians.
    """
    wall = rectangle_gaussians(WALL, 2.0, 1.4, wall_color)
    seen = torch.from_numpy(~is_hidden_everywhere(wall.means.numpy(), square_at))
    square = rectangle_gaussians(square_at, HALF, HALF, lambda x, y: np.broadcast_to((0.9, 0.1, 0.1), (*x.shape, 3)))
    labels = torch.cat([torch.zeros(int(seen.sum()), dtype=torch.bool), torch.ones(len(square), dtype=torch.bool)])
    return join_gaussians(wall.map(lambda p: p[seen]), square), labels


def is_behind_square(points: np.ndarray, view: Camera, square_at: float) -> np.ndarray:
    """Return bool [...], True for the points [..., 3] of the wall that the square hides from the view."""
    at = view.center + (points - view.center) * (square_at - view.center[2]) / (points[..., 2:] - view.center[2])
    return (np.abs(at[..., :2]) <= HALF + RIM).all(-1)


def is_hidden_everywhere(points: np.ndarray, square_at: float) -> np.ndarray:
    return np.all([is_behind_square(points, CAMERAS[name], square_at) for name in TRAIN], 0)


def wall_points(view: Camera) -> np.ndarray:
    return geometry.unproject(np.full((HEIGHT, WIDTH), WALL - view.center[2]), view)


def true_mask(view: Camera, square_at: float) -> np.ndarray:
    return is_behind_square(wall_points(view), view, square_at)


def true_unobserved(view: Camera, square_at: float) -> np.ndarray:
    return true_mask(view, square_at) & is_hidden_everywhere(wall_points(view), square_at)


def photo(view: Camera) -> np.ndarray:
    """Return the true picture of the wall without the square, uint8 [H, W, 3]."""
    points = wall_points(view)
    return (255 * wall_color(points[..., 0], points[..., 1])).round().astype(np.uint8)


def write_poses_and_fit(folder, square_at: float, masks=None, clean=()):
    """Write the folders `poses`, `fit` and `raw_masks`; return `poses`, `fit` and the labels of the Gaussians.

    The labels, bool [N], are True for the Gaussians of the square.

    Args:
        masks: view name -> bool [H, W]; None for the true masks of all training views.
        clean: names of training views without the square.
    """
    poses, fit = folder / "poses", folder / "fit"
    (folder / "raw_masks").mkdir(parents=True, exist_ok=True)
    masks = {name: true_mask(CAMERAS[name], square_at) for name in TRAIN} if masks is None else masks
    points = np.stack([*(a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 25), np.linspace(-0.7, 0.7, 19))),
                       np.full(475, WALL)], -1)  # fmt: skip
    points = points[~is_hidden_everywhere(points, square_at)]
    save_scene(poses, make_scene(CAMERAS, TEST, clean, points))
    for name, view in CAMERAS.items():
        save_image(poses / "images" / f"{name}.png", photo(view))
    for name, mask in masks.items():
        save_mask(folder / "raw_masks" / "masks" / f"{name}.png", mask)
    fit.mkdir(parents=True, exist_ok=True)
    everything, labels = wall_and_square(square_at)
    save_ply(fit / "gaussians.ply", everything)
    return poses, fit, labels


def write_capture_photos(scene, poses, cameras) -> None:
    """Write a capture whose photographs equal the pictures in `poses`, and the lenses with which it is undistorted."""
    for name in cameras:
        save_image(scene / "images" / f"{name}.png", load_image(poses / "images" / f"{name}.png"))
    lenses = {n: Lens(c.width, c.height, c.fx, c.fy, c.cx, c.cy) for n, c in cameras.items()}
    save_lenses(poses, lenses, False, {n: (c.width, c.height) for n, c in cameras.items()})


def iou(a: np.ndarray, b: np.ndarray) -> float:
    union = (a | b).sum()
    return float((a & b).sum() / union) if union else 1.0


def write_background(poses: Path, fit: Path, masks: Path) -> None:
    """Write the planes and mirror planes of the scene to the folder `masks`, as the stage `masks` does.

    For tests that write the masks themselves and do not run this stage.
    """
    space = Workspace(poses, fit, masks)
    background = space.background_views.with_surfaces(space.gaussians.means[space.labels], space.remaining)
    save_arrays(masks / SURFACES, surfaces_to_arrays(background))

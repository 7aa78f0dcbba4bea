"""Cases of the normalised frame: scenes of any extent and any offset, and exports to the scene's own frame.

The stage `poses` transforms a scene to a normalised frame of extent about 1. The cases make the same small scene with
several extents and offsets, and check that the results do not depend on them. Errors "in extents" are divided by the
scene's extent.
"""

from __future__ import annotations

import math
import tempfile
from functools import cache, partial
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData

from lab.stability.cases import EPS32, EPS64, Case, nan_safe_max
from reffusion import seeding
from reffusion.capture import normalized_frame
from reffusion.capture.lens import Lens
from reffusion.fit.reconstruction import fit
from reffusion.fit.start import initial_gaussians
from reffusion.gaussians.optimize import Rates
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_scene, save_scene
from reffusion.params.fit import Densify, Params, SphericalHarmonics
from reffusion.splat.rasterizer import render
from reffusion.types import Camera, Gaussians, Scene, Similarity

WIDTH, HEIGHT, VIEWS = 24, 18, 5
OFFSET_DIRECTION = np.array([1.0, -0.6, 0.3])  # direction of the offset; the cases' offsets are those along x
EXPORT_TOLERANCE = 1e-5  # accuracy of exported positions that `save_ply` guarantees, in extents


def true_gaussians() -> Gaussians:
    """Make the ground truth of the photographs: sixty colored Gaussians in a box of extent 1 around the origin."""
    random = seeding.generator(0, "stability", "truth")
    uniform = lambda *shape: torch.rand(*shape, generator=random)
    return Gaussians(
        uniform(60, 3) - 0.5, torch.randn(60, 4, generator=random), math.log(0.06) + 0.8 * (uniform(60, 3) - 0.5),
        1 + 2 * uniform(60), 2.5 * (uniform(60, 1, 3) - 0.5),
    )  # fmt: skip


def poses(extent: float, offset: np.ndarray) -> dict[str, np.ndarray]:
    """Return world-to-camera poses [4, 4] of five views of the box, from 1.6 extents away, in the scene's own frame.

    Args:
        extent: extent of the scene in its own frame.
        offset: [3], position of the box's center in the scene's own frame.
    """
    found = {}
    for k in range(VIEWS):
        turn, pose = 0.9 * (k / (VIEWS - 1) - 0.5), np.eye(4)
        pose[:3, :3] = [[math.cos(turn), 0, math.sin(turn)], [0, 1, 0], [-math.sin(turn), 0, math.cos(turn)]]
        center = extent * (pose[:3, :3].T @ np.array([0, 0, -1.6])) + offset
        pose[:3, 3] = -pose[:3, :3] @ center
        found[f"v{k}"] = pose
    return found


def normalized_scene(extent: float, offset: float) -> Scene:
    """Make a scene in the normalised frame, as the stage `poses` does.

    Args:
        extent: extent of the scene in its own frame.
        offset: x coordinate of the scene's center in its own frame, in extents. The center lies in the direction
            `OFFSET_DIRECTION`.
    """
    place = extent * offset * OFFSET_DIRECTION
    world, lens = poses(extent, place), Lens(WIDTH, HEIGHT, 26.0, 26.0, WIDTH / 2, HEIGHT / 2)
    points = extent * true_gaussians().means.double().numpy() + place
    matrices = np.stack(list(world.values()))
    ranges = normalized_frame.depth_ranges(matrices, [lens] * VIEWS, points, None)
    similarity = normalized_frame.normalizing_similarity(matrices, ranges[:, 1])
    cameras = {
        name: Camera(
            name, WIDTH, HEIGHT, lens.fx, lens.fy, lens.cx, lens.cy, normalized_frame.normalize_pose(pose, similarity)
        )
        for name, pose in world.items()
    }
    colors = np.full((len(points), 3), 128, np.uint8)
    return Scene(cameras, tuple(cameras), (), frozenset(), similarity.apply(points), colors, similarity)


@cache
def fit_scene(extent: float, offset: float, rate: float = 1.0) -> tuple[Scene, Gaussians, float]:
    """Make a scene, fit it in 60 steps, and return scene, Gaussians and the PSNR over its views in dB.

    Args:
        extent, offset: as for `normalized_scene`.
        rate: factor on the learning rates.
    """
    scene = normalized_scene(extent, offset)
    cameras = list(scene.cameras.values())
    pictures = render_photographs()
    rates = Rates(means=2e-3, means_last=2e-4, log_scales=1.5e-2, sh_dc=1.5e-2)
    still = {"sh": SphericalHarmonics(degree=0), "densify": Densify(start=1.0)}
    settings = Params(iterations=60, random_background=False, **still)
    start = initial_gaussians(scene.points, scene.point_colors, 0, 1000, seeding.generator(0))
    with tempfile.TemporaryDirectory() as folder:
        gaussians = fit(cameras, pictures, start, settings, folder=Path(folder), rates=scale_rates(rates, rate))
    error = np.mean([(render(gaussians, c).color.clamp(0, 1).numpy() - pictures[c.name] / 255.0) ** 2 for c in cameras])
    return scene, gaussians, float(-10 * math.log10(error))


def scale_rates(rates: Rates, factor: float) -> Rates:
    """Return the step sizes, all multiplied by `factor`."""
    return Rates(**{name: factor * value for name, value in vars(rates).items()})


@cache
def render_photographs() -> dict[str, np.ndarray]:
    """Render the photographs from the true Gaussians, {view: uint8 [H, W, 3]}; they are the same for all frames."""
    pictures = {}
    for name, pose in poses(1.0, np.zeros(3)).items():
        view = Camera(name, WIDTH, HEIGHT, 26.0, 26.0, WIDTH / 2, HEIGHT / 2, pose)
        pictures[name] = (255 * render(true_gaussians(), view).color.clamp(0, 1)).round().byte().numpy()
    return pictures


def psnr_difference(extent: float, offset: float) -> float:
    """Return the absolute difference in PSNR (dB) from the fit of the same scene with extent 1 at the origin."""
    return abs(fit_scene(extent, offset)[2] - fit_scene(1.0, 0.0)[2])


def camera_difference(extent: float, offset: float) -> float:
    """Return the largest difference, by entry, of normalised poses and points from those of extent 1 at the origin."""
    scene, reference = normalized_scene(extent, offset), normalized_scene(1.0, 0.0)
    poses_apart = [
        np.abs(scene.cameras[n].world_to_camera - reference.cameras[n].world_to_camera).max() for n in reference.cameras
    ]
    return float(nan_safe_max(*poses_apart, np.abs(scene.points - reference.points).max()))


def export_vertices(extent: float, offset: float) -> np.ndarray:
    """Export the fit to a .ply in the scene's own frame, and return its vertices as a structured array."""
    scene, gaussians, _ = fit_scene(extent, offset)
    with tempfile.TemporaryDirectory() as folder:
        save_ply(Path(folder) / "scene.ply", gaussians, similarity=scene.similarity)
        return PlyData.read(str(Path(folder) / "scene.ply"), mmap=False)["vertex"].data.copy()


def position_error(extent: float, offset: float) -> float:
    """Return the largest error of the exported positions against the fit's in the scene's own frame, in extents."""
    scene, gaussians, _ = fit_scene(extent, offset)
    table = export_vertices(extent, offset)
    positions = np.stack([table[axis] for axis in "xyz"], 1).astype(np.float64)
    return float(np.abs(positions - scene.similarity.invert(gaussians.means.numpy())).max() / extent)


def scale_error(extent: float, offset: float) -> float:
    """Return the largest error of the exported log-scales against the fit's in the scene's own frame."""
    scene, gaussians, _ = fit_scene(extent, offset)
    table = export_vertices(extent, offset)
    scales = np.stack([table[f"scale_{k}"] for k in range(3)], 1).astype(np.float64)
    return float(np.abs(scales - (gaussians.log_scales.double().numpy() - math.log(scene.similarity.scale))).max())


def export_picture_error(extent: float, offset: float) -> float:
    """Return the largest color difference between one view of the fit and of its export.

    The export is loaded into the normalised frame. Colors are in [0, 1].
    """
    scene, gaussians, _ = fit_scene(extent, offset)
    with tempfile.TemporaryDirectory() as folder:
        save_ply(Path(folder) / "scene.ply", gaussians, similarity=scene.similarity)
        again = load_ply(Path(folder) / "scene.ply", similarity=scene.similarity)
    view = scene.cameras["v1"]
    return (render(again, view).color - render(gaussians, view).color).abs().max().item()


def scene_file_error(extent: float, offset: float) -> float:
    """Return the largest error, in extents, of points in the scene's own frame after saving and loading the scene."""
    scene = normalized_scene(extent, offset)
    with tempfile.TemporaryDirectory() as folder:
        save_scene(Path(folder), scene)
        again = load_scene(Path(folder))
    true = extent * true_gaussians().means.double().numpy() + extent * offset * OFFSET_DIRECTION
    return float(np.abs(again.similarity.invert(again.points) - true).max() / extent)


def refuse_one_place() -> float:
    """Return 0 if cameras at a single place, without points or depth bounds, are refused with the cause, else 1.

    Such cameras do not determine the scale of the scene.
    """
    lens = Lens(WIDTH, HEIGHT, 26.0, 26.0, WIDTH / 2, HEIGHT / 2)
    try:
        normalized_frame.depth_ranges(np.stack([np.eye(4)] * 3), [lens] * 3, np.zeros((0, 3)), None)
    except ValueError as refusal:
        return float("nothing tells" not in str(refusal))
    return 1.0


def similarity_error() -> float:
    """Return the largest error, in extents, of points after a similarity's inverse and the similarity.

    The scene has an extent of 1e-3 and an offset of 1e6, both in units of its own frame.
    """
    similarity = Similarity(1e3, 1e6 * OFFSET_DIRECTION)
    points = np.random.default_rng(0).uniform(-1, 1, (100, 3))
    return float(np.abs(similarity.apply(similarity.invert(points)) - points).max())


FRAMES = {
    "extent 1e-3": (1e-3, 0.0),
    "extent 1e4": (1e4, 0.0),
    "offset 1e6 of the extent": (1.0, 1e6),
    "extent 1e4, offset 1e6 of the extent": (1e4, 1e6),
    "extent 1e-3, offset 1e6 of the extent": (1e-3, 1e6),
}
# Rounding of coordinates of 1e6 extents in float64, and a handful of operations on them.
FAR_ROUNDING = 16 * 1e6 * EPS64
CASES = (
    *(Case(f"{name}, fit", "difference of PSNR from extent 1 at the origin (dB)", 0.2, partial(psnr_difference, *at))
      for name, at in FRAMES.items()),
    *(Case(f"{name}, normalised", "largest difference of poses and points from extent 1 at the origin", FAR_ROUNDING,
           partial(camera_difference, *at)) for name, at in FRAMES.items()),
    *(Case(f"{name}, exported positions", "error in the scene's own frame, in extents", EXPORT_TOLERANCE,
           partial(position_error, *at)) for name, at in FRAMES.items()),
    # Logarithms of sizes lie in +-16 here: half a unit in the last place of float32 is 2^-24 of that.
    *(Case(f"{name}, exported sizes", "error of a log-scale", 16 * EPS32, partial(scale_error, *at))
      for name, at in FRAMES.items()),
    # A position moves by up to 1e-5 extents, a footprint of 0.5 px or more by 26 * 1e-5 px; sixty may overlap.
    Case("offset 1e6 of the extent, picture of the export", "largest difference from the fit's", 60 * 26e-5,
         partial(export_picture_error, 1.0, 1e6)),
    Case("offset 1e6 of the extent, scene file", "error of points after the way back, in extents", FAR_ROUNDING,
         partial(scene_file_error, 1.0, 1e6)),
    # x / scale + offset and back: an offset of 1e9 extents leaves 2^-53 * 1e9 of them.
    Case("similarity, extent 1e-3 at 1e6", "error of the way there and back, in extents", 4e9 * EPS64,
         similarity_error),
    Case("all cameras at one place", "refusals without the cause in the message", 0.0, refuse_one_place),
)  # fmt: skip

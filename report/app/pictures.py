"""Pictures of a scene for the page: thumbnails, photographs, the result from every view, and where it is unsure."""

from __future__ import annotations

import threading
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from reffusion.fit import exposure
from reffusion.io.images import load_image, load_mask, load_thumbnail, to_uint8
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_scene
from reffusion.splat import rasterizer
from reffusion.types import Gaussians, Scene
from report.app.mask_step import to_jpeg, to_png
from report.app.scenes import OpenScene
from report.check import overlay_masks
from report.sheet import stage_folder

SMALL = 240  # longer side of a thumbnail, px
KEPT = 64  # pictures that stay in memory
OWN_FRAME = "scene.ply"  # the name of files in the scene's own frame
# Origins of pixels (reffusion/initialize/origins.py) that the page marks, by their color there -> RGBA of the overlay.
UNSURE = {(60, 120, 255): (60, 120, 255, 110), (255, 170, 0): (255, 170, 0, 130), (220, 30, 50): (220, 30, 50, 170)}
RENDERING = threading.Lock()  # the rasterizer uses all threads for one picture


def draw_thumbnail(scene: OpenScene, view: str) -> bytes:
    """Return a photograph as a small JPEG; with its masks tinted if the stage `raw_masks` has run.

    Raises:
        KeyError: there is no such view.
        ValueError: the file is no picture.
    """
    path = scene.pictures()[view]
    masks = scene.home / "raw_masks"
    if (masks / "receipt.json").is_file() and path.parent.parent == scene.home / "poses":
        return to_jpeg(overlay_masks(scene.home / "poses", masks, view), SMALL)
    return to_jpeg(load_thumbnail(path, SMALL, upright=True), SMALL)


def draw_photograph(scene: OpenScene, view: str) -> bytes:
    """Return a photograph as a JPEG; errors as for `draw_thumbnail`."""
    return to_jpeg(load_image(scene.pictures()[view]))


def draw_fit(scene: OpenScene, view: str) -> bytes:
    """Return the scene with the object from a view as a JPEG: as `evaluate` rendered it, or else rendered now.

    Raises:
        KeyError: there is no such view.
    """
    fit = stage_folder(scene.home, "fit") / "gaussians.ply"
    return to_jpeg(_load_or_render(scene, view, "renders_fit", fit))


def draw_result(scene: OpenScene, view: str) -> bytes:
    """Return the finished scene from a view as a JPEG; for the errors see `load_result`."""
    return to_jpeg(load_result(scene, view))


def load_result(scene: OpenScene, view: str) -> np.ndarray:
    """Return the finished scene from a view, uint8 [H, W, 3]: as `evaluate` rendered it, or else rendered now.

    Raises:
        KeyError: there is no such view.
    """
    return _load_or_render(scene, view, "renders", scene.home / "evaluate" / OWN_FRAME)


def _load_or_render(scene: OpenScene, view: str, renders: str, gaussians: Path) -> np.ndarray:
    """Return a view of the folder `renders` of the stage `evaluate`, or else a render of a .ply file."""
    rendered = scene.home / "evaluate" / renders / f"{view}.png"
    if view in scene.pictures() and rendered.is_file():
        return load_image(rendered)
    return _render(scene.home, view, gaussians, gaussians.stat().st_mtime_ns)


def draw_unsure(scene: OpenScene, view: str) -> bytes:
    """Return a transparent PNG that tints the pixels of a view which no photograph shows.

    Blue is filled from a reference, orange from patches of photographs; red is not filled. Before the stage
    `initialize` the whole invent mask is orange.

    Raises:
        KeyError: there is no such view.
    """
    photo = scene.pictures()[view]
    origin = stage_folder(scene.home, "initialize") / "origins" / f"{view}.png"
    invent = stage_folder(scene.home, "masks") / "invent" / f"{view}.png"
    if origin.is_file():
        colors = load_image(origin)
        overlay = np.zeros((*colors.shape[:2], 4), np.uint8)
        for color, tint in UNSURE.items():
            overlay[(colors == color).all(-1)] = tint
    else:
        mask = load_mask(invent) if invent.is_file() else np.zeros(load_image(photo).shape[:2], bool)
        overlay = mask[..., None] * np.array(UNSURE[255, 170, 0], np.uint8)
    return to_png(overlay)


@lru_cache(KEPT)
def _render(home: Path, view: str, path: Path, changed: int) -> np.ndarray:
    """Render a view of a .ply file, uint8 [H, W, 3]; `changed` is the file's time of change, for the cache."""
    with RENDERING, torch.no_grad():
        scene, gaussians, exposures = _load_gaussians(home, path, changed)
        rendering = rasterizer.render(gaussians, scene.cameras[view])
        color = exposure.apply_exposure(rendering.color, exposures.get(view)).clamp(0, 1)
    return to_uint8(color.numpy())


@lru_cache(2)
def _load_gaussians(home: Path, path: Path, changed: int) -> tuple[Scene, Gaussians, dict[str, np.ndarray]]:
    """Return the scene, the Gaussians of a file and the exposures; `changed` is the file's time of change."""
    scene = load_scene(home / "poses")
    gaussians = load_ply(path, scene.similarity) if path.name == OWN_FRAME else load_ply(path)
    return scene, gaussians, exposure.view_exposures(stage_folder(home, "fit"), list(scene.cameras.values()))

"""Masks of all views from clicks on some, for the stage `masks`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from reffusion import trace
from reffusion.capture.click_coordinates import undistort_clicks
from reffusion.capture.views import check_outliers
from reffusion.clicks import all_views
from reffusion.clicks.marks import Clicks
from reffusion.io.scene import load_views
from reffusion.params.clicks import Clicked
from reffusion.types import Gaussians, Scene


def masks_from_clicks(
    scene: Scene, gaussians: Gaussians, poses: Path, clicks: Clicked, masks: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """View name -> bool [H, W]: masks of all training views, and of the test views that show the object.

    Args:
        clicks: of scene.yaml. masks: those that the scene brings; they stay as they are.

    Raises:
        ValueError: the clicks lie where undistorted views show nothing, or on nothing that the Gaussians show.
    """
    check_outliers("clicks", clicks, scene.outliers)
    points = {name: Clicks(*each) for name, each in undistort_clicks(poses, clicks).items()}
    image_of = lambda name: load_views(poses, [name])[name]
    cameras = {name: scene.cameras[name] for name in scene.train if name in masks or name not in scene.clean}
    solution = all_views.segment_by_clicks(
        gaussians, all_views.find_neighbours(gaussians), cameras, image_of, points, masks
    )
    if not solution.labels.any():
        raise ValueError("scene.yaml: clicks: the views show nothing there; click in the middle of the object")
    names = [name for name in (*scene.train, *scene.test) if name not in {*masks, *scene.clean}]
    found = dict(masks)
    for k in trace.progress(len(names), "masks from clicks"):
        name, camera, image = names[k], scene.cameras[names[k]], image_of(names[k])
        mask = all_views.object_mask(gaussians, solution.labels, camera, image, points.get(name))
        if name in scene.train or all_views.is_visible(gaussians, camera, image, mask):
            found[name] = mask
    return found

"""Masks of all views from clicks on some views, for the stage `masks`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np

from reffusion.capture.click_coordinates import undistort_clicks
from reffusion.capture.views import check_outliers
from reffusion.clicks import propagation_without_network
from reffusion.clicks.events import Event
from reffusion.clicks.fitted_views import FittedViews
from reffusion.clicks.marks import Mark
from reffusion.clicks.propagation_with_network import count_all_votes, draw_view, project_votes
from reffusion.clicks.refinement import redraw_masks
from reffusion.clicks.scene_segmentation import segment_scene
from reffusion.clicks.segmenter import ImageFeatures, Segmenter, encode_image, predict_masks
from reffusion.clicks.single_view import ViewEvidence
from reffusion.io.scene import load_views
from reffusion.params.clicks import Clicked
from reffusion.types import Camera, Gaussians, Scene

KEPT_VIEWS = 96  # views that stay in memory: network features, 4 MB each; photograph and relief, 11 bytes a pixel


def masks_from_clicks(
    scene: Scene,
    gaussians: Gaussians,
    poses: Path,
    clicks: Clicked,
    masks: Mapping[str, np.ndarray],
    segmenter: Segmenter | None = None,
) -> dict[str, np.ndarray]:
    """Make the object's masks from clicks: view name -> bool [H, W], True = the object.

    The result holds all training views except `scene.clean` (views without the object, unless they have a mask), and
    the test views whose photographs show the object. Without given masks, the view with most clicks on the object is
    segmented first, and its mask is propagated. With given masks, all clicks are corrections.

    Args:
        poses: folder of the stage `poses`, which holds the undistorted photographs.
        clicks: the key `clicks` of scene.yaml: view -> clicks in pixels of the photograph before undistortion.
        masks: view name -> bool [H, W], masks that the scene provides. Only clicks in its own view change a mask.
        segmenter: the segmentation network; None to segment by colors and surfaces alone.

    Raises:
        ValueError: clicks are on a view that is not a training view showing the object, or that was left out because
            its photograph contradicts its pose; or all masks are empty, because the clicks lie outside the undistorted
            photographs or where the Gaussians show nothing.
    """
    check_outliers("clicks", clicks, scene.outliers)
    points = undistort_clicks(poses, clicks)
    events = [
        Event(name, Mark(point[None], bool(positive)))
        for name in sorted(points, key=lambda name: (-int(points[name][1].sum()), name))
        for point, positive in zip(*points[name], strict=True)
    ]
    cameras = {name: scene.cameras[name] for name in scene.train if name in masks or name not in scene.clean}
    if clean := [name for name in points if name not in cameras]:
        raise ValueError(f"scene.yaml: clicks: {clean[0]} is no training view that shows the object")
    views = FittedViews(gaussians, cameras, evidence_loader(scene, gaussians, poses, segmenter))
    found = segment_scene(views, events, masks)
    if not any(mask.any() for mask in found.values()):
        raise ValueError("scene.yaml: clicks: the views show nothing there; click in the middle of the object")
    return found | masks_of_test_views(scene, views, found)


def refine_masks(
    scene: Scene, gaussians: Gaussians, poses: Path, masks: Mapping[str, np.ndarray], segmenter: Segmenter
) -> dict[str, np.ndarray]:
    """Draw rough masks anew: view name -> bool [H, W], for all training views that show the object.

    Args:
        poses: folder of the stage `poses`, which holds the undistorted photographs.
        masks: view name -> bool [H, W], the rough masks. Views may lack a mask. An empty mask votes, too: nothing in
            its view is the object. Masks of `scene.clean`, views without the object, are ignored.
        segmenter: the segmentation network.
    """
    cameras = {name: scene.cameras[name] for name in scene.train if name not in scene.clean}
    rough = {name: mask for name, mask in masks.items() if name in cameras}
    return redraw_masks(FittedViews(gaussians, cameras, evidence_loader(scene, gaussians, poses, segmenter)), rough)


def masks_of_test_views(scene: Scene, views: FittedViews, masks: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the masks of the test views whose photographs show the object: view name -> bool [H, W].

    The masks of the training views vote on the Gaussians, and the votes are projected into the test views. Test views
    whose photographs were taken without the object are left out.

    Args:
        masks: view name -> bool [H, W], the masks of the training views.
    """
    votes = count_all_votes(views.gaussians, views.cameras, masks)
    found = {}
    for name in scene.test:
        camera, view = scene.cameras[name], views.evidence_of(name)
        mask = draw_view(view, project_votes(views.gaussians, camera, votes))
        if propagation_without_network.is_visible(views.gaussians, camera, view.image, mask):
            found[name] = mask
    return found


def evidence_loader(
    scene: Scene, gaussians: Gaussians, poses: Path, segmenter: Segmenter | None
) -> Callable[[str], ViewEvidence]:
    """Return a function from a view's name to its ViewEvidence.

    The function loads the view's photograph and renders its relief at the first call. The segmentation network encodes
    the photograph at the first prompt. The last `KEPT_VIEWS` views stay in memory.

    Args:
        poses: folder of the stage `poses`, which holds the undistorted photographs.
        segmenter: the segmentation network; None for none.
    """
    image_of = lambda name: load_views(poses, [name])[name]

    @lru_cache(KEPT_VIEWS)
    def features_of(name: str) -> ImageFeatures:
        assert segmenter is not None
        return encode_image(segmenter, image_of(name))

    @lru_cache(KEPT_VIEWS)
    def evidence_of(name: str) -> ViewEvidence:
        return load_evidence(image_of(name), gaussians, scene.cameras[name], segmenter, lambda: features_of(name))

    return evidence_of


def load_evidence(
    image: np.ndarray,
    gaussians: Gaussians | None,
    camera: Camera,
    segmenter: Segmenter | None,
    features_of: Callable[[], ImageFeatures],
) -> ViewEvidence:
    """Build the ViewEvidence of a view: its photograph, its relief, and the segmentation network.

    Args:
        image: uint8 [H, W, 3], the undistorted photograph.
        gaussians: the fitted scene; None if the scene is not fitted yet, which leaves out the relief.
        segmenter: the segmentation network; None for none.
        features_of: function that returns the network's features of the photograph.
    """
    relief = None if gaussians is None else propagation_without_network.surface_relief(gaussians, camera)
    if segmenter is None:
        return ViewEvidence(image, relief)
    return ViewEvidence(image, relief, lambda prompt: predict_masks(segmenter, features_of(), prompt))

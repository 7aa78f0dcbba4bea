"""The object's cast shadows, which the masks do not cover, found by comparison with references.

A reference is a view completed without the object. Where the object casts a shadow, reference and photograph differ
beside the object. The shadow is projected into all views, and their photographs are relit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from scipy import ndimage

from reffusion import geometry, morphology
from reffusion.background.model import Background
from reffusion.background.visibility import DepthView, with_photographed_depth
from reffusion.prior import inpaint
from reffusion.shadows.light import BLUR, DARK_OFFSET, measure_log_gain, relight
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians, Reference

MIN_DENSITY = 0.05  # number of projected points per pixel below which the light of a pixel is unknown
LOG_RATIO = 0.08  # absolute logarithm of the brightness ratio above which a pixel is in a shadow
NEAR_MASK = 0.02  # of the image's width: largest gap between the mask and its shadow
MIN_AREA = 0.02  # of the mask's area: area that must differ farther from the mask than NEAR_MASK
PENUMBRA = 0.012  # of the image's width: dilation of a detected shadow, to include its soft rim
NOISE_FACTOR = 4.0  # if a reference is redrawn everywhere, a shadow's log-ratio is this many times the usual one


def remove_shadows(
    references: Sequence[Reference], gaussians: Gaussians, background: Background
) -> tuple[list[Reference], Background, dict[str, np.ndarray]]:
    """Detect the object's cast shadow by comparing references with their photographs, and relight all photographs.

    Of a reference that also fills pixels outside C (the object's mask), only the differences inside C count as shadow:
    such a reference shows an inserted object, which differs from the photograph, too. A line is printed for each
    reference that shows a shadow.

    Args:
        references: completed views, without the object and its shadow.
        gaussians: the Gaussians of the filled scene.
        background: the photographs and where they show the object.

    Returns:
        - the references, each with the shadow that was detected in its own view added to its mask;
        - the background. Its photographs have the references' light where they showed the shadow. Pixels whose light
          is unknown are added to the masks of its views, and so do not supervise;
        - view name -> bool [H, W], the shadow in each view; an empty dictionary if no reference shows a shadow.
    """
    found = {camera.name: np.zeros((camera.height, camera.width), bool) for camera in background.cameras}
    unknown, photos = dict(found), dict(background.photos)
    extended = []
    for each in references:
        name = each.camera.name
        mask = background.masks[name]
        view = inpaint.composite_background(gaussians, each.camera, photos[name], mask)
        shadow = detect_shadow(each.image, view, mask)
        if (each.mask & ~mask).any():  # an inserted object and its rim differ too, but are no shadow
            shadow &= mask
        extended.append(replace(each, mask=each.mask | shadow))
        if not shadow.any():
            continue
        print(f"reference {name}: {shadow.sum()} px differ from what is seen, a shadow perhaps")
        depth = rasterizer.render(gaussians, each.camera, sh_degree=0).depth.double().cpu().numpy()
        depth = with_photographed_depth(depth, each.camera, background.views)
        light = measure_log_gain(each.image, view)
        projected = project_shadow(shadow, light, depth, each.camera, background.views)
        for other, (pixels, own_light) in projected.items():
            photos[other] = relight(photos[other], own_light)
            found[other] = found[other] | pixels
            unknown[other] = unknown[other] | (pixels & np.isnan(own_light).any(-1))
    if not any(pixels.any() for pixels in found.values()):
        return list(references), background, {}
    views = [replace(view, masked=view.masked | unknown[view.camera.name]) for view in background.views]
    return extended, replace(background, views=views, photos=photos), found


def detect_shadow(reference: np.ndarray, view: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Find the object's shadow in a view: pixels that are darker or brighter than in the completed view.

    A shadow is connected to the mask, up to a small gap. If too few pixels beside the mask differ, there is no shadow.

    Args:
        reference: [H, W, 3] uint8, the completed view.
        view: [H, W, 3] uint8 in the same exposure, the photograph. Inside the mask it may show a rendering of the scene
            without the object instead.
        mask: bool [H, W], C, True at pixels that show the object.

    Returns:
        bool [H, W], the shadow with its soft rim, which may extend into the mask; all False without a shadow.
    """
    sigma = morphology.to_pixels(BLUR, mask.shape[1])
    blur = lambda image: cv2.GaussianBlur(image.astype(np.float32).mean(2), (0, 0), sigma)
    ratio = np.abs(np.log((blur(reference) + DARK_OFFSET) / (blur(view) + DARK_OFFSET)))
    near = morphology.dilate(mask, NEAR_MASK)
    noise = 1.4826 * float(np.median(ratio[~near])) if (~near).any() else 0.0  # about 0 unless the view is redrawn
    differs = ratio > max(LOG_RATIO, NOISE_FACTOR * noise)
    if (differs & ~near).sum() <= MIN_AREA * mask.sum():  # no shadow: differences inside C have other causes
        return np.zeros_like(mask)
    found = differs & ndimage.binary_propagation(mask & near, mask=differs | near)
    return morphology.dilate(found, PENUMBRA) if found.any() else found


def project_shadow(
    shadow: np.ndarray, light: np.ndarray, depth: np.ndarray, camera: Camera, views: Sequence[DepthView]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Project the shadow that was detected in one view, and its log light (see `measure_log_gain`), into given views.

    Args:
        shadow: bool [H, W], the shadow in the view `camera`.
        light: [H, W, 3], the result of `measure_log_gain` for the view `camera`.
        depth: [H, W], camera z of the surfaces in the view `camera`; 0 where unknown.
        camera: the view in which the shadow was detected.
        views: the views into which the shadow is projected. The view `camera` may be among them.

    Returns:
        View name -> (bool [H, W], the shadow in this view; [H, W, 3], its log light). The log light is NaN outside the
        shadow, and where too few points are projected.
    """
    rows, columns = np.nonzero(shadow & (depth > 0))
    points = geometry.unproject(np.where(depth > 0, depth, 1.0), camera)[rows, columns]
    values = np.concatenate([light[rows, columns], np.ones((len(rows), 1))], 1)
    found = {}
    for view in views:
        shape = view.masked.shape
        uv, z = geometry.project(points, view.camera)
        surface, inside = geometry.sample_nearest(view.farthest, uv)
        visible = inside & (z > 0) & (z < surface * (1 + geometry.OTHER_SURFACE))
        at = uv[visible].astype(np.int64)
        mask, total = np.zeros(shape, bool), np.zeros((*shape, 4), np.float32)
        mask[at[:, 1], at[:, 0]] = True
        np.add.at(total, (at[:, 1], at[:, 0]), values[visible])
        total = cv2.GaussianBlur(total, (0, 0), morphology.to_pixels(BLUR, shape[1]))
        mask = morphology.dilate(mask, PENUMBRA) if mask.any() else mask
        known = mask[..., None] & (total[..., 3:] > MIN_DENSITY)
        own = np.where(known, total[..., :3] / np.where(known, total[..., 3:], 1), np.nan)
        found[view.camera.name] = mask, own
    return found

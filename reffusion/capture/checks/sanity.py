"""Warns of masks and photographs that can be used, but are probably mistakes.

PAPER leaves open: it takes masks, poses and photographs as given. The thresholds are chosen so that a warning is
seldom wrong. No input is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import cv2
import numpy as np

from reffusion.capture.image_detail import sample_visible
from reffusion.geometry import pixel_rays, project, sample_nearest
from reffusion.io.images import to_gray
from reffusion.types import Camera, Scene

LARGE = 0.5  # share of a picture: a mask that covers more is probably inverted
LOOKED_AT = 24  # largest number of masks, spread evenly, with which each mask is compared in 3D
RAYS, DEPTHS = 64, 128  # pixels of a mask, and points on the ray of each; many, since the object is short on a ray
AGREE = 0.75  # share of the other masks that must contain a point, so that it may be on the object
SUPPORTED = 0.3  # share of a mask's pixels with such a point; a mask with less shows something else
WITHIN = 0.9  # share of the object's points that lie within a picture whose empty mask is then probably a mistake
BLACK = 0.1  # a photograph is black if its brightness is less than this share of that of the others
# A photograph is blurred if its contrast is less than this share of that of the others. Sharp ones have .76 or more.
BLURRED = 0.4
BRIGHTER = 1.5  # a photograph is odd if it is this many times as bright as the others, or as dark
POINTS = 5000  # largest number of points at which photographs are compared
LEAST_SEEN = 50  # points that must be visible in a view to judge it


def find_odd_photographs(scene: Scene, image_of: Callable[[str], np.ndarray]) -> list[str]:
    """Return warnings about photographs that are much darker, brighter or more blurred than the other photographs.

    Brightness and contrast are compared at points that several views see. The views are training and test views without
    suspects (views whose photographs contradict their poses).

    Args:
        scene: undistorted views in the normalized frame. Its points must be sparse points or points from optical flow,
            not random points.
        image_of: function from a view's name to its picture, uint8 [H, W, 3].

    Returns:
        At most one sentence for each fault; empty if there are no such photographs, or too few points or views.
    """
    cameras = [scene.cameras[name] for name in (*scene.train, *scene.test) if name not in scene.suspects]
    points = scene.points[:: max(1, -(-len(scene.points) // POINTS))]
    if len(points) < LEAST_SEEN or len(cameras) < 3:
        return []
    seen = np.stack([_looks(camera, points, image_of(camera.name)) for camera in cameras])  # [V, P, 2]
    known = ~np.isnan(seen)
    total, count = np.where(known, seen, 0).sum(0), known[..., 0].sum(0)
    brightness, contrast = {}, {}
    for camera, own, here in zip(cameras, seen, known[..., 0] & (count > 1), strict=True):
        if here.sum() >= LEAST_SEEN:
            others = (total - own)[here] / (count[here, None] - 1)
            brightness[camera.name], contrast[camera.name] = np.median((own[here] + 4) / (others + 4), 0).tolist()
    return [*_warn_exposures(brightness), *_warn_blurred(contrast, brightness)]


def _warn_exposures(ratios: Mapping[str, float]) -> list[str]:
    """Return warnings for views whose brightness, relative to that of the other views, is far from 1."""
    jumps = {name: ratio for name, ratio in ratios.items() if not 1 / BRIGHTER < ratio < BRIGHTER}
    dark = sorted(name for name, ratio in jumps.items() if ratio < BLACK)
    black = [f"black photographs: {_join_names(dark)}; {_leave_out(dark)}"] if dark else []
    jumps = {name: ratio for name, ratio in jumps.items() if name not in dark}
    if not jumps:
        return black
    worst = max(jumps, key=lambda name: abs(np.log(jumps[name])))
    who = f"{len(jumps)} of {len(ratios)} photographs are" if len(jumps) > 1 else "a photograph is"
    return [
        *black,
        f"{who} exposed otherwise than the rest ({_join_names(sorted(jumps))}; {worst} is {jumps[worst]:.2g} times as "
        "bright): take them with a fixed exposure, or have each one's fitted (fit.exposure)",
    ]


def _warn_blurred(contrast: Mapping[str, float], brightness: Mapping[str, float]) -> list[str]:
    """Return at most one warning, for views with little contrast relative to the others, dark ones left out."""
    blurred = sorted(name for name, ratio in contrast.items() if ratio < BLURRED < brightness[name])
    return [f"blurred photographs: {_join_names(blurred)}; {_leave_out(blurred)}"] if blurred else []


def _leave_out(names: Iterable[str]) -> str:
    """Return the remedy, which names the line of scene.yaml that leaves these views out."""
    return f"leave them out by `exclude: [{', '.join(names)}]` in scene.yaml"


def find_odd_masks(scene: Scene, masks: Mapping[str, np.ndarray]) -> list[str]:
    """Return warnings about masks that cover most of their pictures, or that contradict other masks in 3D.

    Args:
        masks: view name -> bool [H, W], True = the object.

    Returns:
        Sentences for the user; empty if all masks are plausible.
    """
    return [*_warn_large(masks), *_warn_inconsistent(scene, masks)]


def _warn_large(masks: Mapping[str, np.ndarray]) -> list[str]:
    """Return at most one warning: masks cover most of their pictures and borders, so they are probably inverted."""
    shares = {name: float(mask.mean()) for name, mask in masks.items()}
    # even an object close to the camera leaves most of the border free
    border = lambda mask: np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).mean()
    large = sorted(name for name, share in shares.items() if share > LARGE and border(masks[name]) > LARGE)
    if not large:
        return []
    middle = float(np.median(list(shares.values())))
    who = f"the masks of {_join_names(large)} cover" if len(large) > 1 else f"the mask of {large[0]} covers"
    if middle > LARGE:
        who = f"the masks cover {middle:.0%} of the pictures (median);"
    else:
        who += f" more than {LARGE:.0%} of the picture, the others' median is {middle:.0%};"
    return [f"{who} inverted? The object is 255 (or 1), all else 0"]


# ---------------------------------------------------------------------------------------------- masks in 3D


def _warn_inconsistent(scene: Scene, masks: Mapping[str, np.ndarray]) -> list[str]:
    """Return warnings about masks that mark something else in 3D than the other masks, or nothing where these do."""
    names = [name for name in scene.train if name in masks and name not in scene.clean]
    marked = [name for name in names if masks[name].any()]
    if len(marked) < 3:
        return []
    cameras = [scene.cameras[name] for name in names[:: -(-len(names) // LOOKED_AT)]]
    share, body = {}, [np.zeros((0, 3))]
    for name in marked:
        places = _along_rays(scene.cameras[name], masks[name], scene.points)
        inside, framed = np.zeros(places.shape[:2]), np.zeros(places.shape[:2])
        for camera in cameras:
            if camera.name != name:
                hit, within = sample_nearest(masks[camera.name], project(places, camera)[0])
                inside += hit & within
                framed += within
        # some point on the pixel's ray projects into most of the masks whose pictures contain the point
        agreed = (inside >= AGREE * framed) & (framed >= 2)
        supported = agreed.any(1)
        body.append(np.average(places[supported], 1, np.repeat(agreed[supported][..., None], 3, 2)))
        judged = (framed >= 2).any(1)
        if judged.sum() >= RAYS // 4:
            share[name] = float(supported[judged].mean())
    alone = sorted(name for name, each in share.items() if each < SUPPORTED)
    if len(alone) > len(share) / 2:
        return [
            f"{len(alone)} of {len(share)} masks do not agree in 3D; do all mark the same object, and are the poses "
            "right?"
        ]
    points, empty = np.concatenate(body), [name for name in names if name not in marked]
    return [
        *(f"the mask of {name} shows something else than those of the other views do" for name in alone),
        *(
            f"the mask of {name} is empty, though the object of the other masks lies in its view; is it hidden there?"
            for name in empty
            if _share_within(scene.cameras[name], points) > WITHIN
        ),
    ]


def _share_within(camera: Camera, points: np.ndarray) -> float:
    """Return the share in [0, 1] of the points [P, 3] that project into a view's picture; 0 without points."""
    at, depth = project(points, camera)
    inside = sample_nearest(np.ones((camera.height, camera.width), bool), at)[1] & (depth > 0)
    return float(inside.sum() / max(len(points), 1))


def _along_rays(camera: Camera, mask: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return world points [R, D, 3] on the rays of R pixels of a non-empty mask, evenly spaced in disparity."""
    rows, columns = np.nonzero(mask)
    chosen = np.unique(np.linspace(0, len(rows) - 1, RAYS).astype(int))
    at, depth = project(points, camera)
    depth = depth[sample_nearest(np.ones(mask.shape, bool), at)[1] & (depth > 1e-3)]
    near, far = np.percentile(depth, (1, 99)) if len(depth) else (1 / 3, 4.0)
    rays = pixel_rays(camera)[rows[chosen], columns[chosen]]
    # somewhat beyond the range of depths of the scene's points in the view
    local = rays[:, None] / np.linspace(1 / (0.7 * near), 1 / (1.5 * far), DEPTHS)[:, None]
    return (local - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]


# ---------------------------------------------------------------------------------------------- photographs


def _looks(camera: Camera, points: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Return [P, 2], brightness and contrast (length of the gradient) at the points [P, 3]; NaN if not visible."""
    gray = to_gray(image)
    contrast = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    window = (max(3, camera.width // 40),) * 2
    return sample_visible(camera, points, cv2.blur(np.stack([gray, contrast], -1), window))


def _join_names(names: Iterable[str], most: int = 4) -> str:
    """Return the names joined by commas; after `most` names, only the number of the remaining ones."""
    names = list(names)
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")

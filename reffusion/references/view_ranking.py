"""For people who paint: which views to complete, by what each would cover, and what of them is known.

The surface behind the object is not known before a view is painted; here it is the surroundings' disparity drawn
across the hole. That is enough to tell which views look at the same part of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from reffusion import geometry
from reffusion.depth.inpaint_depth import inpaint_depth
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

SIDE = 160  # px, the longer side at which surfaces are compared
NEAR = 0.1  # relative depth up to which two views speak of the same surface
GREY = 128  # of what is to be painted
LEAST = 0.02  # share of all pixels to be invented that a further view must cover


@dataclass(frozen=True)
class Hole:
    """A view's pixels to be invented, at a small size.

    Attributes:
        camera: the small view.
        pixels: bool [h, w].
        depth: [h, w] of the surroundings drawn across them, camera z; 0 where nothing is known.
    """

    camera: Camera
    pixels: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True)
class Ranked:
    """A view to paint: its name, and the share of all pixels to be invented that it covers beyond those before it."""

    view: str
    share: float


@torch.no_grad()
def holes(
    remaining: Gaussians,
    cameras: Sequence[Camera],
    hidden: Mapping[str, np.ndarray],
    invent: Mapping[str, np.ndarray],
) -> dict[str, Hole]:
    """View name -> its hole, of the views that have one.

    Args:
        remaining: the Gaussians without the object's.
        hidden, invent: view name -> bool [H, W], where the object stood, and what is to be made up.
    """
    found = {}
    for camera in cameras:
        if not invent[camera.name].any():
            continue
        factor = min(1.0, SIDE / max(camera.width, camera.height))
        small = camera.resized(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))
        shrunk = lambda mask, least, size=(small.width, small.height): (
            cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > least
        )
        covered = shrunk(hidden[camera.name] | invent[camera.name], 0.01)
        drawn = rasterizer.render(remaining, small, sh_degree=0)
        known = (drawn.alpha.cpu().numpy() > 0.5) & ~covered
        pixels = shrunk(invent[camera.name], 0.5) & covered
        if pixels.any() and known.any():
            found[camera.name] = Hole(small, pixels, inpaint_depth(drawn.depth.cpu().numpy(), known))
    return found


def ranked(holes: Mapping[str, Hole], chosen: Sequence[str], most: int) -> list[Ranked]:
    """The views of `chosen`, then up to `most` others, each the one that covers most of what is not covered yet.

    Of the others those come first whose hole keeps clear of the border: one that is cut off by it hides a part.

    Args:
        chosen: views that have their picture already.
        most: how many further ones.
    """
    covers, total = _coverage(holes)
    if not total:
        return []
    left, result = np.ones(total, bool), []
    named = [name for name in chosen if name in holes]
    cut_off = {name for name in holes if _cut_off(holes[name])}
    groups = [([name], 1, 0.0) for name in named] + [(set(holes) - cut_off, most, LEAST), (cut_off, most, LEAST)]
    for group, count, least in groups:
        for _ in range(min(count, len(named) + most - len(result))):
            candidates = sorted(set(group) - {each.view for each in result})
            gains = {name: int((covers[name] & left).sum()) for name in candidates}
            best = max(candidates, key=gains.__getitem__, default=None)
            if best is None or gains[best] < least * total:
                break
            result.append(Ranked(best, gains[best] / total))
            left &= ~covers[best]
    return result


def _cut_off(hole: Hole) -> bool:
    return bool(hole.pixels[[0, -1]].any() or hole.pixels[:, [0, -1]].any())


def _coverage(holes: Mapping[str, Hole]) -> tuple[dict[str, np.ndarray], int]:
    """View -> bool [P]: which of all views' pixels to be invented its own hole covers; and P."""
    points = [geometry.unproject(hole.depth, hole.camera)[hole.pixels & (hole.depth > 0)] for hole in holes.values()]
    everything = np.concatenate(points) if points else np.zeros((0, 3))
    covers = {}
    for name, hole in holes.items():
        uv, z = geometry.project(everything, hole.camera)
        inside, framed = geometry.sample_nearest(hole.pixels, uv)
        depth, _ = geometry.sample_nearest(hole.depth, uv)
        covers[name] = framed & inside & (depth > 0) & (np.abs(z - depth) < NEAR * depth)
    return covers, len(everything)


def to_paint(known: np.ndarray, invent: np.ndarray) -> np.ndarray:
    """The picture to paint over, uint8 [H, W, 3]: what is known of the view, grey where it is to be made up."""
    return np.where(invent[..., None], np.uint8(GREY), known)


def words(views: Sequence[Ranked], painted: Sequence[str]) -> str:
    """The ranked list for people, a line a view."""
    lines = ["# what each view would cover of all that has to be invented, beyond the views above it"]
    for number, each in enumerate(views, start=1):
        lines.append(f"{number}. {each.view}  {each.share:.0%}{'  (painted)' if each.view in painted else ''}")
    lines.append("# paint <view>.png where <view>_mask.png is white, and save it in the scene as painted/<view>.png")
    return "\n".join(lines) + "\n"

"""Ranking of views for people who paint references: which views should be completed, and the pictures to paint over.

Views are ranked by how much of the hole they show that earlier views do not show. The surface behind the object is not
known before a view is painted. Here the disparity of the surroundings is continued across the hole, which is accurate
enough to tell which views show the same part of the hole.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from reffusion import geometry, morphology
from reffusion.depth.inpaint_depth import inpaint_depth
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

SIDE = 160  # px, the longer side to which views are reduced before their surfaces are compared
GRAY = 128  # gray level of the pixels to be painted
LEAST_GAIN = 0.02  # share of all pixels to be invented that a view must newly cover to be ranked


@dataclass(frozen=True)
class Hole:
    """The hole of a view, that is, its pixels to be invented, at a reduced size.

    Attributes:
        camera: the camera of the reduced view.
        pixels: bool [h, w], the pixels to be invented.
        depth: [h, w], camera z, continued from the surroundings into the hole; 0 where unknown.
    """

    camera: Camera
    pixels: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True)
class RankedView:
    """An entry of the ranking.

    Attributes:
        view: the name of the view.
        share: share in [0, 1] of the pixels to be invented, in all views together, that this view covers and no view
            before it in the ranking covers.
    """

    view: str
    share: float


@torch.no_grad()
def find_holes(
    remaining: Gaussians, cameras: Sequence[Camera], hidden: Mapping[str, np.ndarray], invent: Mapping[str, np.ndarray]
) -> dict[str, Hole]:
    """Return view name -> its hole at a reduced size, for the views that have pixels to be invented.

    Views in which no depth around the hole is known are left out, and so are holes that vanish at the reduced size.

    Args:
        remaining: the Gaussians of the scene without the object.
        cameras: the views.
        hidden: view name -> bool [H, W], the object's pixels.
        invent: view name -> bool [H, W], the pixels to be invented.
    """
    found = {}
    for camera in cameras:
        if not invent[camera.name].any():
            continue
        small = camera.shrunk(SIDE)
        shrunk = lambda mask, least, size=(small.width, small.height): (
            cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > least
        )
        covered = shrunk(hidden[camera.name] | invent[camera.name], 0.01)
        rendering = rasterizer.render(remaining, small, sh_degree=0)
        known = (rendering.alpha.cpu().numpy() > 0.5) & ~covered
        pixels = shrunk(invent[camera.name], 0.5) & covered
        if pixels.any() and known.any():
            found[camera.name] = Hole(small, pixels, inpaint_depth(rendering.depth.cpu().numpy(), known))
    return found


def rank_views(view_holes: Mapping[str, Hole], chosen: Sequence[str], most: int) -> list[RankedView]:
    """Rank views greedily by how many pixels to be invented they cover that the views before them do not cover.

    The views in `chosen` that have a hole come first, in the given order. Up to `most` other views follow. Of these,
    views whose hole does not touch the border of the picture precede the rest, because the border cuts off a part of
    the hole. Other views that newly cover less than `LEAST_GAIN` are left out.

    Args:
        view_holes: view name -> its hole.
        chosen: the views that have been painted already.
        most: the largest number of other views.

    Returns:
        The ranking, the first view first; empty if no hole has a known depth.
    """
    covers, total = _coverage(view_holes)
    if not total:
        return []
    uncovered, result = np.ones(total, bool), []
    named = [name for name in chosen if name in view_holes]
    at_border = {name for name in view_holes if morphology.touches_border(view_holes[name].pixels)}
    groups = [([name], 1, 0.0) for name in named] + [
        (set(view_holes) - at_border, most, LEAST_GAIN),
        (at_border, most, LEAST_GAIN),
    ]
    for group, count, least in groups:
        for _ in range(min(count, len(named) + most - len(result))):
            candidates = sorted(set(group) - {each.view for each in result})
            gains = {name: int((covers[name] & uncovered).sum()) for name in candidates}
            best = max(candidates, key=gains.__getitem__, default=None)
            if best is None or gains[best] < least * total:
                break
            result.append(RankedView(best, gains[best] / total))
            uncovered &= ~covers[best]
    return result


def _coverage(view_holes: Mapping[str, Hole]) -> tuple[dict[str, np.ndarray], int]:
    """Return which of the P pixels to be invented in all views each view covers, name -> bool [P], and P."""
    points = [
        geometry.unproject(hole.depth, hole.camera)[hole.pixels & (hole.depth > 0)] for hole in view_holes.values()
    ]
    everything = np.concatenate(points) if points else np.zeros((0, 3))
    covers = {}
    for name, hole in view_holes.items():
        uv, z = geometry.project(everything, hole.camera)
        # A view covers a pixel of another view if its own hole, at the reduced size, shows the same surface point.
        covers[name] = geometry.shows_points(np.where(hole.pixels, hole.depth, 0), uv, z, geometry.SAME_IF_COARSE)
    return covers, len(everything)


def painting_template(known: np.ndarray, invent: np.ndarray) -> np.ndarray:
    """Return the picture to paint over, uint8 [H, W, 3].

    Args:
        known: uint8 [H, W, 3], the view without the object, as far as it is known.
        invent: bool [H, W], the pixels to be invented; they become gray.
    """
    return np.where(invent[..., None], np.uint8(GRAY), known)


def format_ranking(views: Sequence[RankedView], painted: Sequence[str]) -> str:
    """Return the ranking as text, with one line per view.

    Args:
        views: the ranking.
        painted: names of the views that have been painted already; they are marked.
    """
    lines = ["# what each view would cover of all that has to be invented, beyond the views above it"]
    for number, each in enumerate(views, start=1):
        lines.append(f"{number}. {each.view}  {each.share:.0%}{'  (painted)' if each.view in painted else ''}")
    lines.append("# paint <view>.png where <view>_mask.png is white, and save it in the scene as painted/<view>.png")
    return "\n".join(lines) + "\n"

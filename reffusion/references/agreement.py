"""Check of whether completed views agree where two of them show the same part of a hole.

The surface behind the object is not known yet. As in `view_ranking`, the disparity of the surroundings is continued
across the hole, unless the completed view has a depth map. Therefore a point of one view is found in the other only to
within a few pixels, and texture cannot be compared. Instead, smoothed colors of one view are compared with the range
of colors that the other view shows around the same point.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np

from reffusion import geometry
from reffusion.depth.alignment import Degenerate, align_either
from reffusion.gaussians.surfels import surface_normals
from reffusion.morphology import square
from reffusion.references.view_ranking import Hole
from reffusion.splat import rasterizer
from reffusion.types import Gaussians, Reference

# Of the image's width: standard deviation of the smoothing, and radius of the window whose range of colors is taken.
SMOOTH, REACH = 0.02, 0.04
ALIKE = 0.7  # smallest cosine between the normals of the same surface in two views
LEAST_PIXELS = 40  # pixels, at the size `view_ranking.SIDE`, that both views must show for a pair to be compared
# Mean difference, colors in [0, 1], from which two pictures contradict each other. On demo-pair true pictures have
# 0.001, one 0.9 times as bright 0.004, one with a smoothly inpainted hole 0.007, one turned upside down 0.021; one 0.7
# times as bright 0.038, with red and blue exchanged 0.047, mirrored 0.053, with the objects left in 0.089. A checkered
# box on a real rock: up to 0.03.
CONTRADICTION = 0.04


def refine_hole_depth(
    holes: Mapping[str, Hole], references: Sequence[Reference], remaining: Gaussians, hidden: Mapping[str, np.ndarray]
) -> dict[str, Hole]:
    """Return those holes that have a reference and a known depth, with the depth that the references tell.

    If a reference has a depth map, this map, aligned with the rendered depth around the hole, replaces the whole depth
    of the hole. Otherwise the depth stays as given. A hole is left out if its depth map cannot be aligned, because too
    little depth is known or the map is constant. A hole is also left out if its reference has no depth map and draws
    mostly outside the object's pixels. Such a reference inserts an object, which does not lie at the depth of the
    surroundings.

    Args:
        holes: view name -> its hole (`view_ranking.find_holes`).
        references: the completed views.
        remaining: the Gaussians of the scene without the object.
        hidden: view name -> bool [H, W], the object's pixels.

    Raises:
        ValueError: a depth map does not fit the scene.
    """
    found = {}
    for each in (each for each in references if each.camera.name in holes):
        hole, beside = holes[each.camera.name], each.mask & ~hidden[each.camera.name]
        if each.depth is not None:
            with suppress(Degenerate):
                found[each.camera.name] = _align_depth(hole, each, remaining, hidden[each.camera.name])
        elif beside.sum() < each.mask.sum() / 2:
            found[each.camera.name] = hole
    return found


def _align_depth(hole: Hole, reference: Reference, remaining: Gaussians, hidden: np.ndarray) -> Hole:
    """Return the hole with its reference's depth, aligned to the rendered depth around it; raises as `align_either`."""
    size = hole.camera.width, hole.camera.height
    shrunk = lambda array: cv2.resize(array, size, interpolation=cv2.INTER_NEAREST)
    depth = shrunk(reference.depth.astype(np.float64))
    covered = cv2.resize((hidden | reference.mask).astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.01
    rendering = rasterizer.render(remaining, hole.camera, sh_degree=0)
    aligned, _ = align_either(depth, rendering.depth.cpu().numpy(), (rendering.alpha.cpu().numpy() > 0.5) & ~covered)
    return replace(hole, depth=np.where(np.isfinite(aligned), aligned, 0.0))


def find_contradictions(references: Sequence[Reference], holes: Mapping[str, Hole]) -> list[tuple[str, str, float]]:
    """Return the pairs of views whose references contradict each other, with their `color_difference`.

    An entry is (first view, second view, difference). Two references contradict each other if the difference exceeds
    `CONTRADICTION`. The largest difference comes first.

    Args:
        references: the completed views; those without an entry in `holes` are ignored.
        holes: view name -> its hole (`refine_hole_depth`).
    """
    candidates = [each for each in references if each.camera.name in holes]
    found = []
    for a, b in combinations(candidates, 2):
        unlike = color_difference(a, b, holes[a.camera.name], holes[b.camera.name])
        if unlike is not None and unlike > CONTRADICTION:
            found.append((a.camera.name, b.camera.name, unlike))
    return sorted(found, key=lambda pair: -pair[2])


def color_difference(a: Reference, b: Reference, hole_a: Hole, hole_b: Hole) -> float | None:
    """Return the mean difference in [0, 1] between the colors of two references, where both show the same surface.

    At a point in both holes, the difference is how far the smoothed color of one reference lies outside the range of
    smoothed colors that the other shows around this point, in the channel in which it lies furthest outside. It is
    averaged over all such points, and over both directions of comparison.

    Args:
        a, b: the two references.
        hole_a, hole_b: the hole of each.

    Returns:
        None if the references share fewer than `LEAST_PIXELS` pixels. A direction of comparison with fewer pixels does
        not count.
    """
    ways = [_one_way_difference(a, b, hole_a, hole_b), _one_way_difference(b, a, hole_b, hole_a)]
    differences = [way for way in ways if way is not None]
    return sum(differences) / len(differences) if differences else None


def _one_way_difference(a: Reference, b: Reference, hole_a: Hole, hole_b: Hole) -> float | None:
    """Return how far the colors of `a` lie outside the range of those of `b`, None as `color_difference`."""
    own = hole_a.pixels & (hole_a.depth > 0)
    points, colors = geometry.unproject(hole_a.depth, hole_a.camera)[own], _smooth_colors(a, hole_a)[own]
    uv, z = geometry.project(points, hole_b.camera)
    is_shown = geometry.shows_points(np.where(hole_b.pixels, hole_b.depth, 0), uv, z, geometry.SAME_SURFACE)
    # The front and the back of an object are two surfaces, however thin it is.
    normals_a = surface_normals(hole_a.depth, hole_a.camera)[own]
    normals_b, _ = geometry.sample_nearest(surface_normals(hole_b.depth, hole_b.camera), uv)
    both = is_shown & ((normals_a * normals_b).sum(-1) > ALIKE)
    if both.sum() < LEAST_PIXELS:
        return None
    other, reach = _smooth_colors(b, hole_b), max(1, round(REACH * hole_b.camera.width))
    around = square(reach)
    darkest, lightest = (geometry.sample_nearest(of(other, around), uv)[0] for of in (cv2.erode, cv2.dilate))
    beyond = np.maximum(0, np.maximum(darkest - colors, colors - lightest)).max(-1)
    return float(beyond[both].mean())


def _smooth_colors(reference: Reference, hole: Hole) -> np.ndarray:
    """Return [h, w, 3] float32 in [0, 1], the reference's picture, reduced to the size of its hole and smoothed."""
    size = hole.camera.width, hole.camera.height
    small = cv2.resize(reference.image, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    return cv2.GaussianBlur(small, (0, 0), SMOOTH * hole.camera.width)

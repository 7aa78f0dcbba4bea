"""Checks whether completed views agree where two of them show the same part of a hole.

The surface behind the object is not known yet. As in `view_ranking`, the disparity of the surroundings is continued
across the hole, unless the completed view brings its depth. So pictures are aligned only to a few pixels, and colours
are compared, not texture: the smoothed colours of one, beyond the range of the other's around the same point.
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

SMOOTH, REACH = 0.02, 0.04  # of the width: standard deviation of the smoothing, and radius of the window of colours
NEAR = 0.015  # relative depth within which two views show the same surface
ALIKE = 0.7  # cosine between normals of the same surface
LEAST_PIXELS = 40  # pixels that both show, at `view_ranking.SIDE`, from which a pair is compared
# Mean difference, colours in [0, 1], from which two pictures contradict each other. On demo-pair true pictures have
# 0.001, one 0.9 times as bright 0.004, one with a smoothly inpainted hole 0.007, one turned upside down 0.021; one 0.7
# times as bright 0.038, with red and blue exchanged 0.047, mirrored 0.053, with the objects left in 0.089. A chequered
# box on a real rock: up to 0.03.
CONTRADICTION = 0.04


def refine_hole_depth(
    holes: Mapping[str, Hole], references: Sequence[Reference], remaining: Gaussians, hidden: Mapping[str, np.ndarray]
) -> dict[str, Hole]:
    """The holes with the depth that completed views bring. Holes of unknown depth are left out: what is drawn over the
    background does not lie at the depth of the surroundings.

    Args:
        holes: view name -> its hole (`view_ranking.find_holes`).
        remaining: the Gaussians without the object's.
        hidden: view name -> bool [H, W], the object's pixels.
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
    """The hole with the depth map of its reference, aligned to the surroundings."""
    size = hole.camera.width, hole.camera.height
    shrunk = lambda array: cv2.resize(array, size, interpolation=cv2.INTER_NEAREST)
    depth = shrunk(reference.depth.astype(np.float64))
    covered = cv2.resize((hidden | reference.mask).astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.01
    rendering = rasterizer.render(remaining, hole.camera, sh_degree=0)
    aligned, _ = align_either(depth, rendering.depth.cpu().numpy(), (rendering.alpha.cpu().numpy() > 0.5) & ~covered)
    return replace(hole, depth=np.where(np.isfinite(aligned), aligned, 0.0))


def find_contradictions(references: Sequence[Reference], holes: Mapping[str, Hole]) -> list[tuple[str, str, float]]:
    """The pairs of views that contradict each other, with their `color_difference`, the largest first.

    Args:
        holes: view name -> its hole (`view_ranking.find_holes`).
    """
    candidates = [each for each in references if each.camera.name in holes]
    found = []
    for a, b in combinations(candidates, 2):
        unlike = color_difference(a, b, holes[a.camera.name], holes[b.camera.name])
        if unlike is not None and unlike > CONTRADICTION:
            found.append((a.camera.name, b.camera.name, unlike))
    return sorted(found, key=lambda pair: -pair[2])


def color_difference(a: Reference, b: Reference, hole_a: Hole, hole_b: Hole) -> float | None:
    """How far the colours of one reference lie beyond those of the other around the same point, [0, 1]: the mean over
    what both show in their holes, in both directions. None where they share too few pixels."""
    ways = [_one_way_difference(a, b, hole_a, hole_b), _one_way_difference(b, a, hole_b, hole_a)]
    differences = [way for way in ways if way is not None]
    return sum(differences) / len(differences) if differences else None


def _one_way_difference(a: Reference, b: Reference, hole_a: Hole, hole_b: Hole) -> float | None:
    """`color_difference` of `a` from `b` alone."""
    own = hole_a.pixels & (hole_a.depth > 0)
    points, colors = geometry.unproject(hole_a.depth, hole_a.camera)[own], _smooth_colors(a, hole_a)[own]
    uv, z = geometry.project(points, hole_b.camera)
    inside, framed = geometry.sample_nearest(hole_b.pixels, uv)
    depth, _ = geometry.sample_nearest(hole_b.depth, uv)
    # The front and the back of an object are two surfaces, however thin it is.
    normals_a = surface_normals(hole_a.depth, hole_a.camera)[own]
    normals_b, _ = geometry.sample_nearest(surface_normals(hole_b.depth, hole_b.camera), uv)
    both = (
        framed & inside & (depth > 0) & (np.abs(z - depth) < NEAR * depth) & ((normals_a * normals_b).sum(-1) > ALIKE)
    )
    if both.sum() < LEAST_PIXELS:
        return None
    other, reach = _smooth_colors(b, hole_b), max(1, round(REACH * hole_b.camera.width))
    around = square(reach)
    darkest, lightest = (geometry.sample_nearest(of(other, around), uv)[0] for of in (cv2.erode, cv2.dilate))
    beyond = np.maximum(0, np.maximum(darkest - colors, colors - lightest)).max(-1)
    return float(beyond[both].mean())


def _smooth_colors(reference: Reference, hole: Hole) -> np.ndarray:
    """[h, w, 3] float32 in [0, 1], the smoothed picture at the size of its hole."""
    size = hole.camera.width, hole.camera.height
    small = cv2.resize(reference.image, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    return cv2.GaussianBlur(small, (0, 0), SMOOTH * hole.camera.width)

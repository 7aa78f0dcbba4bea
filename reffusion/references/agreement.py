"""Do completed views agree where two of them show the same part of a hole?

The surface behind the object is not known yet; as in `painting` it is the surroundings' disparity drawn across the
hole, unless the completed view brings its depth. So one picture lands in the other only to a few pixels, and colours
are asked for, not texture: those of the one, smoothed, beyond the range of the other's around the same place.
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
from reffusion.references.view_ranking import Hole
from reffusion.splat import rasterizer
from reffusion.types import Gaussians, Reference

SMOOTH, REACH = 0.02, 0.04  # of the image's width: deviation of the smoothing; how far around colours are taken
NEAR = 0.015  # relative depth within which two views show the same surface
ALIKE = 0.7  # cosine between normals of what is one surface
FEWEST = 40  # pixels that both show, at `painting.SIDE`, from which a pair is compared
# Mean of the differences, colours in [0, 1], from which two pictures contradict each other. On demo-pair true pictures
# are at 0.001, one 0.9 times as bright at 0.004, its hole smoothly inpainted 0.007, turned upside down 0.021; 0.7
# times as bright 0.038, red and blue exchanged 0.047, mirrored 0.053, with the objects left in 0.089. A chequered box
# on a real rock: up to 0.03.
UNLIKE = 0.04


def as_drawn(
    holes: Mapping[str, Hole], references: Sequence[Reference], remaining: Gaussians, hidden: Mapping[str, np.ndarray]
) -> dict[str, Hole]:
    """The holes with the depth that completed views bring; without those whose depth nothing tells, for what is drawn
    over what stays does not lie at the surroundings' depth.

    Args:
        remaining: the Gaussians without the object's. hidden: view name -> bool [H, W], where it stood.
    """
    found = {}
    for each in (each for each in references if each.camera.name in holes):
        hole, beside = holes[each.camera.name], each.mask & ~hidden[each.camera.name]
        if each.depth is not None:
            with suppress(Degenerate):
                found[each.camera.name] = _measured(hole, each, remaining, hidden[each.camera.name])
        elif beside.sum() < each.mask.sum() / 2:
            found[each.camera.name] = hole
    return found


def _measured(hole: Hole, reference: Reference, remaining: Gaussians, hidden: np.ndarray) -> Hole:
    size = hole.camera.width, hole.camera.height
    shrunk = lambda array: cv2.resize(array, size, interpolation=cv2.INTER_NEAREST)
    told = shrunk(reference.depth.astype(np.float64))
    covered = cv2.resize((hidden | reference.mask).astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.01
    shown = rasterizer.render(remaining, hole.camera, sh_degree=0)
    aligned, _ = align_either(told, shown.depth.cpu().numpy(), (shown.alpha.cpu().numpy() > 0.5) & ~covered)
    return replace(hole, depth=np.where(np.isfinite(aligned), aligned, 0.0))


def contradicting(references: Sequence[Reference], holes: Mapping[str, Hole]) -> list[tuple[str, str, float]]:
    """The pairs of views that contradict each other, with their difference (`difference`), the worst first.

    Args:
        holes: view name -> its hole (`painting.holes`).
    """
    shown = [each for each in references if each.camera.name in holes]
    found = []
    for a, b in combinations(shown, 2):
        unlike = difference(a, b, holes[a.camera.name], holes[b.camera.name])
        if unlike is not None and unlike > UNLIKE:
            found.append((a.camera.name, b.camera.name, unlike))
    return sorted(found, key=lambda pair: -pair[2])


def difference(a: Reference, b: Reference, hole_a: Hole, hole_b: Hole) -> float | None:
    """By how much colours of the one lie beyond those of the other around the same place, [0, 1]; the mean over what
    both show in their holes, of both ways. None where that is too little to tell."""
    ways = [_one_way(a, b, hole_a, hole_b), _one_way(b, a, hole_b, hole_a)]
    told = [way for way in ways if way is not None]
    return sum(told) / len(told) if told else None


def _one_way(a: Reference, b: Reference, hole_a: Hole, hole_b: Hole) -> float | None:
    own = hole_a.pixels & (hole_a.depth > 0)
    points, colors = geometry.unproject(hole_a.depth, hole_a.camera)[own], _smoothed(a, hole_a)[own]
    uv, z = geometry.project(points, hole_b.camera)
    inside, framed = geometry.sample_nearest(hole_b.pixels, uv)
    depth, _ = geometry.sample_nearest(hole_b.depth, uv)
    # A thing's front and its back are two surfaces, however thin it is.
    faces = surface_normals(hole_a.depth, hole_a.camera)[own]
    there, _ = geometry.sample_nearest(surface_normals(hole_b.depth, hole_b.camera), uv)
    both = framed & inside & (depth > 0) & (np.abs(z - depth) < NEAR * depth) & ((faces * there).sum(-1) > ALIKE)
    if both.sum() < FEWEST:
        return None
    other, reach = _smoothed(b, hole_b), max(1, round(REACH * hole_b.camera.width))
    around = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    darkest, lightest = (geometry.sample_nearest(of(other, around), uv)[0] for of in (cv2.erode, cv2.dilate))
    beyond = np.maximum(0, np.maximum(darkest - colors, colors - lightest)).max(-1)
    return float(beyond[both].mean())


def _smoothed(reference: Reference, hole: Hole) -> np.ndarray:
    """[h, w, 3] float32 in [0, 1], the picture at the size of its hole, smoothed."""
    size = hole.camera.width, hole.camera.height
    small = cv2.resize(reference.image, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    return cv2.GaussianBlur(small, (0, 0), SMOOTH * hole.camera.width)

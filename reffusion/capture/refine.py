"""Cameras that do not quite fit their photographs: whether they do, and bundle adjustment where they do not.

Poses that come with a capture were solved with one lens for all views. But a phone's stabiliser shifts its lens from
shot to shot: far things then end up a pixel or two from where near things put them, and no Gaussian is sharp in all
views. Flow between neighbours shows it, everywhere in the picture; then pose and principal point of each view are
adjusted to it, by Ceres through COLMAP. Focal lengths stay: freed as well, they drift where the views see little of
each other (`fox`: by half), and give `statue` next to nothing (0.097 -> 0.091 px).

PAPER leaves open: it takes the cameras as given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from reffusion.capture import stereo
from reffusion.capture.sfm import bundle_adjusted
from reffusion.types import Camera

ENOUGH = 0.15  # px of `misfit` with which cameras are left as they are; exact ones show 0.08, COLMAP's own 0.10
# The adjusted cameras' misfit must be under so much of the given ones'. Where stabilisers moved principal points
# (`statue`) a fifth remains. Where more than half remains (`fox`, `bear`, `garden`, `dinosaur`: 0.7 to 0.85) something
# else moves in the pictures; adjustment bends the cameras after it, and held-out views get worse (docs/flow.md).
GAIN = 0.5
TRACKS = 10_000  # points to adjust to
ROUNDS = 2  # the second with the matches that the first one's cameras agree with
BLOCK = 8  # cells a side, over which flow's noise is averaged away by the median
LEAST_IN_BLOCK = 15
LOOKED_AT = 8  # views for the first look
CELLS = 64  # of it, along a picture's longer side; in larger pictures flow's noise, too, is more pixels wide
LEAST_CELL = 8  # px
FARTHEST_SHIFT = 0.02  # of the longer side; a principal point that wants to go farther, beyond stabilisers, stays


@dataclass(frozen=True)
class Refined:
    """Attributes:
    cameras: view name -> camera, adjusted or as given.
    before, after: px of `misfit`; `after` is None where nothing was adjusted.
    """

    cameras: dict[str, Camera]
    before: float
    after: float | None


def refined(cameras: Sequence[Camera], images: Mapping[str, np.ndarray]) -> Refined:
    """The cameras, adjusted where flow says that they need it and that it helped.

    Half of the matches are adjusted to; the other half must fit better by `GAIN`.

    Args:
        cameras: undistorted views in the normalised frame.
        images: view name -> uint8 [H, W, 3].
    """
    given = {camera.name: camera for camera in cameras}
    cell = max(4, round((sum(c.width * c.height for c in cameras) / (2 * TRACKS)) ** 0.5))
    few = cameras[:: -(-len(cameras) // LOOKED_AT)]
    coarse = max(LEAST_CELL, round(max(max(camera.width, camera.height) for camera in cameras) / CELLS))
    before = misfit(list(stereo.match(few, cameras, images, coarse)), given, coarse)
    if not before > ENOUGH:
        return Refined(given, before, None)
    matches = list(stereo.match(cameras, cameras, images, cell))
    odd = [((m.pixels // cell).sum(1) % 2).astype(bool) for m in matches]
    fitted = [_part(m, ~o) for m, o in zip(matches, odd, strict=True)]
    kept = [_part(m, o) for m, o in zip(matches, odd, strict=True)]
    before = misfit(kept, given, cell)  # of neighbours: those of the few views lie farther apart
    if not before > ENOUGH:
        return Refined(given, before, None)
    adjusted = _aligned(_adjusted(fitted, given), given)
    after = misfit(kept, adjusted, cell)
    return Refined(adjusted, before, after) if after < GAIN * before else Refined(given, before, None)


def _adjusted(matches: Sequence[stereo.Matches], given: Mapping[str, Camera]) -> dict[str, Camera]:
    """`bundle_adjusted` in rounds; again from the start while principal points go astray, with those lenses held."""
    held: set[str] = set()
    while True:
        cameras = dict(given)
        for _ in range(ROUNDS):
            cameras = bundle_adjusted(cameras, *_tracks(matches, cameras), held)
        astray = {name for name, camera in cameras.items() if _shift(camera, given[name]) > FARTHEST_SHIFT} - held
        if not astray:
            return cameras
        held |= astray


def _shift(camera: Camera, given: Camera) -> float:
    """How far the principal point has moved, in units of the picture's longer side."""
    return float(np.hypot(camera.cx - given.cx, camera.cy - given.cy) / max(given.width, given.height))


def misfit(matches: Sequence[stereo.Matches], cameras: Mapping[str, Camera], cell: int) -> float:
    """Mean over blocks of the pictures of the length of the median vector, px, by which flow misses the points that it
    was triangulated to: what cameras get wrong, for flow's own noise has no direction. NaN where nothing matches.
    """
    lengths = []
    for match in matches:
        depth, known = stereo.triangulate(match, cameras)
        block = (match.pixels // (BLOCK * cell)).astype(int) @ (100_000, 1)
        for vectors, seen in zip(stereo.misses(match, cameras, depth), match.seen, strict=True):
            usable = known & seen & np.isfinite(vectors).all(1)
            for index in np.unique(block[usable]):
                here = vectors[usable & (block == index)]
                if len(here) >= LEAST_IN_BLOCK:
                    lengths.append(np.linalg.norm(np.median(here, 0)))
    return float(np.mean(lengths)) if lengths else float("nan")


def _tracks(matches: Sequence[stereo.Matches], cameras: Mapping[str, Camera]):
    """Sightings and points as `bundle_adjusted` wants them."""
    seen_at: dict[str, list[np.ndarray]] = {name: [] for name in cameras}
    points = []
    for match in matches:
        depth, known = stereo.triangulate(match, cameras)
        depth = np.minimum(depth, stereo.FARTHEST)
        away = np.abs(stereo.misses(match, cameras, depth)).max(2)
        agree = match.seen & (away < stereo.RESIDUAL)
        places = stereo.unproject(cameras[match.view], match.pixels, depth)
        for k in np.flatnonzero(known & agree.any(0)):
            sightings = [(match.view, match.pixels[k])]
            sightings += [(name, match.places[j, k]) for j, name in enumerate(match.others) if agree[j, k]]
            track = []
            for name, pixel in sightings:
                track.append((name, len(seen_at[name])))
                seen_at[name].append(pixel)
            points.append((places[k], track))
    return seen_at, points


def _part(matches: stereo.Matches, chosen: np.ndarray) -> stereo.Matches:
    return replace(
        matches, pixels=matches.pixels[chosen], places=matches.places[:, chosen], seen=matches.seen[:, chosen]
    )


def _aligned(cameras: Mapping[str, Camera], given: Mapping[str, Camera]) -> dict[str, Camera]:
    """The cameras moved, turned and scaled as a whole to where the given ones stand: adjustment knows no frame."""
    names = list(cameras)
    turns = [given[n].world_to_camera[:3, :3].T @ cameras[n].world_to_camera[:3, :3] for n in names]
    turn = Rotation.from_matrix(turns).mean().as_matrix()
    here, there = (np.array([each[n].center for n in names]) for each in (cameras, given))
    middle_here, middle_there = here.mean(0), there.mean(0)
    turned = (here - middle_here) @ turn.T
    scale = (turned * (there - middle_there)).sum() / (turned**2).sum()
    moved = {}
    for name, center in zip(names, scale * turned + middle_there, strict=True):
        pose = np.eye(4)
        pose[:3, :3] = cameras[name].world_to_camera[:3, :3] @ turn.T
        pose[:3, 3] = -pose[:3, :3] @ center
        moved[name] = replace(cameras[name], world_to_camera=pose)
    return moved

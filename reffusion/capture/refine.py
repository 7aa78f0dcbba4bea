"""Tests whether cameras fit their photographs, and adjusts the cameras if they do not.

Poses that come with a capture were solved with one lens for all views. But a phone's stabilizer shifts the lens from
shot to shot. Then no pose fits near and distant objects at once: distant objects are off by a pixel or two, and no
Gaussian is sharp in all views. Optical flow between neighboring views shows such errors everywhere in the picture. The
pose and the principal point of each view are then adjusted to the flow by bundle adjustment (Ceres, through COLMAP).
Focal lengths stay fixed. If they are adjusted too, they drift in captures whose views share little (`fox`: by half),
and gain almost nothing elsewhere (`statue`: 0.097 -> 0.091 px).

PAPER leaves open: it takes the cameras as given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from reffusion.capture import flow
from reffusion.capture.sfm import bundle_adjust
from reffusion.types import Camera

# px of `flow_residual` up to which cameras stay as given; exact cameras have 0.08, COLMAP's own poses 0.10
GOOD_RESIDUAL = 0.15
# Largest accepted ratio of the residuals after and before adjustment. If stabilizers moved principal points (`statue`),
# the ratio is 0.2. If the ratio is above a half (`fox`, `bear`, `garden`, `dinosaur`: 0.7 to 0.85), the residuals come
# from something else that moves in the pictures. The adjusted cameras then follow this motion, and held-out views get
# worse (docs/method.md#cameras-and-fit).
LARGEST_RATIO = 0.5
TRACKS = 10_000  # number of points for bundle adjustment
ROUNDS = 2  # of bundle adjustment; the second round uses the matches that agree with the cameras of the first
BLOCK = 8  # cells along each side of a block of the picture; the median over a block removes the noise of flow
LEAST_IN_BLOCK = 15  # residual vectors that a block must have
PROBE_VIEWS = 8  # views for the first, quick test
# cells of this test along a picture's longer side: cells grow with the picture, as the noise of flow does
PROBE_CELLS = 64
LEAST_CELL = 8  # px: smallest cell of the test
# share of the longer side: a principal point that would move further, more than stabilizers do, is held fixed
LARGEST_SHIFT = 0.02


@dataclass(frozen=True)
class Refinement:
    """The result of `refine_cameras`.

    Attributes:
        cameras: view name -> camera, adjusted or as given.
        before: `flow_residual` of the given cameras in pixels; NaN if no views match. If the quick test decided, this
            is its residual, else the residual at the half of the matches that is not used for adjustment.
        after: `flow_residual` of the adjusted cameras at the same matches; None if the cameras are as given, also if
            adjusted cameras were rejected.
    """

    cameras: dict[str, Camera]
    before: float
    after: float | None


def refine_cameras(cameras: Sequence[Camera], images: Mapping[str, np.ndarray]) -> Refinement:
    """Adjust cameras to optical flow, if the flow contradicts the given cameras and the adjustment reduces the error.

    Cameras stay as given if their residual (`flow_residual`) is at most `GOOD_RESIDUAL` or unknown, first in a quick
    test of a few views, then at one half of the matches of all views. Otherwise the other half is used for bundle
    adjustment, and the result is aligned with the given cameras by a similarity. The adjusted cameras are accepted if
    their residual at the former half is less than `LARGEST_RATIO` times that of the given cameras.

    Args:
        cameras: cameras of undistorted views in the normalized frame.
        images: view name -> uint8 [H, W, 3].
    """
    initial = {camera.name: camera for camera in cameras}
    cell = max(4, round((sum(c.width * c.height for c in cameras) / (2 * TRACKS)) ** 0.5))
    probe = cameras[:: -(-len(cameras) // PROBE_VIEWS)]
    coarse = max(LEAST_CELL, round(max(max(camera.width, camera.height) for camera in cameras) / PROBE_CELLS))
    before = flow_residual(list(flow.match_views(probe, cameras, images, coarse)), initial, coarse)
    if not before > GOOD_RESIDUAL:
        return Refinement(initial, before, None)
    matches = list(flow.match_views(cameras, cameras, images, cell))
    odd = [((m.pixels // cell).sum(1) % 2).astype(bool) for m in matches]
    fitting = [_select(m, ~o) for m, o in zip(matches, odd, strict=True)]
    checking = [_select(m, o) for m, o in zip(matches, odd, strict=True)]
    # again, to be comparable with `after`: in the quick test the cells are larger, and the views few
    before = flow_residual(checking, initial, cell)
    if not before > GOOD_RESIDUAL:
        return Refinement(initial, before, None)
    adjusted = _align(_adjust(fitting, initial), initial)
    after = flow_residual(checking, adjusted, cell)
    return Refinement(adjusted, before, after) if after < LARGEST_RATIO * before else Refinement(initial, before, None)


def _adjust(matches: Sequence[flow.Matches], initial: Mapping[str, Camera]) -> dict[str, Camera]:
    """Return the cameras after `ROUNDS` rounds of `bundle_adjust`; runaway principal points are held fixed."""
    fixed: set[str] = set()
    while True:
        cameras = dict(initial)
        for _ in range(ROUNDS):
            cameras = bundle_adjust(cameras, *_build_tracks(matches, cameras), fixed)
        # Principal points that move further than this are fixed, and the adjustment starts again.
        escaped = {name for name, camera in cameras.items() if _shift(camera, initial[name]) > LARGEST_SHIFT} - fixed
        if not escaped:
            return cameras
        fixed |= escaped


def _shift(camera: Camera, initial: Camera) -> float:
    """Return the distance between two cameras' principal points, in units of the picture's longer side."""
    return float(np.hypot(camera.cx - initial.cx, camera.cy - initial.cy) / max(initial.width, initial.height))


def flow_residual(matches: Sequence[flow.Matches], cameras: Mapping[str, Camera], cell: int) -> float:
    """Return the systematic reprojection error of cameras in pixels; NaN if there are too few matches.

    Points are triangulated from the flow. A residual vector leads from the place where flow finds a point in a
    neighboring view to the point's projection. For each block of a picture and each neighbor, the median of the
    residual vectors is taken. The result is the mean length of these medians. The noise of flow has no preferred
    direction, so that the median leaves the error of the cameras.

    Args:
        matches: matches of each view with its neighbors.
        cameras: view name -> camera.
        cell: side in pixels of the cells in which the matches were made; a block has `BLOCK` x `BLOCK` cells.
    """
    lengths = []
    for match in matches:
        depth, known = flow.depths_from_matches(match, cameras)
        block = (match.pixels // (BLOCK * cell)).astype(int) @ (100_000, 1)
        for vectors, seen in zip(flow.flow_residuals(match, cameras, depth), match.seen, strict=True):
            usable = known & seen & np.isfinite(vectors).all(1)
            for index in np.unique(block[usable]):
                centers = vectors[usable & (block == index)]
                if len(centers) >= LEAST_IN_BLOCK:
                    lengths.append(np.linalg.norm(np.median(centers, 0)))
    return float(np.mean(lengths)) if lengths else float("nan")


def _build_tracks(matches: Sequence[flow.Matches], cameras: Mapping[str, Camera]):
    """Return `sightings` and `points` of `bundle_adjust`: one point per matched pixel that agrees with a neighbor."""
    seen_at: dict[str, list[np.ndarray]] = {name: [] for name in cameras}
    points = []
    for match in matches:
        depth, known = flow.depths_from_matches(match, cameras)
        depth = np.minimum(depth, flow.FARTHEST)
        away = np.abs(flow.flow_residuals(match, cameras, depth)).max(2)
        agree = match.seen & (away < flow.RESIDUAL)
        places = flow.unproject(cameras[match.view], match.pixels, depth)
        for k in np.flatnonzero(known & agree.any(0)):
            sightings = [(match.view, match.pixels[k])]
            sightings += [(name, match.places[j, k]) for j, name in enumerate(match.others) if agree[j, k]]
            track = []
            for name, pixel in sightings:
                track.append((name, len(seen_at[name])))
                seen_at[name].append(pixel)
            points.append((places[k], track))
    return seen_at, points


def _select(matches: flow.Matches, chosen: np.ndarray) -> flow.Matches:
    """Return the matches of the pixels for which `chosen`, bool [P], is True."""
    return replace(
        matches, pixels=matches.pixels[chosen], places=matches.places[:, chosen], seen=matches.seen[:, chosen]
    )


def _align(cameras: Mapping[str, Camera], initial: Mapping[str, Camera]) -> dict[str, Camera]:
    """Return adjusted cameras, aligned with the given ones by a similarity: the adjustment does not fix the frame."""
    names = list(cameras)
    turns = [initial[n].world_to_camera[:3, :3].T @ cameras[n].world_to_camera[:3, :3] for n in names]
    turn = Rotation.from_matrix(turns).mean().as_matrix()
    centers, initial_centers = (np.array([each[n].center for n in names]) for each in (cameras, initial))
    mean, initial_mean = centers.mean(0), initial_centers.mean(0)
    turned = (centers - mean) @ turn.T
    scale = (turned * (initial_centers - initial_mean)).sum() / (turned**2).sum()
    moved = {}
    for name, center in zip(names, scale * turned + initial_mean, strict=True):
        pose = np.eye(4)
        pose[:3, :3] = cameras[name].world_to_camera[:3, :3] @ turn.T
        pose[:3, 3] = -pose[:3, :3] @ center
        moved[name] = replace(cameras[name], world_to_camera=pose)
    return moved

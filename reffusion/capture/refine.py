"""Tests whether cameras fit their photographs, and adjusts them where they do not.

Poses that come with a capture were solved with one lens for all views. But a phone's stabiliser shifts its lens from
shot to shot: distant objects then end up a pixel or two from where near ones put them, and no Gaussian is sharp in all
views. Optical flow between neighbours shows this everywhere in the picture. Pose and principal point of each view are
then adjusted to the flow by bundle adjustment (Ceres, through COLMAP). Focal lengths stay fixed: adjusted as well, they
drift where the views see little of each other (`fox`: by half), and give `statue` next to nothing (0.097 -> 0.091 px).

PAPER leaves open: it takes the cameras as given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from reffusion.capture import stereo
from reffusion.capture.sfm import bundle_adjust
from reffusion.types import Camera

# px of `flow_residual` up to which cameras stay as they are; exact ones show 0.08, COLMAP's own 0.10
GOOD_RESIDUAL = 0.15
# Largest ratio of the residuals after and before adjustment. Where stabilisers moved principal points (`statue`) a
# fifth remains. Where more than half remains (`fox`, `bear`, `garden`, `dinosaur`: 0.7 to 0.85) something else moves in
# the pictures; adjustment bends the cameras to it, and held-out views get worse (docs/method.md#cameras-and-fit).
LARGEST_RATIO = 0.5
TRACKS = 10_000  # number of points for bundle adjustment
ROUNDS = 2  # of bundle adjustment; the second uses the matches that agree with the cameras of the first
BLOCK = 8  # cells along a side of a block, over which the median averages out the noise of flow
LEAST_IN_BLOCK = 15  # vectors in a block
PROBE_VIEWS = 8  # views for the first, quick test
# of the test, along a picture's longer side; in larger pictures the noise of flow, too, is more pixels wide
PROBE_CELLS = 64
LEAST_CELL = 8  # px: smallest cell of the test
# of the longer side: a principal point that moves further, beyond what stabilisers do, is held fixed
LARGEST_SHIFT = 0.02


@dataclass(frozen=True)
class Refinement:
    """The result of `refine_cameras`.

    Attributes:
        cameras: view name -> camera, adjusted or as given.
        before, after: px, `flow_residual`; `after` is None where nothing was adjusted.
    """

    cameras: dict[str, Camera]
    before: float
    after: float | None


def refine_cameras(cameras: Sequence[Camera], images: Mapping[str, np.ndarray]) -> Refinement:
    """Adjust the cameras where flow shows that they need it and that it helped.

    Half of the matches are used for adjustment; the residual of the other half must fall below `LARGEST_RATIO` of what
    it was.

    Args:
        cameras: undistorted views in the normalised frame.
        images: view name -> uint8 [H, W, 3].
    """
    initial = {camera.name: camera for camera in cameras}
    cell = max(4, round((sum(c.width * c.height for c in cameras) / (2 * TRACKS)) ** 0.5))
    probe = cameras[:: -(-len(cameras) // PROBE_VIEWS)]
    coarse = max(LEAST_CELL, round(max(max(camera.width, camera.height) for camera in cameras) / PROBE_CELLS))
    before = flow_residual(list(stereo.match_views(probe, cameras, images, coarse)), initial, coarse)
    if not before > GOOD_RESIDUAL:
        return Refinement(initial, before, None)
    matches = list(stereo.match_views(cameras, cameras, images, cell))
    odd = [((m.pixels // cell).sum(1) % 2).astype(bool) for m in matches]
    fitting = [_select(m, ~o) for m, o in zip(matches, odd, strict=True)]
    checking = [_select(m, o) for m, o in zip(matches, odd, strict=True)]
    before = flow_residual(checking, initial, cell)  # of neighbours: those of the few views lie farther apart
    if not before > GOOD_RESIDUAL:
        return Refinement(initial, before, None)
    adjusted = _align(_adjust(fitting, initial), initial)
    after = flow_residual(checking, adjusted, cell)
    return Refinement(adjusted, before, after) if after < LARGEST_RATIO * before else Refinement(initial, before, None)


def _adjust(matches: Sequence[stereo.Matches], initial: Mapping[str, Camera]) -> dict[str, Camera]:
    """`bundle_adjust` in rounds. It restarts while principal points leave their range, with these held fixed."""
    fixed: set[str] = set()
    while True:
        cameras = dict(initial)
        for _ in range(ROUNDS):
            cameras = bundle_adjust(cameras, *_build_tracks(matches, cameras), fixed)
        escaped = {name for name, camera in cameras.items() if _shift(camera, initial[name]) > LARGEST_SHIFT} - fixed
        if not escaped:
            return cameras
        fixed |= escaped


def _shift(camera: Camera, initial: Camera) -> float:
    """Displacement of the principal point, in units of the picture's longer side."""
    return float(np.hypot(camera.cx - initial.cx, camera.cy - initial.cy) / max(initial.width, initial.height))


def flow_residual(matches: Sequence[stereo.Matches], cameras: Mapping[str, Camera], cell: int) -> float:
    """The systematic error of the cameras in px, NaN where nothing matches.

    Each block of a picture contributes the length of its median residual vector, between flow and the points
    triangulated from it; the result is the mean over blocks. The noise of flow has no preferred direction, so the
    median leaves what the cameras get wrong.
    """
    lengths = []
    for match in matches:
        depth, known = stereo.triangulate(match, cameras)
        block = (match.pixels // (BLOCK * cell)).astype(int) @ (100_000, 1)
        for vectors, seen in zip(stereo.flow_residuals(match, cameras, depth), match.seen, strict=True):
            usable = known & seen & np.isfinite(vectors).all(1)
            for index in np.unique(block[usable]):
                centers = vectors[usable & (block == index)]
                if len(centers) >= LEAST_IN_BLOCK:
                    lengths.append(np.linalg.norm(np.median(centers, 0)))
    return float(np.mean(lengths)) if lengths else float("nan")


def _build_tracks(matches: Sequence[stereo.Matches], cameras: Mapping[str, Camera]):
    """Observations and points as `bundle_adjust` takes them."""
    seen_at: dict[str, list[np.ndarray]] = {name: [] for name in cameras}
    points = []
    for match in matches:
        depth, known = stereo.triangulate(match, cameras)
        depth = np.minimum(depth, stereo.FARTHEST)
        away = np.abs(stereo.flow_residuals(match, cameras, depth)).max(2)
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


def _select(matches: stereo.Matches, chosen: np.ndarray) -> stereo.Matches:
    """The chosen ones of the matches, bool [P]."""
    return replace(
        matches, pixels=matches.pixels[chosen], places=matches.places[:, chosen], seen=matches.seen[:, chosen]
    )


def _align(cameras: Mapping[str, Camera], initial: Mapping[str, Camera]) -> dict[str, Camera]:
    """Align adjusted cameras with the given ones by a similarity: adjustment does not fix the frame."""
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

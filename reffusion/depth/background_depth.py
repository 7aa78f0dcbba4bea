"""Depth where a view shows nothing yet: the surroundings continued through the hole, or a picture's estimate fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import ndimage

from reffusion import geometry, seeding
from reffusion.depth import bilateral, planes
from reffusion.depth.completion import Plate, complete
from reffusion.depth.layers import of_planes, shared_out
from reffusion.depth.solverlog import SILENT, SolverLog
from reffusion.types import Camera, Rendering

ENOUGH_POINTS = 50  # fewer sparse points around the hole, and the rendered depth is asked instead
SURE = 0.8  # share of the sparse points that planes explain, from which nothing else is asked
SWEPT = 3  # times as many pixels whose depth was swept take part in the search for planes
BEHIND = 1.03  # relative depth from which a sparse point is hidden by what is rendered
STRETCH = 1.15  # a surface continued beyond the disparities that are seen of it, by so much at most
REFUTED = 0.05  # share of the hole in which planes that meet are wrong, from which they are not taken
NEARER = 1.03  # relative disparity by which they are, before a plane that goes on
FARTHEST = 2.0  # times the farthest known depth: beyond it lies infinity, of which nothing is known


@dataclass(frozen=True)
class Completion:
    """How depth is found behind the object.

    PAPER leaves open: the depth model. Without one the surroundings are continued, by two hypotheses: planes that meet
    (rooms), taken where they explain the surroundings, else the smooth completion.

    Attributes:
        explained: alpha from which the rendered depth is known.
        margin: known pixels nearer to the hole are left out, / image width: their depth is half the object's.
        ring: surroundings that are continued, / image width.
        planar_share: share of the surroundings that planes must explain to be taken; above 1 they never are.
        planar_tolerance: relative disparity within which they do.
        stiffness, edge, unknowns: see `depth.Plate`.
        solver_smoothness, solver_spatial, solver_luma, solver_chroma: see `bilateral.Solver`.
        robust: an estimate is aligned with outliers let go, see `alignment.align`.
        seed: of the draws that find planes.
    """

    explained: float = 0.5
    margin: float = 0.01
    ring: float = 0.08
    planar_share: float = 0.8
    planar_tolerance: float = 0.01
    stiffness: float = 100.0
    edge: float = 0.1
    unknowns: int = 60_000
    solver_smoothness: float = 128.0
    solver_spatial: float = 8.0
    solver_luma: float = 8.0
    solver_chroma: float = 8.0
    robust: bool = False
    seed: int = 0

    @property
    def solver(self) -> bilateral.Solver:
        return bilateral.Solver(self.solver_smoothness, self.solver_spatial, self.solver_luma, self.solver_chroma)


@dataclass(frozen=True)
class Hints:
    """What else is known of a view's depth; None where it was not asked.

    Attributes:
        continued: [H, W] depth of planes that go on in the hole, inf where none does (`unobserved.Uncovered`).
        planes: depth [H, W] of each of these planes, everywhere. witnessed: bool [H, W], pixels of the hole whose
            rendered depth other views show.
        outer: [H, W] depth that is better known than the rendering's, above 0 where there is one.
        told: bool [H, W], pixels of `outer` that other photographs agree on (`reffusion.initialize.sweep`).
        looked_past: depth [H, W] -> bool [H, W], where other views look past such a surface.
    """

    continued: np.ndarray | None = None
    planes: Sequence[np.ndarray] = ()
    witnessed: np.ndarray | None = None
    outer: np.ndarray | None = None
    told: np.ndarray | None = None
    looked_past: Callable[[np.ndarray], np.ndarray] | None = None


NO_HINTS = Hints()


@dataclass(frozen=True)
class Seen:
    """What one view shows of the scene's depth.

    Attributes:
        camera: the view.
        depth: [H, W] float64 camera z as rendered.
        known: bool [H, W], the pixels whose depth is the scene's: covered, and not beside the hole; or witnessed in it.
        hole: bool [H, W], the pixels to be filled. hidden: bool [H, W], C: where the object stood.
        anchored: bool [H, W], pixels of the hole whose `depth` is that of a plane which goes on there.
        hints: what else is known.
    """

    camera: Camera
    depth: np.ndarray
    known: np.ndarray
    hole: np.ndarray
    hidden: np.ndarray
    anchored: np.ndarray
    hints: Hints = NO_HINTS

    @property
    def disparity(self) -> np.ndarray:
        """[H, W] float64; 0 where there is no depth."""
        return geometry.reciprocal(self.depth)

    @property
    def least_disparity(self) -> float:
        """Of what is farther nothing is known. Degenerate where nothing is known at all."""
        if not self.known.any():
            raise geometry.Degenerate("few pixels", "no depth is known around the hole")
        return 1.0 / (FARTHEST * self.depth[self.known].max())


def seen(
    drawn: Rendering,
    camera: Camera,
    hole: np.ndarray,
    hidden: np.ndarray,
    how: Completion,
    hints: Hints = NO_HINTS,
) -> Seen:
    """The depth of a rendering, known where it is covered, but for the hole and a margin around it."""
    depth, alpha = (t.detach().double().cpu().numpy() for t in (drawn.depth, drawn.alpha))
    continued, outer = hints.continued, hints.outer
    if outer is not None:
        depth, alpha = np.where(outer > 0, outer, depth), np.where(outer > 0, 1.0, alpha)
    known = (alpha > how.explained) & (depth > 0) & ~grown(hole, how.margin)
    if hints.witnessed is not None:
        known |= hole & hints.witnessed
    anchored = hole & ~known & np.isfinite(continued) if continued is not None else np.zeros_like(hole)
    depth = np.where(anchored, continued, depth) if anchored.any() else depth
    return Seen(camera, depth, known, hole, hidden, anchored, hints)


def continued(
    view: Seen,
    guide: np.ndarray | Callable[[], np.ndarray],
    points: np.ndarray,
    how: Completion,
    solvers: SolverLog = SILENT,
    farthest: bool = False,
) -> tuple[np.ndarray, str]:
    """The scene's own disparity, [H, W] float64, continued through the hole; and how in words.

    Planes are found among the sparse points where there are enough (they are unbiased, while the expected depth of
    splats lies too near wherever haze hangs before a plain surface), else among the rendered depths. Where planes do
    not explain the surroundings, they are continued smoothly but for creases at edges of the guide.

    Args:
        guide: [H, W, 3] uint8 or [0, 1], or what gives it when it is needed; the view's picture without the object.
        points: [P, 3] sparse points of the scene; P = 0 allowed.
        solvers: are told of what each solver finds.
        farthest: of several surfaces around the hole only the farthest goes on: for a hole through which one looks.
    Raises:
        Degenerate: too little is known around the hole.
    """
    planar, said = _planar(view, points, how)
    solvers.solved("planes", planar.disparity)
    if planar.explained >= how.planar_share:
        wrong = _refuted(view, planar.disparity)
        if wrong <= REFUTED:
            return planar.disparity, said
        said = f"{said}, but would hide what is known of the space in {wrong:.0%} of the hole"
    guide = guide() if callable(guide) else guide
    plate = Plate(how.ring, how.stiffness, how.edge, how.unknowns)
    given = view.known | view.anchored
    around, hole = given & grown(view.hole, how.ring), grown(view.hole, how.margin)
    planes = () if farthest else view.hints.planes
    share = partial(shared_out, view.disparity, around, hole, guide, planes, view.anchored)
    surfaces = share()
    if surfaces.max() > 1 and farthest:
        far = complete(view.disparity, given & (surfaces == _farthest(view, surfaces, given)), guide, plate)
        return np.where(view.anchored, view.disparity, far), f"{said}: the farthest of {surfaces.max()} surfaces"
    if surfaces.max() > 1:
        layered, said = _layered(view, surfaces, planes, guide, plate), f"{said}: {surfaces.max()} surfaces continued"
        # Of planes that go on their maps tell; and views look into a mirror that is a part of one.
        wrong = _looked_past(view, layered) & ~view.anchored & (surfaces != _farthest(view, surfaces, given))
        if wrong.any():
            layered = _layered(view, share(np.where(wrong, surfaces, 0)), planes, guide, plate)
        solvers.solved("completion", layered)
        return layered, said
    fitted = complete(view.disparity, given, guide, plate, keep=False)
    solvers.solved("completion", fitted)
    # Its misfit on known pixels is spread by the bilateral solver, so that rims meet.
    refined = bilateral.refine(fitted, view.disparity, given.astype(np.float64), guide, how.solver, solvers.iterated)
    solvers.solved("bilateral", refined, solvers.iterations)
    share = view.anchored.sum() / max(view.hole.sum(), 1)
    onward = f", planes that go on in {share:.0%} of the hole" if share else ""
    return np.where(view.anchored, view.disparity, refined), f"{said}: continued smoothly instead{onward}"


def _farthest(view: Seen, surfaces: np.ndarray, given: np.ndarray) -> int:
    """The surface of the smallest median disparity."""
    median = lambda surface: float(np.median(view.disparity[given & ~view.anchored & (surfaces == surface)]))
    present = [k for k in range(1, surfaces.max() + 1) if (given & ~view.anchored & (surfaces == k)).any()]
    return min(present, key=median)


def _layered(
    view: Seen, surfaces: np.ndarray, planes: Sequence[np.ndarray], guide: np.ndarray, plate: Plate
) -> np.ndarray:
    """[H, W] disparity: each surface continued smoothly by itself, with a step where two meet. One that has taken what
    was supposed to be a plane's stands before the plane."""
    taken = view.anchored & (of_planes(view.disparity, view.anchored, surfaces, planes) != surfaces)
    given = view.known | (view.anchored & ~taken)
    found = np.where(given, view.disparity, 0.0)
    for surface in range(1, surfaces.max() + 1):
        own, part = surfaces == surface, view.hole & (surfaces == surface) & ~given
        if not part.any():
            continue
        # Unknown for this surface is what is to be filled; what belongs to others takes no part.
        done = complete(view.disparity, given & own, guide, plate)
        low, high = np.percentile(view.disparity[given & own], [1, 99])
        found[part] = done[part].clip(low / STRETCH, high * STRETCH)
    found = np.where(taken, np.maximum(found, view.disparity), found)
    rest = ~given & (found <= 0)
    return np.where(rest, complete(found, found > 0, guide, plate), found) if rest.any() else found


def _refuted(view: Seen, disparity: np.ndarray) -> float:
    """The share of the hole in which a surface of this disparity hides a plane that goes on, or other views look past
    it: the planes of a post and of the ground meet in front of the ground behind the post."""
    wrong = (view.anchored & (disparity > view.disparity * NEARER)) | _looked_past(view, disparity)
    return float(wrong[view.hole].mean()) if view.hole.any() else 0.0


def _looked_past(view: Seen, disparity: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels of the hole in which other views look past a surface of this disparity."""
    if view.hints.looked_past is None:
        return np.zeros_like(view.hole)
    return view.hole & view.hints.looked_past(1 / np.maximum(disparity, view.least_disparity))


def points_around(view: Seen, points: np.ndarray, how: Completion) -> tuple[np.ndarray, np.ndarray]:
    """Image points [S, 2] and disparities [S] of the scene's points that are seen around the hole."""
    return visible_points(points, view.camera, _around(view, how), view.disparity)


def _around(view: Seen, how: Completion) -> np.ndarray:
    taken = view.hidden | view.hole
    return grown(taken, how.ring) & ~taken


def _planar(view: Seen, points: np.ndarray, how: Completion) -> tuple[planes.PlanarModel, str]:
    """Planes through the surroundings; and how many explain how much.

    Sparse points where they are enough; where planes explain most of them, but not all, so that it is their noise that
    decides, also the pixels whose depth was swept.
    """
    (pixels, values), source = points_around(view, points, how), "sparse points"
    sparse = len(values) >= ENOUGH_POINTS
    if not sparse:
        rows, columns = np.nonzero(_around(view, how) & view.known)
        values, source = view.disparity[rows, columns], "rendered depth"
        pixels = np.stack([columns, rows], 1) + 0.5
    planar = _planes_through(view, pixels, values, how)
    if sparse and view.hints.told is not None and planar.explained < SURE:
        rows, columns = np.nonzero(_around(view, how) & view.known & view.hints.told)
        kept = slice(None, None, max(1, len(rows) // (SWEPT * len(values))))
        rows, columns, source = rows[kept], columns[kept], "sparse points and photographs compared"
        values = np.concatenate([values, view.disparity[rows, columns]])
        pixels = np.concatenate([pixels, np.stack([columns, rows], 1) + 0.5])
        planar = _planes_through(view, pixels, values, how)
    return planar, f"{planar.planes} planes explain {planar.explained:.0%} of {len(values)} {source}"


def _planes_through(view: Seen, pixels: np.ndarray, values: np.ndarray, how: Completion) -> planes.PlanarModel:
    draws = seeding.generator(how.seed, "planes", view.camera.name)
    return planes.planar_model(pixels, values, view.hole.shape, draws, tolerance=how.planar_tolerance)


def visible_points(
    points: np.ndarray, camera: Camera, pixels: np.ndarray, disparity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Image points [S, 2] and disparities [S] of the points that fall on `pixels`, not behind what is rendered."""
    uv, z = geometry.project(points, camera)
    chosen, inside = geometry.sample_nearest(pixels, uv)
    shown, _ = geometry.sample_nearest(disparity, uv)
    visible = chosen & inside & (z > 0) & (z * shown < BEHIND)
    return uv[visible], 1.0 / z[visible]


def grown(mask: np.ndarray, fraction: float) -> np.ndarray:
    """`mask` and all pixels within `fraction` of the image's width of it."""
    if not mask.any():
        return mask
    return ndimage.distance_transform_edt(~mask) <= fraction * mask.shape[1]

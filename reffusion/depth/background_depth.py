"""Depth inside a hole, where a view shows nothing yet: the surroundings are continued through it.

`reffusion.depth.estimates` fits the depth map of a network or of a reference instead.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from reffusion import geometry, morphology, seeding
from reffusion.depth import bilateral, planes
from reffusion.depth.completion import Plate, complete
from reffusion.depth.layers import label_surfaces, plane_labels
from reffusion.depth.solverlog import NO_LOG, SolverLog
from reffusion.types import Camera, Rendering

MIN_POINTS = 50  # with fewer sparse points around the hole, the rendered depth is used instead
CONCLUSIVE_SHARE = 0.8  # share of the sparse points explained by planes, above which no further samples are added
SWEPT_RATIO = 3  # pixels of swept depth that join the search for planes, for each sparse point
OCCLUSION_RATIO = 1.03  # a sparse point this many times as deep as the rendering is occluded
MAX_EXTRAPOLATION = 1.15  # a continued surface exceeds the range of its known disparities by this factor at most
MAX_REFUTED_SHARE = 0.05  # share of the hole in which intersecting planes are refuted, above which they are rejected
IN_FRONT_RATIO = 1.03  # they are refuted where their disparity exceeds that of a continued plane by this factor
FARTHEST_RATIO = 2.0  # depth is limited to this many times the farthest known depth


@dataclass(frozen=True)
class CompletionSettings:
    """Settings for finding the depth behind the object.

    PAPER leaves open: the depth model. Without one the surroundings are continued under one of two hypotheses:
    intersecting planes (rooms), where these explain the surroundings, else a smooth completion.

    Attributes:
        explained: alpha above which the rendered depth counts as known.
        margin: pixels within this distance of the hole do not count as known, / image width: the object's depth is
            blended into theirs.
        ring: width of the surroundings that are continued, / image width.
        planar_share: share of the surroundings that planes must explain to be used; above 1 they never are.
        planar_tolerance: relative disparity within which planes explain a sample.
        stiffness, edge, unknowns: see `completion.Plate`.
        solver_smoothness, solver_spatial, solver_luma, solver_chroma: see `bilateral.Solver`.
        robust: reject outliers when an estimate is aligned, see `alignment.align`.
        seed: of the random samples that find planes.
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
    """Further knowledge of a view's depth; None where it was not computed.

    Attributes:
        plane_depth: [H, W] depth of planes that continue into the hole, inf where none does
            (`reffusion.background.continuation`).
        planes: depth [H, W] of each of these planes, at every pixel.
        confirmed: bool [H, W], pixels of the hole whose rendered depth other views confirm.
        photographed_depth: [H, W] depth of what the photograph shows, 0 where unknown; elsewhere it replaces the
            rendered depth, because it is more accurate.
        swept: bool [H, W], pixels of `photographed_depth` on which other photographs agree
            (`reffusion.initialize.sweep`).
        free_space: depth [H, W] -> bool [H, W], pixels in which other views see past a surface of this depth.
    """

    plane_depth: np.ndarray | None = None
    planes: Sequence[np.ndarray] = ()
    confirmed: np.ndarray | None = None
    photographed_depth: np.ndarray | None = None
    swept: np.ndarray | None = None
    free_space: Callable[[np.ndarray], np.ndarray] | None = None


NO_HINTS = Hints()


@dataclass(frozen=True)
class ViewDepth:
    """The scene's depth in one view, and where it is known.

    Attributes:
        camera: the view.
        depth: [H, W] float64 camera z as rendered.
        known: bool [H, W], the pixels whose depth is that of the scene: covered by Gaussians and not beside the hole,
            or inside it and confirmed by other views.
        hole: bool [H, W], the pixels to be filled.
        hidden: bool [H, W], C: the pixels of the removed object.
        anchored: bool [H, W], pixels of the hole whose `depth` is that of a plane which continues there.
        hints: further knowledge of the depth.
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
        """The disparity of the farthest depth that is allowed. Raises Degenerate where no depth is known."""
        if not self.known.any():
            raise geometry.Degenerate("few pixels", "no depth is known around the hole")
        return 1.0 / (FARTHEST_RATIO * self.depth[self.known].max())


def extract_depth(
    rendering: Rendering,
    camera: Camera,
    hole: np.ndarray,
    hidden: np.ndarray,
    settings: CompletionSettings,
    hints: Hints = NO_HINTS,
) -> ViewDepth:
    """The depth of a rendering: known where alpha is high, except in the hole and a margin around it."""
    depth, alpha = (t.detach().double().cpu().numpy() for t in (rendering.depth, rendering.alpha))
    plane_depth, outer = hints.plane_depth, hints.photographed_depth
    if outer is not None:
        depth, alpha = np.where(outer > 0, outer, depth), np.where(outer > 0, 1.0, alpha)
    known = (alpha > settings.explained) & (depth > 0) & ~morphology.dilate_by_distance(hole, settings.margin)
    if hints.confirmed is not None:
        known |= hole & hints.confirmed
    anchored = hole & ~known & np.isfinite(plane_depth) if plane_depth is not None else np.zeros_like(hole)
    depth = np.where(anchored, plane_depth, depth) if plane_depth is not None and anchored.any() else depth
    return ViewDepth(camera, depth, known, hole, hidden, anchored, hints)


def continue_depth(
    view: ViewDepth,
    guide: np.ndarray | Callable[[], np.ndarray],
    points: np.ndarray,
    settings: CompletionSettings,
    log: SolverLog = NO_LOG,
    farthest: bool = False,
) -> tuple[np.ndarray, str]:
    """The scene's disparity continued through the hole, [H, W] float64, and a description of the method used.

    Planes are fitted to the sparse points where there are enough of them, else to the rendered depth. (Sparse points
    are unbiased, while the expected depth of splats is too small wherever haze floats in front of a plain surface.)
    Where planes do not explain the surroundings, these are continued smoothly, with creases at edges of the guide.

    Args:
        guide: [H, W, 3] uint8 or [0, 1], the view's picture without the object; or a function that returns it, called
            only if it is needed.
        points: [P, 3] sparse points of the scene; P = 0 is allowed.
        log: records the result of each solver.
        farthest: continue only the farthest of several surfaces around the hole, for a hole one looks through.

    Raises:
        Degenerate: too few known pixels around the hole.
    """
    planar, description = _fit_planar_model(view, points, settings)
    log.log_result("planes", planar.disparity)
    if planar.explained >= settings.planar_share:
        refuted = _refuted_share(view, planar.disparity)
        if refuted <= MAX_REFUTED_SHARE:
            return planar.disparity, description
        description = f"{description}, but occlude known free space in {refuted:.0%} of the hole"
    guide = guide() if callable(guide) else guide
    plate = Plate(settings.ring, settings.stiffness, settings.edge, settings.unknowns)
    usable = view.known | view.anchored
    near = lambda fraction: morphology.dilate_by_distance(view.hole, fraction)
    surroundings, hole = usable & near(settings.ring), near(settings.margin)
    planes = () if farthest else view.hints.planes
    label = partial(label_surfaces, view.disparity, surroundings, hole, guide, planes, view.anchored)
    surfaces = label()
    if surfaces.max() > 1 and farthest:
        far_disparity = complete(
            view.disparity, usable & (surfaces == _farthest_surface(view, surfaces, usable)), guide, plate
        )
        return np.where(
            view.anchored, view.disparity, far_disparity
        ), f"{description}: the farthest of {surfaces.max()} surfaces"
    if surfaces.max() > 1:
        layered, description = (
            _complete_layers(view, surfaces, planes, guide, plate),
            f"{description}: {surfaces.max()} surfaces continued",
        )
        # Planes that continue have depth maps of their own; and views do see "past" a mirror that is part of one.
        refuted = (
            _in_free_space(view, layered) & ~view.anchored & (surfaces != _farthest_surface(view, surfaces, usable))
        )
        if refuted.any():
            layered = _complete_layers(view, label(np.where(refuted, surfaces, 0)), planes, guide, plate)
        log.log_result("completion", layered)
        return layered, description
    smooth = complete(view.disparity, usable, guide, plate, keep=False)
    log.log_result("completion", smooth)
    # The bilateral solver spreads the residuals of known pixels into the hole, so that there is no step at its rim.
    refined = bilateral.refine(
        smooth, view.disparity, usable.astype(np.float64), guide, settings.solver, log.log_iteration
    )
    log.log_result("bilateral", refined, log.iterations)
    share = view.anchored.sum() / max(view.hole.sum(), 1)
    onward = f", planes that continue in {share:.0%} of the hole" if share else ""
    return np.where(view.anchored, view.disparity, refined), f"{description}: continued smoothly instead{onward}"


def _farthest_surface(view: ViewDepth, surfaces: np.ndarray, usable: np.ndarray) -> int:
    """The surface of the smallest median disparity."""
    median_disparity = lambda surface: float(np.median(view.disparity[usable & ~view.anchored & (surfaces == surface)]))
    present = [k for k in range(1, surfaces.max() + 1) if (usable & ~view.anchored & (surfaces == k)).any()]
    return min(present, key=median_disparity)


def _complete_layers(
    view: ViewDepth, surfaces: np.ndarray, planes: Sequence[np.ndarray], guide: np.ndarray, plate: Plate
) -> np.ndarray:
    """[H, W] disparity: each surface is continued smoothly by itself, with a step between two surfaces.

    A surface that was given pixels of a continued plane lies in front of that plane.
    """
    reassigned = view.anchored & (plane_labels(view.disparity, view.anchored, surfaces, planes) != surfaces)
    usable = view.known | (view.anchored & ~reassigned)
    result = np.where(usable, view.disparity, 0.0)
    for surface in range(1, surfaces.max() + 1):
        is_surface, missing = surfaces == surface, view.hole & (surfaces == surface) & ~usable
        if not missing.any():
            continue
        # For this surface, only the missing pixels are unknown; pixels of other surfaces take no part.
        filled = complete(view.disparity, usable & is_surface, guide, plate)
        low, high = np.percentile(view.disparity[usable & is_surface], [1, 99])
        result[missing] = filled[missing].clip(low / MAX_EXTRAPOLATION, high * MAX_EXTRAPOLATION)
    result = np.where(reassigned, np.maximum(result, view.disparity), result)
    rest = ~usable & (result <= 0)
    return np.where(rest, complete(result, result > 0, guide, plate), result) if rest.any() else result


def _refuted_share(view: ViewDepth, disparity: np.ndarray) -> float:
    """The share of the hole in which a surface of this disparity occludes a continued plane or fills free space.

    This rejects, for example, the planes of a post and of the ground, which meet before the ground behind the post.
    """
    refuted = (view.anchored & (disparity > view.disparity * IN_FRONT_RATIO)) | _in_free_space(view, disparity)
    return float(refuted[view.hole].mean()) if view.hole.any() else 0.0


def _in_free_space(view: ViewDepth, disparity: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels of the hole in which other views see past a surface of this disparity."""
    if view.hints.free_space is None:
        return np.zeros_like(view.hole)
    return view.hole & view.hints.free_space(1 / np.maximum(disparity, view.least_disparity))


def points_around(view: ViewDepth, points: np.ndarray, settings: CompletionSettings) -> tuple[np.ndarray, np.ndarray]:
    """Image points [S, 2] and disparities [S] of the sparse points that are visible around the hole."""
    return visible_points(points, view.camera, _surroundings(view, settings), view.disparity)


def _surroundings(view: ViewDepth, settings: CompletionSettings) -> np.ndarray:
    excluded = view.hidden | view.hole
    return morphology.dilate_by_distance(excluded, settings.ring) & ~excluded


def _fit_planar_model(
    view: ViewDepth, points: np.ndarray, settings: CompletionSettings
) -> tuple[planes.PlanarModel, str]:
    """The planes fitted to the surroundings, and a description: how many explain what share of the samples.

    The samples are the sparse points where there are enough. Where planes explain most of these but not all, so that
    their noise decides, pixels of swept depth are added.
    """
    (pixels, values), source = points_around(view, points, settings), "sparse points"
    sparse = len(values) >= MIN_POINTS
    if not sparse:
        rows, columns = np.nonzero(_surroundings(view, settings) & view.known)
        values, source = view.disparity[rows, columns], "rendered depth"
        pixels = np.stack([columns, rows], 1) + 0.5
    model = _fit_planes(view, pixels, values, settings)
    if sparse and view.hints.swept is not None and model.explained < CONCLUSIVE_SHARE:
        rows, columns = np.nonzero(_surroundings(view, settings) & view.known & view.hints.swept)
        every = slice(None, None, max(1, len(rows) // (SWEPT_RATIO * len(values))))
        rows, columns, source = rows[every], columns[every], "sparse points and photographs compared"
        values = np.concatenate([values, view.disparity[rows, columns]])
        pixels = np.concatenate([pixels, np.stack([columns, rows], 1) + 0.5])
        model = _fit_planes(view, pixels, values, settings)
    return model, f"{model.planes} planes explain {model.explained:.0%} of {len(values)} {source}"


def _fit_planes(
    view: ViewDepth, pixels: np.ndarray, values: np.ndarray, settings: CompletionSettings
) -> planes.PlanarModel:
    generator = seeding.generator(settings.seed, "planes", view.camera.name)
    return planes.planar_model(pixels, values, view.hole.shape, generator, tolerance=settings.planar_tolerance)


def visible_points(
    points: np.ndarray, camera: Camera, pixels: np.ndarray, disparity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Image points [S, 2] and disparities [S] of the points that project to `pixels`, bool [H, W], and are visible."""
    uv, z = geometry.project(points, camera)
    on_pixels, inside = geometry.sample_nearest(pixels, uv)
    rendered, _ = geometry.sample_nearest(disparity, uv)
    visible = on_pixels & inside & (z > 0) & (z * rendered < OCCLUSION_RATIO)
    return uv[visible], 1.0 / z[visible]

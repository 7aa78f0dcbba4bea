"""Depth inside a hole: the surfaces around the hole are continued through it.

`reffusion.depth.estimates` fits the depth map of a network or of a reference instead. The *surroundings* are the pixels
in a ring around the hole. *Sparse points* are those of structure from motion. *Swept depth* is the depth that plane
sweep stereo finds around the hole.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import ndimage

from reffusion import geometry, morphology, seeding
from reffusion.depth import bilateral, planes
from reffusion.depth.completion import Plate, complete
from reffusion.depth.layers import label_surfaces, surfaces_on_planes
from reffusion.depth.solverlog import NO_LOG, SolverLog
from reffusion.types import Camera, Rendering

MIN_POINTS = 50  # with fewer sparse points around the hole, the rendered depth is used instead
CONCLUSIVE_SHARE = 0.8  # share of the sparse points explained by planes, above which no further samples are added
SWEPT_RATIO = 3  # pixels of swept depth for each sparse point that are added to the samples of planes
MAX_EXTRAPOLATION = 1.15  # a continued surface exceeds the range of its known disparities by this factor at most
MAX_REFUTED_SHARE = 0.05  # share of the hole in which intersecting planes are refuted, above which they are rejected
GAP_RING = 0.01  # of the image's width: width of the ring in which a gap touches surfaces
MIN_GAP_SHARE = 0.15  # share of this ring that a surface must have
FARTHEST_RATIO = 2.0  # depth is limited to this many times the farthest known depth


@dataclass(frozen=True)
class CompletionSettings:
    """Settings for finding the depth behind the object.

    PAPER leaves open: the depth model. Without one the surroundings are continued under one of two hypotheses:
    intersecting planes (rooms), if these explain the surroundings, else a smooth completion.

    Attributes:
        explained: Alpha above which the rendered depth counts as known.
        margin: Distance as a fraction of the image's width. The rendered depth of pixels nearer to the hole does not
            count as known, because it is blended with that of the object.
        ring: Width of the surroundings, as a fraction of the image's width.
        planar_share: Share of the surroundings that planes must explain to be used. A value above 1 excludes planes.
        planar_tolerance: Relative difference in disparity up to which planes explain a sample.
        seed: Seed of the random samples in the search for planes.
    """

    explained: float = 0.5
    margin: float = 0.01
    ring: float = 0.08
    planar_share: float = 0.8
    planar_tolerance: float = 0.01
    seed: int = 0


@dataclass(frozen=True)
class Hints:
    """Further knowledge of the depth in a view. A field is None, and `planes` is empty, if it was not computed.

    Attributes:
        plane_depth: [H, W] depth of planes that continue into the hole (`reffusion.background.continuation`), inf where
            no plane continues. Mirror images of symmetric objects count as planes.
        planes: Depth [H, W] of each of these planes at all pixels, inf where the pixel's ray does not meet the plane.
        confirmed: bool [H, W], True at pixels of the hole whose rendered depth is confirmed by other views.
        photographed_depth: [H, W] depth of the surfaces in the photograph, 0 where unknown. Where known it replaces the
            rendered depth, because it is more accurate.
        swept: bool [H, W], True at pixels of `photographed_depth` that were found by comparing photographs
            (`reffusion.initialize.sweep`).
        free_space: Function of a depth map [H, W] that returns bool [H, W], True at pixels where other views see past a
            surface of this depth.
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
    """The depth of the scene in one view, and the pixels at which it is known.

    Attributes:
        camera: The camera of the view.
        depth: [H, W] float64 camera z of the rendering, replaced where `hints` know a better depth.
        known: bool [H, W], True where `depth` is the depth of the scene: outside the hole where photographs show a
            surface, or Gaussians do beyond the margin, and inside the hole where other views confirm the rendered
            depth.
        hole: bool [H, W], True at the pixels to fill.
        hidden: bool [H, W], True at pixels that show the removed object (the consistent mask C).
        anchored: bool [H, W], True at pixels of the hole whose `depth` is that of a plane that continues there.
        hints: Further knowledge of the depth.
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
        """Return the disparity 1/depth, [H, W] float64; 0 where there is no depth."""
        return geometry.reciprocal(self.depth)

    @property
    def least_disparity(self) -> float:
        """Return the smallest disparity that is allowed: that of `FARTHEST_RATIO` times the farthest known depth.

        Raises:
            Degenerate: No depth is known.
        """
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
    """Return the depth of the scene in one view from a rendering of its Gaussians and from `hints`.

    Depth counts as known where alpha is high, except in the hole, where it is known only where `hints.confirmed` is
    True, and except in a margin around the hole, where only `hints.photographed_depth` is known.

    Args:
        rendering: The rendering of the Gaussians without the object.
        camera: The camera of the view.
        hole: bool [H, W], True at the pixels to fill.
        hidden: bool [H, W], True at pixels that show the removed object.
        settings: Gives the threshold of alpha and the width of the margin.
        hints: Further knowledge of the depth.
    """
    depth, alpha = (t.detach().double().cpu().numpy() for t in (rendering.depth, rendering.alpha))
    plane_depth, outer = hints.plane_depth, hints.photographed_depth
    if outer is not None:
        depth, alpha = np.where(outer > 0, outer, depth), np.where(outer > 0, 1.0, alpha)
    apart = ~morphology.dilate_by_distance(hole, settings.margin)
    if outer is not None:
        apart |= (outer > 0) & ~hole
    known = (alpha > settings.explained) & (depth > 0) & apart
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
    """Return the disparity of the scene, continued through the hole, and a description of the method used.

    Intersecting planes are fitted to the sparse points around the hole, or to the rendered depth if there are few
    points. (Sparse points are unbiased, while the expected depth of splats is too small wherever haze floats in front
    of a plain surface.) If the planes do not explain the surroundings, if other views see past the planes, or if the
    planes would hide a plane that is known to continue there (`Hints.plane_depth`), each surface around the hole is
    continued smoothly instead, with creases at edges of the guide.

    Args:
        view: The depth around the hole.
        guide: [H, W, 3] picture of the view without the object, uint8 or in [0, 1]; or a function that returns this
            picture and is called only if it is needed.
        points: [P, 3] sparse points of the scene; P = 0 is allowed.
        settings: Settings of the fits.
        log: Records the result of each solver.
        farthest: If True, each connected part of the hole continues only the farthest of the surfaces that it touches.
            This suits gaps through which the view looks at the background. Intersecting planes, if they are accepted,
            are not affected.

    Returns:
        disparity: [H, W] float64, at all pixels. At known pixels it is that of the fit, which may differ from the
            view's. It may be 0 or negative where a surface is continued beyond infinite depth.
        description: The method, and the share of the samples that planes explain, in words.

    Raises:
        Degenerate: There are too few known pixels around the hole.
    """
    planar, description = _fit_planar_model(view, points, settings)
    log.log_result("planes", planar.disparity)
    if planar.explained >= settings.planar_share:
        refuted = _refuted_share(view, planar.disparity)
        if refuted <= MAX_REFUTED_SHARE:
            return planar.disparity, description
        description = f"{description}, but occlude known free space in {refuted:.0%} of the hole"
    guide = guide() if callable(guide) else guide
    plate = Plate(ring=settings.ring)
    usable = view.known | view.anchored
    near = lambda fraction: morphology.dilate_by_distance(view.hole, fraction)
    surroundings, hole = usable & near(settings.ring), near(settings.margin)
    if not surroundings.any():
        raise geometry.Degenerate("few pixels", "no depth is known around the hole")
    planes = () if farthest else view.hints.planes
    label = partial(label_surfaces, view.disparity, surroundings, hole, guide, planes, view.anchored)
    surfaces = label()
    if surfaces.max() <= 1:
        share = view.anchored.sum() / max(view.hole.sum(), 1)
        onward = f", planes that continue in {share:.0%} of the hole" if share else ""
        smooth = _complete_smoothly(view, usable, guide, plate, log)
        return smooth, f"{description}: continued smoothly instead{onward}"
    if farthest:
        disparity = np.where(view.anchored, view.disparity, _complete_gaps(view, surfaces, usable, guide, plate))
        return disparity, f"{description}: the farthest of {surfaces.max()} surfaces"
    layered = _complete_layers(view, surfaces, planes, guide, plate)
    # Planes that continue have a depth of their own. Other views do see "past" a mirror that is part of a plane.
    is_farthest = surfaces == _farthest_surface(view, surfaces, usable)
    refuted_pixels = _in_free_space(view, layered) & ~view.anchored & ~is_farthest
    if refuted_pixels.any():
        layered = _complete_layers(view, label(np.where(refuted_pixels, surfaces, 0)), planes, guide, plate)
    log.log_result("completion", layered)
    return layered, f"{description}: {surfaces.max()} surfaces continued"


def _complete_smoothly(
    view: ViewDepth, usable: np.ndarray, guide: np.ndarray, plate: Plate, log: SolverLog
) -> np.ndarray:
    """Return disparity [H, W] that continues the pixels `usable`, bool [H, W], as one smooth surface."""
    smooth = complete(view.disparity, usable, guide, plate, keep=False)
    log.log_result("completion", smooth)
    # The bilateral solver spreads the residuals of known pixels into the hole, so that its border shows no step.
    confidence = usable.astype(np.float64)
    refined = bilateral.refine(smooth, view.disparity, confidence, guide, watch=log.log_iteration)
    log.log_result("bilateral", refined, log.iterations)
    return np.where(view.anchored, view.disparity, refined)


def _farthest_surface(view: ViewDepth, surfaces: np.ndarray, usable: np.ndarray) -> int:
    """Return the label of the surface with the smallest median disparity at the pixels `usable`, bool [H, W]."""
    # At anchored pixels a plane is only assumed to continue.
    median_disparity = lambda surface: float(np.median(view.disparity[usable & ~view.anchored & (surfaces == surface)]))
    present = [k for k in range(1, surfaces.max() + 1) if (usable & ~view.anchored & (surfaces == k)).any()]
    return min(present, key=median_disparity)


def _complete_gaps(
    view: ViewDepth, surfaces: np.ndarray, usable: np.ndarray, guide: np.ndarray, plate: Plate
) -> np.ndarray:
    """Return disparity [H, W] in which each gap of the hole continues the farthest of the surfaces that it touches."""
    result, continued = view.disparity.copy(), {}
    gaps, count = ndimage.label(view.hole, np.ones((3, 3)))
    nearest_gap = gaps[morphology.nearest_known(view.hole)]
    for gap in range(1, count + 1):
        # `usable` pixels have a known or an anchored disparity.
        border = usable & ~view.anchored & (surfaces > 0) & morphology.dilate(gaps == gap, GAP_RING)
        sizes = np.bincount(surfaces[border], minlength=surfaces.max() + 1)
        # A gap that touches no surface continues the farthest of all.
        touching = np.flatnonzero(sizes >= MIN_GAP_SHARE * border.sum())
        chosen = _farthest_surface(view, np.where(np.isin(surfaces, touching), surfaces, 0), usable)
        if chosen not in continued:
            continued[chosen] = complete(view.disparity, usable & (surfaces == chosen), guide, plate)
        result[nearest_gap == gap] = continued[chosen][nearest_gap == gap]
    return result


def _complete_layers(
    view: ViewDepth, surfaces: np.ndarray, planes: Sequence[np.ndarray], guide: np.ndarray, plate: Plate
) -> np.ndarray:
    """Return disparity [H, W] in which each surface is continued smoothly by itself, with a step between surfaces."""
    # The graph cut may give a surface pixels at which a plane was assumed to continue.
    reassigned = view.anchored & (surfaces_on_planes(view.disparity, view.anchored, surfaces, planes) != surfaces)
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
    # At these reassigned pixels the surface lies in front of the plane: its disparity is at least that of the plane.
    result = np.where(reassigned, np.maximum(result, view.disparity), result)
    rest = ~usable & (result <= 0)
    return np.where(rest, complete(result, result > 0, guide, plate), result) if rest.any() else result


def _refuted_share(view: ViewDepth, disparity: np.ndarray) -> float:
    """Return the share of the hole, in [0, 1], in which other knowledge contradicts a surface of disparity [H, W]."""
    # The surface would hide a plane that continues there, or other views see past the surface. For example, the planes
    # of a post and of the ground behind the post intersect in front of ground that other views see, so these planes are
    # rejected.
    hides_plane = view.anchored & (disparity > view.disparity * (1 + geometry.OTHER_SURFACE))
    refuted = hides_plane | _in_free_space(view, disparity)
    return float(refuted[view.hole].mean()) if view.hole.any() else 0.0


def _in_free_space(view: ViewDepth, disparity: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the pixels of the hole in which other views see past a surface of this disparity, [H, W]."""
    if view.hints.free_space is None:
        return np.zeros_like(view.hole)
    return view.hole & view.hints.free_space(1 / np.maximum(disparity, view.least_disparity))


def points_around(view: ViewDepth, points: np.ndarray, settings: CompletionSettings) -> tuple[np.ndarray, np.ndarray]:
    """Return the sparse points that are visible around the hole: image points [S, 2] in pixels, and disparities [S].

    The points lie in a ring (`settings.ring`) around the pixels of the hole and of the removed object.
    """
    return visible_points(points, view.camera, _surroundings(view, settings), view.disparity)


def _surroundings(view: ViewDepth, settings: CompletionSettings) -> np.ndarray:
    """Return bool [H, W], the ring (`settings.ring`) around the pixels of the hole and of the removed object."""
    excluded = view.hidden | view.hole
    return morphology.dilate_by_distance(excluded, settings.ring) & ~excluded


def _fit_planar_model(
    view: ViewDepth, points: np.ndarray, settings: CompletionSettings
) -> tuple[planes.PlanarModel, str]:
    """Fit planes to the surroundings of the hole, and describe how many planes explain which share of the samples."""
    (pixels, values), source = points_around(view, points, settings), "sparse points"
    sparse = len(values) >= MIN_POINTS
    if not sparse:
        rows, columns = np.nonzero(_surroundings(view, settings) & view.known)
        values, source = view.disparity[rows, columns], "rendered depth"
        pixels = np.stack([columns, rows], 1) + 0.5
    model = _fit_planes(view, pixels, values, settings)
    # If planes explain less than `CONCLUSIVE_SHARE` of the sparse points, the noise of these points would decide
    # whether the planes are accepted. Pixels of swept depth are then added to the samples.
    if sparse and view.hints.swept is not None and model.explained < CONCLUSIVE_SHARE:
        rows, columns = np.nonzero(_surroundings(view, settings) & view.known & view.hints.swept)
        every = slice(None, None, max(1, len(rows) // (SWEPT_RATIO * len(values))))
        rows, columns, source = rows[every], columns[every], "sparse points and photographs compared"
        values = np.concatenate([values, view.disparity[rows, columns]])
        pixels = np.concatenate([pixels, np.stack([columns, rows], 1) + 0.5])
        model = _fit_planes(view, pixels, values, settings)
    planes = "1 plane explains" if model.planes == 1 else f"{model.planes} planes explain"
    return model, f"{planes} {model.explained:.0%} of {len(values)} {source}"


def _fit_planes(
    view: ViewDepth, pixels: np.ndarray, values: np.ndarray, settings: CompletionSettings
) -> planes.PlanarModel:
    """Return planes fitted to samples: image points [S, 2] in pixels, and their disparities [S]."""
    generator = seeding.generator(settings.seed, "planes", view.camera.name)
    return planes.planar_model(pixels, values, view.hole.shape, generator, tolerance=settings.planar_tolerance)


def visible_points(
    points: np.ndarray, camera: Camera, pixels: np.ndarray, disparity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points that project to `pixels` and are visible there: image points [S, 2] and disparities [S].

    Args:
        points: [P, 3] points in the world.
        camera: The camera of the view.
        pixels: bool [H, W].
        disparity: [H, W] of the view. A point that is clearly farther is hidden. Where the disparity is 0 (unknown), no
            point in front of the camera is hidden.
    """
    uv, z = geometry.project(points, camera)
    on_pixels, inside = geometry.sample_nearest(pixels, uv)
    rendered, _ = geometry.sample_nearest(disparity, uv)
    visible = on_pixels & inside & (z > 0) & (z * rendered < 1 + geometry.OTHER_SURFACE)
    return uv[visible], 1.0 / z[visible]

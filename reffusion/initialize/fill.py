"""Filling of the hole from references: each reference is unprojected onto estimated depth, the best one first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from reffusion.background.model import Background
from reffusion.background.unobserved import find_unobserved
from reffusion.background.visibility import OPAQUE
from reffusion.depth import billboard, monocular
from reffusion.depth.background_depth import NO_HINTS, CompletionSettings, Hints
from reffusion.depth.discontinuities import beside_steps, sharpen_steps
from reffusion.depth.monocular import DepthNetwork
from reffusion.initialize import coverage, unprojection
from reffusion.initialize.draft import EXTRA_VIEW, REFERENCE, Draft
from reffusion.initialize.sharing import Share, share_surfaces
from reffusion.initialize.sweep import refine_background
from reffusion.morphology import dilate_by_distance
from reffusion.params.initialize import Params
from reffusion.splat import rasterizer
from reffusion.trace import Trace
from reffusion.types import Camera, Reference, Rendering

STEPS_MARGIN = 0.006  # of the image's width: how far beyond the hole ramps of the depth are sharpened to steps
GAP_ALPHA = 0.5  # the new surface has a gap where another view renders a lower alpha in its C
COMPLETION = CompletionSettings()


@dataclass(frozen=True)
class ReferenceFill:
    """The result of adding one reference to a draft.

    Attributes:
        draft: the draft (the scene that is being filled) with the reference's Gaussians.
        depth: [H, W] float64, camera z of the surface onto which the reference was unprojected.
    """

    draft: Draft
    depth: np.ndarray


def fill_references(
    params: Params,
    draft: Draft,
    references: Sequence[Reference],
    first: str,
    background: Background,
    network: DepthNetwork | None,
    log: Trace,
) -> tuple[Draft, dict[str, np.ndarray]]:
    """Add all references to the draft, one after the other; each fills only what the earlier ones left empty.

    Args:
        params: parameters of the stage `initialize`.
        draft: the scene without the object.
        references: completed views; those with an empty mask are left out.
        first: name of the view that is added first. The other views follow by decreasing size of their masks.
        background: the photographs and surfaces around the object.
        network: the depth model; None to continue the depth of the surroundings into the hole instead.
        log: receives the traces of the depth solvers.

    Returns:
        The filled draft, and view name -> [H, W], the camera z at which the reference was added.

    Raises:
        ValueError: as `unprojection.estimate_depth`.
    """
    ordered = [each for each in references if each.mask.any()]
    ordered.sort(key=lambda each: (each.camera.name != first, -int(each.mask.sum())))
    shares = share_surfaces(draft.gaussians, ordered, background, COMPLETION) if params.tidy else {}
    depths = {}
    for each in ordered:
        disparity = _predict_disparity(network, each)
        share = shares.get(each.camera.name)
        filled = fill_reference(params, draft, each, background, disparity=disparity, log=log, share=share)
        draft, depths[each.camera.name] = filled.draft, filled.depth
    return draft, depths


def fill_reference(
    params: Params,
    draft: Draft,
    reference: Reference,
    background: Background,
    *,
    disparity: np.ndarray | None = None,
    log: Trace | None = None,
    farthest: bool = False,
    share: Share | None = None,
) -> ReferenceFill:
    """Return the draft with one reference added, on the pixels of its mask that earlier references did not fill.

    Pixels of C (the object's mask) at which the draft is not opaque, or beside which another view would show a gap, are
    added too. Inside C the reference shows the background, whose depth is estimated. Outside C it may draw an inserted
    object over the remaining scene. A line that says how the depth was found is printed.

    Args:
        params: parameters of the stage `initialize`.
        draft: the scene that is being filled.
        reference: the completed view.
        background: the photographs and surfaces around the object.
        disparity: [H, W], the depth model's output for the reference, up to scale and offset; None without a model.
        log: receives the traces of the depth solvers.
        farthest: True for an extra view (`extra_views`). Through the gap that it fills one sees the farthest of the
            surfaces around the gap, so only this surface is continued into the gap.
        share: the pixels outside C that this reference adds, and those that it leaves to other references. None if
            inserted surfaces are not divided among references (`sharing.share_surfaces`).

    Raises:
        ValueError: as `unprojection.estimate_depth`.
    """
    camera, mask = reference.camera, background.masks[reference.camera.name]
    hole = unprojection.find_hole(draft, reference, mask, OPAQUE)
    if farthest and background.mirrors:
        hole |= reference.mask  # also where the visible surface lies behind a mirror image
    surface = estimate_surface(params, draft, reference, background, hole, disparity, log, farthest)
    nothing = np.zeros_like(hole)
    inserted, drawn_over, ceded = nothing, nothing, share.ceded if share else nothing
    if inserts := bool((reference.mask & ~mask).any()):
        is_estimated = reference.depth is not None or disparity is not None
        surface, inserted, drawn_over = insert_object(surface, draft, reference, mask, hole, share, is_estimated)
    print(f"depth of reference {camera.name}: {surface.words}")
    filled = hole & ~inserted & ~ceded
    pixels = filled | drawn_over
    if params.overlap:  # at a step no seam has to be closed: the surface beyond it is another one
        pixels |= dilate_by_distance(filled, params.overlap) & ~ceded & ~beside_steps(surface.depth)
    # New Gaussians change color with direction as their surroundings do. An inserted object does not: it has a shine
    # of its own. An extra view is too narrow to show how colors change.
    view_dependent = params.view_dependent_color and not farthest and not inserts
    origin = EXTRA_VIEW if farthest else REFERENCE
    draft = unprojection.add_surface(draft, reference, surface.depth, pixels, background, view_dependent, origin)
    if farthest or not params.tidy:  # gaps that are still open are left to the extra views, if there are any
        return ReferenceFill(draft, surface.depth)
    views = [(each, background.masks[each.name]) for each in background.cameras]
    gaps = unprojection.find_gaps(draft.gaussians, camera, surface.estimate, mask & ~pixels, views, GAP_ALPHA)
    if gaps.any():
        draft = unprojection.add_surface(draft, reference, surface.estimate, gaps, background, view_dependent)
    return ReferenceFill(draft, surface.depth)


@dataclass(frozen=True)
class Surface:
    """The surface onto which a reference is unprojected.

    Attributes:
        depth: [H, W] float64, camera z: known where the scene shows a surface, estimated in the hole.
        estimate: [H, W] float64, the estimated depth, also where a surface is known.
        words: how the depth was found.
    """

    depth: np.ndarray
    estimate: np.ndarray
    words: str


def estimate_surface(
    params: Params,
    draft: Draft,
    reference: Reference,
    background: Background,
    hole: np.ndarray,
    disparity: np.ndarray | None,
    log: Trace | None,
    farthest: bool,
) -> Surface:
    """Estimate the depth of a reference in its hole, bool [H, W]; the other arguments are those of `fill_reference`."""
    camera, mask = reference.camera, background.masks[reference.camera.name]
    # The plane sweep cannot measure depth at the rim of a gap as narrow as this.
    sweep = params.depth.sweep and not (farthest and coverage.is_narrow(hole))
    near, swept = refine_background(background, camera, hole) if sweep else (background, None)
    rendering = rasterizer.render(draft.remaining, camera, sh_degree=0)
    hints = _gather_hints(rendering, camera, near, swept, params.depth.sweep) if params.depth.hints else NO_HINTS
    # The gap of an extra view lies among new surfaces too; a reference must not continue what an earlier one invented.
    surroundings = rasterizer.render(draft.gaussians, camera, sh_degree=0) if farthest else rendering
    depth, estimate, words = unprojection.estimate_depth(
        surroundings, reference, hole, mask, background.points, COMPLETION, disparity, log, hints, farthest
    )
    if params.depth.hints and reference.depth is None:  # a depth map that the scene provides has no ramps
        near_hole = dilate_by_distance(hole | mask | reference.mask, STEPS_MARGIN)
        depth, estimate = (sharpen_steps(each, reference.image, near_hole) for each in (depth, estimate))
    return Surface(depth, estimate, words)


def insert_object(
    surface: Surface,
    draft: Draft,
    reference: Reference,
    mask: np.ndarray,
    hole: np.ndarray,
    share: Share | None,
    is_estimated: bool,
) -> tuple[Surface, np.ndarray, np.ndarray]:
    """Extend a reference's surface by the object that the reference draws over the remaining scene.

    With a depth map or a depth model, pixels whose estimate lies in front of the scene show the object. Without both
    the object is a billboard that stands where it meets the scene.

    Args:
        surface: the reference's surface in the hole.
        draft: the scene that is being filled.
        reference: the completed view.
        mask: bool [H, W], C of the view.
        hole: bool [H, W], the pixels to fill.
        share: as for `fill_reference`.
        is_estimated: whether a depth map or a depth model estimated the surface.

    Returns:
        The surface with the object; bool [H, W], the object's pixels; and those of them that are added now, which are
        not beside an edge of the depth.
    """
    visible = rasterizer.render(draft.remaining, reference.camera, sh_degree=0).depth.double().cpu().numpy()
    depth, estimate, words = surface.depth, surface.estimate, surface.words
    behind, inserted = np.where(visible > 0, visible, depth), hole & reference.mask & ~mask
    if not is_estimated:
        upright = billboard.billboard_depth(inserted, behind, reference.camera)
        depth, estimate = (np.where(inserted, upright, each) for each in (depth, estimate))
        words += f"; a billboard, good within {billboard.MAX_ANGLE_DEG} degrees, stands where the scene goes on"
    else:
        in_front = coverage.pixels_in_front(draft.gaussians, estimate, reference, mask)
        back = share.drawn if share else in_front & ~hole
        ceded = share.ceded if share else np.zeros_like(hole)
        inserted, depth = inserted & ~ceded | back, np.where(back, estimate, depth)
    drawn_over = inserted & ~coverage.beside_depth_edges(depth, behind)
    return Surface(depth, estimate, words), inserted, drawn_over


def _gather_hints(
    rendering: Rendering, camera: Camera, background: Background, swept: np.ndarray | None, use_free_space: bool
) -> Hints:
    """Return what planes, mirror images and other views tell about the depth in the hole of a view."""
    uncovered = find_unobserved(
        rendering, camera, background.masks[camera.name], background.views, background.planes, background.mirrors
    )
    # `rendering` shows neither removed nor new Gaussians. `swept`, bool [H, W] or None, marks depth found by a plane
    # sweep. With `use_free_space`, continued surfaces that other views see past are rejected.
    return Hints(
        plane_depth=uncovered.continued_depth,
        planes=uncovered.plane_depths,
        confirmed=uncovered.confirmed,
        photographed_depth=background.photographed_depth(camera),
        swept=swept,
        free_space=(lambda depth: background.is_empty(camera, depth)) if use_free_space else None,
    )


def _predict_disparity(network: DepthNetwork | None, reference: Reference) -> np.ndarray | None:
    """Return the depth model's disparity [H, W] of the reference, up to scale and offset; None without a model."""
    if network is None:
        return None
    image = torch.from_numpy(reference.image).permute(2, 0, 1) / 255
    return monocular.predict_disparity(network, image).numpy()

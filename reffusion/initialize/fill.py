"""Fill the hole from references: each is unprojected onto its depth, the best one first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from reffusion.background.model import Background
from reffusion.background.unobserved import find_unobserved
from reffusion.depth import billboard, monocular
from reffusion.depth.background_depth import CompletionSettings, Hints
from reffusion.depth.monocular import DepthNetwork
from reffusion.gaussians.sheets import Sheets
from reffusion.initialize import coverage, unprojection
from reffusion.initialize.draft import Draft
from reffusion.initialize.sharing import Share, share_surfaces
from reffusion.initialize.sweep import refine_background
from reffusion.morphology import dilate_by_distance
from reffusion.params.initialize import Params
from reffusion.splat import rasterizer
from reffusion.trace import Trace
from reffusion.types import Reference

OVERLAP = 0.006  # of the image's width: how far new Gaussians extend beyond the hole
COVERED = 0.9  # alpha below which a reference also fills pixels of C
GAP_ALPHA = 0.5  # alpha in C of another view below which the new surface has a gap
COMPLETION = CompletionSettings()


@dataclass(frozen=True)
class Filled:
    """A draft after a reference was added, and the depth at which it was added, [H, W] float64."""

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
    """The draft with all references that have a mask; and view name -> the depth [H, W] at which each was added.

    Args:
        first: the view that is drawn first; the others follow by size.
        network: the depth model; None where the surroundings are continued instead.
        log: receives the traces of the depth solvers.
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
) -> Filled:
    """The draft with one reference, on the pixels of its mask, or of its share, that are still empty.

    Args:
        disparity: [H, W], a depth model's answer to the reference, up to scale and offset; None without a model.
        farthest: the reference is an extra view, that fills a gap through which one sees the farthest surface.
        share: what the reference draws over what remains, where several have depth maps.
    """
    camera, mask = reference.camera, background.masks[reference.camera.name]
    over = reference.mask & ~mask  # an inserted part, drawn over what remains
    # An inserted part has a shine of its own, and so narrow an extra view tells nothing of it.
    sheets = Sheets(view_dependent=params.view_dependent_color and not farthest and not over.any())
    hole = unprojection.find_hole(draft, reference, mask, COVERED)
    if farthest and background.mirrors:
        hole |= reference.mask  # also where something is visible, but behind a mirror image
    remaining = draft.remaining
    # A gap that is still open after the references is too narrow for the sweep to tell of its rim.
    sweep = params.depth.sweep and not (farthest and coverage.is_narrow(hole))
    near, swept = refine_background(background, camera, hole) if sweep else (background, None)
    uncovered = find_unobserved(remaining, camera, mask, near.views, near.planes, near.mirrors)
    hints = Hints(
        plane_depth=uncovered.continued_depth,
        planes=uncovered.plane_depths,
        confirmed=uncovered.confirmed,
        photographed_depth=near.photographed_depth(camera),
        swept=swept,
        free_space=(lambda depth: near.is_empty(camera, depth)) if params.depth.sweep else None,
    )
    depth, estimate, words = unprojection.estimate_depth(
        remaining, reference, hole, mask, background.points, COMPLETION, disparity, log, hints, farthest
    )
    inserted = drawn_over = np.zeros_like(hole)
    ceded = share.ceded if share else inserted
    if over.any():
        visible = rasterizer.render(remaining, camera, sh_degree=0).depth.double().cpu().numpy()
        behind, inserted = np.where(visible > 0, visible, depth), hole & over
        if reference.depth is None and disparity is None:
            upright = billboard.billboard_depth(inserted, behind, camera)
            depth, estimate = (np.where(inserted, upright, each) for each in (depth, estimate))
            words += f"; a billboard, good within {billboard.MAX_ANGLE_DEG} degrees, stands where the scene goes on"
        else:
            back = (
                share.drawn if share else coverage.pixels_in_front(draft.gaussians, estimate, reference, mask) & ~hole
            )
            inserted, depth = inserted & ~ceded | back, np.where(back, estimate, depth)
        drawn_over = inserted & ~coverage.beside_depth_edges(depth, behind)
    print(f"depth of reference {camera.name}: {words}")
    pixels = dilate_by_distance(hole & ~inserted & ~ceded, OVERLAP) & ~ceded | drawn_over
    draft = unprojection.add_surface(draft, reference, depth, pixels, background, sheets)
    if farthest or not params.tidy:  # what is still open is completed view by view, or left
        return Filled(draft, depth)
    views = [(each, background.masks[each.name]) for each in background.cameras]
    gaps = unprojection.find_gaps(draft.gaussians, camera, estimate, mask & ~pixels, views, GAP_ALPHA)
    if gaps.any():
        draft = unprojection.add_surface(draft, reference, estimate, gaps, background, sheets)
    return Filled(draft, depth)


def _predict_disparity(network: DepthNetwork | None, reference: Reference) -> np.ndarray | None:
    """The depth model's answer to the reference, [H, W] disparity up to scale and offset; None without a model."""
    if network is None:
        return None
    image = torch.from_numpy(reference.image).permute(2, 0, 1) / 255
    return monocular.predict_disparity(network, image).numpy()

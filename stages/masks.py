"""masks: votes label the object's Gaussians; rendered back they give every view's consistent, never-seen and
invent mask."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class Params(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    vote: Literal["weight", "count"] = Field(
        "weight", description="what a contribution counts: its blending weight, or 1 (the paper's word is 'count')"
    )
    tau: float = Field(1.0, gt=0, description="masked from this ratio of masked to unmasked contributions (paper: 1)")
    tau_rendered: float = Field(0.3, gt=0, lt=1, description="C is where the rendered label exceeds it (paper: 0.3)")
    observed: float = Field(
        1.0, gt=0, description="unmasked blending weight, summed over pixels and views, of a fully observed Gaussian"
    )
    buried: float = Field(
        0.1, ge=0, description="blending weight in all views up to which a Gaussian votes by where it stands"
    )
    hull: float = Field(
        0.9, ge=0, le=1, description="masked too: centres inside C in more than this share of the views; 1 = none"
    )
    explained: float = Field(0.5, gt=0, lt=1, description="blended observation from which a pixel is explained")
    witnesses: int = Field(1, ge=0, description="training views that must show a pixel's background; 0 = not asked")
    tolerance: float = Field(0.02, gt=0, description="relative depth by which a visible point may lie too far")
    speck: float = Field(0.01, ge=0, description="islands of a mask below this diameter go, / image width")
    gap: float = Field(0.02, ge=0, description="holes in a mask below this diameter close, / image width")
    # PAPER leaves open: it always invents. So few pixels are rims of masks and crannies, not worth a diffusion model.
    negligible: float = Field(0.005, ge=0, lt=1, description="share of C up to which never-seen pixels are left alone")
    invent: Literal["auto", "never_seen", "consistent", "region"] = Field(
        "auto", description="what is made up; auto = the scene's 3D region where it names one, else never-seen pixels"
    )


def run(params: Params, out: Path, *, poses: Path, fit: Path) -> None:
    from dataclasses import replace

    import numpy as np
    import torch

    from reffusion import io, masks, trace
    from reffusion.types import MaskSet

    scene, gaussians = io.load_scene(poses), io.load_ply(fit / "gaussians.ply")
    train = [scene.cameras[name] for name in scene.train]
    region = io.load_json(poses / "region.json") if (poses / "region.json").exists() else None
    raw = io.load_raw_masks(poses, scene.train)
    empty = {name: np.zeros((camera.height, camera.width), bool) for name, camera in scene.cameras.items()}
    ballots = raw | {name: empty[name] for name in scene.clean}
    if params.invent == "region" and region is None:
        raise ValueError(f"masks.invent is 'region', but {poses / 'region.json'} is missing: set region in scene.yaml")

    # Observation outside the masks is measured by weight, whatever the votes count.
    seen = masks.cast_votes(gaussians, train, ballots or empty, mode="weight")
    if raw:
        votes = seen if params.vote == "weight" else masks.cast_votes(gaussians, train, ballots, mode=params.vote)
        labels = masks.label_gaussians(votes, params.tau)
        # What hardly any view sees (buried in the object, or in the wall behind it) votes by where it stands.
        unseen = seen.masked + seen.unmasked <= params.buried
        labels |= unseen & masks.hidden_inside(gaussians, train, ballots)
    elif region is not None:
        labels = masks.inside_box(gaussians, region["center"], region["size"])
    else:
        raise ValueError(f"{poses}: neither masks nor a region say what is to be changed: add masks, or a region")

    clean = lambda mask: masks.tidy(mask, params.speck * mask.shape[1], params.gap * mask.shape[1])
    consistent, shown = {}, {}
    for name, camera in scene.cameras.items():
        share, shown[name] = masks.label_view(gaussians, labels, camera)
        consistent[name] = clean(share > params.tau_rendered)
    # What stands where (almost) every view sees the object can only be the object, whatever it was painted with.
    labels |= masks.hidden_inside(
        gaussians, train, {n: consistent[n] for n in scene.train if n not in scene.clean}, share=params.hull
    )
    hidden = consistent | {name: empty[name] for name in scene.clean}
    remaining, observed = gaussians.map(lambda p: p[~labels]), masks.evidence(seen, params.observed)[~labels]

    sets, names = {}, list(scene.cameras)
    fill_region = params.invent == "region" or (params.invent == "auto" and region is not None)
    for k in trace.progress(len(names), "masks"):
        name, camera = names[k], scene.cameras[names[k]]
        disparity, explained = masks.remaining_view(remaining, observed, camera)
        asked = consistent[name] & (explained > params.explained)
        seen_by = masks.seen_elsewhere(disparity, asked, camera, train, hidden, shown, tolerance=params.tolerance)
        unseen = consistent[name] & ~(asked & (seen_by >= params.witnesses))
        unseen = clean(unseen) & hidden[name]
        invent = hidden[name] if params.invent == "consistent" else unseen
        if fill_region:
            invent = masks.box_silhouette(**region, camera=camera, disparity=disparity)
        sets[name] = MaskSet(raw.get(name, empty[name]), consistent[name], unseen, invent)

    count = lambda kind, chosen: int(sum(np.count_nonzero(getattr(sets[name], kind)) for name in chosen))
    unseen_share = count("never_seen", scene.train) / max(count("consistent", scene.train), 1)
    if params.invent != "consistent" and not fill_region and unseen_share <= params.negligible:
        sets = {name: replace(each, invent=empty[name]) for name, each in sets.items()}
    io.save_labels(out / "labels.npy", labels.cpu())
    io.save_mask_sets(out, sets)
    invents = {name: each.invent for name, each in sets.items()}
    facts = {
        "masked_gaussians": int(torch.count_nonzero(labels)),
        "gaussians": len(gaussians),
        "voting_views": len(ballots),
        "invent_pixels": count("invent", scene.train),
        "consistent_pixels": count("consistent", scene.train),
        "never_seen_share": unseen_share,
        "invent_views": [name for name in scene.train if invents[name].any()],
        "best_reference": masks.best_view(invents, scene.train),
    }
    io.save_json(out / "facts.json", facts)

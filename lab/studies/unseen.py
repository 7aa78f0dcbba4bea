"""What a prior can add where neither a photograph nor a reference looks: `python -m lab.studies.unseen RUN ...`.

An *unseen* pixel of a test view lies in the object's mask and shows a surface that no photograph and no given
reference shows. The stage `initialize` fills such pixels by patches. The study paints them by a prior instead, in each
test view by itself. The rest of the view is the initialization. That is more than distillation can do with the same
prior, because the pictures need not agree with each other.

The prior is used as it is ("base"), personalized to the references ("reference"), and personalized to the references
and the scene's photographs, in which the initialization replaces the object ("photographs"). Each paints in the `WAYS`.
Scored is LPIPS (VGG and AlexNet): the mean of its map over the unseen pixels, against the ground truth. The study
prints a table, and writes unseen.json and rows of pictures (unseen pixels in gray, patches, all paintings, truth).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lab.studies.prior import keep_if_same, profile_params
from lab.studies.scene_priors import run_study
from reffusion import geometry, seeding
from reffusion.io.arrays import load_json, save_json
from reffusion.io.ground_truth import load_ground_truth, load_object_mask
from reffusion.io.images import save_image
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_references
from reffusion.metrics import lpips
from reffusion.params.base import Prompts
from reffusion.params.personalize import Params
from reffusion.prior import crops, diffusion, inpaint, lora
from reffusion.prior.model import Prior, load_prior
from reffusion.prior.personalize import personalize
from reffusion.splat import rasterizer
from reffusion.types import Camera
from reffusion.workspace import Workspace
from report.sheet import pick_evenly

WAYS = {  # name -> noise level from which the whole view is painted, and the finer sizes
    "whole view": {"start": 1.0, "finest": 0.35, "levels": 0},
    "all sizes": {"start": 1.0, "finest": 0.35, "levels": 9},
    "on top of patches": {"start": 0.35, "finest": 0.35, "levels": 9},
}
TRAININGS = ("base", "reference", "photographs")
SAMPLER_STEPS = 12
PHOTOGRAPHS = 12  # of the scene, at most, that a prior is personalized to
MIN_SHARE = 0.02  # a test view counts if more than this share of its mask is unseen
MATCH = 0.02  # relative difference of depth up to which a view shows a point


class UnseenView(NamedTuple):
    """A test view with unseen pixels.

    Attributes:
        name: of the view.
        start: uint8 [H, W, 3], the initialization, in which patches fill the unseen pixels.
        truth: uint8 [H, W, 3].
        unseen: bool [H, W].
    """

    name: str
    start: np.ndarray
    truth: np.ndarray
    unseen: np.ndarray


@torch.no_grad()
def find_unseen_views(run: Path, count: int) -> list[UnseenView]:
    """Find up to `count` evenly spread test views of a finished run that have ground truth and unseen pixels."""
    space = Workspace(run / "poses", run / "fit", run / "masks")
    scene, sets = space.scene, space.mask_sets
    gaussians = load_ply(run / "initialize/gaussians.ply")
    given = load_json(run / "reference" / "facts.json")["given"]
    references = {
        each.camera.name: each.mask for each in load_references(run / "reference", scene) if each.camera.name in given
    }

    depth_maps = []
    for name in scene.train:
        hidden = sets[name].consistent & (name not in scene.clean)
        if name in references:
            hidden = hidden & ~references[name]
        depth = rasterizer.render(gaussians, scene.cameras[name]).depth.double().cpu().numpy()
        depth_maps.append((scene.cameras[name], np.where(hidden, 0.0, depth)))
    views = []
    for name in scene.test:
        camera = scene.cameras[name]
        truth = load_ground_truth(camera, run / "poses")
        mask = load_object_mask(camera, run / "raw_masks", run / "masks")
        if truth is None or not mask.any():
            continue
        rendering = rasterizer.render(gaussians, camera)
        points = geometry.unproject(rendering.depth.double().cpu().numpy(), camera)[mask]
        unseen = mask.copy()
        unseen[mask] = ~np.any([_is_seen(points, *view) for view in depth_maps], axis=0)
        unseen = cv2.morphologyEx(unseen.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3))).astype(bool)
        if unseen.sum() > MIN_SHARE * mask.sum():
            start = (255 * rendering.color.clamp(0, 1)).round().byte().cpu().numpy()
            views.append(UnseenView(name, start, truth, unseen))
    return pick_evenly(views, count)


def _is_seen(points: np.ndarray, camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Return bool [P], points on a view's surface; `depth` [H, W] is 0 where no photograph or reference shows it."""
    uv, z = geometry.project(points, camera)
    shown, inside = geometry.sample_nearest(depth, uv)
    return inside & (z > 0) & (np.abs(shown - z) < MATCH * z)


def adapt_prior(run: Path, params: Params, with_photographs: bool, folder: Path) -> Prior:
    """Return the prior personalized to a run's references, and perhaps to its photographs without the object."""
    keep_if_same(folder, params)
    prior = load_prior(params.prior)
    if not (folder / lora.LORA_FILE).exists():
        trained = lora.attach(prior, **params.lora.model_dump(), seed=params.seed)
        personalize(prior, trained, _collect_pictures(run, prior.native_size, with_photographs), params, folder)
        lora.save(prior, folder)
        prior = load_prior(params.prior)
    return lora.merge(prior, folder)


def _collect_pictures(run: Path, size: int, with_photographs: bool) -> list[crops.Picture]:
    space = Workspace(run / "poses", run / "fit", run / "masks")
    references = load_references(run / "reference", space.scene)
    pictures = [(each.image, each.mask) for each in references]
    if with_photographs:
        gaussians = load_ply(run / "initialize/gaussians.ply")
        names = space.scene.train[:: -(-len(space.scene.train) // PHOTOGRAPHS)]
        for name in names:
            mask = space.mask_sets[name].consistent
            photo = space.background.photos[name]
            picture = inpaint.composite_background(gaussians, space.scene.cameras[name], photo, mask)
            pictures.append((picture, np.zeros_like(mask)))
    return [crops.make_picture(torch.from_numpy(image), torch.from_numpy(mask), size) for image, mask in pictures]


@torch.no_grad()
def paint(prior: Prior, view: UnseenView, way: str, prompts: tuple[str, ...], seed: int) -> np.ndarray:
    """Return the view with its unseen pixels painted by the prior, uint8 [H, W, 3]."""
    painting = inpaint.repaint(
        prior,
        inpaint.to_input(view.start),
        torch.from_numpy(view.unseen),
        diffusion.embed_text(prior, list(prompts)),
        seeding.generator(seed, "unseen", view.name),
        steps=SAMPLER_STEPS,
        guidance=0.0,
        **WAYS[way],
    )
    return inpaint.to_picture(painting)


def distance_map(network: lpips.Lpips, images: Tensor, targets: Tensor) -> Tensor:
    """Return the contribution of each pixel to the LPIPS distance, [B, H, W], whose mean is about the distance.

    The map of each layer is enlarged to the images' size.

    Args:
        network: the metric.
        images, targets: [B, 3, H, W] in [-1, 1].
    """
    maps = zip(network.activations(images), network.activations(targets), network.linear, strict=True)
    layers = [((a - b).square() * w.float().view(1, -1, 1, 1)).sum(1, keepdim=True) for a, b, w in maps]
    return sum(F.interpolate(each, images.shape[2:], mode="bilinear", align_corners=False) for each in layers)[:, 0]


def make_scorer() -> Callable[[np.ndarray, UnseenView], dict[str, float]]:
    """Return a function that scores a picture of a view: network -> mean of LPIPS's map over the unseen pixels.

    Raises:
        ValueError: the weights of a network have not been fetched.
    """
    networks = {}
    for net in ("vgg", "alex"):
        network, _ = lpips.load(net)
        if network is None:
            raise ValueError("LPIPS has no weights here; run `make weights` first")
        networks[net] = network
    tensor = lambda image: torch.from_numpy(image).permute(2, 0, 1)[None].float() / 127.5 - 1

    @torch.no_grad()
    def score(picture: np.ndarray, view: UnseenView) -> dict[str, float]:
        pair = tensor(picture), tensor(view.truth)
        return {net: float(distance_map(each, *pair)[0][view.unseen].mean()) for net, each in networks.items()}

    return score


def study_run(
    run: Path, prior: str, seeds: list[int], out: Path, trainings: list[str], ways: list[str], count: int
) -> dict:
    """Score the paintings of at most `count` views of a run by some `TRAININGS` in some `WAYS`.

    Returns:
        "views": number of views; "share": mean unseen share of a view; "scores": method -> seed -> network -> mean over
        the views. The method "patches" has one seed.
    """
    views = find_unseen_views(run, count)
    if not views:
        return {"views": 0}
    score = make_scorer()
    mean = lambda rows: {net: float(np.mean([row[net] for row in rows])) for net in rows[0]}
    scores = {"patches": {"0": mean([score(view.start, view) for view in views])}}
    rows = {view.name: [np.where(view.unseen[..., None], 128, view.start), view.start] for view in views}
    for seed in seeds:
        params = profile_params(prior, {"seed": seed})
        for training in trainings:
            folder = out / "personalize" / f"{training}-{seed}"
            model = load_prior(prior)
            if training != "base":
                model = adapt_prior(run, params, training == "photographs", folder)
            prompts = ("", "", "") if training == "base" else Prompts().texts
            for way in ways:
                pictures = {view.name: paint(model, view, way, prompts, seed) for view in views}
                method = f"{training}, {way}"
                scores.setdefault(method, {})[str(seed)] = mean([score(pictures[view.name], view) for view in views])
                if seed == seeds[0]:
                    for name, row in rows.items():
                        row.append(pictures[name])
    for view in views:
        crop = _crop(view.unseen)
        row = [cell[crop] for cell in (*rows[view.name], view.truth)]
        save_image(out / f"{view.name}.png", np.hstack(row).astype(np.uint8))
    share = float(np.mean([view.unseen.mean() for view in views]))
    return {"views": len(views), "share": share, "scores": scores}


def _crop(mask: np.ndarray) -> tuple[slice, slice]:
    rows, columns = np.nonzero(mask)
    margin = 20
    return (
        slice(max(rows.min() - margin, 0), rows.max() + margin),
        slice(max(columns.min() - margin, 0), columns.max() + margin),
    )


def print_table(results: dict[str, dict]) -> None:
    """Print LPIPS over unseen pixels: mean over seeds and its spread, per run and method."""
    for run, result in results.items():
        if not result["views"]:
            print(f"{run}: no unseen pixels", flush=True)
            continue
        print(f"{run}: {result['views']} views, {result['share']:.1%} of a view", flush=True)
        for method, by_seed in result["scores"].items():
            cells = []
            for net in ("vgg", "alex"):
                values = [row[net] for row in by_seed.values()]
                cells.append(f"{net} {np.mean(values):.4f} ± {np.std(values):.4f}")
            print(f"  {method:32} {'  '.join(cells)}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", help="runs/<scene>, finished up to `initialize`")
    parser.add_argument("--prior", default="priors/tiny", help="diffusers folder")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--trainings", nargs="+", choices=TRAININGS, default=list(TRAININGS))
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), default=list(WAYS), help="minutes each")
    parser.add_argument("--views", type=int, default=6, help="test views, at most, that are painted")
    parser.add_argument("--out", type=Path, default=Path("runs/unseen"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    results = {}
    for run in arguments.runs:
        results[run.name] = study_run(
            run,
            arguments.prior,
            arguments.seeds,
            arguments.out / run.name,
            arguments.trainings,
            arguments.ways,
            arguments.views,
        )
        print_table({run.name: results[run.name]})
        save_json(arguments.out / "unseen.json", results)


if __name__ == "__main__":
    run_study(main)

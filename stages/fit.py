"""fit: the scene as it was photographed, object included, in Gaussians; a scene's own .ply is taken over."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from reffusion import seeding, trace
from reffusion.capture import image_detail, stereo
from reffusion.fit import few_views
from reffusion.fit.exposure import UNEVEN
from reffusion.fit.gains import gains, uneven
from reffusion.fit.reconstruction import fit
from reffusion.fit.start import initial_gaussians
from reffusion.fit.step import GENTLE
from reffusion.inpaint import classical
from reffusion.io.images import to_uint8
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_raw_masks, load_scene, load_views
from reffusion.masks import voting
from reffusion.params.fit import Params
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians, Scene


def run(params: Params, out: Path, *, poses: Path, raw_masks: Path | None = None) -> None:
    if (poses / "gaussians.ply").exists() and params.pixels == "all":
        save_ply(out / "gaussians.ply", load_ply(poses / "gaussians.ply"))
        return
    rasterizer.prepare(params.device)
    began, scene = time.monotonic(), load_scene(poses)
    params = supported(params, scene)
    held_out = scene.train[params.holdout // 2 :: params.holdout] if params.holdout else ()
    cameras = [scene.cameras[name] for name in scene.train if name not in held_out]
    images = load_views(poses, scene.train)
    hidden = hidden_pixels(raw_masks, scene) if params.pixels == "unmasked" else {}
    images |= {name: classical.telea(images[name], mask) for name, mask in hidden.items()}  # flow looks at them too
    exposed = exposures(params, scene, cameras, images)
    even = images if exposed is None else evened(images, cameras, exposed)
    params, first = capped(params, cameras), on_surfaces(params, scene, cameras, even, hidden)
    rates = None
    if first is not None:
        params, rates = few_views.gently(params), GENTLE
    elif (out / trace.CHECKPOINT).exists():  # of what it starts from only the degree and the device still matter
        first = start(params, scene.points, scene.point_colors)
    else:
        first = start(params, *start_points(params, scene, cameras, even, hidden))
    views = (cameras, images, first)
    weights = {name: ~mask for name, mask in hidden.items()}
    spent, lasting = lambda: time.monotonic() - began, lambda steps: params.changed({"iterations": steps})
    tried = lambda folder, steps: fit(
        *views, lasting(steps), folder=folder, weights=weights, rates=rates, gains=exposed
    )
    steps = trace.affordable(out, params.iterations, params.seconds, spent, tried)
    gaussians = fit(
        *views,
        lasting(steps),
        folder=out,
        weights=weights,
        rates=rates,
        gains=exposed,
        held_out=[scene.cameras[name] for name in held_out],
        spent=spent(),
    )
    save_ply(out / "gaussians.ply", gaussians.map(lambda p: p.cpu()))
    trace.clear_checkpoint(out)


def supported(params: Params, scene: Scene) -> Params:
    """The parameters with no higher degree of spherical harmonics than the training views determine."""
    most = params.sh.degree
    if params.few_views == "as_many":
        return params
    degree, views = image_detail.harmonics(scene.points, [scene.cameras[name] for name in scene.train], most)
    if degree == most:
        return params
    print(f"spherical harmonics of degree {degree}: a typical point is in {views} views", flush=True)
    return params.changed({"sh.degree": degree})


def exposures(
    params: Params, scene: Scene, cameras: list[Camera], images: Mapping[str, np.ndarray]
) -> np.ndarray | None:
    """[V, 3], how bright each view is beside the others; None where their exposures are not fitted."""
    if params.exposure == "never":
        return None
    found = gains(scene.points, cameras, images)
    differ = uneven(found)
    if params.exposure == "auto" and differ < UNEVEN:
        return None
    print(f"exposures are fitted: the brightness of the same points differs by {differ:.1%} between views", flush=True)
    return found


def evened(images: Mapping[str, np.ndarray], cameras: list[Camera], exposed: np.ndarray) -> dict[str, np.ndarray]:
    """View name -> uint8 [H, W, 3], the pictures as bright as each other."""
    bright = {camera.name: gain for camera, gain in zip(cameras, exposed, strict=True)}
    return {name: to_uint8(image / 255.0 / bright.get(name, 1.0)) for name, image in images.items()}


def on_surfaces(params: Params, scene: Scene, cameras: list[Camera], images, hidden) -> Gaussians | None:
    """The Gaussians to start from where there are few views; None where there are enough, or too few points that they
    show."""
    if params.few_views != "surfaces" or len(cameras) > few_views.MOST:
        return None
    found = few_views.surfaces(cameras, images, scene.points, scene.point_colors, hidden, params)
    if found is not None:
        print(f"few photographs: {len(found)} Gaussians on surfaces between {len(scene.points)} points", flush=True)
    return found


def hidden_pixels(raw_masks: Path, scene: Scene) -> dict[str, np.ndarray]:
    """View name -> bool [H, W], its raw mask; none for a view without one, or one marked clean."""
    masks = load_raw_masks(raw_masks, [name for name in scene.train if name not in scene.clean])
    if not masks:
        raise ValueError(f"{raw_masks / 'masks'}: fit.pixels is 'unmasked', but the scene has no masks")
    return masks


def start_points(
    params: Params,
    scene: Scene,
    cameras: list[Camera],
    images: dict[str, np.ndarray],
    hidden: Mapping[str, np.ndarray] = MappingProxyType({}),
):
    """Positions [P, 3] and colours [P, 3] uint8: the scene's sparse points, and the flow points of these views.

    Points that most views show inside `hidden` are left out: no pixel would ever move them.
    """

    points, colors = scene.points, scene.point_colors
    if params.init.flow_cell:
        found, found_colors = stereo.dense_points(cameras, images, params.init.flow_cell)
        print(f"{len(found)} points by optical flow beside {len(points)}", flush=True)
        points, colors = np.concatenate([points, found]), np.concatenate([colors, found_colors])
    keep = ~voting.points_inside(points, cameras, hidden)
    return points[keep], colors[keep]


def start(params: Params, points: np.ndarray, colors: np.ndarray) -> Gaussians:
    """The Gaussians to start from, on the device to compute on."""
    noise, init = seeding.generator(params.seed, "start"), params.init
    degree, most = params.sh.degree, params.densify.cap_max
    first = initial_gaussians(points, colors, degree, most, noise, init.opacity, init.scale)
    return replace(first.map(lambda p: p.to(params.device)), antialiased=params.antialiased)


def capped(params: Params, cameras: list[Camera]) -> Params:
    """The parameters for these views: a larger picture has room for more Gaussians."""
    densify = params.densify
    if not densify.per_pixel:
        return params
    pixels = sum(camera.width * camera.height for camera in cameras) / len(cameras)
    most = min(densify.cap_max, max(4, round(densify.per_pixel * pixels)))
    return params.changed({"densify.cap_max": most})

"""What a fit starts from: parameters limited to what the scene's views determine, equal exposure, initial Gaussians."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from reffusion import seeding
from reffusion.capture import image_detail, stereo
from reffusion.fit import few_views
from reffusion.fit.exposure import BRIGHTNESS_DEVIATION
from reffusion.fit.gains import brightness_deviation, estimate_gains
from reffusion.fit.start import initial_gaussians
from reffusion.io.images import to_uint8
from reffusion.masks import voting
from reffusion.params.fit import Params
from reffusion.types import Camera, Gaussians, Scene


def limit_sh_degree(params: Params, scene: Scene) -> Params:
    """The parameters with the degree of spherical harmonics limited to what the training views determine."""
    max_degree = params.sh.degree
    if params.few_views == "as_many":
        return params
    degree, views = image_detail.supported_sh_degree(
        scene.points, [scene.cameras[name] for name in scene.train], max_degree
    )
    if degree == max_degree:
        return params
    print(f"spherical harmonics of degree {degree}: a typical point is in {views} views", flush=True)
    return params.changed({"sh.degree": degree})


def estimate_exposures(
    params: Params, scene: Scene, cameras: list[Camera], images: Mapping[str, np.ndarray]
) -> np.ndarray | None:
    """[V, 3], relative brightness of the views; None if exposures are not fitted."""
    if params.exposure == "never":
        return None
    gains = estimate_gains(scene.points, cameras, images)
    deviation = brightness_deviation(gains)
    if params.exposure == "auto" and deviation < BRIGHTNESS_DEVIATION:
        return None
    print(
        f"exposures are fitted: the brightness of the same points differs by {deviation:.1%} between views", flush=True
    )
    return gains


def equalize_exposure(
    images: Mapping[str, np.ndarray], cameras: list[Camera], gains: np.ndarray
) -> dict[str, np.ndarray]:
    """View name -> uint8 [H, W, 3], the pictures with equal brightness."""
    gain_of = {camera.name: gain for camera, gain in zip(cameras, gains, strict=True)}
    return {name: to_uint8(image / 255.0 / gain_of.get(name, 1.0)) for name, image in images.items()}


def start_on_surfaces(params: Params, scene: Scene, cameras: list[Camera], images, hidden) -> Gaussians | None:
    """Initial Gaussians on surfaces, for scenes with few views; None with more views or too few visible points."""
    if params.few_views != "surfaces" or len(cameras) > few_views.MAX_VIEWS:
        return None
    gaussians = few_views.gaussians_on_surfaces(cameras, images, scene.points, scene.point_colors, hidden, params)
    if gaussians is not None:
        print(f"few photographs: {len(gaussians)} Gaussians on surfaces between {len(scene.points)} points", flush=True)
    return gaussians


def collect_points(
    params: Params,
    scene: Scene,
    cameras: list[Camera],
    images: dict[str, np.ndarray],
    hidden: Mapping[str, np.ndarray] = MappingProxyType({}),
):
    """Positions [P, 3] and colours [P, 3] uint8 of the sparse points and of the optical flow between these views.

    Points that most views show inside `hidden` are left out: no pixel would ever move them.
    """

    points, colors = scene.points, scene.point_colors
    if params.init.flow_cell:
        flow_points, flow_colors = stereo.triangulate_points(cameras, images, params.init.flow_cell)
        print(f"{len(flow_points)} points by optical flow beside {len(points)}", flush=True)
        points, colors = np.concatenate([points, flow_points]), np.concatenate([colors, flow_colors])
    kept = ~voting.points_inside(points, cameras, hidden)
    return points[kept], colors[kept]


def make_gaussians(params: Params, points: np.ndarray, colors: np.ndarray) -> Gaussians:
    """Initial Gaussians at the points, on the device of the computation."""
    generator, settings = seeding.generator(params.seed, "start"), params.init
    sh_degree, max_gaussians = params.sh.degree, params.densify.cap_max
    gaussians = initial_gaussians(points, colors, sh_degree, max_gaussians, generator, settings.opacity, settings.scale)
    return replace(gaussians.map(lambda p: p.to(params.device)), antialiased=params.antialiased)


def limit_gaussians(params: Params, cameras: list[Camera]) -> Params:
    """The parameters with `cap_max` limited by the image size: larger pictures have room for more Gaussians."""
    densify = params.densify
    if not densify.per_pixel:
        return params
    pixels = sum(camera.width * camera.height for camera in cameras) / len(cameras)
    max_gaussians = min(densify.cap_max, max(4, round(densify.per_pixel * pixels)))
    return params.changed({"densify.cap_max": max_gaussians})

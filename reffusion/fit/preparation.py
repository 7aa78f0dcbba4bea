"""Preparation of a fit: parameters that suit the scene's views, photographs of equal exposure, initial Gaussians."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from reffusion import seeding
from reffusion.capture import flow, image_detail
from reffusion.fit import few_views
from reffusion.fit.exposure import BRIGHTNESS_DEVIATION
from reffusion.fit.gains import brightness_deviation, estimate_gains
from reffusion.fit.start import initial_gaussians
from reffusion.fit.unmatched import points_for_empty_cells
from reffusion.io.images import to_uint8
from reffusion.masks import voting
from reffusion.params.fit import Params
from reffusion.types import Camera, Gaussians, Scene

# One Gaussian a pixel gains .7 dB with 60 views and loses .8 dB with 18 or 21: docs/results.md.
FEW_VIEWS, MANY_VIEWS, FEW_SHARE = 18, 30, 0.4
UNMATCHED_OPACITY = 0.05  # initial opacity of a Gaussian at a point that no match confirms


def limit_sh_degree(params: Params, scene: Scene) -> Params:
    """Return the parameters with the degree of spherical harmonics limited to what the training views determine.

    A degree d has (d + 1)^2 coefficients, and at least this many training views must contain a typical sparse point.
    With `params.few_views` = "as_many" the parameters are returned unchanged. If the degree is lowered, it is printed.
    """
    max_degree = params.sh.degree
    if params.few_views == "as_many":
        return params
    degree, views = image_detail.choose_sh_degree(
        scene.points, [scene.cameras[name] for name in scene.train], max_degree
    )
    if degree == max_degree:
        return params
    print(f"spherical harmonics of degree {degree}: a typical point is in {views} views", flush=True)
    return params.changed({"sh.degree": degree})


def estimate_exposures(
    params: Params, scene: Scene, cameras: list[Camera], images: Mapping[str, np.ndarray]
) -> np.ndarray | None:
    """Decide whether exposures are fitted, and estimate the brightness of the views as their initial values.

    `params.exposure` decides: "never", "always" or "auto". With "auto" exposures are fitted if the standard deviation
    of the views' log brightness (`brightness_deviation`) is at least `BRIGHTNESS_DEVIATION`. The decision to fit is
    printed.

    Args:
        scene: the scene, at whose sparse points brightness is compared.
        cameras: the V views.
        images: view name -> uint8 [H, W, 3].

    Returns:
        [V, 3], brightness of each view's red, green and blue relative to the geometric mean of all views; None if
        exposures are not fitted.
    """
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
    """Return copies of the pictures, divided by the gains of their views, so that all have equal brightness.

    Args:
        images: view name -> uint8 [H, W, 3]; the copy of a picture whose view is not among `cameras` is unchanged.
        cameras: the V views.
        gains: [V, 3], from `estimate_exposures`.

    Returns:
        View name -> uint8 [H, W, 3], clipped to [0, 255].
    """
    gain_of = {camera.name: gain for camera, gain in zip(cameras, gains, strict=True)}
    return {name: to_uint8(image / 255.0 / gain_of.get(name, 1.0)) for name, image in images.items()}


def start_on_surfaces(params: Params, scene: Scene, cameras: list[Camera], images, hidden) -> Gaussians | None:
    """Return initial Gaussians on the surfaces between the sparse points, for a scene with few views.

    Args:
        cameras: the training views.
        images: view name -> uint8 [H, W, 3], with equal exposure.
        hidden: view name -> bool [H, W], True for pixels to be ignored.

    Returns:
        The Gaussians, whose number is printed; None if `params.few_views` is not "surfaces", if there are more than
        `few_views.MAX_VIEWS` views, or if too few sparse points are visible.
    """
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
    """Collect the points from which a fit starts: the sparse points, and points where pictures show more.

    If `params.init.flow_cell` is not 0, all points that optical flow triangulates are added, and then further points
    where a view shows none of them (`points_for_empty_cells`); the numbers are printed. No match confirms the further
    points, so they start almost transparent (`UNMATCHED_OPACITY`): views that see past them remove them sooner. A point
    is left out if it projects into `hidden` in more than half of those views that have such a mask and contain the
    point, because no supervising pixel would ever move Gaussians there.

    Args:
        cameras: the views between which flow is computed.
        images: view name -> uint8 [H, W, 3].
        hidden: view name -> bool [H, W], True for pixels that do not supervise.

    Returns:
        Positions [P, 3] float64, colors [P, 3] uint8 and opacities [P]: sparse points, then those by flow, then the
        further points.
    """
    points, colors, more = scene.points, scene.point_colors, np.empty((0, 3))
    if params.init.flow_cell:
        flow_points, flow_colors = flow.triangulate_points(cameras, images, params.init.flow_cell)
        print(f"{len(flow_points)} points by optical flow beside {len(points)}", flush=True)
        points, colors = np.concatenate([points, flow_points]), np.concatenate([colors, flow_colors])
        more, more_colors = points_for_empty_cells(cameras, images, points)
        print(f"{len(more)} points where a view shows none of them", flush=True)
        points, colors = np.concatenate([points, more]), np.concatenate([colors, more_colors])
    opacities = np.full(len(points), params.init.opacity)
    opacities[len(points) - len(more) :] = UNMATCHED_OPACITY
    kept = ~voting.points_inside(points, cameras, hidden)
    return points[kept], colors[kept], opacities[kept]


def make_gaussians(
    params: Params, points: np.ndarray, colors: np.ndarray, opacities: np.ndarray | None = None
) -> Gaussians:
    """Return an initial Gaussian at each point (see `initial_gaussians`), on the device `params.device`.

    If there are more points than `params.densify.cap_max`, a random subset of this size is used.

    Args:
        points: [P, 3] positions, P >= 4; fewer raise ValueError.
        colors: [P, 3] uint8.
        opacities: [P], the opacity of the Gaussian at each point; None: `params.init.opacity` for all.
    """
    generator, settings = seeding.generator(params.seed, "start"), params.init
    sh_degree, max_gaussians = params.sh.degree, params.densify.cap_max
    opacity = settings.opacity if opacities is None else opacities
    gaussians = initial_gaussians(points, colors, sh_degree, max_gaussians, generator, opacity, settings.scale)
    return replace(gaussians.map(lambda p: p.to(params.device)), antialiased=params.antialiased)


def limit_gaussians(params: Params, cameras: list[Camera]) -> Params:
    """Return the parameters with `densify.cap_max`, the maximum number of Gaussians, limited by the image size.

    Larger pictures show more detail, which needs more Gaussians. Few views do not determine so many. The limit is
    `densify.per_pixel` times the mean number of pixels of a view, times a share that grows linearly from `FEW_SHARE`
    with `FEW_VIEWS` views to 1 with `MANY_VIEWS`; at least 4. With `densify.per_pixel` = 0 the parameters are returned
    unchanged.
    """
    densify = params.densify
    if not densify.per_pixel:
        return params
    pixels = sum(camera.width * camera.height for camera in cameras) / len(cameras)
    share = float(np.interp(len(cameras), (FEW_VIEWS, MANY_VIEWS), (FEW_SHARE, 1.0)))
    max_gaussians = min(densify.cap_max, max(4, round(share * densify.per_pixel * pixels)))
    return params.changed({"densify.cap_max": max_gaussians})

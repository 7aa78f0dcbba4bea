"""Cases of the rasterizer: values and gradients against float64 (`oracle`), order of depths, image sizes.

Scenes have an extent of about 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from lab.stability import oracle
from lab.stability.cases import EPS32, EXACT, Case, nan_safe_max
from reffusion.gaussians import densify
from reffusion.splat import rasterizer
from reffusion.splat.conventions import NEAR
from reffusion.types import PARAMETERS, Camera, Gaussians

RELATIVE = 1e-3  # bound of the relative error: three digits, as extreme inputs cost some of float32's seven
QUANTITY = "relative L2 error of the worst value or gradient block against float64"


def camera(width: int = 12, height: int = 10, distance: float = 1.0) -> Camera:
    """Make a camera that looks at the origin, slightly turned and off-center, so that no symmetry hides an error."""
    turn, pose = 0.3, np.eye(4)
    pose[:3, :3] = [[math.cos(turn), 0, math.sin(turn)], [0, 1, 0], [-math.sin(turn), 0, math.cos(turn)]]
    pose[:3, 3] = 0.02, -0.01, distance
    return Camera("case", width, height, 1.2 * width, 1.25 * width, width / 2 + 0.3, height / 2 - 0.2, pose)


def cloud(count: int = 8, seed: int = 0, degree: int = 2) -> Gaussians:
    """Make random Gaussians around the origin with standard deviations of about a tenth of the extent."""
    random = torch.Generator().manual_seed(seed)
    normal = lambda *shape: torch.randn(*shape, generator=random)
    return Gaussians(
        means=0.25 * normal(count, 3),
        quaternions=normal(count, 4),
        log_scales=math.log(0.1) + 0.5 * normal(count, 3),
        opacity_logits=normal(count),
        sh=0.5 * normal(count, (degree + 1) ** 2, 3),
    )


def world_from_camera(points: list[list[float]], view: Camera) -> torch.Tensor:
    """Transform points [N, 3] from a camera's axes to the world; return float32."""
    pose = view.world_to_camera
    return torch.tensor((np.array(points) - pose[:3, 3]) @ pose[:3, :3], dtype=torch.float32)


def oracle_error(change: Callable[[Gaussians], Gaussians], view: Camera | None = None) -> float:
    """Return the largest relative L2 error of the rasterizer's images and gradients (`oracle.worst_error`).

    The result is infinite if nothing is visible, because the case would then test nothing.

    Args:
        change: function that returns an extreme version of the Gaussians of `cloud`.
        view: camera; None for `camera()`.
    """
    gaussians, view = change(cloud()), view or camera()
    is_visible = rasterizer.render(gaussians, view, impl="cpu").alpha.max() > 0
    return oracle.worst_error(gaussians, view, RELATIVE) if is_visible else math.inf


def scale_all(scale: float, gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians with standard deviations of about `scale` extents.

    Their opacities are raised, so that tiny Gaussians are visible.
    """
    log_scales = gaussians.log_scales - math.log(0.1) + math.log(scale)
    return replace(gaussians, log_scales=log_scales, opacity_logits=gaussians.opacity_logits + 3)


def make_needles(ratio: float, longest: float, gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians as needles with the standard deviation `longest` along, and `longest` / `ratio` across."""
    sizes = torch.tensor([longest, longest / ratio, longest / ratio]).log()
    return replace(gaussians, log_scales=sizes.repeat(len(gaussians), 1))


def make_sheets(ratio: float, longest: float, gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians as sheets with the standard deviation `longest` along, and `longest` / `ratio` across."""
    sizes = torch.tensor([longest, longest, longest / ratio]).log()
    return replace(gaussians, log_scales=sizes.repeat(len(gaussians), 1))


def set_opacity(logit: float, gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians with all opacity logits set to `logit`."""
    return replace(gaussians, opacity_logits=torch.full_like(gaussians.opacity_logits, logit))


def faint_contribution() -> float:
    """Return the largest absolute value of alpha and of the gradients for opacities of e^-30.

    Such opacities are below the cut-off 1/255, so all values must be 0.
    """
    rendering = oracle.render_with_gradients(set_opacity(-30.0, cloud()), camera(), "cpu")
    blocks = [rendering.gradients[name] for name in PARAMETERS] + [rendering.images["alpha"]]
    return nan_safe_max(*(block.abs().max().item() for block in blocks))


def set_quaternion_length(length: float, gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians with all quaternions scaled to `length`."""
    return replace(gaussians, quaternions=torch.nn.functional.normalize(gaussians.quaternions) * length)


def zero_quaternion_error() -> float:
    """Return the larger of two numbers that must be 0, for Gaussians whose quaternions are zero.

    The first is the largest difference of their images from those with identity quaternions, the second the largest
    gradient of the zero quaternions.
    """
    zero = replace(cloud(), quaternions=torch.zeros(8, 4))
    one = replace(zero, quaternions=torch.tensor([1.0, 0, 0, 0]).repeat(8, 1))
    rendering, expected = (
        oracle.render_with_gradients(zero, camera(), "cpu"),
        oracle.render_with_gradients(one, camera(), "cpu"),
    )
    difference = max((rendering.images[n] - expected.images[n]).abs().max().item() for n in oracle.IMAGES)
    return nan_safe_max(difference, rendering.gradients["quaternions"].abs().max().item())


def short_quaternion_error() -> float:
    """Return the largest difference between offsets rotated by quaternions of length 1e-20 and of length 1.

    Densification rotates offsets in this way when it splits Gaussians.
    """
    gaussians, vectors = cloud(), torch.ones(8, 3)
    unit = torch.nn.functional.normalize(gaussians.quaternions)
    return (densify.rotate(unit * 1e-20, vectors) - densify.rotate(unit, vectors)).abs().max().item()


def near_plane_errors() -> float:
    """Count Gaussians near the near plane that are wrongly kept or dropped.

    Their depths are just below, on and just above 0.01, and 0 and less. Those with z >= 0.01 in float64 must be kept,
    all others dropped.
    """
    view = replace(camera(), world_to_camera=np.eye(4))
    below, above = np.nextafter(np.float32(NEAR), np.float32(0)), np.nextafter(np.float32(NEAR), np.float32(1))
    depths = torch.tensor([below, np.float32(NEAR), above, 0.0, -NEAR, -1.0])
    gaussians = replace(scale_all(1e-3, cloud(6)), means=torch.stack([0 * depths, 0 * depths, depths], 1))
    kept = rasterizer.render(gaussians, view, impl="cpu").radii > 0
    return float((kept != (depths.double() >= NEAR)).sum())


def move_to_near_plane(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians, made small, at depths from 0.0101, just beyond the near plane of 0.01, to 0.05."""
    z = [0.0101, 0.0105, 0.011, 0.012, 0.015, 0.02, 0.03, 0.05]
    means = world_from_camera([[0.001 * k, -0.001 * k, depth] for k, depth in enumerate(z)], camera())
    return replace(scale_all(2e-3, gaussians), means=means)


def move_behind_camera(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians with half of them behind the camera, by distances of 1e-6 to 1e6."""
    means = gaussians.means.clone()
    means[::2] = world_from_camera([[0.1, 0.1, -1e-6], [0, 0, -1e-2], [0, 0.5, -1], [1, 1, -1e6]], camera())
    return replace(gaussians, means=means)


def move_to_camera_center(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians with two at the camera's center, and one 1e-30 in front of it."""
    means = gaussians.means.clone()
    means[:3] = world_from_camera([[0, 0, 0], [0, 0, 0], [0, 0, 1e-30]], camera())
    return replace(gaussians, means=means)


def unrotated_camera() -> Camera:
    """Make the camera of `camera` without its rotation."""
    view = camera()
    pose = np.eye(4)
    pose[:3, 3] = view.world_to_camera[:3, 3]
    return replace(view, world_to_camera=pose)


def make_far_needles(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians as needles whose centers are 1e4 extents away and that nevertheless cross the image.

    Their standard deviations are 2e4 along the needle and 1e-2 across it.
    """
    angles = torch.linspace(0.1, 1.4, len(gaussians))
    along = torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], 1)
    turn = torch.stack([(angles / 2).cos(), 0 * angles, 0 * angles, (angles / 2).sin()], 1)
    sizes = torch.tensor([2e4, 1e-2, 1e-2]).log().repeat(len(gaussians), 1)
    return replace(gaussians, means=1e4 * along, quaternions=turn, log_scales=sizes)


def equal_depth_differences() -> float:
    """Count the numbers in images and gradients that differ from the first of three renderings.

    The Gaussians have equal depths. The renderings use one, three and one threads.
    """
    place = replace(cloud(40), means=torch.zeros(40, 3), opacity_logits=torch.full((40,), 2.0))
    before, renderings = torch.get_num_threads(), []
    try:
        for threads in (1, 3, 1):
            torch.set_num_threads(threads)
            rendering = oracle.render_with_gradients(place, camera(), "cpu")
            renderings.append([*rendering.images.values(), *rendering.gradients.values()])
    finally:
        torch.set_num_threads(before)
    return float(sum((a != b).sum() for other in renderings[1:] for a, b in zip(renderings[0], other, strict=True)))


def move_to_origin(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians with all means at the origin, so that their depths are equal."""
    return replace(gaussians, means=torch.zeros_like(gaussians.means))


def wide_image_error() -> float:
    """Return the relative L2 error of the color of an image of 8192 x 2 px.

    Footprints span a thousand tiles, and pixel coordinates have only 11 fractional bits in float32. The image has too
    many pixels for `oracle.blended_pixels`, so only values are compared, and the float64 reference decides on its own
    which contributions are skipped.
    """
    view = camera(8192, 2)
    view, gaussians = replace(view, fx=4000.0, fy=4000.0), cloud(12)
    fast = rasterizer.render(gaussians, view, impl="cpu").color.double()
    exact = rasterizer.render(gaussians.map(torch.Tensor.double), view, impl="torch").color
    return ((fast - exact).norm() / exact.norm()).item()


def count_invalid_values() -> float:
    """Count the violations for Gaussians with NaN and infinite parameters, which must be dropped.

    A violation is a non-finite value or gradient, or a dropped Gaussian whose radius is not 0.
    """
    gaussians, broken = cloud(), (math.nan, math.inf, -math.inf, math.nan)
    for row, (name, value) in enumerate(zip(("means", "quaternions", "means", "log_scales"), broken, strict=True)):
        getattr(gaussians, name)[row] = value
    rendering = oracle.render_with_gradients(gaussians, camera(), "cpu")
    bad = sum((~torch.isfinite(image)).sum() for image in rendering.images.values())
    bad += sum((~torch.isfinite(gradient)).sum() for gradient in rendering.gradients.values())
    return float(bad + (rendering.radii[:4] > 0).sum())


def oracle_case(name: str, change: Callable[[Gaussians], Gaussians], view: Camera | None = None) -> Case:
    """Return the case that measures `oracle_error`."""
    return Case(name, QUANTITY, RELATIVE, partial(oracle_error, change, view))


CASES = (
    *(oracle_case(f"scales {scale:g} of the extent", partial(scale_all, scale)) for scale in
      (1e-7, 1e-5, 1e-3, 1.0, 1e2, 1e4)),
    *(oracle_case(f"needles, anisotropy {ratio:g}", partial(make_needles, ratio, 0.3)) for ratio in (1e3, 1e6)),
    oracle_case("sheets, anisotropy 1e6", partial(make_sheets, 1e6, 0.3)),
    oracle_case("needles larger than the scene, anisotropy 1e6", partial(make_needles, 1e6, 1e3)),
    oracle_case("needles from 1e4 extents away", make_far_needles, unrotated_camera()),
    oracle_case("opacity logit +30", partial(set_opacity, 30.0)),
    Case("opacity logit -30", "largest value or gradient", EXACT, faint_contribution),
    Case("quaternion zero", "largest difference from the identity, and its gradient", EXACT, zero_quaternion_error),
    *(oracle_case(f"quaternions of length {length:g}", partial(set_quaternion_length, length)) for length in
      (1e-12, 1e12)),
    # Rotating a vector of length 1.7 rounds some ten times.
    Case("quaternions of length 1e-20, splitting", "largest difference from unit ones", 32 * EPS32,
         short_quaternion_error),
    Case("Gaussians on the near plane", "Gaussians drawn or left out wrongly", EXACT, near_plane_errors),
    oracle_case("Gaussians at the near plane", move_to_near_plane),
    oracle_case("Gaussians behind the near plane", move_behind_camera),
    oracle_case("Gaussian at the camera centre", move_to_camera_center),
    oracle_case("Gaussians larger than the scene", partial(scale_all, 30.0)),
    Case("equal depths, repeated, other numbers of threads", "numbers that differ", EXACT, equal_depth_differences),
    oracle_case("equal depths, drawn by index", move_to_origin),
    oracle_case("one-pixel image", lambda gaussians: gaussians, camera(1, 1)),
    # Pixel coordinates of 8192 carry 24 - 13 bits of fraction: 2^-11 of a footprint's width of 0.5 px or more,
    # to which alpha answers by at most its slope, 0.6 per standard deviation.
    Case("8k-wide image", "relative L2 error of the colour against float64", 0.6 * 2**-10, wide_image_error),
    Case("parameters that are not numbers", "numbers that are not finite, and radii", EXACT, count_invalid_values),
)  # fmt: skip

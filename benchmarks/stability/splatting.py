"""Cases of the rasterizer: values and gradients against float64 (`oracle`), order, sizes of images."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from benchmarks.stability import oracle
from benchmarks.stability.cases import EPS32, EXACT, Case, largest
from reffusion.gaussians import densify
from reffusion.splat import rasterizer
from reffusion.splat.conventions import NEAR
from reffusion.types import PARAMETERS, Camera, Gaussians

RELATIVE = 1e-3  # the issue's: three digits of each block, where float32 has seven and the extremes eat some
QUANTITY = "relative L2 error of the worst value or gradient block against float64"


def camera(width: int = 12, height: int = 10, distance: float = 1.0) -> Camera:
    """A view of the origin, a little turned and off-centre so that no symmetry hides an error."""
    turn, pose = 0.3, np.eye(4)
    pose[:3, :3] = [[math.cos(turn), 0, math.sin(turn)], [0, 1, 0], [-math.sin(turn), 0, math.cos(turn)]]
    pose[:3, 3] = 0.02, -0.01, distance
    return Camera("case", width, height, 1.2 * width, 1.25 * width, width / 2 + 0.3, height / 2 - 0.2, pose)


def cloud(count: int = 8, seed: int = 0, degree: int = 2) -> Gaussians:
    """Gaussians of a tenth of the extent around the origin."""
    random = torch.Generator().manual_seed(seed)
    normal = lambda *shape: torch.randn(*shape, generator=random)
    return Gaussians(
        means=0.25 * normal(count, 3),
        quaternions=normal(count, 4),
        log_scales=math.log(0.1) + 0.5 * normal(count, 3),
        opacity_logits=normal(count),
        sh=0.5 * normal(count, (degree + 1) ** 2, 3),
    )


def in_camera(points: list[list[float]], view: Camera) -> torch.Tensor:
    """Points [N, 3] given in the camera's axes, in the world, float32."""
    pose = view.world_to_camera
    return torch.tensor((np.array(points) - pose[:3, 3]) @ pose[:3, :3], dtype=torch.float32)


def error(change: Callable[[Gaussians], Gaussians], view: Camera | None = None) -> float:
    """The worst block's; infinite where nothing is drawn, which would say nothing."""
    gaussians, view = change(cloud()), view or camera()
    drawn = rasterizer.render(gaussians, view, impl="cpu").alpha.max() > 0
    return oracle.worst(gaussians, view, RELATIVE) if drawn else math.inf


def scaled(scale: float, gaussians: Gaussians) -> Gaussians:
    """All standard deviations about `scale` extents; opaque, so that a footprint of a point shows."""
    log_scales = gaussians.log_scales - math.log(0.1) + math.log(scale)
    return replace(gaussians, log_scales=log_scales, opacity_logits=gaussians.opacity_logits + 3)


def stretched(ratio: float, longest: float, gaussians: Gaussians) -> Gaussians:
    sizes = torch.tensor([longest, longest / ratio, longest / ratio]).log()
    return replace(gaussians, log_scales=sizes.repeat(len(gaussians), 1))


def flattened(ratio: float, longest: float, gaussians: Gaussians) -> Gaussians:
    sizes = torch.tensor([longest, longest, longest / ratio]).log()
    return replace(gaussians, log_scales=sizes.repeat(len(gaussians), 1))


def with_opacity(logit: float, gaussians: Gaussians) -> Gaussians:
    return replace(gaussians, opacity_logits=torch.full_like(gaussians.opacity_logits, logit))


def faint_draw_nothing() -> float:
    """Opacity e^-30 is under 1/255: no pixel and no gradient may show it; the largest number that does."""
    drawn = oracle.draw(with_opacity(-30.0, cloud()), camera(), "cpu")
    blocks = [drawn.gradients[name] for name in PARAMETERS] + [drawn.images["alpha"]]
    return largest(*(block.abs().max().item() for block in blocks))


def long_quaternions(length: float, gaussians: Gaussians) -> Gaussians:
    return replace(gaussians, quaternions=torch.nn.functional.normalize(gaussians.quaternions) * length)


def zero_quaternions() -> float:
    """Zero is the identity, bit for bit, and its gradient is zero; the largest difference."""
    zero = replace(cloud(), quaternions=torch.zeros(8, 4))
    one = replace(zero, quaternions=torch.tensor([1.0, 0, 0, 0]).repeat(8, 1))
    drawn, expected = oracle.draw(zero, camera(), "cpu"), oracle.draw(one, camera(), "cpu")
    apart = max((drawn.images[n] - expected.images[n]).abs().max().item() for n in oracle.IMAGES)
    return largest(apart, drawn.gradients["quaternions"].abs().max().item())


def short_quaternions_turn() -> float:
    """Splitting turns offsets by quaternions of any length: how far 1e-20 is from 1."""
    gaussians, vectors = cloud(), torch.ones(8, 3)
    unit = torch.nn.functional.normalize(gaussians.quaternions)
    return (densify.rotate(unit * 1e-20, vectors) - densify.rotate(unit, vectors)).abs().max().item()


def on_the_near_plane() -> float:
    """Who is drawn just before, on and just behind z = 0.01: disagreements with z >= 0.01 in float64."""
    view = replace(camera(), world_to_camera=np.eye(4))
    below, above = np.nextafter(np.float32(NEAR), np.float32(0)), np.nextafter(np.float32(NEAR), np.float32(1))
    depths = torch.tensor([below, np.float32(NEAR), above, 0.0, -NEAR, -1.0])
    gaussians = replace(scaled(1e-3, cloud(6)), means=torch.stack([0 * depths, 0 * depths, depths], 1))
    kept = rasterizer.render(gaussians, view, impl="cpu").radii > 0
    return float((kept != (depths.double() >= NEAR)).sum())


def at_the_near_plane(gaussians: Gaussians) -> Gaussians:
    z = [0.0101, 0.0105, 0.011, 0.012, 0.015, 0.02, 0.03, 0.05]
    means = in_camera([[0.001 * k, -0.001 * k, depth] for k, depth in enumerate(z)], camera())
    return replace(scaled(2e-3, gaussians), means=means)


def behind(gaussians: Gaussians) -> Gaussians:
    """Half of them behind the camera, by 1e-6 to 1e6."""
    means = gaussians.means.clone()
    means[::2] = in_camera([[0.1, 0.1, -1e-6], [0, 0, -1e-2], [0, 0.5, -1], [1, 1, -1e6]], camera())
    return replace(gaussians, means=means)


def at_the_center(gaussians: Gaussians) -> Gaussians:
    """Two in the camera's centre, one a hair before it."""
    means = gaussians.means.clone()
    means[:3] = in_camera([[0, 0, 0], [0, 0, 0], [0, 0, 1e-30]], camera())
    return replace(gaussians, means=means)


def straight() -> Camera:
    """A view that is not turned."""
    view = camera()
    pose = np.eye(4)
    pose[:3, 3] = view.world_to_camera[:3, 3]
    return replace(view, world_to_camera=pose)


def needles_from_afar(gaussians: Gaussians) -> Gaussians:
    """Centres 1e4 extents beside the image, lengths of as much, widths of 1e-2: they cross it nevertheless."""
    angles = torch.linspace(0.1, 1.4, len(gaussians))
    along = torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], 1)
    turn = torch.stack([(angles / 2).cos(), 0 * angles, 0 * angles, (angles / 2).sin()], 1)
    sizes = torch.tensor([2e4, 1e-2, 1e-2]).log().repeat(len(gaussians), 1)
    return replace(gaussians, means=1e4 * along, quaternions=turn, log_scales=sizes)


def equal_depths() -> float:
    """Forty opaque ones in one place, two calls, one and three threads: different numbers among them."""
    place = replace(cloud(40), means=torch.zeros(40, 3), opacity_logits=torch.full((40,), 2.0))
    before, drawn = torch.get_num_threads(), []
    try:
        for threads in (1, 3, 1):
            torch.set_num_threads(threads)
            found = oracle.draw(place, camera(), "cpu")
            drawn.append([*found.images.values(), *found.gradients.values()])
    finally:
        torch.set_num_threads(before)
    return float(sum((a != b).sum() for other in drawn[1:] for a, b in zip(drawn[0], other, strict=True)))


def in_one_place(gaussians: Gaussians) -> Gaussians:
    return replace(gaussians, means=torch.zeros_like(gaussians.means))


def wide_image() -> float:
    """8192 x 2 px: footprints over a thousand tiles, pixel coordinates with 11 bits less for fractions.

    Too many pixels to ask which Gaussian reached which: against the reference's own cut-offs, values only.
    """
    view = camera(8192, 2)
    view, gaussians = replace(view, fx=4000.0, fy=4000.0), cloud(12)
    fast = rasterizer.render(gaussians, view, impl="cpu").color.double()
    exact = rasterizer.render(gaussians.map(torch.Tensor.double), view, impl="reference").color
    return ((fast - exact).norm() / exact.norm()).item()


def not_numbers() -> float:
    """Gaussians that are NaN or infinite are left out: values that are not finite, and radii that are not 0."""
    gaussians, broken = cloud(), (math.nan, math.inf, -math.inf, math.nan)
    for row, (name, value) in enumerate(zip(("means", "quaternions", "means", "log_scales"), broken, strict=True)):
        getattr(gaussians, name)[row] = value
    drawn = oracle.draw(gaussians, camera(), "cpu")
    bad = sum((~torch.isfinite(image)).sum() for image in drawn.images.values())
    bad += sum((~torch.isfinite(gradient)).sum() for gradient in drawn.gradients.values())
    return float(bad + (drawn.radii[:4] > 0).sum())


def against_oracle(name: str, change: Callable[[Gaussians], Gaussians], view: Camera | None = None) -> Case:
    return Case(name, QUANTITY, RELATIVE, partial(error, change, view))


CASES = (
    *(against_oracle(f"scales {scale:g} of the extent", partial(scaled, scale)) for scale in
      (1e-7, 1e-5, 1e-3, 1.0, 1e2, 1e4)),
    *(against_oracle(f"needles, anisotropy {ratio:g}", partial(stretched, ratio, 0.3)) for ratio in (1e3, 1e6)),
    against_oracle("sheets, anisotropy 1e6", partial(flattened, 1e6, 0.3)),
    against_oracle("needles larger than the scene, anisotropy 1e6", partial(stretched, 1e6, 1e3)),
    against_oracle("needles from 1e4 extents away", needles_from_afar, straight()),
    against_oracle("opacity logit +30", partial(with_opacity, 30.0)),
    Case("opacity logit -30", "largest value or gradient", EXACT, faint_draw_nothing),
    Case("quaternion zero", "largest difference from the identity, and its gradient", EXACT, zero_quaternions),
    *(against_oracle(f"quaternions of length {length:g}", partial(long_quaternions, length)) for length in
      (1e-12, 1e12)),
    # Rotating a vector of length 1.7 rounds some ten times.
    Case("quaternions of length 1e-20, splitting", "largest difference from unit ones", 32 * EPS32,
         short_quaternions_turn),
    Case("Gaussians on the near plane", "Gaussians drawn or left out wrongly", EXACT, on_the_near_plane),
    against_oracle("Gaussians at the near plane", at_the_near_plane),
    against_oracle("Gaussians behind the near plane", behind),
    against_oracle("Gaussian at the camera centre", at_the_center),
    against_oracle("Gaussians larger than the scene", partial(scaled, 30.0)),
    Case("equal depths, repeated, other numbers of threads", "numbers that differ", EXACT, equal_depths),
    against_oracle("equal depths, drawn by index", in_one_place),
    against_oracle("one-pixel image", lambda gaussians: gaussians, camera(1, 1)),
    # Pixel coordinates of 8192 carry 24 - 13 bits of fraction: 2^-11 of a footprint's width of 0.5 px or more,
    # to which alpha answers by at most its slope, 0.6 per standard deviation.
    Case("8k-wide image", "relative L2 error of the colour against float64", 0.6 * 2**-10, wide_image),
    Case("parameters that are not numbers", "numbers that are not finite, and radii", EXACT, not_numbers),
)  # fmt: skip

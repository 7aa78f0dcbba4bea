"""fit: the scene as it was photographed, object included, in Gaussians; a scene's own .ply is taken over."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

if TYPE_CHECKING:
    import numpy as np

    from reffusion.types import Camera, Gaussians, Scene

Memory = Annotated[float, Field(ge=0, lt=1)]  # part of a mean that the next step keeps


class Params(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    iterations: int = Field(30_000, ge=1, description="optimisation steps, one view each (3DGS: 30000)")
    seed: int = Field(0, description="of the order of views, backgrounds and splits")
    sh_degree: int = Field(3, ge=0, le=3, description="highest degree of the spherical harmonics")
    sh_supported: bool = Field(True, description="no more coefficients than views in which a typical point is seen")
    sh_every: float = Field(1 / 30, ge=0, le=1, description="part of the run after which one more degree joins")
    random_background: bool = Field(True, description="a new background colour each step, instead of black")
    densify_by: Literal["slopes", "mcmc"] = Field("slopes", description="3DGS's densification, or 3DGS-MCMC's")
    opacity_weight: float = Field(0.0, ge=0, description="price of the mean opacity in the loss (mcmc: 0.01)")
    scale_weight: float = Field(0.0, ge=0, description="price of the mean standard deviation (mcmc: 0.01)")
    densify_from: float = Field(1 / 60, ge=0, le=1, description="part of the run before the first densification")
    densify_until: float = Field(0.5, ge=0, le=1, description="part of the run after which no Gaussian is added")
    densify_every: int = Field(100, ge=1, description="steps from one densification to the next")
    slope: float = Field(2e-4, gt=0, description="screen-space gradient that clones or splits; images span [-1, 1]")
    split_above: float = Field(0.01, gt=0, description="a larger size splits, a smaller clones; deviation / distance")
    budget: int = Field(1_000_000, ge=4, description="most Gaussians")
    per_pixel: float = Field(0.0, ge=0, description="most Gaussians for each pixel of a view; 0: `budget` alone")
    least_opacity: float = Field(0.005, ge=0, lt=1, description="fainter Gaussians are pruned")
    largest: float = Field(0.5, gt=0, description="Gaussians of a larger size are pruned; deviation / distance")
    reset_every: float = Field(0.1, ge=0, le=1, description="part of the run between opacity resets; 0 = none")
    means_rate: float = Field(1.6e-4, gt=0, description="first step size of positions; the last is a hundredth of it")
    opacity_rate: float = Field(0.05, gt=0, description="step size of opacity logits")
    scales_rate: float = Field(5e-3, gt=0, description="step size of log scales")
    rotations_rate: float = Field(1e-3, gt=0, description="step size of quaternions")
    color_rate: float = Field(2.5e-3, gt=0, description="step size of the constant spherical harmonic")
    sh_rate: float = Field(1.25e-4, gt=0, description="step size of the others")
    betas: tuple[Memory, Memory] = Field((0.9, 0.999), description="Adam's memory of gradients and of their squares")
    seconds: float = Field(0.0, ge=0, description="the stage's share of a time budget: as many steps as fit; 0: all")
    patience: int = Field(0, ge=0, description="stop after so many twentieths of the run without a gain; 0: never")
    stop_gain: float = Field(0.02, ge=0, description="dB of the trace's main quantity that count as a gain")
    checkpoint_seconds: float = Field(10.0, gt=0, description="seconds of work between checkpoints")
    antialiased: bool = Field(False, description="a Gaussian adds up to the same from any distance (Mip-Splatting)")
    exposure: bool = Field(False, description="fit each view's exposure too; later stages see the views without it")
    flow_cell: int = Field(0, ge=0, description="start also from a flow point per cell of so many px a side; 0: none")
    start_opacity: float = Field(0.1, gt=0, lt=1, description="of the Gaussians at the points")
    start_size: float = Field(1.0, gt=0, description="their deviation over the way to the next points (3DGS: 1)")
    pixels: Literal["all", "unmasked"] = Field(
        "all", description="those that supervise; unmasked, a baseline: masked pixels are never looked at (Masked NeRF)"
    )
    holdout: int = Field(0, ge=0, description="every so manieth training view is only measured; 0 = none")
    device: Literal["cpu", "cuda"] = Field("cpu", description="where to compute")


def preview(params: Params, *, poses: Path) -> list[str]:
    given = poses is not None and (poses / "gaussians.ply").exists() and params.pixels == "all"
    return ["takes over the scene's gaussians.ply: no optimisation"] if given else []


def run(params: Params, out: Path, *, poses: Path) -> None:
    import time
    from dataclasses import replace

    from reffusion import trace
    from reffusion.fit.reconstruction import fit
    from reffusion.io.ply import load_ply, save_ply
    from reffusion.io.scene import load_scene, load_views
    from reffusion.paint import paint2d

    if (poses / "gaussians.ply").exists() and params.pixels == "all":
        save_ply(out / "gaussians.ply", load_ply(poses / "gaussians.ply"))
        return
    began, scene = time.monotonic(), load_scene(poses)
    params = supported(params, scene)
    held_out = scene.train[params.holdout // 2 :: params.holdout] if params.holdout else ()
    cameras = [scene.cameras[name] for name in scene.train if name not in held_out]
    images, chosen = load_views(poses, scene.train), settings(params, cameras)
    hidden = hidden_pixels(poses, scene) if params.pixels == "unmasked" else {}
    images |= {name: paint2d.telea(images[name], mask) for name, mask in hidden.items()}  # flow looks at them too
    if (out / trace.CHECKPOINT).exists():  # of what it starts from only the degree and the device still matter
        points, colors = scene.points, scene.point_colors
    else:
        points, colors = start_points(params, scene, cameras, images, hidden)
    views = (cameras, images, start(params, points, colors, chosen.budget))
    spent, weights = (
        lambda: time.monotonic() - began,
        {name: (~mask).astype("float32") for name, mask in hidden.items()},
    )
    tried = lambda folder, steps: fit(*views, replace(chosen, iterations=steps), folder=folder, weights=weights)
    steps = trace.affordable(out, params.iterations, params.seconds, spent, tried)
    gaussians = fit(
        *views,
        replace(chosen, iterations=steps),
        folder=out,
        weights=weights,
        held_out=[scene.cameras[name] for name in held_out],
        spent=spent(),
    )
    save_ply(out / "gaussians.ply", gaussians.map(lambda p: p.cpu()))
    trace.clear_checkpoint(out)


def supported(params: Params, scene: Scene) -> Params:
    """The parameters with no higher degree of spherical harmonics than the training views determine."""
    from reffusion.capture import support

    if not params.sh_supported:
        return params
    degree, views = support.harmonics(scene.points, [scene.cameras[name] for name in scene.train], params.sh_degree)
    if degree < params.sh_degree:
        print(f"spherical harmonics of degree {degree}: a typical point is in {views} views", flush=True)
    return params.model_copy(update={"sh_degree": degree})


def hidden_pixels(poses: Path, scene: Scene) -> dict[str, np.ndarray]:
    """View name -> bool [H, W], its raw mask; none for a view without one, or one marked clean."""
    from reffusion.io.scene import load_raw_masks

    masks = load_raw_masks(poses, [name for name in scene.train if name not in scene.clean])
    if not masks:
        raise ValueError(f"{poses / 'masks'}: fit.pixels is 'unmasked', but the scene has no masks")
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
    import numpy as np

    from reffusion.capture import stereo
    from reffusion.masks import voting

    points, colors = scene.points, scene.point_colors
    if params.flow_cell:
        found, found_colors = stereo.dense_points(cameras, images, params.flow_cell)
        print(f"{len(found)} points by optical flow beside {len(points)}", flush=True)
        points, colors = np.concatenate([points, found]), np.concatenate([colors, found_colors])
    keep = ~voting.points_inside(points, cameras, hidden)
    return points[keep], colors[keep]


def start(params: Params, points: np.ndarray, colors: np.ndarray, budget: int) -> Gaussians:
    """The Gaussians to start from, on the device to compute on."""
    from dataclasses import replace

    from reffusion import seeding
    from reffusion.fit.start import initial_gaussians

    noise = seeding.generator(params.seed, "start")
    first = initial_gaussians(points, colors, params.sh_degree, budget, noise, params.start_opacity, params.start_size)
    return replace(first.map(lambda p: p.to(params.device)), antialiased=params.antialiased)


def settings(params: Params, cameras: list):
    """The fit's settings for these views: a larger picture has room for more Gaussians."""
    from dataclasses import fields

    from reffusion.fit.step import Settings
    from reffusion.gaussians.optimize import Rates

    shared = {f.name: getattr(params, f.name) for f in fields(Settings) if f.name not in ("rates", "budget")}
    pixels = sum(camera.width * camera.height for camera in cameras) / len(cameras)
    most = max(4, round(params.per_pixel * pixels)) if params.per_pixel else params.budget
    rates = Rates(
        means=params.means_rate,
        means_last=params.means_rate / 100,
        quaternions=params.rotations_rate,
        log_scales=params.scales_rate,
        opacity_logits=params.opacity_rate,
        sh_dc=params.color_rate,
        sh_rest=params.sh_rate,
    )
    return Settings(**shared, budget=min(params.budget, most), rates=rates)

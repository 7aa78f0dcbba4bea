"""Parameters of the stage `fit`. Moments are parts of the run in [0, 1]; 3DGS's values unless said otherwise.

PAPER leaves open: 3DGS measures Gaussians by the extent of the cameras, and so, in a street, prunes what is far away
and large. Here sizes are standard deviations divided by the distance to the nearest camera.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from reffusion.params.base import (
    Decay,
    Device,
    MeansUnit,
    Settings,
    checkpoint_field,
    means_unit_field,
    seconds_field,
)


class SphericalHarmonics(Settings):
    degree: int = Field(3, ge=0, le=3, description="highest degree")
    every: float = Field(1 / 30, ge=0, le=1, description="part of the run after which one more degree joins")


class Init(Settings):
    """The Gaussians a fit starts from: one at each point."""

    flow_cell: int = Field(0, ge=0, description="start also from a flow point per cell of so many px a side; 0: none")
    opacity: float = Field(0.1, gt=0, lt=1, description="of the Gaussians at the points")
    scale: float = Field(1.0, gt=0, description="their deviation over the way to the next points (3DGS: 1)")


class Densify(Settings):
    start: float = Field(1 / 60, ge=0, le=1, description="part of the run before the first densification")
    stop: float = Field(0.5, ge=0, le=1, description="part of the run after which no Gaussian is added")
    every: int = Field(100, ge=1, description="steps from one densification to the next")
    grow_grad2d: float = Field(2e-4, gt=0, description="screen-space gradient that clones or splits; images: [-1, 1]")
    cap_max: int = Field(
        1_000_000,
        ge=4,
        description="most Gaussians, reached at `stop`: the number allowed grows evenly from that of the start, so "
        "that some are left for where late views still pull",
    )
    per_pixel: float = Field(0.0, ge=0, description="most Gaussians for each pixel of a view; 0: `cap_max` alone")
    prune_scale3d: float = Field(0.5, gt=0, description="Gaussians of a larger size are pruned; deviation / distance")
    reset_every: float = Field(0.1, ge=0, le=1, description="part of the run between opacity resets; 0 = none")


class LearningRates(Settings):
    """Adam's step sizes, for the normalised frame, in which cameras stand about 1 from the scene."""

    means: float = Field(1.6e-4, gt=0, description="first step size of positions; the last is a hundredth of it")
    means_unit: MeansUnit = means_unit_field()
    scales: float = Field(5e-3, gt=0, description="of log scales")
    quats: float = Field(1e-3, gt=0, description="of quaternions")
    sh0: float = Field(2.5e-3, gt=0, description="of the constant spherical harmonic")
    shN: float = Field(2.5e-3 / 20, gt=0, description="of the others")
    betas: tuple[Decay, Decay] = Field(
        (0.9, 0.999), description="Adam's memory of gradients and of their squares; a short run is better off with less"
    )


class Params(Settings):
    iterations: int = Field(30_000, ge=1, description="optimisation steps, one view each (3DGS: 30000)")
    sh: SphericalHarmonics = SphericalHarmonics()
    init: Init = Init()
    densify: Densify = Densify()
    lr: LearningRates = LearningRates()
    # PAPER leaves open: 3DGS takes black by default. Dark texture is then drawn by leaving holes, which the stages
    # after this one would read as places that no Gaussian explains.
    random_background: bool = Field(True, description="a new background colour each step, instead of black")
    antialiased: bool = Field(False, description="a Gaussian adds up to the same from any distance (Mip-Splatting)")
    exposure: Literal["never", "auto", "always"] = Field(
        "never",
        description="fit each view's exposure too; later stages see the views without it; auto: where the photographs "
        "of the same points differ in brightness",
    )
    few_views: Literal["as_many", "fewer_harmonics", "surfaces"] = Field(
        "fewer_harmonics",
        description="what views too few for it change: nothing; no degree of spherical harmonics that they do not "
        "determine; that, and, of at most 8 views, a start on surfaces between the sparse points",
    )
    pixels: Literal["all", "unmasked"] = Field(
        "all", description="those that supervise; unmasked, a baseline: masked pixels are never looked at (Masked NeRF)"
    )
    holdout: int = Field(0, ge=0, description="every so manieth training view is only measured; 0 = none")
    seed: int = Field(0, description="of the order of views, backgrounds and splits")
    device: Device = Field("cpu", description="where to compute")
    seconds: float = seconds_field()
    checkpoint_seconds: float = checkpoint_field()

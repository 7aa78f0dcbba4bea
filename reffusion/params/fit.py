"""Parameters of the stage `fit`.

Times are fractions of the run in [0, 1]. Default values are those of 3DGS unless a description says otherwise.

3DGS measures the size of Gaussians by the extent of the cameras, and so prunes large distant Gaussians, for example in
a street. By default the size of a Gaussian here is its standard deviation divided by its distance from the nearest
camera.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from reffusion.params.base import Decay, Device, MeansUnit, Settings, checkpoint_field, means_unit_field, seconds_field


class SphericalHarmonics(Settings):
    degree: int = Field(3, ge=0, le=3, description="highest degree")
    every: float = Field(1 / 30, ge=0, le=1, description="fraction of the run after which the degree increases by one")


class Init(Settings):
    """Settings of the initial Gaussians, one at each sparse point and at each added point."""

    flow_cell: int = Field(
        0,
        ge=0,
        description="cell size in px; adds a point from optical flow per cell, more where a view shows none; 0: none",
    )
    opacity: float = Field(0.1, gt=0, lt=1, description="opacity of the initial Gaussians")
    scale: float = Field(1.0, gt=0, description="their standard deviation / distance to the nearest points (3DGS: 1)")


class Densify(Settings):
    start: float = Field(1 / 60, ge=0, le=1, description="fraction of the run before the first densification")
    stop: float = Field(0.5, ge=0, le=1, description="fraction of the run after which no Gaussian is added")
    every: int = Field(100, ge=1, description="steps from one densification to the next")
    grow_grad2d: float = Field(
        2e-4, gt=0, description="screen-space gradient for cloning or splitting, image in [-1, 1]"
    )
    cap_max: int = Field(1_000_000, ge=4, description="maximum number of Gaussians")
    cap_growth: Literal["linear", "immediate"] = Field(
        "linear",
        description="the maximum grows linearly from the initial number to `cap_max` at `stop`, so that late "
        "densifications can still add Gaussians; or it is `cap_max` from the start (3DGS)",
    )
    per_pixel: float = Field(
        0.0,
        ge=0,
        description="maximum number of Gaussians per pixel of a view, with 30 views or more; 0: `cap_max` only",
    )
    size_unit: MeansUnit = Field(
        "distance", description="unit of a Gaussian's size: its distance, or the cameras' extent (3DGS)"
    )
    prune_scale3d: float = Field(
        0.5, gt=0, description="size (standard deviation) above which Gaussians are pruned, once opacities were reset"
    )
    reset_every: float = Field(0.1, ge=0, le=1, description="fraction of the run between opacity resets; 0 = none")


class LearningRates(Settings):
    """Adam's learning rates. They suit the normalized frame, in which cameras are about 1 from the scene."""

    means: float = Field(1.6e-4, gt=0, description="initial learning rate of positions; the final one is 1/100 of it")
    means_unit: MeansUnit = means_unit_field()
    scales: float = Field(5e-3, gt=0, description="learning rate of log scales")
    quats: float = Field(1e-3, gt=0, description="learning rate of quaternions")
    sh0: float = Field(2.5e-3, gt=0, description="learning rate of the constant spherical harmonic")
    shN: float = Field(2.5e-3 / 20, gt=0, description="learning rate of the other harmonics")
    betas: tuple[Decay, Decay] = Field(
        (0.9, 0.999), description="Adam's decay rates of the gradient and of its square; short runs need smaller ones"
    )


class Params(Settings):
    iterations: int = Field(30_000, ge=1, description="optimization steps, one view each (3DGS: 30000)")
    sh: SphericalHarmonics = SphericalHarmonics()
    init: Init = Init()
    densify: Densify = Densify()
    lr: LearningRates = LearningRates()
    # PAPER leaves open: the background color; the default of 3DGS is black. On black, a fit can represent dark texture
    # by holes, which later stages would take for places without a surface.
    random_background: bool = Field(True, description="a random background color in each step instead of black")
    antialiased: bool = Field(False, description="2D filter of Mip-Splatting: same total opacity at any distance")
    exposure: Literal["never", "auto", "always"] = Field(
        "never",
        description="fit the exposure of each view; later stages use the views without it; auto: if the brightness of "
        "the same points differs between photographs",
    )
    few_views: Literal["as_many", "fewer_harmonics", "surfaces"] = Field(
        "fewer_harmonics",
        description="adaptation to few views: none; limit the degree of spherical harmonics to what they determine; or "
        "also, with at most 8 views, start on surfaces between the sparse points",
    )
    pixels: Literal["all", "unmasked"] = Field(
        "all", description="pixels that supervise; unmasked is a baseline that ignores masked pixels (Masked NeRF)"
    )
    holdout: int = Field(0, ge=0, description="use every n-th training view only for evaluation; 0 = none")
    seed: int = Field(0, description="seed of the order of views, backgrounds and splits")
    device: Device = Field("cpu", description="where to compute")
    seconds: float = seconds_field()
    checkpoint_seconds: float = checkpoint_field()

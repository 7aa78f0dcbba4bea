"""Parameters of the stage `distill` (RefFusion section 4)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from reffusion.params.base import (
    Device,
    Dtype,
    MeansUnit,
    Settings,
    checkpoint_field,
    depth_model_field,
    means_unit_field,
    memory_field,
    prior_field,
    seconds_field,
)


class Sds(Settings):
    """Multi-scale score distillation (section 4.2)."""

    weight: float = Field(1e-3, ge=0, description="lambda of the SDS term; 0 leaves it out")
    # The paper always distils. What it could gain at most is told by `initialize`: reffusion.initialize.sds_gain.
    run: Literal["auto", "always", "never"] = Field(
        "always", description="auto: where the initialization is not yet better than what the embedded prior paints"
    )
    patches: int = Field(2, ge=0, description="local patches beside the whole view; 0 leaves the local term out")
    # The paper confines it to masked ones. Background that was seen through the hole wears the object's tint.
    reaches: Literal["masked", "all"] = Field("masked", description="Gaussians it moves; all: all that show there")
    # The paper distils every view. What a small prior knows of a place ends not far from the picture it learnt it by.
    within: float = Field(
        180, gt=0, le=180, description="degrees between a view and the nearest reference up to which it is distilled"
    )
    # PAPER leaves open: timesteps, w(t), normalisation, guidance, reduction: see `distill.sds`. threestudio's here.
    t_high: float = Field(0.98, ge=0, le=1, description="highest timestep")
    weighting: Literal["x0", "sigma2", "one"] = Field("sigma2", description="w(t) of the SDS gradient")
    hole_only: bool = Field(False, description="drop the gradient at latents that are not repainted")
    # Not in the paper: a small prior's answers are paler than what they stand for, and fade a render that was right.
    keep_contrast: bool = Field(False, description="the prior's answer does not lower the hole's contrast")
    guidance: float = Field(7.5, ge=0, description="the paper's a; libraries' guidance scale is 1 + a")
    reduction: Literal["sum", "mean"] = Field("sum", description="over a latent's elements")


class Depth(Settings):
    """Depth regularization."""

    weight: float = Field(0.0625, ge=0, description="lambda of the depth term; 0 leaves it out")
    every: int = Field(8, ge=1, description="steps between two with a depth term")
    # PAPER leaves open: the depth model, and the sampler's steps.
    model: str | None = depth_model_field()
    steps: int = Field(20, ge=1, description="sampler steps from pure noise; a later start takes its share")


class Adversarial(Settings):
    """The critic, and the term by which the scene is to pass it (section 4.3, GANeRF)."""

    weight: float = Field(0.03, ge=0, description="lambda of the adversarial term; 0 leaves it out")
    patches: int = Field(64, ge=4, multiple_of=4, description="real patches in a step, and fake ones")
    size: Literal[8, 16, 32, 64, 128, 256] = Field(64, description="their side, px")
    # PAPER leaves open: the critic's width and its step size; GANeRF's.
    width: int = Field(256, ge=1, description="the critic's channels at that side, doubled up to 512")
    # The paper prints the saturating form; GANeRF's code has this one, which pulls where the critic is sure.
    form: Literal["non-saturating", "saturating"] = Field("non-saturating", description="generator's loss")
    # PAPER leaves open: the weight, GANeRF's here. The paper prints the slope at the fake patches, GANeRF at the real.
    penalty: float = Field(0.2, ge=0, description="weight of half the squared slope of the critic (R1)")
    penalized: Literal["real", "fake"] = Field("fake", description="the patches where that slope is taken")


class Reconstruction(Settings):
    every: int = Field(1, ge=0, description="steps between two with a reconstruction term; 0: never")
    # PAPER leaves open: what happens at the rim, where masked and unmasked Gaussians are blended into the same pixels.
    # Its text confines reconstruction to unmasked ones; yet a photograph is true wherever new footprints reach as well.
    reaches: Literal["unmasked", "shown"] = Field(
        "unmasked", description="Gaussians that photographs move: unmasked ones, or all that show outside the mask"
    )


class Reference(Settings):
    """The reference's own pixels in its hole: not in the paper."""

    weight: float = Field(0.0, ge=0, description="weight of the reference's pixels in its hole (paper: 0)")
    reaches: Literal["masked", "all"] = Field(
        "masked", description="Gaussians that these pixels move: masked ones, or all that show in the hole"
    )


class Lift(Settings):
    """The terms of the baselines that carry pictures inpainted in 2D into the scene: not in the paper's method."""

    weight: float = Field(0.0, ge=0, description="weight of the pictures of the stage lift; 0 leaves it out")
    loss: Literal["mse", "perceptual"] = Field("mse", description="squared error (NeRF-In), or patches (SPIn-NeRF)")
    patch: int = Field(64, ge=16, description="side of such a patch, px")


class LearningRates(Settings):
    """PAPER leaves open: Adam's step sizes here; 3DGS's. Those of unmasked Gaussians are left alone: what the object's
    blurred rim had tinted is put right by the reconstruction term."""

    masked: float = Field(1.0, gt=0, description="factor on 3DGS's step sizes of masked Gaussians")
    means_unit: MeansUnit = means_unit_field()
    opacities: float = Field(1.0, ge=0, description="further factor on the opacities'")
    shape: float = Field(1.0, ge=0, description="further factor on those of means, scales and rotations")
    # PAPER leaves open: Adam's epsilon; 3DGS's 1e-15. The gradient of a mean over an image's pixels is about 1e-6. At
    # 1e-15 a Gaussian that hardly anything but SDS reaches takes full steps, however small lambda is.
    epsilon: float = Field(1e-15, gt=0, description="gradients far below it do not move a Gaussian")


class Densify(Settings):
    """PAPER leaves open: how densification changes. Among masked Gaussians those pulled hardest on the screen are
    cloned or split, a share of them, for the SDS gradient has no scale a threshold could refer to."""

    every: int = Field(0, ge=0, description="steps between densifications of masked Gaussians; 0: never")
    stop: float = Field(0.5, ge=0, le=1, description="part of the run after which no Gaussian is added")


class Params(Settings):
    prior: str = prior_field()
    # PAPER leaves open: the number of iterations; 3DGS's own, less the fit's, is of this size.
    iterations: int = Field(5000, ge=1, description="optimisation steps")
    sds: Sds = Sds()
    depth: Depth = Depth()
    adversarial: Adversarial = Adversarial()
    reconstruction: Reconstruction = Reconstruction()
    reference: Reference = Reference()
    lift: Lift = Lift()
    lr: LearningRates = LearningRates()
    densify: Densify = Densify()
    # PAPER leaves open: which mask m is. Its text repaints the consistent mask; the invent mask keeps true background.
    repaint: Literal["invent", "consistent"] = Field("invent", description="the pixels the UNet repaints")
    # PAPER leaves open: the prompt of a prior that was not adapted. "sks" was taught to none, but may mean something.
    prompts: Literal["sks", "empty"] = Field(
        "sks",
        description="what the prior is told of a view: the prompts it is adapted with, or nothing, and then guidance, "
        "which strengthens what a prompt adds, changes nothing",
    )
    confined: bool = Field(
        True,
        description="each term reaches its own Gaussians; false (an ablation): all of them, and none is pruned for "
        "changing region",
    )
    seed: int = Field(0, description="of views, windows, timesteps, noise, splits and the critic's first weights")
    device: Device = "cpu"
    dtype: Dtype = Field("float32", description="of the prior's weights")
    memory_gb: float = memory_field()
    checkpointing: bool = Field(False, description="compute activations again on the way back: less memory, more time")
    seconds: float = seconds_field()
    checkpoint_seconds: float = checkpoint_field()

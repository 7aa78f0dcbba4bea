"""Parameters of the stage `distill` (RefFusion section 4)."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from reffusion.params.base import (
    Device,
    Dtype,
    MeansUnit,
    Prompts,
    Settings,
    checkpoint_field,
    depth_model_field,
    means_unit_field,
    memory_field,
    prior_field,
    seconds_field,
)


class SdsTerm(Settings):
    """Settings of multi-scale score distillation, SDS (paper, section 4.2)."""

    weight: float = Field(1e-3, ge=0, description="lambda of the SDS term; 0 leaves it out")
    # The paper always distils. The embedded prior improves no initialization (docs/results.md#score-distillation).
    run: Literal["always", "never"] = Field("always", description="whether SDS runs")
    patches: int = Field(2, ge=0, description="local patches beside the whole view; 0 leaves the local term out")
    # The paper confines SDS to masked Gaussians. The background around the hole may still be tinted by the object.
    reaches: Literal["masked", "all"] = Field(
        "masked", description="Gaussians that SDS moves: masked ones, or all that show in the view"
    )
    # The paper distills every view. A small prior knows little of views that are far from the reference it learnt.
    max_angle: float = Field(
        180, gt=0, le=180, description="degrees; views farther than this from every reference are not distilled"
    )
    # PAPER leaves open: timesteps, w(t), normalization, guidance, reduction (see `distill.sds`). The values are those
    # of threestudio, except guidance, which is RealFill's: a scale of 100 suits a prior that was not adapted.
    t_high: float = Field(0.98, ge=0, le=1, description="highest timestep")
    # Not in the paper: high timesteps decide the layout, which is settled first.
    t_high_last: float | None = Field(
        None, ge=0, le=1, description="highest timestep in the second half of the run; it falls linearly until then"
    )
    weighting: Literal["sigma2", "alpha_sigma2", "x0", "one"] = Field(
        "sigma2", description="w(t) of the SDS gradient, see `distill.sds.sds_gradient`"
    )
    hole_only: bool = Field(False, description="drop the gradient at latents that are not repainted")
    # Not in the paper: the predictions of a small prior have too little contrast, and fade a correct rendering.
    keep_contrast: bool = Field(False, description="raise the prediction's contrast to that of the rendered hole")
    guidance: float = Field(4.0, ge=0, description="γ of (1 + γ) ε(cond) - γ ε(empty); libraries' scale is 1 + γ")
    reduction: Literal["sum", "mean"] = Field("sum", description="over a latent's elements")

    @property
    def is_on(self) -> bool:
        """Whether SDS runs: its weight is positive and `run` is not "never"."""
        return self.weight > 0 and self.run != "never"


class DepthTerm(Settings):
    """Settings of the depth term (paper, section 4.3): rendered depth follows the depth of a repainted view."""

    weight: float = Field(0.0625, ge=0, description="lambda of the depth term; 0 leaves it out")
    every: int = Field(8, ge=1, description="steps between two evaluations of the depth term")
    # PAPER leaves open: the depth model, the unit of depth, and the sampler's steps.
    model: str | None = depth_model_field()
    unit: float = Field(1, gt=0, description="the depth that counts as 1 in the loss, in the normalized frame's unit")
    steps: int = Field(20, ge=1, description="sampler steps from pure noise; a later start takes proportionally fewer")


class AdversarialTerm(Settings):
    """Settings of the adversarial term and its critic (paper, section 4.3, after GANeRF).

    The critic tells patches of the reference ("real") from rendered patches ("fake"). The term changes the Gaussians so
    that the critic takes rendered patches for real ones.
    """

    weight: float = Field(0.03, ge=0, description="lambda of the adversarial term; 0 leaves it out")
    # PAPER leaves open: its "all spherical harmonics" may mean all coefficients of masked Gaussians, or those of all
    # Gaussians. The latter can remove the color differences at the mask's border that the section describes.
    reaches: Literal["masked", "all"] = Field(
        "all", description="Gaussians whose spherical harmonics the term moves: masked ones, or all in its patches"
    )
    patches: int = Field(64, ge=4, multiple_of=4, description="real patches in a step, and as many fake ones")
    size: Literal[8, 16, 32, 64, 128, 256] = Field(64, description="side of a patch, px")
    # PAPER leaves open: the critic's width and its step size. Both are GANeRF's.
    width: int = Field(
        256, ge=1, description="the critic's channels at that side; doubled with each halving, up to 512"
    )
    # Not as printed: the paper prints the saturating form and says that it follows GANeRF, whose code has the
    # non-saturating form. The gradient of the saturating form vanishes where the critic is certain.
    form: Literal["non-saturating", "saturating"] = Field("non-saturating", description="form of the generator's loss")
    # PAPER leaves open: the weight, which is GANeRF's. The paper prints fake patches; GANeRF's code takes real ones,
    # for which R1 is defined.
    penalty: float = Field(0.2, ge=0, description="weight of half the squared gradient norm of the critic (R1)")
    penalized: Literal["real", "fake"] = Field("real", description="the patches at which that gradient is taken")


class ReconstructionTerm(Settings):
    """Settings of the photometric loss against the photographs, outside the mask."""

    every: int = Field(1, ge=0, description="steps between two evaluations of the reconstruction term; 0: never")
    # PAPER leaves open: the rim, where masked and unmasked Gaussians are blended into the same pixels. Its text
    # confines reconstruction to unmasked Gaussians, but photographs are also true where masked ones reach beyond the
    # mask. ("Masked" Gaussians are those that `initialize` added.)
    reaches: Literal["unmasked", "shown"] = Field(
        "unmasked", description="Gaussians that photographs move: unmasked ones, or all that show outside the mask"
    )


class ReferenceTerm(Settings):
    """Settings of the loss against the reference's own pixels in its hole. Not in the paper."""

    weight: float = Field(0.0, ge=0, description="weight of the reference's pixels in its hole (paper: 0)")
    reaches: Literal["masked", "all"] = Field(
        "masked", description="Gaussians that the reference moves: masked ones, or all that show in its hole"
    )


class LiftTerm(Settings):
    """Settings of the loss against views inpainted in 2D by the stage `lift`. For baselines; not in the paper."""

    weight: float = Field(0.0, ge=0, description="weight of the images of the stage lift; 0 leaves the term out")
    loss: Literal["mse", "perceptual"] = Field(
        "mse", description="squared error (NeRF-In), or perceptual distance of patches (SPIn-NeRF)"
    )
    patch: ClassVar[int] = 64  # side of a patch for the perceptual loss, px: that of the adversarial term


class LearningRates(Settings):
    """Settings of Adam in distillation: factors on the step sizes of 3DGS, the unit of position steps, and epsilon.

    The factors `masked`, `opacities` and `shape` apply to masked Gaussians (those that `initialize` added) only.
    Unmasked Gaussians keep the step sizes of 3DGS, because the reconstruction term has to correct the Gaussians that
    the object's blurred rim had tinted. `means_unit` and `epsilon` apply to all Gaussians.

    PAPER leaves open: Adam's step sizes in distillation. They are those of 3DGS, times these factors.
    """

    masked: float = Field(1.0, gt=0, description="factor on 3DGS's step sizes of masked Gaussians")
    means_unit: MeansUnit = means_unit_field()
    opacities: float = Field(1.0, ge=0, description="further factor on the step sizes of opacities")
    shape: float = Field(1.0, ge=0, description="further factor on the step sizes of means, scales and rotations")
    # PAPER leaves open: Adam's epsilon. It is 3DGS's, 1e-15. The gradient of a mean over an image's pixels is about
    # 1e-6. With an epsilon of 1e-15 a Gaussian that gets its gradient almost only from SDS takes full steps, however
    # small lambda is.
    epsilon: float = Field(1e-15, gt=0, description="Adam's epsilon: much smaller gradients do not move a Gaussian")


class Densify(Settings):
    """Settings of the densification of masked Gaussians (those that `initialize` added).

    PAPER leaves open: how densification changes, so that the gradients of SDS do not add too many Gaussians. Here the
    threshold is higher than that of 3DGS, and the number of masked Gaussians is bounded, because the gradient of SDS
    has no fixed scale.
    """

    every: int = Field(0, ge=0, description="steps between densifications of masked Gaussians; 0: never")
    grow_grad2d: float = Field(
        1e-3, gt=0, description="screen-space gradient for cloning or splitting, image in [-1, 1]; 3DGS: 2e-4"
    )
    max_growth: float = Field(
        1.5, ge=1, description="largest number of masked Gaussians, relative to that at the start"
    )


class Params(Settings):
    prior: str = prior_field()
    prompts: Prompts = Prompts()  # as in `personalize`, which teaches the prior what they mean
    # PAPER leaves open: the number of iterations; 3DGS's own, less the fit's, is of this size.
    iterations: int = Field(5000, ge=1, description="optimization steps")
    sds: SdsTerm = SdsTerm()
    depth: DepthTerm = DepthTerm()
    adversarial: AdversarialTerm = AdversarialTerm()
    reconstruction: ReconstructionTerm = ReconstructionTerm()
    reference: ReferenceTerm = ReferenceTerm()
    lift: LiftTerm = LiftTerm()
    lr: LearningRates = LearningRates()
    densify: Densify = Densify()
    # PAPER leaves open: which mask m is. Its text repaints the consistent mask. Repainting only the invent mask keeps
    # the background that other views see.
    repaint: Literal["invent", "consistent"] = Field("invent", description="the pixels the UNet repaints")
    confined: bool = Field(
        True,
        description="each term reaches its own Gaussians; false (an ablation): every term reaches all, and none is "
        "pruned for changing region",
    )
    seed: int = Field(0, description="of views, windows, timesteps, noise, splits and the critic's first weights")
    device: Device = "cpu"
    dtype: Dtype = Field("float32", description="of the prior's weights")
    memory_gb: float = memory_field()
    checkpointing: bool = Field(False, description="recompute activations in the backward pass: less memory, more time")
    seconds: float = seconds_field()
    checkpoint_seconds: float = checkpoint_field()

    @property
    def needs_prior(self) -> bool:
        """Whether a loss term uses the diffusion prior: SDS or the depth term."""
        return self.sds.is_on or self.depth.weight > 0

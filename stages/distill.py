"""distill: reconstruction, multi-scale score distillation and a critic, each confined (RefFusion section 4)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class Params(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    prior: str = Field(
        "sd2-community/stable-diffusion-2-inpainting",
        description="inpainting prior: a diffusers folder, or the name of one on the hub",
        json_schema_extra={"weights": True},
    )
    # PAPER leaves open: the number of iterations; 3DGS's own, less the fit's, is of this size.
    iterations: int = Field(5000, ge=1, description="optimisation steps")
    sds_weight: float = Field(1e-3, ge=0, description="lambda of the SDS term; 0 leaves it out")
    # The paper confines it to masked ones. Background that was seen through the hole wears the object's tint.
    sds_reaches: Literal["masked", "all"] = Field("masked", description="Gaussians it moves; all: all that show there")
    # The paper distils every view. What a small prior knows of a place ends not far from the picture it learnt it by.
    sds_within: float = Field(
        180, gt=0, le=180, description="degrees between a view and the nearest reference up to which it is distilled"
    )
    patches: int = Field(2, ge=0, description="local patches beside the whole view")
    # PAPER leaves open: timesteps, w(t), normalisation, guidance, reduction: see distill.sds. threestudio's here.
    t_low: float = Field(0.02, ge=0, le=1, description="lowest timestep, as a part of the schedule")
    t_high: float = Field(0.98, ge=0, le=1, description="highest timestep")
    weighting: Literal["x0", "sigma2", "one"] = Field("sigma2", description="w(t) of the SDS gradient")
    unit_rms: bool = Field(False, description="divide each sample's gradient by its root mean square")
    hole_only: bool = Field(False, description="drop the gradient at latents that are not repainted")
    # Not in the paper: a small prior's answers are paler than what they stand for, and fade a render that was right.
    keep_contrast: bool = Field(False, description="the prior's answer does not lower the hole's contrast")
    guidance: float = Field(7.5, ge=0, description="the paper's a; libraries' guidance scale is 1 + a")
    reduction: Literal["sum", "mean"] = Field("sum", description="over a latent's elements")
    # PAPER leaves open: which mask m is. Its text repaints the consistent mask; the invent mask keeps true background.
    repaint: Literal["invent", "consistent"] = Field("invent", description="the pixels the UNet repaints")
    depth_weight: float = Field(0.0625, ge=0, description="lambda of the depth term; 0 leaves it out")
    depth_every: int = Field(8, ge=1, description="steps between two with a depth term")
    # PAPER leaves open: the depth model, and whether its alignment is plain or robust.
    depth_model: str | None = Field(
        None,
        description="depth model: a transformers folder, or the name of one on the hub; none: the scene's own depth "
        "around the hole is continued",
        json_schema_extra={"weights": True},
    )
    depth_align: Literal["l2", "robust"] = Field("l2", description="fit of its scale and offset on known pixels")
    # PAPER leaves open: the range of the "random timestep", the sampler's steps, the size that is painted. Its prior's
    # 512 px are all that a depth model sees of a view.
    depth_t_low: float = Field(0.02, gt=0, le=1, description="lowest timestep from which the view is repainted")
    depth_t_high: float = Field(0.98, gt=0, le=1, description="highest")
    depth_steps: int = Field(20, ge=1, description="sampler steps from pure noise; a later start takes its share")
    depth_levels: int = Field(0, ge=0, description="sizes painted after the prior's native one, each twice the last")
    adversarial_weight: float = Field(0.03, ge=0, description="lambda of the adversarial term; 0 leaves it out")
    # PAPER leaves open: when it starts. At once: the paper trains with the sum of all terms.
    adversarial_from: float = Field(0.0, ge=0, le=1, description="part of the run after which it acts")
    adversarial_patches: int = Field(64, ge=4, multiple_of=4, description="real patches in a step, and fake ones")
    adversarial_size: Literal[8, 16, 32, 64, 128, 256] = Field(64, description="their side, px")
    # PAPER leaves open: the critic's width, StyleGAN2's here; its step size, GANeRF's.
    adversarial_width: int = Field(512, ge=1, description="the critic's channels at that side, doubled up to 512")
    adversarial_rate: float = Field(1e-3, gt=0, description="RMSprop's step size of the critic")
    # PAPER leaves open: the generator's form; this one pulls where the critic is sure.
    adversarial_form: Literal["non-saturating", "saturating"] = Field("non-saturating", description="generator's loss")
    # PAPER leaves open: the weight, GANeRF's here. The paper prints the slope at the fake patches, GANeRF at the real.
    adversarial_penalty: float = Field(0.2, ge=0, description="weight of half the squared slope of the critic (R1)")
    adversarial_penalized: Literal["real", "fake"] = Field("fake", description="the patches where that slope is taken")
    # PAPER leaves open: the paper's "all spherical harmonics" may mean all coefficients or those of all Gaussians.
    adversarial_reaches: Literal["masked", "all"] = Field("masked", description="the Gaussians whose colour it moves")
    reconstruction_every: int = Field(1, ge=0, description="steps between two with a reconstruction term; 0: never")
    reference_weight: float = Field(0.0, ge=0, description="weight of the reference's pixels in its hole (paper: 0)")
    reference_reaches: Literal["masked", "all"] = Field(
        "masked", description="Gaussians that these pixels move: masked ones, or all that show in the hole"
    )
    # Not in the paper's method: the terms of the baselines that carry pictures inpainted in 2D into the scene.
    lift_weight: float = Field(0.0, ge=0, description="weight of the pictures of the stage lift; 0 leaves it out")
    lift_loss: Literal["mse", "perceptual"] = Field(
        "mse", description="squared error (NeRF-In), or patches (SPIn-NeRF)"
    )
    lift_patch: int = Field(64, ge=16, description="side of such a patch, px")
    lpips_weights: str | None = Field(
        None, description="folder with LPIPS weights, see evaluate.lpips_weights", json_schema_extra={"weights": True}
    )
    # PAPER leaves open: what happens at the rim, where masked and unmasked Gaussians are blended into the same pixels.
    # Its text confines reconstruction to unmasked ones; yet a photograph is true wherever new footprints reach as well.
    reconstruction_reaches: Literal["unmasked", "shown"] = Field(
        "unmasked", description="Gaussians that photographs move: unmasked ones, or all that show outside the mask"
    )
    confined: bool = Field(True, description="each term reaches its own Gaussians; false (an ablation): all of them")
    # PAPER leaves open: Adam's step sizes here; 3DGS's. Those of unmasked Gaussians are left alone: what the object's
    # blurred rim had tinted is to be mended by the reconstruction term.
    rate: float = Field(1.0, gt=0, description="factor on 3DGS's step sizes of masked Gaussians")
    rate_opacity: float = Field(1.0, ge=0, description="further factor on the opacities'")
    rate_shape: float = Field(1.0, ge=0, description="further factor on those of means, scales and rotations")
    # PAPER leaves open: Adam's epsilon; 3DGS's 1e-15. The gradient of a mean over an image's pixels is about 1e-6.
    epsilon: float = Field(1e-15, gt=0, description="gradients far below it do not move a Gaussian")
    # PAPER leaves open: how densification changes. Among masked Gaussians those pulled hardest on the screen are
    # cloned or split, a share of them, for the SDS gradient has no scale a threshold could refer to.
    densify_every: int = Field(0, ge=0, description="steps between densifications of masked Gaussians; 0: never")
    densify_rule: Literal["share", "slope"] = Field("share", description="by share, or (3DGS's) by a threshold")
    densify_share: float = Field(0.05, gt=0, lt=1, description="share of the masked Gaussians chosen each time")
    densify_slope: float = Field(2e-4, ge=0, description="3DGS's threshold on the mean screen-space gradient")
    densify_until: float = Field(0.5, ge=0, le=1, description="part of the run after which no Gaussian is added")
    split_above: float = Field(0.01, gt=0, description="standard deviation from which a Gaussian is split, not cloned")
    budget: int = Field(2_000_000, ge=1, description="most Gaussians")
    least_opacity: float = Field(0.005, ge=0, lt=1, description="fainter ones are pruned when others are added")
    region_every: int = Field(50, ge=1, description="steps between prunings of Gaussians that changed region")
    stop_drop: float = Field(0.0, ge=0, description="dB the reference's PSNR may fall under its best; 0: no early stop")
    seconds: float = Field(0.0, ge=0, description="the stage's share of a time budget: as many steps as fit; 0: all")
    patience: int = Field(0, ge=0, description="stop after so many twentieths of the run without a gain; 0: never")
    stop_gain: float = Field(0.02, ge=0, description="dB of the trace's main quantity that count as a gain")
    seed: int = 0
    device: Literal["cpu", "cuda"] = "cpu"
    dtype: Literal["float32", "bfloat16", "float16"] = Field("float32", description="of the prior's weights")
    memory_gb: float = Field(0.0, ge=0, description="GB that the prior may take; batches are split to fit; 0: no limit")
    checkpointing: bool = Field(False, description="compute activations again on the way back: less memory, more time")
    checkpoint_seconds: float = Field(10.0, gt=0, description="seconds of work between checkpoints")


def needed_weights(params: Params, brings: frozenset[str]) -> list:
    """What must lie on this machine, and what of it does not; `brings`: the keys of scene.yaml."""
    from reffusion.weights import local

    found = [local.of_model(params.prior, params.dtype)] if params.sds_weight > 0 or params.depth_weight > 0 else []
    estimates = params.depth_weight > 0 and params.depth_model
    return found + ([local.of_model(params.depth_model, "float32")] if estimates else [])


def run(
    params: Params,
    out: Path,
    *,
    poses: Path,
    fit: Path,
    masks: Path,
    reference: Path,
    personalize: Path | None,
    initialize: Path,
    lift: Path | None = None,
) -> None:
    import time
    from dataclasses import replace

    began = time.monotonic()
    from reffusion import trace
    from reffusion.distill.optimization import distill
    from reffusion.io.arrays import load_json, save_json, save_labels
    from reffusion.io.ply import save_ply
    from reffusion.io.scene import load_scene
    from reffusion.prior import memory

    scene = load_scene(poses)
    initial, masked, holes = start(params, scene, reference, initialize)
    prior, text = adapted_prior(params, personalize)
    estimator = depth_estimator(params, scene.points) if params.depth_weight > 0 else None
    sights = load_sights(params, scene, poses, fit, masks, lift, initialize / "tainted")
    perceptual, lifting = lift_choices(params)
    if params.sds_weight > 0 and params.sds_within < 180:
        print(within(params, initial.means[masked], sights, holes), flush=True)
    with memory.blamed("distill.memory_gb", params.memory_gb):
        if prior is not None:
            prior = memory.fitted(prior, params.memory_gb, "distill.memory_gb", memory.encoding)
        chosen, given = settings(params, lifting), (initial, masked, sights, holes, prior, text)
        made = lambda folder, steps: distill(*given, replace(chosen, iterations=steps), folder, estimator)
        steps = trace.affordable(out, params.iterations, params.seconds, lambda: time.monotonic() - began, made)
        gaussians, masked = made(out, steps)
    save_ply(out / "gaussians.ply", gaussians.map(lambda p: p.cpu()))
    save_labels(out / "labels.npy", masked.cpu())
    painted = load_json(lift / "facts.json")["inpainter"] if lift else None
    save_json(out / "facts.json", {"inpainter": painted, "perceptual": perceptual})
    trace.clear_checkpoint(out)


def start(params: Params, scene, reference: Path, initialize: Path) -> tuple:
    """The initialization's Gaussians and labels, and (camera, image, hole) of each reference, on the device."""
    import torch

    from reffusion.io.arrays import load_labels
    from reffusion.io.ply import load_ply
    from reffusion.io.scene import load_references

    initial = load_ply(initialize / "gaussians.ply").map(lambda p: p.to(params.device))
    masked = load_labels(initialize / "labels.npy").to(params.device)
    place = lambda array: torch.from_numpy(array).to(params.device)
    holes = [(r.camera, place(r.image) / 255, place(r.mask)) for r in load_references(reference, scene)]
    return initial, masked, holes


def adapted_prior(params: Params, personalize: Path | None) -> tuple:
    """The prior with what it learnt, without its text encoder, and the prompts' embeddings; None, None if unused."""
    import torch

    from reffusion.prior import diffusion, lora
    from reffusion.prior.crops import PROMPTS
    from reffusion.prior.model import load_prior, recomputing, without_text

    if not (params.sds_weight > 0 or params.depth_weight > 0):
        return None, None
    prior = load_prior(params.prior, device=params.device, dtype=getattr(torch, params.dtype))
    prior = prior if personalize is None else lora.merged(prior, personalize)
    with torch.no_grad():
        text = diffusion.embed_text(prior, list(PROMPTS))
    prior = without_text(prior)
    return recomputing(prior) if params.checkpointing else prior, text


def load_sights(
    params: Params, scene, poses: Path, fit: Path, masks: Path, lift: Path | None = None, tainted: Path | None = None
) -> list:
    """The training views with the pixels that may supervise, those to repaint, and their pictures inpainted in 2D.

    `tainted`: a folder of masks, of pixels that the object had shadowed; they may not supervise.
    """
    import torch

    from reffusion.distill.confinement import Sight
    from reffusion.fit import exposure
    from reffusion.io.images import load_mask
    from reffusion.io.scene import load_mask_sets, load_views

    photos, sets = exposure.load_views(poses, fit, scene.train), load_mask_sets(masks, scene.train)
    place = lambda array: torch.from_numpy(array).to(params.device)
    painted = load_views(lift, [n for n in scene.train if (lift / "images" / f"{n}.png").exists()]) if lift else {}
    sights = []
    for name in scene.train:
        clean, pixels = name in scene.clean, sets[name]
        repaint = pixels.invent if params.repaint == "invent" else pixels.consistent
        # A view with nothing to invent shows the truth, or at least what other views saw: nothing is distilled there.
        repaint = repaint & pixels.invent.any() & (not clean)
        supervises = ~pixels.consistent | clean
        if tainted and (tainted / f"{name}.png").exists():
            supervises &= ~load_mask(tainted / f"{name}.png")
        lifted = place(painted[name]) / 255 if name in painted else None
        photo = place(photos[name]) / 255
        sights.append(Sight(scene.cameras[name], photo, place(supervises), place(repaint), clean, lifted))
    return sights


def within(params: Params, means, sights: list, holes: list) -> str:
    """How many of the views that could be distilled are."""
    from reffusion.distill.steps import near_a_reference

    painted = [sight for sight in sights if sight.repaint.any()]
    near = near_a_reference(painted, [camera for camera, _, _ in holes], means, params.sds_within)
    return f"SDS in {len(near)} of {len(painted)} views: those within {params.sds_within:g} degrees of a reference"


def lift_choices(params: Params) -> tuple:
    """The name of the perceptual distance, None where none is used; and the term's choices, None where it is left out.

    Raises ValueError where LPIPS weights are there but broken.
    """
    from reffusion.distill import perceptual
    from reffusion.distill.lift import Lift

    if not params.lift_weight:
        return None, None
    if params.lift_loss == "mse":
        return None, Lift(params.lift_weight)
    name, distance = perceptual.load(params.lpips_weights, params.device)
    print(f"perceptual distance: {name}", flush=True)
    return name, Lift(params.lift_weight, distance, params.lift_patch)


def settings(params: Params, lift=None):
    from dataclasses import fields

    from reffusion.distill.adversary import Adversarial
    from reffusion.distill.confinement import Distillation
    from reffusion.distill.optimization import Settings

    shape = params.rate * params.rate_shape
    pace = {"means": shape, "quaternions": shape, "log_scales": shape, "sh": params.rate}
    pace["opacity_logits"] = params.rate * params.rate_opacity
    given = ("rates", "masked_pace", "sds", "depth", "adversarial", "lift")
    shared = {f.name: getattr(params, f.name) for f in fields(Settings) if f.name not in given}
    sds = Distillation(
        params.patches,
        params.t_low,
        params.t_high,
        params.weighting,
        params.unit_rms,
        params.hole_only,
        params.keep_contrast,
        params.guidance,
        params.reduction,
    )
    adversarial = Adversarial(
        params.adversarial_weight,
        params.adversarial_from,
        params.adversarial_patches,
        params.adversarial_size,
        params.adversarial_width,
        params.adversarial_form,
        params.adversarial_penalty,
        params.adversarial_penalized,
        params.adversarial_rate,
        params.adversarial_reaches,
    )
    chosen = adversarial if params.adversarial_weight > 0 else None
    depth = depth_settings(params) if params.depth_weight > 0 else None
    return Settings(**shared, sds=sds, depth=depth, adversarial=chosen, lift=lift, masked_pace=pace)


def depth_settings(params: Params):
    from reffusion.depth.behind import Completion
    from reffusion.distill.depth_term import DepthRegularization

    return DepthRegularization(
        params.depth_weight,
        params.depth_every,
        params.depth_t_low,
        params.depth_t_high,
        params.depth_steps,
        params.depth_levels,
        guidance=params.guidance,
        how=Completion(robust=params.depth_align == "robust", seed=params.seed),
    )


def depth_estimator(params: Params, points):
    """The depth term's estimator: by a network where one is named, else the scene's own depth continued."""
    from functools import partial

    from reffusion.depth import monocular
    from reffusion.distill import depth_term

    how = depth_settings(params).how
    if not params.depth_model:
        return depth_term.by_continuation(points, how)
    network = monocular.load_network(params.depth_model, params.device)
    return depth_term.by_network(partial(monocular.disparity, network), how)

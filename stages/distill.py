"""The stage `distill`: the initialization is optimized by the loss of RefFusion, section 4.

Its main terms are reconstruction, score distillation (SDS), depth and a critic; see docs/method.md#distillation.
"""

from __future__ import annotations

import time
from pathlib import Path

from reffusion import trace
from reffusion.distill import depth_estimator, perceptual
from reffusion.distill.inputs import load_adapted_prior, load_initialization, load_train_views
from reffusion.distill.loop import distill
from reffusion.distill.terms.sds import describe_sds_views
from reffusion.distill.terms.term import TermInputs
from reffusion.io.arrays import load_json, save_json, save_labels
from reffusion.io.ply import save_ply
from reffusion.params.distill import Params
from reffusion.prior import memory
from reffusion.splat import rasterizer
from reffusion.workspace import Workspace

MEMORY_PARAM = "distill.memory_gb"  # the parameter that out-of-memory errors name


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
    """Run the stage: optimize the initialized Gaussians.

    Writes gaussians.ply, labels.npy (bool [N], True for the masked Gaussians, which `initialize` added), facts.json,
    trace.jsonl and snapshots/ (the masked Gaussians at some steps). An interrupted run resumes from the checkpoint in
    `out`.

    Args:
        out: folder of this stage.
        poses, fit, masks, reference, personalize, initialize, lift: folders of the stages of these names; `personalize`
            and `lift` are None if the stage was skipped.

    Raises:
        ValueError: the memory does not suffice; the message names the parameter to lower.
    """
    rasterizer.prepare(params.device)
    began = time.monotonic()
    space = Workspace(poses, fit, masks)  # on the CPU: it loads photographs and masks only
    initial, masked, references = load_initialization(params, space.scene, reference, initialize)
    prior, text = load_adapted_prior(params, personalize)
    estimator = depth_estimator.build_estimator(params, space.scene.points) if params.depth.weight > 0 else None
    views = load_train_views(params, space, initialize, lift)
    has_distance = params.lift.weight > 0 and params.lift.loss == "perceptual"
    distance_name, distance = perceptual.load(params.device) if has_distance else (None, None)
    if has_distance:
        print(f"perceptual distance: {distance_name}", flush=True)
    if params.sds.is_on and params.sds.max_angle < 180:
        print(describe_sds_views(params.sds, initial.means[masked], views, references), flush=True)
    with memory.explain_oom(MEMORY_PARAM, params.memory_gb):
        if prior is not None:
            prior = memory.fit_to_memory(prior, params.memory_gb, MEMORY_PARAM, memory.encode_one_sample)
        inputs = TermInputs(views, references, initial.means[masked], prior, text, estimator, distance)
        distill_for = lambda folder, steps: distill(
            initial, masked, inputs, params.changed({"iterations": steps}), folder
        )
        elapsed = lambda: time.monotonic() - began
        steps = trace.steps_within_budget(out, params.iterations, params.seconds, elapsed, distill_for)
        gaussians, masked = distill_for(out, steps)
    save_ply(out / "gaussians.ply", gaussians.map(lambda p: p.cpu()))
    save_labels(out / "labels.npy", masked.cpu())
    inpainter = load_json(lift / "facts.json")["inpainter"] if lift else None
    save_json(out / "facts.json", {"inpainter": inpainter, "perceptual": distance_name})
    trace.clear_checkpoint(out)

"""Faults planted in the code, each with the case that must catch it: what the suite is worth.

A fault is an edit of one function's source, put into its module while the case runs.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from textwrap import dedent
from typing import NamedTuple

from benchmarks.stability import all_cases, run


class Fault(NamedTuple):
    """What is wrong, where, the text that is changed and into what, and the case that catches it."""

    name: str
    module: str
    function: str
    right: str
    wrong: str
    caught_by: str


FAULTS = (
    Fault("a sign in the gradient", "reffusion.splat.cpu", "_to_parameters",
          "return [array[:count] for array in out]", "return [-out[0][:count], *(array[:count] for array in out[1:])]",
          "scales 1 of the extent"),
    Fault("a wrong order of equal depths", "reffusion.splat.cpu", "project_and_bin",
          "order = binning.depth_order(radii[:count], drawn)",
          "order = binning.depth_order(radii[:count], drawn)[::-1].copy()", "equal depths, drawn by index"),
    Fault("a dropped clamp of the Jacobian", "reffusion.splat.cpu", "project_and_bin",
          "numbers = (array.reshape(-1) for array in parameters), view_numbers(camera, antialiased)",
          "numbers = (array.reshape(-1) for array in parameters), view_numbers(camera, antialiased) + "
          "1e9 * np.repeat([0, -1, 1, -1, 1, 0], [16, 1, 1, 1, 1, 3])", "needles from 1e4 extents away"),
    Fault("squares that underflow", "reffusion.gaussians.densify", "rotate",
          "quaternions.abs().amax(1, keepdim=True).clamp_min(torch.finfo(quaternions.dtype).tiny)", "1.0",
          "quaternions of length 1e-20, splitting"),
    Fault("an alignment that is not centred", "reffusion.depth.alignment", "_weighted_line",
          "x_mean, y_mean = (w @ x) / total, (w @ y) / total", "x_mean, y_mean = 0.0, 0.0",
          "alignment, four pixels"),
    Fault("no consensus before the reweighting", "reffusion.depth.alignment", "_robust_line",
          "_consensus(x, y, w, draws) or (plain, 1.0)", "(plain, 1.0)", "alignment, 90% outliers"),
    Fault("an unsafe logarithm in PSNR", "reffusion.score.metrics", "psnr",
          "-10.0 * log10(error) if error > 0 else inf", "-10.0 * log10(error)", "metrics of identical images"),
    Fault("an unsafe logarithm in the critic's loss", "reffusion.distill.discriminator", "critic_loss",
          "-F.logsigmoid(real).mean() - F.logsigmoid(-fake).mean()",
          "-torch.log(torch.sigmoid(real)).mean() - torch.log(torch.sigmoid(-fake)).mean()",
          "discriminator logits +-1e4, critic"),
    Fault("a mean over nothing where a mask is empty", "reffusion.distill.sds", "unfaded",
          "mask.sum((2, 3), keepdim=True).clamp(min=1)", "mask.sum((2, 3), keepdim=True)", "mask empty, gradient"),
    Fault("1 - alpha bar in half precision", "reffusion.distill.sds", "sds_gradient",
          "alpha_bar = alphas_cumprod[timesteps]", "alpha_bar = alphas_cumprod.to(latents)[timesteps]",
          "timestep 0, half precision, score distillation"),
    Fault("guidance of a instead of 1 + a", "reffusion.prior.diffusion", "guided",
          "return (1 + guidance) * eps", "return guidance * eps", "guidance 100, equal prompts"),
    Fault("a tie that masks", "reffusion.masks.voting", "label_gaussians",
          "votes.masked > tau * votes.unmasked", "votes.masked >= tau * votes.unmasked", "masks contradicting"),
    Fault("a completion that is not about a plane", "reffusion.depth.completion", "_complete_region",
          "plane = fit_plane(disparity, known * confidence)", "plane = np.zeros_like(disparity)",
          "completion, hole over three borders"),
    Fault("a missing epsilon where no confidence reaches", "reffusion.depth.bilateral", "system_of",
          "unreached = 1e-9 * mass", "unreached = 0.0 * mass", "solver, two known pixels"),
    Fault("an offset that is taken off twice", "reffusion.capture.frame", "normalise_pose",
          "similarity.offset + world_to_camera", "similarity.offset - world_to_camera",
          "offset 1e6 of the extent, normalised"),
    Fault("positions of an export in float32 always", "reffusion.io.ply", "save_ply",
          '"f8" if rounding * similarity.scale > 1e-5 else "f4"', '"f4"',
          "offset 1e6 of the extent, exported positions"),
    Fault("a gradient that nobody looks at", "reffusion.gaussians.optimize", "step",
          "not torch.isfinite(gradient.sum())", "False", "gradients that are not numbers"),
)  # fmt: skip


@contextmanager
def planted(fault: Fault) -> Iterator[None]:
    """The function with the fault in its place, while in the context; ValueError where the text is not there."""
    module = import_module(fault.module)
    owner = module if hasattr(module, fault.function) else module.GaussianOptimizer
    before = getattr(owner, fault.function)
    source = dedent(inspect.getsource(before))
    if source.count(fault.right) != 1:
        raise ValueError(f"{fault.module}.{fault.function} holds {source.count(fault.right)} times: {fault.right}")
    names = dict(before.__globals__)
    edited = "from __future__ import annotations\n" + source.replace(fault.right, fault.wrong)
    exec(compile(edited, "<fault>", "exec"), names)
    right = before.__code__
    before.__code__ = names[fault.function].__code__  # the function itself, for who imported it by name
    try:
        yield
    finally:
        before.__code__ = right


def caught(fault: Fault) -> bool:
    """Whether the case is out of its bound, or raises, with the fault.

    Raises:
        ValueError: it is out of bound without any fault.
        NameError, TypeError, AttributeError: the fault is not one of numbers, but broken code.
    """
    (case,) = (case for case in all_cases() if case.name == fault.caught_by)
    if not run(case).ok:
        raise ValueError(f"case {case.name!r} is out of bound without any fault")
    with planted(fault):
        try:
            return not case.measure() <= case.bound
        except (NameError, TypeError, AttributeError):
            raise
        except Exception:
            return True

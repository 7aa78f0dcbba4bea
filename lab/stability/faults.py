"""Deliberate faults in the code, each with the case that must detect it: a test of the stability suite itself.

A fault is a wrong version of a function. While the case runs, it replaces the correct function in all modules that
imported it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from importlib import import_module
from math import log10
from types import ModuleType
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import torch
import torch.nn.functional as F

from lab.stability import all_cases, run
from reffusion.depth.alignment import Alignment


class Fault(NamedTuple):
    """Deliberate fault.

    Attributes:
        name: description of the fault.
        module: module of the replaced function (or constant).
        function: name of the replaced function (or constant).
        wrong: returns the faulty version, given the correct one.
        caught_by: name of the case that must detect the fault.
    """

    name: str
    module: str
    function: str
    wrong: Callable[[Any], Any]
    caught_by: str


def fold_filter_naively(log_scales: np.ndarray, logits: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fold Mip-Splatting's 3D filter into scales and opacities by the formulas as printed in its paper.

    The exponentials overflow, and the quotient of products loses digits. The arguments are those of `fold_filter`.
    """
    with np.errstate(all="ignore"):
        squares = np.exp(2 * np.asarray(log_scales, np.float64))
        widened = squares + np.asarray(sizes, np.float64)[:, None] ** 2
        opacity = np.sqrt(squares.prod(1) / widened.prod(1)) / (1 + np.exp(-np.asarray(logits, np.float64)))
        return np.log(widened) / 2, np.log(opacity / (1 - opacity))


def change_result(change: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a value for `Fault.wrong`: it maps a function to one that returns `change` of the function's result."""
    return lambda right: lambda *arguments: change(right(*arguments))


def log_of_sigmoid(real: torch.Tensor, fake: torch.Tensor) -> torch.Tensor:
    """Return the critic's loss by logarithms of sigmoids, which are infinite for large scores."""
    return -torch.log(torch.sigmoid(real)).mean() - torch.log(torch.sigmoid(-fake)).mean()


FAULTS = (
    Fault("a sign in the gradient", "reffusion.splat.cpu", "_to_parameters",
          change_result(lambda gradients: [-gradients[0], *gradients[1:]]), "scales 1 of the extent"),
    Fault("a wrong order of depths", "reffusion.splat.binning", "depth_order",
          change_result(lambda order: order[::-1].copy()), "equal depths, drawn by index"),
    Fault("a dropped clamp of the Jacobian", "reffusion.splat.projection", "view_numbers",
          change_result(lambda numbers: np.r_[numbers[:16], -1e9, 1e9, -1e9, 1e9, numbers[20:]]),
          "needles from 1e4 extents away"),
    Fault("squares that underflow", "reffusion.gaussians.densify", "unit", lambda right: partial(F.normalize, dim=1),
          "quaternions of length 1e-20, splitting"),
    Fault("an alignment that is not centred", "reffusion.depth.alignment", "_weighted_line",
          lambda right: lambda x, y, w: Alignment((w @ (x * y)) / (w @ x**2), 0.0, 0.0), "alignment, four pixels"),
    Fault("no consensus before the reweighting", "reffusion.depth.alignment", "_consensus",
          lambda right: lambda x, y, w, draws: None, "alignment, 90% outliers"),
    Fault("an unsafe logarithm in PSNR", "reffusion.metrics.image_metrics", "psnr",
          change_result(lambda decibels: -10 * log10(10 ** (-decibels / 10))), "metrics of identical images"),
    Fault("an unsafe logarithm in the critic's loss", "reffusion.distill.discriminator", "critic_loss",
          lambda right: log_of_sigmoid, "discriminator logits +-1e4, critic"),
    Fault("a mean over nothing where a mask is empty", "reffusion.distill.sds", "match_contrast",
          lambda right: lambda x0, latents, mask: right(x0, latents, mask) * (mask.sum() / mask.sum()),
          "mask empty, gradient"),
    Fault("1 - alpha bar in half precision", "reffusion.distill.sds", "sds_gradient",
          lambda right: lambda z, denoise, t, noise, alphas, weighting: right(
              z, denoise, t, noise, alphas.to(z), weighting=weighting),
          "timestep 0, half precision, score distillation"),
    Fault("guidance of a instead of 1 + a", "reffusion.prior.diffusion", "predict_with_guidance",
          lambda right: lambda *arguments: (right(*arguments)[0] - right(*arguments[:-1], 0)[0], right(*arguments)[1]),
          "guidance 100, equal prompts"),
    Fault("a tie that masks", "reffusion.masks.voting", "label_gaussians",
          lambda right: lambda votes, tau=1.0: votes.masked >= tau * votes.unmasked, "masks contradicting"),
    Fault("a completion that is not about a plane", "reffusion.depth.planes", "fit_plane",
          lambda right: lambda disparity, weights: np.zeros_like(disparity), "completion, hole over three borders"),
    Fault("a missing epsilon where no confidence reaches", "reffusion.depth.bilateral", "UNREACHED", lambda right: 0.0,
          "solver, two known pixels"),
    Fault("an offset that is added, not taken off", "reffusion.capture.normalized_frame", "normalize_pose",
          lambda right: lambda pose, similarity: right(pose, replace(similarity, offset=-similarity.offset)),
          "offset 1e6 of the extent, normalised"),
    Fault("positions of an export in float32 always", "reffusion.io.ply", "save_vertices",
          lambda right: lambda path, table, comments: right(
              path, table.astype([(name, "f4") for name in table.dtype.names]), comments),
          "offset 1e6 of the extent, exported positions"),
    Fault("a 3D filter folded in without logarithms", "reffusion.io.splat_rows", "fold_filter",
          lambda right: fold_filter_naively, "filter_3D, sizes from 0 to 1e8, scales e-40 to e40"),
    Fault("a gradient that nobody looks at", "reffusion.gaussians.optimize", "refuse_not_finite",
          lambda right: lambda gradients: None, "gradients that are not numbers"),
)  # fmt: skip


@contextmanager
def plant(fault: Fault) -> Iterator[None]:
    """Replace the correct function by the fault, under every name in every loaded module, within the context.

    A module that is loaded for the first time within the context would keep the fault, so the case must run once
    before. A compiled kernel keeps the functions with which it was compiled, so no fault may be inside a kernel.
    """
    right = getattr(import_module(fault.module), fault.function)
    wrong = fault.wrong(right)
    modules = [module for module in list(sys.modules.values()) if isinstance(module, ModuleType)]
    places = [(module, name) for module in modules for name, value in vars(module).items() if value is right]
    with ExitStack() as put_back:
        for module, name in places:
            put_back.enter_context(patch.object(module, name, wrong))
        yield


def is_caught(fault: Fault) -> bool:
    """Return True if a fault's case, run with the fault, is out of its bound or raises an exception.

    Raises:
        ValueError: the case is out of its bound even without the fault.
        NameError, TypeError, AttributeError: the fault is broken code, while it should give wrong numbers.
    """
    (case,) = (case for case in all_cases() if case.name == fault.caught_by)
    if not run(case).ok:
        raise ValueError(f"case {case.name!r} is out of bound without any fault")
    with plant(fault):
        try:
            return not case.measure() <= case.bound
        except (NameError, TypeError, AttributeError):
            raise
        except Exception:
            return True

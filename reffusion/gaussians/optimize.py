"""The reconstruction loss, the paper's confinement of gradients, and Adam over a varying number of Gaussians.

The stages `fit` and `distill` share this module. *Masked* Gaussians are those with the label True: in `distill` the new
ones that fill the hole, in `fit` the ones whose positions are known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from reffusion.gaussians import adam
from reffusion.gaussians.ssim import dssim
from reffusion.types import PARAMETERS, Gaussians

OPACITY_CAP = 0.01  # opacity to which `cap_opacity` clamps, as in 3DGS
DSSIM_SHARE = 0.2  # share of D-SSIM in the reconstruction loss, as in 3DGS


def reconstruction_loss(image: Tensor, target: Tensor, weights: Tensor | None = None) -> Tensor:
    """Compute the photometric loss of 3DGS: 0.8 L1 + 0.2 D-SSIM, where D-SSIM = 1 - SSIM.

    PAPER leaves open: by what a masked loss is divided. Here it is divided by the number of all pixels, so that a pixel
    has the same influence in every view. The loss of a completely masked view is 0.

    Args:
        image, target: [H, W, C] in [0, 1]; the gradient reaches `image` only.
        weights: [H, W], bool or in [0, 1]; None: all 1. A pixel of weight 0 influences neither the value nor the
            gradient of any other pixel, and its own gradient is 0 (see `gaussians.ssim`).

    Returns:
        The loss, a scalar.
    """
    return (1 - DSSIM_SHARE) * _l1(image, target.detach(), weights) + DSSIM_SHARE * dssim(image, target, weights)


def _l1(image: Tensor, target: Tensor, weights: Tensor | None) -> Tensor:
    """Return the mean of weights * |image - target| over pixels and channels; a pixel of weight 0 may hold NaN."""
    difference = (image - target).abs()
    if weights is None:
        return difference.mean()
    weights = weights.to(image.dtype)[..., None]
    return torch.where(weights > 0, weights * difference, 0.0).mean()


def confine(gaussians: Gaussians, select: Tensor) -> Gaussians:
    """Return Gaussians of the same values, through which gradients reach only the selected ones of `gaussians`.

    Args:
        select: bool [N], True for the Gaussians whose parameters receive gradients. The gradients of all other
            Gaussians are exactly 0.
    """

    def confined(parameter: Tensor) -> Tensor:
        return torch.where(select.view(-1, *[1] * (parameter.ndim - 1)), parameter, parameter.detach())

    return gaussians.map(confined)


@dataclass(frozen=True)
class Rates:
    """Adam's learning rates for the parameters of Gaussians.

    The defaults are those of 3DGS, for the normalized frame, in which cameras are about 1 from the scene.

    Attributes:
        means: learning rate of positions at the start, in units of the frame; it decays exponentially to `means_last`.
        means_last: learning rate of positions at the end.
        quaternions, log_scales, opacity_logits: learning rates of the parameters of these names.
        sh_dc: learning rate of the constant spherical harmonic.
        sh_rest: learning rate of all other spherical harmonics.
    """

    means: float = 1.6e-4
    means_last: float = 1.6e-6
    quaternions: float = 1e-3
    log_scales: float = 5e-3
    opacity_logits: float = 0.05
    sh_dc: float = 2.5e-3
    sh_rest: float = 2.5e-3 / 20

    def in_units_of(self, unit: float) -> Rates:
        """Return these rates, with the rates of positions multiplied by `unit`, a length in the normalized frame."""
        return replace(self, means=unit * self.means, means_last=unit * self.means_last)

    def at(self, progress: float, gaussians: Gaussians) -> dict[str, Tensor]:
        """Return the learning rates of each parameter at one moment of the run.

        Args:
            progress: share of the run in [0, 1] that is done.
            gaussians: the Gaussians; only the number of their spherical harmonics matters.

        Returns:
            Parameter name -> [D], a learning rate for each of the D numbers that a Gaussian has of this parameter.
        """
        constant = lambda value, count: torch.full((count,), value)
        sh = constant(self.sh_rest, gaussians.sh.shape[1] * 3)
        sh[:3] = self.sh_dc
        return {
            "means": constant(self.means ** (1 - progress) * self.means_last**progress, 3),
            "quaternions": constant(self.quaternions, 4),
            "log_scales": constant(self.log_scales, 3),
            "opacity_logits": constant(self.opacity_logits, 1),
            "sh": sh,
        }


class GaussianOptimizer:
    """Adam over Gaussians that can be added and removed.

    Each Gaussian counts its own steps, so that one added later starts Adam anew, bias correction included. A step
    updates only visible Gaussians and their moments (as in Taming 3DGS), because a Gaussian that no pixel sees has no
    gradient to average.

    Attributes:
        gaussians: the N Gaussians; their parameters are leaf tensors that require gradients. `select` and `append`
            replace this object by a new one without gradients.
        masked: [N] bool, labels of the Gaussians; `select` and `append` update them.
        masked_factors: parameter name -> factor on the learning rates of masked Gaussians; 1 without an entry.
        grad2d_sum: [N], sum over views of the norm of each Gaussian's screen-space gradient (see `observe`), since the
            last `forget_grad2d`.
        grad2d_count: [N], number of views in this sum, those that rendered the Gaussian. `select` and `append` update
            both.
    """

    _COUNTERS = ("masked", "_steps", "grad2d_sum", "grad2d_count")

    def __init__(
        self,
        gaussians: Gaussians,
        masked: Tensor | None = None,
        rates: Rates | None = None,
        masked_factors: Mapping[str, float] | None = None,
        betas: tuple[float, float] = (0.9, 0.999),
        epsilon: float = 1e-15,
    ):
        """Start Adam with zero moments.

        Args:
            gaussians: the initial Gaussians, which are copied.
            masked: [N] bool, their labels; None: all False.
            rates: learning rates; None takes the defaults of `Rates`.
            masked_factors: see the class; None: no factors.
            betas: Adam's decay rates of the first and of the second moment.
            epsilon: added to the root of the second moment.
        """
        self.rates, self.betas, self.epsilon = rates or Rates(), betas, epsilon
        self.masked_factors = dict(masked_factors or {})
        self.masked = torch.zeros(len(gaussians), dtype=torch.bool) if masked is None else masked.clone()
        self.masked = self.masked.to(gaussians.means.device)
        self.gaussians = gaussians.map(_leaf)
        self._first = gaussians.map(_zeros)
        self._second = gaussians.map(_zeros)
        self._steps = torch.zeros(len(gaussians), dtype=torch.int32, device=self.masked.device)
        self._mean, self._meant = None, 0
        self.forget_grad2d()

    def observe(self, probe_gradient: Tensor, radii: Tensor, width: int, height: int) -> None:
        """Add the norms of the screen-space gradients of one view to `grad2d_sum`, from which `densify` takes means.

        3DGS measures in normalized device coordinates, where the image spans [-1, 1]: one unit is half the image. So
        gradients with respect to pixels are multiplied by `width / 2` and `height / 2`. Since the loss is a mean over
        pixels, the result depends neither on the size of the image nor on the size of the scene.

        Args:
            probe_gradient: [N, 2], d loss / d (2D mean in pixels), the gradient of the probe of `splat.render`.
            radii: [N], radii of the footprints; Gaussians of radius 0 were not rendered and do not count.
            width, height: size of the rendered image in pixels.
        """
        visible = radii > 0
        grad2d = torch.hypot(probe_gradient[:, 0] * (width / 2), probe_gradient[:, 1] * (height / 2))
        self.grad2d_sum += torch.where(visible, grad2d, 0.0)
        self.grad2d_count += visible

    def forget_grad2d(self) -> None:
        """Reset the accumulated screen-space gradients."""
        self.grad2d_sum = torch.zeros_like(self._steps, dtype=torch.float32)
        self.grad2d_count = torch.zeros_like(self._steps)

    def step(self, progress: float, visible: Tensor | None = None, sh_degree: int | None = None) -> None:
        """Take one Adam step with the gradients in `.grad` of the parameters, and clear these gradients.

        A parameter without a gradient stays unchanged.

        Args:
            progress: share of the run in [0, 1] that is done; sets the learning rate of the means.
            visible: [N] bool, True for the Gaussians to update, e.g. `rendering.radii > 0`; None updates all.
            sh_degree: the highest degree of spherical harmonics rendered so far; coefficients of higher degrees are not
                updated. None updates all coefficients.

        Raises:
            FloatingPointError: a gradient is NaN or infinite. The message names the parameter. Nothing has changed.
        """
        gradients = {name: getattr(self.gaussians, name).grad for name in PARAMETERS}
        refuse_not_finite(gradients)
        if not len(self.masked):
            return self.forget_gradients()
        if visible is None:
            visible = torch.ones_like(self.masked)
        self._steps += visible
        unbias = adam.unbiasing(self.betas, 1 + int(self._steps.max()) // 1024, self._steps.device)
        rates = self.rates.at(progress, self.gaussians)
        updates = []
        for name, gradient in gradients.items():
            if gradient is not None:
                parameter, first, second = (_rows(getattr(each, name)) for each in self._states())
                moving = rates[name] if name != "sh" or sh_degree is None else rates[name][: 3 * (sh_degree + 1) ** 2]
                factor = self.masked_factors.get(name, 1.0)
                updates.append(adam.Update(parameter, first, second, _rows(gradient), moving, factor))
        adam.fastest(self.masked.device)(updates, self._steps, visible, self.masked, *unbias, *self.betas, self.epsilon)
        self.forget_gradients()

    def _states(self) -> tuple[Gaussians, Gaussians, Gaussians]:
        """Return the Gaussians, and their first and second moments in the same form."""
        return self.gaussians, self._first, self._second

    def forget_gradients(self) -> None:
        """Clear the gradients of all parameters."""
        for name in PARAMETERS:
            getattr(self.gaussians, name).grad = None

    @torch.no_grad()
    def remember(self) -> None:
        """Include the current Gaussians in the running mean; `apply_mean` later replaces the Gaussians by this mean."""
        self._meant += 1
        if self._mean is None:
            self._mean = self.gaussians.map(lambda p: p.detach().clone())
        else:
            for name in PARAMETERS:
                getattr(self._mean, name).lerp_(getattr(self.gaussians, name), 1 / self._meant)

    @torch.no_grad()
    def apply_mean(self) -> None:
        """Replace the Gaussians by their running mean. Without a call of `remember` nothing changes.

        With one view per step Gaussians fluctuate around their optimum, and the mean of the iterates is closer to the
        optimum than the last iterate (Polyak, Ruppert).
        """
        if self._mean is not None:
            for name in PARAMETERS:
                getattr(self.gaussians, name).copy_(getattr(self._mean, name))

    def select(self, keep: Tensor) -> None:
        """Keep the chosen Gaussians and remove all other ones.

        Labels, step counts, moments, running mean and accumulated screen-space gradients are kept; `.grad` is not.

        Args:
            keep: [N] bool, True for the Gaussians to keep, or their indices [M] in the new order.
        """
        self._replace(lambda p: p[keep])
        self._mean = self._mean and self._mean.map(lambda p: p[keep])
        for name in self._COUNTERS:
            setattr(self, name, getattr(self, name)[keep])

    def append(self, gaussians: Gaussians, masked: Tensor) -> None:
        """Append M Gaussians, whose moments and step counts start at zero.

        The running mean (`remember`) and `.grad` are discarded. The new Gaussians come last.

        Args:
            masked: [M] bool, the labels of the new Gaussians, see `masked` of the class.
        """
        self._mean, self._meant = None, 0
        self.gaussians = self.gaussians.zip_map(gaussians, lambda a, b: _leaf(torch.cat([a, b])))
        empty = gaussians.map(_zeros)
        self._first = self._first.zip_map(empty, lambda a, b: torch.cat([a, b]))
        self._second = self._second.zip_map(empty, lambda a, b: torch.cat([a, b]))
        for name in self._COUNTERS:
            old = getattr(self, name)
            setattr(self, name, torch.cat([old, masked if name == "masked" else old.new_zeros(len(gaussians))]))

    def cap_opacity(self) -> None:
        """Clamp all opacities to at most `OPACITY_CAP`, the opacity reset of 3DGS.

        The opacities of Gaussians that the views need grow again in later steps. Adam's moments of the opacity are set
        to zero, because they belong to the former values.
        """
        with torch.no_grad():
            self.gaussians.opacity_logits.clamp_(max=float(np.log(OPACITY_CAP / (1 - OPACITY_CAP))))
            self._first.opacity_logits.zero_()
            self._second.opacity_logits.zero_()

    def state_dict(self) -> dict[str, Any]:
        """Return the state from which `load_state_dict` continues bit for bit."""
        parts = {"parameters": self.gaussians, "first": self._first, "second": self._second}
        parts |= {"mean": self._mean} if self._mean is not None else {}
        state: dict[str, Any] = {
            part: {name: getattr(g, name).detach().clone() for name in PARAMETERS} for part, g in parts.items()
        }
        return state | {name: getattr(self, name).clone() for name in self._COUNTERS} | {"meant": self._meant}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state that `state_dict` returned; it may have another number of Gaussians than the present one."""
        self.gaussians = Gaussians(**state["parameters"], antialiased=self.gaussians.antialiased).map(_leaf)
        self._first = Gaussians(**state["first"]).map(torch.clone)
        self._second = Gaussians(**state["second"]).map(torch.clone)
        self._mean = Gaussians(**state["mean"]).map(torch.clone) if "mean" in state else None
        self._meant = state["meant"]
        for name in self._COUNTERS:
            setattr(self, name, state[name].clone())

    def _replace(self, function) -> None:
        """Apply `function` to each parameter of the Gaussians and to its moments."""
        self.gaussians = self.gaussians.map(lambda p: _leaf(function(p)))
        self._first, self._second = self._first.map(function), self._second.map(function)


def refuse_not_finite(gradients: Mapping[str, Tensor | None]) -> None:
    """Raise FloatingPointError if a gradient is NaN or infinite; the message names the parameter.

    Args:
        gradients: parameter name -> gradient; None for a parameter without gradient, which passes.
    """
    # A sum is finite only if every term is, and needs no array of flags; all sums are checked at once.
    sums = {name: gradient.sum() for name, gradient in gradients.items() if gradient is not None}
    for name, finite in zip(sums, torch.isfinite(torch.stack([*sums.values()])).tolist() if sums else (), strict=True):
        if not finite:
            raise FloatingPointError(f"the gradient of the Gaussians' {name} is not finite")


def _leaf(parameter: Tensor) -> Tensor:
    """Return a contiguous copy that requires gradients."""
    return parameter.detach().clone().contiguous().requires_grad_()


def _zeros(parameter: Tensor) -> Tensor:
    return torch.zeros_like(parameter, requires_grad=False, memory_format=torch.contiguous_format)


def _rows(parameter: Tensor) -> Tensor:
    """Return a parameter [N, ...] as a table [N, D], one row per Gaussian, that shares its memory if contiguous."""
    return parameter.detach().contiguous().view(parameter.shape[0], -1)

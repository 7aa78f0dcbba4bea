"""The critic of the adversarial term and its optimizer (RefFusion section 4.3)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from reffusion import seeding
from reffusion.distill.discriminator import Critic, critic_loss, generator_loss, gradient_penalty
from reffusion.params.distill import AdversarialTerm

LEARNING_RATE = 1e-3  # PAPER leaves open: the critic's step size. This is GANeRF's, for RMSprop


class Adversary:
    """A critic and its optimizer. Patches are [P, 3, size, size] in [-1, 1].

    Args:
        choices: Parameters of the adversarial term, among them the size of patches.
        seed: Seed of the critic's initial weights.
        device: The device of the critic.
        rate: Step size of RMSprop.
    """

    def __init__(
        self, choices: AdversarialTerm, seed: int, device: torch.device | str = "cpu", rate: float = LEARNING_RATE
    ):
        self.choices = choices
        self.critic = Critic(choices.size, choices.width, seeding.generator(seed, "adversary")).to(device)
        self._optimizer = torch.optim.RMSprop(self.critic.parameters(), lr=rate)

    def train_step(self, real: Tensor, fake: Tensor) -> dict[str, float]:
        """Train the critic for one step. No gradient flows through the patches.

        Args:
            real: Patches of a reference.
            fake: Patches of a rendered view, as many as `real`.

        Returns:
            Values for the trace, of the critic before the step: "critic_loss", without the penalty, and, if the penalty
                is on, "critic_slope", which is the R1 penalty before its weight, i.e. the mean of ||dD / d patch||^2
                over the real or the fake patches, as `choices.penalized` says.

        Raises:
            FloatingPointError: The loss or its gradient is not finite. The critic's weights are unchanged.
            ValueError: The number of patches is not a multiple of 4.
        """
        patches = {"real": real.detach(), "fake": fake.detach()}
        side = self.choices.penalized
        patches[side] = patches[side].clone().requires_grad_(self.choices.penalty > 0)
        scores = {name: self.critic(each) for name, each in patches.items()}
        loss = critic_loss(scores["real"], scores["fake"])
        log, total = {"critic_loss": float(loss.detach())}, loss
        if self.choices.penalty > 0:
            slope = gradient_penalty(scores[side], patches[side])
            log["critic_slope"], total = float(slope.detach()), loss + 0.5 * self.choices.penalty * slope
        if not torch.isfinite(total):
            raise FloatingPointError(f"the critic's loss is {log}")
        self._optimizer.zero_grad()
        total.backward()
        for name, weights in self.critic.named_parameters():
            if not torch.isfinite(weights.grad.sum()):
                raise FloatingPointError(f"the gradient of the critic's {name} is not finite")
        self._optimizer.step()
        return log

    def generator_loss(self, fake: Tensor) -> Tensor:
        """Return the generator's loss, a scalar that is lower the more the critic takes the fake patches for real.

        The loss is differentiable in the patches. The critic's weights get no gradient.
        """
        self.critic.requires_grad_(False)
        scores = self.critic(fake)
        self.critic.requires_grad_(True)
        return generator_loss(scores, self.choices.form)

    def state_dict(self) -> dict[str, Any]:
        """Return the state from which `load_state_dict` continues, bit for bit."""
        return {"critic": self.critic.state_dict(), "optimizer": self._optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore critic and optimizer from what `state_dict` returned."""
        self.critic.load_state_dict(state["critic"])
        self._optimizer.load_state_dict(state["optimizer"])

"""The critic of the adversarial term with its optimizer (RefFusion section 4.3): training, judging, checkpoints."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from reffusion import seeding
from reffusion.distill.discriminator import Critic, critic_loss, generator_loss, gradient_penalty
from reffusion.params.distill import AdversarialTerm

LEARNING_RATE = 1e-3  # PAPER leaves open: the critic's step size; GANeRF's, of RMSprop


class Adversary:
    """A critic and its optimizer. Patches are [P, 3, size, size] in [-1, 1].

    Args:
        seed: of the critic's first weights.
        rate: RMSprop's step size.
    """

    def __init__(
        self, choices: AdversarialTerm, seed: int, device: torch.device | str = "cpu", rate: float = LEARNING_RATE
    ):
        self.choices = choices
        self.critic = Critic(choices.size, choices.width, seeding.generator(seed, "adversary")).to(device)
        self._optimizer = torch.optim.RMSprop(self.critic.parameters(), lr=rate)

    def train_step(self, real: Tensor, fake: Tensor) -> dict[str, float]:
        """Takes one step of the critic. No gradient reaches what the patches were made from.

        Returns:
            critic_loss, and critic_slope: the R1 penalty before its weight, the mean of ||dD / d patch||^2.
        Raises:
            FloatingPointError: the loss or its gradient is not finite; the critic is unchanged.
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
        """The loss of what the fake patches were made from, differentiable in them; no gradient for the critic."""
        self.critic.requires_grad_(False)
        scores = self.critic(fake)
        self.critic.requires_grad_(True)
        return generator_loss(scores, self.choices.form)

    def state_dict(self) -> dict[str, Any]:
        """The state from which `load_state_dict` continues, bit for bit."""
        return {"critic": self.critic.state_dict(), "optimizer": self._optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.critic.load_state_dict(state["critic"])
        self._optimizer.load_state_dict(state["optimizer"])

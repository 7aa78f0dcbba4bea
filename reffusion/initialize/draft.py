"""A scene under construction: the Gaussians that remain, and those that references added."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from reffusion.types import Gaussians


@dataclass(frozen=True)
class Draft:
    """The Gaussians of a scene that is being filled.

    Attributes:
        gaussians: N of them.
        is_new: bool [N], those that were added.
    """

    gaussians: Gaussians
    is_new: Tensor

    @classmethod
    def start(cls, remaining: Gaussians) -> Draft:
        """Nothing is added yet."""
        return cls(remaining, torch.zeros(len(remaining), dtype=torch.bool, device=remaining.means.device))

    @property
    def remaining(self) -> Gaussians:
        """The Gaussians that were not added."""
        return self.gaussians.map(lambda p: p[~self.is_new])

    def drop(self, dropped: Tensor) -> Draft:
        """Without the Gaussians `dropped`, bool [N]."""
        return Draft(self.gaussians.map(lambda p: p[~dropped]), self.is_new[~dropped])

    def add(self, added: Gaussians) -> Draft:
        """With new Gaussians at the end."""
        together = self.gaussians.zip_map(added, lambda a, b: torch.cat([a, b]))
        return Draft(together, torch.cat([self.is_new, self.is_new.new_ones(len(added))]))

"""The draft: the scene while `initialize` fills it.

A draft consists of the remaining Gaussians (the fitted scene without the object) and of the new Gaussians, which were
added to fill the hole.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from reffusion.types import Gaussians


@dataclass(frozen=True)
class Draft:
    """The Gaussians of a scene that is being filled.

    Attributes:
        gaussians: all N Gaussians, remaining and new ones.
        is_new: bool [N], True for the new Gaussians.
    """

    gaussians: Gaussians
    is_new: Tensor

    @classmethod
    def start(cls, remaining: Gaussians) -> Draft:
        """Return a draft that holds the remaining Gaussians and no new ones."""
        return cls(remaining, torch.zeros(len(remaining), dtype=torch.bool, device=remaining.means.device))

    @property
    def remaining(self) -> Gaussians:
        """The Gaussians of the draft that are not new."""
        return self.gaussians.map(lambda p: p[~self.is_new])

    def drop(self, dropped: Tensor) -> Draft:
        """Return the draft without the Gaussians at which `dropped`, bool [N], is True."""
        return Draft(self.gaussians.map(lambda p: p[~dropped]), self.is_new[~dropped])

    def add(self, added: Gaussians) -> Draft:
        """Return the draft with the Gaussians `added` appended, labelled as new."""
        together = self.gaussians.zip_map(added, lambda a, b: torch.cat([a, b]))
        return Draft(together, torch.cat([self.is_new, self.is_new.new_ones(len(added))]))

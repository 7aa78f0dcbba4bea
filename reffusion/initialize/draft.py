"""The draft: the scene while `initialize` fills it.

A draft consists of the remaining Gaussians (the fitted scene without the object) and of the new Gaussians, which were
added to fill the hole.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from reffusion.types import Gaussians

# Origins of Gaussians: the fit; a reference; an extra view, completed from patches; random Gaussians of an ablation.
REMAINING, REFERENCE, EXTRA_VIEW, RANDOM = range(4)


@dataclass(frozen=True)
class Draft:
    """The Gaussians of a scene that is being filled.

    Attributes:
        gaussians: all N Gaussians, remaining and new ones.
        origin: uint8 [N], REMAINING, or for the new Gaussians REFERENCE, EXTRA_VIEW or RANDOM.
    """

    gaussians: Gaussians
    origin: Tensor

    @classmethod
    def start(cls, remaining: Gaussians) -> Draft:
        """Return a draft that holds the remaining Gaussians and no new ones."""
        return cls(remaining, torch.zeros(len(remaining), dtype=torch.uint8, device=remaining.means.device))

    @property
    def is_new(self) -> Tensor:
        """bool [N], True for the new Gaussians."""
        return self.origin != REMAINING

    @property
    def remaining(self) -> Gaussians:
        """The Gaussians of the draft that are not new."""
        return self.gaussians.map(lambda p: p[~self.is_new])

    def drop(self, dropped: Tensor) -> Draft:
        """Return the draft without the Gaussians at which `dropped`, bool [N], is True."""
        return Draft(self.gaussians.map(lambda p: p[~dropped]), self.origin[~dropped])

    def add(self, added: Gaussians, origin: int) -> Draft:
        """Return the draft with new Gaussians appended, all of one origin: REFERENCE, EXTRA_VIEW or RANDOM."""
        together = self.gaussians.zip_map(added, lambda a, b: torch.cat([a, b]))
        return Draft(together, torch.cat([self.origin, self.origin.new_full((len(added),), origin)]))

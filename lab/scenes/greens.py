"""The texture of grass and leaves."""

from __future__ import annotations

import numpy as np

from lab.scenes.patterns import fbm, ramp

GREENS = (
    ((34, 58, 22), (74, 116, 40), (134, 168, 70)),
    ((40, 62, 34), (88, 120, 62), (160, 176, 96)),
    ((30, 66, 36), (60, 124, 58), (126, 176, 84)),
)


def foliage(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return a tileable texture of greens, [size, size, 3] float sRGB in [0, 1], with fine and coarse variations."""
    tone = 0.5 + 0.2 * fbm(rng, size, 64, 64, 2) + 0.1 * fbm(rng, size, 4, 4, 3)
    return ramp(np.clip(tone, 0, 1), *GREENS[rng.integers(len(GREENS))])

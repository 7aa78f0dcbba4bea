"""RefFusion: 3D scene inpainting with a reference-adapted diffusion model (Mirzaei et al., 2024)."""

import os

__version__ = "0.1.0"

# Torch's threads go on spinning for about a millisecond after each of its operations, and take the core from those that
# splat next: a step of `fit` on two cores took 48 ms instead of 31. Read when torch is loaded, so it stands here.
os.environ.setdefault("GOMP_SPINCOUNT", "30000")

"""RefFusion: 3D scene inpainting with a reference-adapted diffusion model (Mirzaei et al., 2024)."""

import os

__version__ = "0.2.0"

# Torch's OpenMP threads keep spinning for about a millisecond after each torch operation. They occupy the cores that
# the splatting kernels need next: a step of `fit` on two cores took 48 ms instead of 31. OpenMP reads this variable
# when torch is loaded, so the variable is set in this file, before any import of torch.
os.environ.setdefault("GOMP_SPINCOUNT", "30000")
# Matrices here are small. NumPy's threads, too, only spin: a fifth of the CPU seconds of `finish`.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

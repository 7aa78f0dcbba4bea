"""RefFusion: 3D scene inpainting with a reference-adapted diffusion model (Mirzaei et al., 2024)."""

__version__ = "0.1.0"
